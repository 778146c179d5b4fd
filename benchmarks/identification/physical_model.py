"""The physical model of an actuator: coverage, bound, starts, planted misfits, speed of its fit.

    python -m benchmarks.identification.physical_model --kind dea-stack --twins 20 --out DIR

Each hidden twin of the kind is played as a quick study, with all frames and monitor samples, and
identified from the start values of the twin that was moved. DIR keeps motions and fits: seeds that
it has already are not run again. See README.md for how to read the rows.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification.physical_bad import bad_rows
from benchmarks.identification.physical_kinds import (
    CAMERA_BIAS_M,
    CAMERA_SCALE_STD,
    KINDS,
    Kind,
    seen,
    started,
)
from benchmarks.identification.physical_twins import Twin
from benchmarks.rows import Row, goal_of
from haselab.actuators import ADDED_INERTIA, ActuatorLaw, SampledLaw, with_parameters
from haselab.base.estimate import Z95
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.unknowns import (
    CAMERA_LATENCY,
    CAMERA_OFFSET,
    CAMERA_SCALE,
    SENSING_LATENCY,
    SENSING_SCALE,
    Unknowns,
    fitted_parameters,
)

Floats = NDArray[np.float64]
KNOWN = {CAMERA_OFFSET: CAMERA_BIAS_M, CAMERA_SCALE: CAMERA_SCALE_STD}
NOT_JUDGED = {CAMERA_LATENCY, SENSING_LATENCY, *KNOWN}  # nobody knows the truth, or it is stated
SAME = 0.3  # standard deviations within which two fits are the same minimum
SCALE_ERROR = 1.01
COUNTS = {"twins": 20, "short": 20, "starts": 100, "planted": 20, "bad": 3}
STATED_TWINS = 20  # for which the goals of coverage are stated
TIMES = ("relaxation_s", "share", "mullins.")  # what an error of a scale leaves alone


def fitted(
    record: MotionRecord, law: ActuatorLaw, mass_kg: float, inertia_kg: float | None = None
) -> tuple[ActuatorFit, float]:
    """The fit, and its processor time in s."""
    start_s = time.process_time()
    fit = fit_actuator(law, [record], mass_kg=mass_kg, added_inertia_kg=inertia_kg)
    return fit, time.process_time() - start_s


def bound_of(
    fit: ActuatorFit, record: MotionRecord, law: ActuatorLaw, truth: dict[str, float]
) -> dict[str, float]:
    """Cramér-Rao bound of the joint problem: derivatives at the truth, noise of neighbours."""
    own = fitted_parameters(law)
    true = with_parameters(law, {name: truth[name] for name in own})
    unknowns = Unknowns.of(true, added_inertia_kg=truth[ADDED_INERTIA], mass_kg=fit.mass_kg)
    values = [truth.get(n, fit.parameters[n].value) for n in unknowns.names]
    unknowns = replace(unknowns, values=np.array(values))
    misfit = Misfit(
        [record],
        length_factor=fit.length_noise_m / float(np.median(record.length_std_m)),
        capacitance_factor=fit.capacitance_noise_f / float(np.median(record.capacitance_std_f)),
        known=KNOWN,
    )
    linear = misfit.linearised(unknowns)
    if linear is None:
        raise RuntimeError("The true parameters describe no motion.")
    size = np.linalg.norm(linear[1], axis=0)
    inner = np.linalg.inv((linear[1] / size).T @ (linear[1] / size))
    std = np.sqrt(np.diag(inner)) / size * np.abs(unknowns.slopes)
    return dict(zip(unknowns.names, std.tolist(), strict=True))


def judged(twin: Twin) -> dict[str, Any]:
    """Fit of a twin with the errors of its parameters, made unless it has been."""
    path = twin.folder / "fit.json"
    record, camera = seen(twin.record(), twin.seed)
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text())
        return found
    truth = {**twin.truth, **camera, SENSING_SCALE: 1.0}
    law, load = twin.usual.law, twin.usual.load
    fit, cpu_s = fitted(record, law, load.mass_kg, load.added_inertia_kg or None)
    answer = summary_of(fit, truth) | {"cpu_s": cpu_s}
    if fit.succeeded:
        bound = bound_of(fit, record, law, truth)
        answer["over_bound"] = {
            name: fit.parameters[name].std / bound[name] for name in answer["z"] if name in bound
        }
        answer["fit"] = {name: found.value for name, found in fit.parameters.items()}
    path.write_text(json.dumps(answer))
    return answer


def summary_of(fit: ActuatorFit, truth: dict[str, float]) -> dict[str, Any]:
    """What is kept of a fit."""
    z, inside = {}, {}
    for name, found in fit.parameters.items():
        if name in NOT_JUDGED or name in fit.not_identifiable or name not in truth:
            continue
        low, high = found.ci95
        half = found.value - low if truth[name] < found.value else high - found.value
        z[name] = Z95 * (found.value - truth[name]) / half
        inside[name] = bool(low <= truth[name] <= high)
    return {
        "status": fit.status,
        "notes": list(fit.notes),
        "rejected": [rival.law for rival in fit.rejected_laws],
        "not_identifiable": list(fit.not_identifiable),
        "evaluations": fit.evaluations,
        "z": z,
        "inside": inside,
        "chi2": {
            "lengths": (fit.length_rms_m / fit.length_noise_m) ** 2,
            "capacitances": (fit.capacitance_rms_f / fit.capacitance_noise_f) ** 2,
        },
    }


def flagged(fit: dict[str, Any]) -> bool:
    """Whether the user learns that something is wrong with law or records."""
    return (
        fit["status"] != "ok"
        or bool(fit["notes"])
        or any(law.startswith("without a branch") for law in fit["rejected"])
    )


def coverage_rows(
    found: list[dict[str, Any]], count: int, what: str, most_s: float
) -> Iterator[Row]:
    """Of all fits together."""
    good = [one for one in found if one["z"]]
    yield Row(f"{what}, with a result", len(good), f"of {count}", float(count))
    if not good:
        return
    z = np.array([value for one in good for value in one["z"].values()])
    inside = np.array([value for one in good for value in one["inside"].values()])

    def goal(limit: float, ideal: float) -> float:
        return goal_of(limit, ideal, len(good), STATED_TWINS)

    note = f"{z.size} pairs of parameter and twin"
    share = 100.0 * inside.mean()
    yield Row("  95 % intervals that contain the truth", share, "%", goal(92.0, 95.0), note=note)
    most = goal(97.0, 95.0)  # with few twins all may be inside
    yield Row("  the same, at most", share, "%", most if most < 100.0 else None, False)
    yield Row("  rms z", float(np.sqrt(np.mean(z**2))), "", goal(1.1, 1.0), False)
    names = {name for one in good for name in one["z"]}
    means = {n: float(np.mean([one["z"][n] for one in good if n in one["z"]])) for n in names}
    worst = max(means, key=lambda name: abs(means[name]))
    note = f"{worst}; chance alone: {1.0 / math.sqrt(len(good)):.2f} (one standard deviation)"
    largest = abs(means[worst])
    yield Row("  largest mean z of a parameter", largest, "", goal(0.6, 0.0), False, note)
    for channel in ("lengths", "capacitances"):
        ratios = np.array([one["chi2"][channel] for one in good])
        yield Row(f"  chi2/n of the {channel}, mean", float(ratios.mean()), "")
        off = float(np.abs(ratios - 1.0).max())
        yield Row(f"  chi2/n of the {channel}, largest distance to 1", off, "", 0.03, False)
    ratios = np.array([v for one in good for v in one.get("over_bound", {}).values()])
    if ratios.size:
        note = f"median {np.median(ratios):.2f}"
        yield Row("  stated deviation over its bound, largest", ratios.max(), "", 1.3, False, note)
    yield Row("  with status ok", sum(one["status"] == "ok" for one in good), "")
    cpu_s = np.array([one["cpu_s"] for one in good])
    note = f"{np.median([one['evaluations'] for one in good]):.0f} evaluations"
    yield Row("  time of a fit, median", float(np.median(cpu_s)), "s of CPU", most_s, False, note)


def short_rows(kind: Kind, count: int) -> Iterator[Row]:
    """Coverage on simulated records of a minute: the fit alone, without the bench."""
    found = []
    for seed in range(1, count + 1):
        truth, record = kind.drawn(seed)
        fit, cpu_s = fitted(record, kind.law, kind.mass_kg)
        found.append(summary_of(fit, truth) | {"cpu_s": cpu_s})
    yield from coverage_rows(found, count, "simulated records of a minute", 5.0)


def start_rows(kind: Kind, starts: int) -> Iterator[Row]:
    """Share of starts that reach the same minimum, on a simulated record of a minute.

    Starts are drawn about the truth: up to 30 % off, times and shares by a factor of 2.
    """
    truth, record = kind.drawn(1)
    own = {name: truth[name] for name in fitted_parameters(kind.law)}
    best = fitted(record, with_parameters(kind.law, own), kind.mass_kg)[0]
    rng, same = np.random.default_rng(2), 0
    for _ in range(starts):
        while (start := started(kind.law, own, rng)) is None:
            pass
        fit = fitted(record, start, kind.mass_kg)[0]
        same += fit.succeeded and all(
            abs(fit.parameters[name].value - found.value) <= SAME * found.std
            for name, found in best.parameters.items()
        )
    yield Row("starts that reach the same minimum", 100.0 * same / starts, "%", 95.0,
              note=f"of {starts}")  # fmt: skip


def _scaled(record: MotionRecord, name: str) -> MotionRecord:
    return replace(record, **{name: SCALE_ERROR * getattr(record, name)})


def planted_rows(kind: Kind, cases: int) -> Iterator[Row]:
    """Effects that the law of the start lacks, on simulated records of a minute."""
    instruments = (ADDED_INERTIA, "sensing.")
    plants: dict[str, tuple[Callable[[ActuatorLaw], ActuatorLaw], str, tuple[str, ...]]] = {
        "one branch more": (lambda law: with_parameters(law, kind.branch(law)), "", ("",)),
        "a cubic end stop": (kind.stopped, "", (*kind.electric, *instruments)),
        "capacitances 1 % too high": (lambda law: law, "capacitance_f", ("",)),
        "lengths 1 % too long": (lambda law: law, "length_m", ()),
    }
    for what, (planted, scaled, alone) in plants.items():
        found, inside = 0, []
        for seed in range(1, cases + 1):
            truth, record = kind.drawn(seed, planted)
            truth |= kind.branch(kind.law)
            if scaled:
                record = _scaled(record, scaled)
                truth[SENSING_SCALE] *= SCALE_ERROR if scaled == "capacitance_f" else 1.0
            said = summary_of(fitted(record, kind.law, kind.mass_kg)[0], truth)
            found += flagged(said)
            inside += [
                held
                for name, held in said["inside"].items()
                if name.startswith(alone) or (not alone and any(part in name for part in TIMES))
            ]
        yield Row(f"planted: {what}, flagged", 100.0 * found / cases, "%", 95.0,
                  note=f"of {cases}")  # fmt: skip
        if inside:
            yield Row("  intervals of the others that contain the truth",
                      100.0 * float(np.mean(inside)), "%", 90.0)  # fmt: skip


def speed_rows(kind: Kind, record: MotionRecord) -> Iterator[Row]:
    """Of one evaluation of the model."""
    law = kind.law
    unknowns = Unknowns.of(law, added_inertia_kg=0.0, mass_kg=kind.mass_kg)
    duration_s = float(np.ptp(record.drive.edge_s))
    misfit = Misfit([record])
    for what, job in (
        ("motion of the record", lambda: misfit.residuals(unknowns)),
        ("the same with derivatives", lambda: misfit.linearised(unknowns)),
        ("table of the law", lambda: SampledLaw(law, 11e3, unknowns.law_names)),
    ):
        job()
        start_s = time.process_time()
        job()
        cpu_s = time.process_time() - start_s
        yield Row(what, cpu_s, "s of CPU", note=f"{duration_s / cpu_s:.0f} rig s / s")


def rows(
    kind: str = "planar-hasel",
    reading: str = "hz",
    out: str | None = None,
    first: int = 1,
    **counts: int,
) -> Iterator[Row]:
    """Measure.

    Args:
        kind: of the actuator.
        reading: of the frequency axis, of a planar HASEL.
        out: folder that keeps motions and fits; None: nothing is kept.
        first: seed of the twins.
        counts: of twins, short (records), starts, planted and bad (cases).
    """
    of, many = KINDS[kind], {**COUNTS, **counts}
    for part, count in (
        (short_rows, many["short"]),
        (start_rows, many["starts"]),
        (planted_rows, many["planted"]),
        (bad_rows, many["bad"]),
    ):
        yield from part(of, count) if count else ()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(out or temporary) / (reading if kind == "planar-hasel" else kind)
        seeds = range(first, first + many["twins"])
        every = [Twin(folder / str(seed), of, seed, reading) for seed in seeds]
        if every:
            found = [judged(twin) for twin in every]
            # 30 s on two cores
            yield from coverage_rows(found, len(every), "hidden twins, quick study", 60.0)
            yield from speed_rows(of, seen(every[0].record(), every[0].seed)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=list(KINDS), default="planar-hasel")
    parser.add_argument("--reading", choices=["rad", "hz"], default="hz")
    parser.add_argument("--twins", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="first seed of the twins")
    parser.add_argument("--short", type=int, default=20, help="simulated records of a minute")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--planted", type=int, default=20, help="cases of each planted misfit")
    parser.add_argument("--bad", type=int, default=3, help="cases of each bad input")
    parser.add_argument("--out", help="folder that keeps motions and fits")
    for row in rows(**vars(parser.parse_args())):
        print(row, flush=True)


if __name__ == "__main__":
    main()
