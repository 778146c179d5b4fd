"""The physical model of an actuator: coverage, bound, starts, planted misfits, speed of its fit.

    python -m benchmarks.identification.physical_model --twins 20 --starts 100 --out DIR

Each hidden twin of the planar HASEL is played as a quick study, with all frames and monitor
samples, and identified from the default start values. DIR keeps motions and fits: seeds that it has
already are not run again. See README.md for how to read the rows.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks.identification.physical_twins import (
    CAMERA_BIAS_M,
    CAMERA_SCALE_STD,
    MASS_KG,
    Twin,
    default_start,
    seen,
    shifted,
    short_record,
    started,
    true_values,
)
from benchmarks.rows import Row, goal_of
from haselab.actuators import ActuatorLaw, PlanarHasel, SampledLaw, with_parameters
from haselab.base import HaselabError
from haselab.base.estimate import Z95
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.unknowns import (
    CAMERA_LATENCY,
    CAMERA_OFFSET,
    CAMERA_SCALE,
    SENSING_LATENCY,
    Unknowns,
    fitted_parameters,
)

Floats = NDArray[np.float64]
KNOWN = {CAMERA_OFFSET: CAMERA_BIAS_M, CAMERA_SCALE: CAMERA_SCALE_STD}
NOT_JUDGED = {CAMERA_LATENCY, SENSING_LATENCY, *KNOWN}  # nobody knows the truth, or it is stated
SAME = 0.3  # standard deviations within which two fits are the same minimum
BRANCH = (0.05, 12.0)  # share and s of the branch that the starting law lacks
SCALE_ERROR = 1.01
END_STOP = 3e-3  # N per mm^3
END_STRETCH = 1.3  # from which it acts
STATED_TWINS = 20  # for which the goals of coverage are stated
ELASTIC = ("shell.", "electrodes.", "viscosity.", "mullins.")


@dataclass(frozen=True)
class EndStop(PlanarHasel):
    """A cubic spring beyond a length, which the law lacks."""

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """With the spring."""
        beyond_mm = 1e3 * np.maximum(np.asarray(length_m) - END_STRETCH * self.free_length_m, 0.0)
        return np.asarray(super().elastic_force_n(length_m) + END_STOP * beyond_mm**3)


def fitted(record: MotionRecord, law: ActuatorLaw, inertia_kg: float | None) -> tuple[Any, float]:
    """The fit, and its processor time in s."""
    start_s = time.process_time()
    fit = fit_actuator(law, [record], mass_kg=MASS_KG, added_inertia_kg=inertia_kg)
    return fit, time.process_time() - start_s


def bound_of(
    fit: ActuatorFit, record: MotionRecord, law: ActuatorLaw, truth: dict[str, float]
) -> dict[str, float]:
    """Cramér-Rao bound of the joint problem: derivatives at the truth, noise of neighbours."""
    true = with_parameters(law, {n: v for n, v in truth.items() if _of_law(n)})
    unknowns = Unknowns.of(true, added_inertia_kg=truth["load.added_inertia_kg"], mass_kg=MASS_KG)
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


def _of_law(name: str) -> bool:
    return name.startswith((*ELASTIC, "dielectric."))


def judged(twin: Twin) -> dict[str, Any]:
    """Fit of a twin with the errors of its parameters, made unless it has been."""
    path = twin.folder / "fit.json"
    record, camera = seen(twin.record(), twin.seed)
    if path.exists():
        found: dict[str, Any] = json.loads(path.read_text())
        return found
    truth = true_values(twin.truth, camera)
    law, inertia_kg = default_start(twin.reading)
    fit, cpu_s = fitted(record, law, inertia_kg)
    answer = summary_of(fit, truth) | {"cpu_s": cpu_s}
    if fit.succeeded:
        bound = bound_of(fit, record, law, truth) if twin.branch is None else {}
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


def drawn(seed: int, planted: Callable[[PlanarHasel], ActuatorLaw], scale: float = 1.0) -> (
    tuple[dict[str, float], MotionRecord]
):  # fmt: skip
    """A hidden law under a short drive: its parameters, what is seen of it."""
    law, _ = default_start("hz")
    for attempt in range(100):
        rng = np.random.default_rng([seed, attempt])
        truth = shifted(fitted_parameters(law), rng)
        try:
            hidden = with_parameters(law, truth)
            assert isinstance(hidden, PlanarHasel)
            record, camera = seen(short_record(planted(hidden), seed, scale), seed)
        except HaselabError:
            continue
        truth["load.added_inertia_kg"] = 0.0
        return true_values(truth, camera) | {"sensing.scale": scale}, record
    raise RuntimeError(f"None of 100 draws of seed {seed} can be simulated.")


def short_rows(count: int) -> Iterator[Row]:
    """Coverage on simulated records of a minute: the fit alone, without the bench."""
    found = []
    for seed in range(1, count + 1):
        truth, record = drawn(seed, lambda law: law)
        law, inertia_kg = default_start("hz")
        fit, cpu_s = fitted(record, law, inertia_kg)
        found.append(summary_of(fit, truth) | {"cpu_s": cpu_s})
    yield from coverage_rows(found, count, "simulated records of a minute", 5.0)


def start_rows(starts: int) -> Iterator[Row]:
    """Share of starts that reach the same minimum, on a simulated record of a minute.

    Starts are drawn about the truth: up to 30 % off, times and shares by a factor of 2.
    """
    truth, record = drawn(1, lambda law: law)
    own = {name: value for name, value in truth.items() if _of_law(name)}
    law, inertia_kg = default_start("hz")
    best = fitted(record, with_parameters(law, own), inertia_kg)[0]
    rng, same = np.random.default_rng(2), 0
    for _ in range(starts):
        while (start := started(law, own, rng)) is None:
            pass
        fit = fitted(record, start, inertia_kg)[0]
        same += fit.succeeded and all(
            abs(fit.parameters[name].value - found.value) <= SAME * found.std
            for name, found in best.parameters.items()
        )
    yield Row("starts that reach the same minimum", 100.0 * same / starts, "%", 95.0,
              note=f"of {starts}")  # fmt: skip


def planted_rows(cases: int) -> Iterator[Row]:
    """Effects that the law of the start lacks, on simulated records of a minute."""
    share, relaxation_s = BRANCH
    branch = {"viscosity.share[3]": share, "viscosity.relaxation_s[3]": relaxation_s}
    plants: dict[str, tuple[Callable[[PlanarHasel], ActuatorLaw], float, tuple[str, ...]]] = {
        "a fourth branch": (lambda law: with_parameters(law, branch), 1.0, ()),
        "a cubic end stop": (lambda law: EndStop(**vars(law)), 1.0, ELASTIC),
        "capacitances 1 % too high": (lambda law: law, SCALE_ERROR, ()),
    }
    law, inertia_kg = default_start("hz")
    for what, (planted, scale, touched) in plants.items():
        found, inside = 0, []
        for seed in range(1, cases + 1):
            truth, record = drawn(seed, planted, scale)
            said = summary_of(fitted(record, law, inertia_kg)[0], truth | branch)
            found += flagged(said)
            others = [n for n in said["inside"] if not (touched and n.startswith(touched))]
            inside += [said["inside"][name] for name in others]
        yield Row(f"planted: {what}, flagged", 100.0 * found / cases, "%", 95.0,
                  note=f"of {cases}")  # fmt: skip
        if inside:
            yield Row("  intervals of the others that contain the truth",
                      100.0 * float(np.mean(inside)), "%", 90.0)  # fmt: skip


def speed_rows(record: MotionRecord) -> Iterator[Row]:
    """Of one evaluation of the model."""
    law = PlanarHasel()
    unknowns = Unknowns.of(law, added_inertia_kg=0.0, mass_kg=MASS_KG)
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
    twins: int = 20,
    starts: int = 100,
    planted: int = 20,
    short: int = 20,
    reading: str = "hz",
    out: str | None = None,
    first: int = 1,
) -> Iterator[Row]:
    """Measure."""
    yield from short_rows(short) if short else ()
    yield from start_rows(starts) if starts else ()
    yield from planted_rows(planted) if planted else ()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(out or temporary) / reading
        every = [Twin(folder / str(seed), reading, seed) for seed in range(first, first + twins)]
        if every:
            found = [judged(twin) for twin in every]
            # 30 s on two cores
            yield from coverage_rows(found, twins, "hidden twins, quick study", 60.0)
            yield from speed_rows(seen(every[0].record(), every[0].seed)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--reading", choices=["rad", "hz"], default="hz")
    parser.add_argument("--twins", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--short", type=int, default=20, help="simulated records of a minute")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--planted", type=int, default=20, help="cases of each planted misfit")
    parser.add_argument("--out", help="folder that keeps motions and fits")
    for row in rows(**vars(parser.parse_args())):
        print(row, flush=True)


if __name__ == "__main__":
    main()
