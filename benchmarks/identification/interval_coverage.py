"""Coverage of the quick study's intervals: many seeds, each estimate compared with the truth.

    python -m benchmarks.identification.interval_coverage --reading hz --seeds 20 --out DIR
    python -m benchmarks.identification.interval_coverage --rows-14-to-21 --seeds 20 --out DIR

With --rows-14-to-21, trials that only other rows need are left out: a third of the time.
The truth of a run is what the same fits give on the same twin with all noise off. Seeds whose
results.json is in the folder already are not run again. See README.md for how to read the table.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from haselab.cli.study.study_run import execute
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.study.definition import builtin_study

PROCESSES = 2
NOT_PLAYED = ("pi_trials", "pid_trials", "extra_delay_trials", "saturating_trials")


@dataclass(frozen=True)
class Spread:
    """One result over all seeds.

    Args:
        key: its id.
        truth: mean over the seeds; a loop's truth depends on the controller that was found.
        mean: of the estimates.
        scatter: standard deviation of estimate minus truth over the seeds.
        claimed: median of the standard deviations that the fits claim.
        inside: seeds whose 95 % interval contains the truth.
        seeds: how many there are.
        worst: largest |estimate - truth| in claimed standard deviations.
    """

    key: str
    truth: float
    mean: float
    scatter: float
    claimed: float
    inside: int
    seeds: int
    worst: float

    @property
    def ratio(self) -> float:
        """Claimed over real spread about the truth: 1 is right, 0.5 too narrow, 10 too wide."""
        return self.claimed / self.scatter if self.scatter > 0.0 else float("inf")


def run_part(folder: Path, seed: int, reading: str) -> str:
    """The experiments of rows S14 to S21 in a quick study."""
    out = folder / f"seed-{seed}"
    if (out / "results.json").exists():
        return "there already"
    study = builtin_study(quick=True)
    fewer = study.steps.model_copy(update=dict.fromkeys(NOT_PLAYED, 0))
    study = study.model_copy(update={"steps": fewer})
    config = twin_of_reading(reading)
    rig = guard(make_twin(config, seed), Safety(SafetySettings()))
    arm_simulated(rig)
    with contextlib.redirect_stdout(io.StringIO()):
        execute(study, rig, config, seed, out, "none", as_json=True, physical_model=True)
    keep_results(out)
    return "done"


def keep_results(out: Path) -> None:
    """Remove the large files of a run."""
    for path in (*out.glob("session.h5"), *out.glob("report.html"), *out.glob("analysis.json")):
        path.unlink()
    for part in ("video", "figures", "firmware"):
        shutil.rmtree(out / part, ignore_errors=True)


def run_seed(folder: Path, seed: int, options: list[str]) -> str:
    """One quick study; of its folder results.json stays."""
    out = folder / f"seed-{seed}"
    if (out / "results.json").exists():
        return "there already"
    command = [sys.executable, "-m", "haselab.cli", "reproduce", "--quick", "--json", *options]
    command += ["--keep-video", "none", "--seed", str(seed), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        return done.stderr.strip().splitlines()[-1] if done.stderr else "failed"
    keep_results(out)
    return "done"


def collect(folder: Path) -> tuple[list[Spread], dict[str, list[float]]]:
    """Spread of every id with a truth; errors in standard deviations by id."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("seed-*/results.json")):
        for row in json.loads(path.read_text())["quantities"]:
            if "noise_free" in row:
                rows.setdefault(row["id"], []).append(row)
    return [spread_of(key, found) for key, found in rows.items()], {
        key: [_error(row) for row in found] for key, found in rows.items()
    }


def _error(row: dict[str, Any]) -> float:
    """Estimate minus truth in claimed standard deviations."""
    off, std = row["measured"]["value"] - row["noise_free"], row["measured"]["std"]
    if off == 0.0:
        return 0.0
    return off / std if std else float("inf")


def spread_of(key: str, rows: list[dict[str, Any]]) -> Spread:
    value = np.array([row["measured"]["value"] for row in rows])
    truth = np.array([row["noise_free"] for row in rows])
    std = np.array([row["measured"]["std"] or 0.0 for row in rows], dtype=float)
    low, high = np.array([row["measured"]["ci95"] for row in rows], dtype=float).T
    return Spread(
        key,
        float(truth.mean()),
        float(value.mean()),
        float(np.sqrt(np.mean((value - truth) ** 2))),
        float(np.median(std)),
        int(((low <= truth) & (truth <= high)).sum()),
        len(rows),
        max(abs(_error(row)) for row in rows),
    )


def table(spreads: list[Spread], errors: dict[str, list[float]]) -> str:
    head = (
        f"{'id':22s} {'truth':>12s} {'mean':>12s} {'rms error':>10s} {'claimed':>10s} "
        f"{'claimed/rms':>11s} {'inside':>7s} {'worst z':>8s}"
    )
    lines = [head]
    for s in spreads:
        lines.append(
            f"{s.key:22s} {s.truth:12.6g} {s.mean:12.6g} {s.scatter:10.3g} {s.claimed:10.3g} "
            f"{s.ratio:11.2f} {s.inside:3d}/{s.seeds:<3d} {s.worst:8.2f}"
        )
    pairs = sum(s.seeds for s in spreads)
    inside = sum(s.inside for s in spreads)
    far = [(key, z) for key, zs in errors.items() for z in zs if not abs(z) <= 4.0]
    lines.append(f"\n{pairs} pairs of id and seed: {100.0 * inside / max(pairs, 1):.1f} % inside "
                 f"the 95 % interval; {len(far)} farther than 4 standard deviations.")  # fmt: skip
    lines += [f"  {key}: {z:+.1f}" for key, z in far]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reading", choices=["rad", "hz"], default="hz")
    parser.add_argument("--twin", type=Path, help="TWIN.toml: another bench")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--rows-14-to-21", action="store_true", help="leave other trials out")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    options = ["--twin", str(given.twin)] if given.twin else ["--reading", given.reading]
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    given.out.mkdir(parents=True, exist_ok=True)
    for seed in seeds if given.rows_14_to_21 else ():
        print(f"seed {seed}: {run_part(given.out, seed, given.reading)}", flush=True)
    with ThreadPoolExecutor(PROCESSES) as pool:
        whole = () if given.rows_14_to_21 else seeds
        jobs = pool.map(lambda seed: run_seed(given.out, seed, options), whole)
        for seed, message in zip(whole, jobs, strict=True):
            print(f"seed {seed}: {message}", file=sys.stderr, flush=True)
    print(table(*collect(given.out)))


if __name__ == "__main__":
    main()
