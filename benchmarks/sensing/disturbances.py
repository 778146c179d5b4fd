"""Disturbed records: is each number right within its stated deviation, or refused?

    python -m benchmarks.sensing.disturbances [--blocks 200] [--seeds 5] [--only TEXT]

Each case of `disturbance_cases.py` is sensed as by `haselab sense`, only carrier and rate stated.
The bound is Cramer-Rao's for the noise and the converter's step alone, without the drive's
own unknowns, which makes it stricter than the bound of the stated model.
"""

import argparse
import os
import time
from collections import Counter
from dataclasses import dataclass

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # as the commands set them

import numpy as np

from benchmarks.rows import Row
from benchmarks.sensing.disturbance_cases import CASES, Case
from haselab.sensing import Lockin

FAR = 5.0  # stated deviations
MOST_FAR = 1e-3  # share of the valid blocks
STATED = (0.8, 1.25)
MOST_OVER_BOUND = 1.15
REFUSED = 0.5  # share of blocks from which on a case counts as refused


@dataclass(frozen=True)
class Line:
    """One case: figures over all its seeds."""

    case: Case
    over_bound: float
    stated: float
    valid: float
    far: float
    message: str
    named: bool
    us: float

    @property
    def refused(self) -> bool:
        return self.valid < REFUSED

    @property
    def calibrated(self) -> bool:
        return self.refused or STATED[0] <= self.stated <= STATED[1]

    @property
    def close(self) -> bool:
        return not self.refused and self.over_bound <= MOST_OVER_BOUND

    def __str__(self) -> str:
        marks = "".join(
            mark
            for mark, bad in (
                ("F", self.far > MOST_FAR),
                ("S", not self.calibrated),
                ("R", not self.refused and not self.close),
                ("N", not self.named),
            )
            if bad
        )
        return (
            f"{self.case.name:36s}{self.over_bound:8.2f}{self.stated:8.2f}{100 * self.valid:7.1f}"
            f"{100 * self.far:7.2f}{self.us:7.1f}  {marks:4s} {self.message}"
        )


HEAD = (
    f"{'case':36s}{'rms/CRB':>8s}{'stated':>8s}{'valid%':>7s}{'>5s %':>7s}{'us':>7s}  "
    "F far off, S stated, R above the bound, N cause not named"
)


def evaluate(case: Case, blocks: int, seeds: int) -> Line:
    errors, stated, valid, spent = [], [], [], []
    messages: Counter[str] = Counter()
    for seed in range(seeds):
        readings, truth_f = case.record(blocks, seed)
        lockin = Lockin(case.scene.config())
        lockin.sense(readings)
        start = time.process_time()
        sensed = lockin.sense(readings)
        spent.append((time.process_time() - start) / blocks)
        errors.append(sensed.capacitance_f / truth_f - 1.0)
        stated.append(sensed.capacitance_std_f / truth_f)
        valid.append(sensed.valid)
        messages.update(texts_of(sensed))
    error, std, ok = np.concatenate(errors), np.concatenate(stated), np.concatenate(valid)
    rms = float(np.sqrt(np.mean(error[ok] ** 2))) if ok.any() else float("nan")
    spread = float(np.sqrt(np.mean(std[ok] ** 2))) if ok.any() else float("nan")
    far = float(np.mean(np.abs(error[ok]) > FAR * std[ok])) if ok.any() else 0.0
    refused = {text: count for text, count in messages.items() if text.startswith("not valid")}
    named = all(
        any(word in text for word in case.words)
        for text, count in refused.items()
        if count > 0.01 * ok.size
    )
    return Line(
        case, rms / case.scene.bound, spread / rms, float(ok.mean()), far,
        "; ".join(f"{count} {text}" for text, count in messages.most_common(2)), named,
        1e6 * float(np.median(spent)),
    )  # fmt: skip


def texts_of(sensed) -> list[str]:  # type: ignore[no-untyped-def]
    """The model of each valid block, the reason of each other one."""
    texts = []
    for k, ok in enumerate(sensed.valid.tolist()):
        texts.append(sensed.model(k) if ok else f"not valid: {sensed.reason_of(k)}")
    return texts


def rows(blocks: int = 200, seeds: int = 5) -> list[Row]:
    """Print a line per case; return the goals."""
    print(HEAD)
    lines = []
    for case in CASES:
        lines.append(evaluate(case, blocks, seeds))
        print(lines[-1], flush=True)
    count = float(len(lines))
    refused = sum(line.refused for line in lines)
    return [
        Row("disturbed records", count, "", 30.0),
        Row("   worst share beyond 5 stated std", max(line.far for line in lines), "", 1e-3, False),
        Row("   stated over true within 0.8 to 1.25", sum(x.calibrated for x in lines), "cases",
            27.0, note=f"{refused} of them refused"),
        Row("   rms at most 1.15 of the bound", sum(x.close for x in lines), "cases", 25.0),
        Row("   cause named", sum(x.named for x in lines), "cases", count),
        Row("   slowest case", max(x.us for x in lines), "us a block", 50.0, False),
        Row("   plain case", lines[0].us, "us a block", 5.0, False),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--blocks", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", default="", help="part of the cases' names")
    options = parser.parse_args()
    if not options.only:
        for row in rows(options.blocks, options.seeds):
            print(row)
        return
    print(HEAD)
    for case in CASES:
        if options.only in case.name:
            print(evaluate(case, options.blocks, options.seeds), flush=True)


if __name__ == "__main__":
    main()
