"""The fault campaign as a table: `python benchmarks/fault_table.py > table.md`."""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from pathlib import Path
from typing import Any

PATH = Path(__file__).resolve().parents[1] / "tests" / "faults" / "campaign.py"


def load() -> Any:
    spec = importlib.util.spec_from_file_location("fault_campaign", PATH)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fault_campaign"] = module
    spec.loader.exec_module(module)
    return module


def main() -> None:
    campaign = load()
    moments = campaign.MOMENTS
    found: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as root, campaign.Programs() as programs:
        for k, (fault, moment) in enumerate(campaign.cases()):
            run = programs.outside if fault in campaign.SIGNALS else campaign.inside
            found.setdefault(fault, {})[moment] = run(Path(root) / str(k), fault, moment)
    print(f"| fault | {' | '.join(moments)} | reason recorded | blocks lost |")
    print("|---" * (len(moments) + 3) + "|")
    for fault, outcomes in found.items():
        cells = [
            f"{1e3 * outcomes[moment].after_s:.0f} ms" if moment in outcomes else ""
            for moment in moments
        ]
        words = (campaign.SIGNALS.get(fault) or campaign.FAULTS[fault][1:])[0] or "put right"
        lost = sum(max(0, o.acknowledged - o.readable) for o in outcomes.values())
        print(f"| {fault} | {' | '.join(cells)} | {words} | {lost} |")
    count = sum(len(outcomes) for outcomes in found.values())
    worst = max(o.output_v for outcomes in found.values() for o in outcomes.values())
    print(f"\n{count} faults; highest output afterwards {worst:.1f} V.")


if __name__ == "__main__":
    main()
