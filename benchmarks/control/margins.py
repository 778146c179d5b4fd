"""Stability of random loops by encirclement against the poles of the closed loop.

    python -m benchmarks.control.margins [--loops 10000]

The loops and the independent counts are those of tests/control/test_encirclement.py.
"""

import argparse
import importlib.util
from collections.abc import Iterator
from types import ModuleType

from benchmarks.rows import CHECKOUT, Row

LOOPS = 10_000
KINDS = ("continuous", "delayed", "sampled")


def counts() -> ModuleType:
    path = CHECKOUT / "tests" / "control" / "test_encirclement.py"
    spec = importlib.util.spec_from_file_location("encirclement_counts", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(loops: int = LOOPS) -> Iterator[Row]:
    module = counts()
    for kind in KINDS:
        agreements = [module.agrees(kind, seed) for seed in range(loops // len(KINDS))]
        wrong = [seed for seed, same in enumerate(agreements) if same is False]
        near = sum(same is None for same in agreements)
        note = f"{near} too near the axis; seeds {wrong[:5]}" if wrong else f"{near} too near"
        yield Row(
            f"margins, {kind} loops: wrong", len(wrong), f"of {len(agreements)}", 0.0, False, note
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=LOOPS)
    for row in rows(parser.parse_args().loops):
        print(row, flush=True)


if __name__ == "__main__":
    main()
