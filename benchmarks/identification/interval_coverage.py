"""Coverage of the quick study's intervals: many seeds, each estimate compared with the truth.

    python -m benchmarks.identification.interval_coverage --reading hz --seeds 20 --out DIR
    python -m benchmarks.identification.interval_coverage --rows-14-to-21 --seeds 20 --out DIR
    python -m benchmarks.identification.interval_coverage --replay --seeds 20 --out DIR

With --rows-14-to-21, trials that only other rows need are left out: a third of the time. With
--replay, the same study is then played on the twin of the actuator that each seed identified, and
its results are compared with the recorded ones.
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
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.rig.twin.twin_file import load_twin
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.study.definition import builtin_study

PROCESSES = 2
REPLAY_SEED = 1000
Z95 = 1.96
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


def run_part(out: Path, seed: int, config: TwinConfig, baseline_v: float | None = None) -> str:
    """The experiments of rows S14 to S21 in a quick study; None: at the baseline that it finds."""
    if (out / "results.json").exists():
        return "there already"
    study = builtin_study(quick=True)
    fewer = study.steps.model_copy(update=dict.fromkeys(NOT_PLAYED, 0))
    point = study.operating_point.model_copy(update={"baseline_v": baseline_v})
    study = study.model_copy(update={"steps": fewer, "operating_point": point})
    rig = guard(make_twin(config, seed), Safety(SafetySettings()))
    arm_simulated(rig)
    with contextlib.redirect_stdout(io.StringIO()):
        execute(study, rig, config, seed, out, "none", as_json=True, physical_model=True)
    keep_results(out)
    return "done"


def replay(folder: Path, seed: int) -> str:
    """The same experiments at the same baseline on the twin of the actuator of a seed."""
    recorded = folder / f"seed-{seed}"
    config = load_twin(recorded / "actuator.toml")
    baseline_v = _quantities(recorded / "results.json")["S18.baseline"]["value"]
    return run_part(folder / f"replay-{seed}", REPLAY_SEED + seed, config, baseline_v)


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


def replayed(folder: Path) -> str:
    """Table of the results of recorded sessions next to those of their replays.

    The two have independent noise, so z divides their difference by the root of the sum of both
    squared half-widths of the 95 % intervals, which are 1.96 standard deviations.
    """
    found: dict[str, list[tuple[bool, float]]] = {}
    for path in sorted(folder.glob("replay-*/results.json")):
        recorded = path.parent.with_name(path.parent.name.replace("replay", "seed"))
        first, second = (_quantities(one) for one in (recorded / "results.json", path))
        for key in first.keys() & second.keys():
            value, (low, high) = second[key]["value"], first[key]["ci95"]
            half = 0.5 * float(np.hypot(high - low, np.diff(second[key]["ci95"])[0]))
            z = Z95 * (value - first[key]["value"]) / half if half else 0.0
            found.setdefault(key, []).append((low <= value <= high, z))
    lines = [f"{'id':22s} {'inside':>9s} {'mean z':>8s} {'rms z':>8s} {'worst z':>8s}"]
    for key, pairs in sorted(found.items()):
        zs = np.array([one for _, one in pairs])
        lines.append(
            f"{key:22s} {sum(one for one, _ in pairs):4d}/{len(pairs):<4d} {zs.mean():8.2f} "
            f"{np.sqrt(np.mean(zs**2)):8.2f} {zs[np.abs(zs).argmax()]:8.2f}"
        )
    every = [pair for pairs in found.values() for pair in pairs]
    share = 100.0 * np.mean([one for one, _ in every])
    both = 100.0 * np.mean([abs(z) <= Z95 for _, z in every])
    lines.append(
        f"\n{len(every)} pairs of id and seed: {share:.1f} % of the replayed results are inside "
        f"the recorded 95 % interval, {both:.1f} % inside the interval of the difference."
    )
    return "\n".join(lines)


def _quantities(path: Path) -> dict[str, dict[str, Any]]:
    """Measured value and interval of each result that has one."""
    rows = json.loads(path.read_text())["quantities"]
    return {row["id"]: row["measured"] for row in rows if row["measured"].get("ci95")}


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
    parser.add_argument("--replay", action="store_true", help="and the twin of each actuator")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    options = ["--twin", str(given.twin)] if given.twin else ["--reading", given.reading]
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    given.out.mkdir(parents=True, exist_ok=True)
    part = given.rows_14_to_21 or given.replay
    for seed in seeds if part else ():
        out, config = given.out / f"seed-{seed}", twin_of_reading(given.reading)
        print(f"seed {seed}: {run_part(out, seed, config)}", flush=True)
        if given.replay:
            print(f"replay {seed}: {replay(given.out, seed)}", flush=True)
    with ThreadPoolExecutor(PROCESSES) as pool:
        whole = () if part else seeds
        jobs = pool.map(lambda seed: run_seed(given.out, seed, options), whole)
        for seed, message in zip(whole, jobs, strict=True):
            print(f"seed {seed}: {message}", file=sys.stderr, flush=True)
    print(table(*collect(given.out)))
    if given.replay:
        print(replayed(given.out))


if __name__ == "__main__":
    main()
