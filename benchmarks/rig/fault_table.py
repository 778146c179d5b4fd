"""The fault campaigns as tables: `python -m benchmarks.rig.fault_table [twin] [wire] [replay]`."""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "tests" / "faults"


def load(name: str) -> Any:
    key = f"fault_{name}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, FOLDER / f"{name}.py")
        assert spec is not None and spec.loader is not None
        sys.modules[key] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[key])
    return sys.modules[key]


def table(
    cases: Iterable[tuple[str, str]],
    run: Callable[[Path, str, str], Any],
    words: Callable[[str], str],
    root: Path,
) -> None:
    """One row a fault, one column a moment."""
    campaign = load("campaign")
    moments = [*campaign.MOMENTS, *(s for s in campaign.STAGES if s not in campaign.MOMENTS)]
    found: dict[str, dict[str, Any]] = {}
    for k, (fault, moment) in enumerate(cases):
        found.setdefault(fault, {})[moment] = run(root / str(k), fault, moment)
    print(f"| fault | {' | '.join(moments)} | reason recorded | blocks lost |")
    print("|---" * (len(moments) + 3) + "|")
    for fault, outcomes in found.items():
        cells = [
            f"{1e3 * outcomes[moment].after_s:.0f} ms" if moment in outcomes else ""
            for moment in moments
        ]
        lost = sum(max(0, o.acknowledged - o.readable) for o in outcomes.values())
        print(f"| {fault} | {' | '.join(cells)} | {words(fault) or 'put right'} | {lost} |")
    count = sum(len(outcomes) for outcomes in found.values())
    worst = max(o.output_v for outcomes in found.values() for o in outcomes.values())
    print(f"\n{count} faults; highest output afterwards {worst:.1f} V.\n")


def on_the_twin(root: Path) -> None:
    campaign = load("campaign")

    table(campaign.cases(), campaign.inside, lambda fault: campaign.FAULTS[fault][1], root)


def on_the_wire(root: Path) -> None:
    wire = load("wire_campaign")

    def words(fault: str) -> str:
        return str(wire.SIGNALS[fault][0] if fault in wire.SIGNALS else wire.FAULTS[fault].words)

    with wire.links.Forks(FOLDER / "wire_campaign.py", root / "socket") as forks:
        table(
            wire.cases(),
            lambda folder, fault, moment: (wire.outside if fault in wire.SIGNALS else wire.inside)(
                folder, fault, moment, forks
            ),
            words,
            root,
        )


def on_a_replay(root: Path) -> None:
    load("campaign")
    replay = load("replay_campaign")
    recorded = replay.record(root / "recorded")
    cases = ((fault, moment) for fault, (_, _, at) in replay.FAULTS.items() for moment in at)
    table(
        cases,
        lambda folder, fault, moment: replay.inside(recorded, folder, fault, moment),
        lambda fault: replay.FAULTS[fault][1],
        root,
    )


def main() -> None:
    tables = {"twin": on_the_twin, "wire": on_the_wire, "replay": on_a_replay}
    for name in sys.argv[1:] or tables:
        with tempfile.TemporaryDirectory() as root:
            tables[name](Path(root))


if __name__ == "__main__":
    main()
