"""Stability of random loops by encirclement against the poles of the closed loop.

    python benchmarks/identify_margins.py [--loops 10000]

The loops and the independent counts are those of tests/control/test_encirclement.py.
"""

import argparse
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from rows import Row

LOOPS = 10_000
KINDS = ("continuous", "delayed", "sampled")


def counts() -> ModuleType:
    path = Path(__file__).parents[1] / "tests" / "control" / "test_encirclement.py"
    spec = importlib.util.spec_from_file_location("encirclement_counts", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(loops: int = LOOPS) -> Iterator[Row]:
    module = counts()
    for kind in KINDS:
        told = [module.agrees(kind, seed) for seed in range(loops // len(KINDS))]
        wrong = [seed for seed, same in enumerate(told) if same is False]
        near = sum(same is None for same in told)
        note = f"{near} too near the axis; seeds {wrong[:5]}" if wrong else f"{near} too near"
        yield Row(f"margins, {kind} loops: wrong", len(wrong), f"of {len(told)}", 0.0, False, note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=LOOPS)
    for row in rows(parser.parse_args().loops):
        print(row, flush=True)


if __name__ == "__main__":
    main()
