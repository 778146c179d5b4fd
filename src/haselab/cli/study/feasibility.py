"""`haselab plan feasibility`: whether a bench can do a study, before it is energised."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from haselab._twin import Bench
from haselab.actuators import ActuatorLaw
from haselab.base import InputError, to_plain
from haselab.cli.common import answer_options
from haselab.rig import RigDescription
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import MegaFile
from haselab.rig.rig_file import RigFile, TwinFile, load_rig
from haselab.rig.twin.bench import GRAVITY_M_S2, describe, native_bench
from haselab.rig.twin.config import TwinConfig
from haselab.safety.feasibility import Drive, Feasibility, Rating, judge
from haselab.safety.state_machine import SafetySettings
from haselab.safety.watchdog.settings import FieldRating, WatchdogSettings
from haselab.signals import linear_chirp, triangle
from haselab.store.folder import write_json
from haselab.store.toml import Section as _Section
from haselab.store.toml import validated
from haselab.study.definition import StepStudy, Study, load_study
from haselab.study.experiments.play import UPDATE_HZ

__all__ = [
    "RatingSection",
    "SafetySection",
    "command",
    "judge_rig",
    "judge_study",
    "rating_of_twin",
    "runs_by_wall_clock",
    "safety_of",
    "study_drives",
]

_NEVER_V_PER_M = 1e15
_LOCK_STEP_LEASE_S = 10.0
_HOST_CHECKS = frozenset(  # of blocks and deadlines, which a microcontroller rig does not have
    {"rate_limit_v_per_s", "current_limit_a", "follow", "settle_s", "missed_limit", "late_limit"}
)
_STEPS = 200_000  # of the twin's mechanics, 20 s: the sheet hangs still, up to creep


class RatingSection(_Section):
    """[rating] of RIG.toml: what amplifier and actuator withstand, see `Rating`."""

    current_limit_a: float = Field(gt=0)
    slew_v_per_s: float = Field(gt=0)
    bandwidth_hz: float = Field(gt=0)
    capacitance_f: float = Field(gt=0)
    thickness_m: float = Field(gt=0)
    breakdown_v_per_m: float = Field(gt=0)
    field_margin: float = Field(0.9, gt=0, le=1)
    stretch_high: float = Field(math.inf, gt=1)
    stretch: float = Field(math.nan)
    settle_s: float = Field(5e-3, gt=0)


class SafetySection(_Section):
    """[safety] of RIG.toml, see `SafetySettings`."""

    rate_limit_v_per_s: float = Field(2000.0, gt=0)
    current_limit_a: float = Field(1e-3, gt=0)
    follow: float = Field(0.1, gt=0, le=1)
    carrier_limit_v: float | None = Field(None, gt=0)
    supply_limit_v: float | None = Field(None, gt=0)
    settle_s: float = Field(5e-3, gt=0)
    residual_v: float = Field(50.0, gt=0, le=50)
    missed_limit: int = Field(5, ge=1)
    late_limit: int = Field(20, ge=1)
    lease_s: float = Field(2.0, ge=0.2, le=10)
    idle_s: float = Field(600.0, gt=0)
    permit_age_s: float = Field(12 * 3600.0, gt=0)
    loop: dict[str, float] = Field({}, description="see `WatchdogSettings`")


def runs_by_wall_clock(file: RigFile) -> bool:
    """Whether the program can be late: not on a twin whose time passes as it is asked for."""
    if isinstance(file, MegaFile):
        return file.port is not None
    return isinstance(file, BenchConfig) and not file.stand.lock_step


def safety_of(file: RigFile, given: Mapping[str, Any], path: Path) -> SafetySettings:
    """The limits of a rig file for the kind of rig it describes.

    A bench runs by the wall clock. A recorded session has no output to read back, and no current
    to limit that would not have been limited when it was recorded.

    Args:
        file: from `load_rig`.
        given: its table `safety`.
        path: of the rig file, for errors.
    """
    section = validated(SafetySection, dict(given), path, "safety")
    if isinstance(file, MegaFile) and (unused := sorted(_HOST_CHECKS & set(given))):
        raise InputError(
            f"safety.{unused[0]} has no effect on a microcontroller rig: its limits are compiled "
            f"into the firmware. Remove it. {path}"
        )
    recorded = file.kind == "replay"
    given_s = section.model_dump(exclude={"loop"})
    if isinstance(file, BenchConfig) and file.stand.lock_step:  # its physics takes computing time
        given_s["lease_s"] = max(section.lease_s, _LOCK_STEP_LEASE_S)
    return SafetySettings(
        **given_s,
        real_time=runs_by_wall_clock(file),
        read_back=not recorded,
        compare_output=not recorded,
        loop=_loop_limits(section.loop, path),
        rating=_field_rating(file, path),
    )


def _loop_limits(given: Mapping[str, float], path: Path) -> WatchdogSettings:
    """[safety.loop] of a rig file."""
    known = {field.name for field in fields(WatchdogSettings)}
    if unknown := sorted(set(given) - known):
        raise InputError(
            f"safety.loop has no limit named {unknown[0]!r}. Use one of "
            f"{', '.join(sorted(known))}. {path}"
        )
    return WatchdogSettings(**given)  # type: ignore[arg-type]


def _field_rating(file: RigFile, path: Path) -> FieldRating | None:
    """The dielectric of [rating]; None where the file has none."""
    given = getattr(file, "rating", None)
    if not isinstance(file, BenchConfig) or not given:
        return None
    rating = validated(RatingSection, dict(given), path, "rating")
    limit_v_per_m = rating.field_margin * rating.breakdown_v_per_m
    return FieldRating(limit_v_per_m, rating.thickness_m, rating.capacitance_f)


def study_drives(study: Study, rig: RigDescription) -> list[Drive]:
    """What a study will put out, as far as it is known before its maps are.

    The step trials go to zero strain, which the study puts at its baseline voltage, and from there
    to a voltage that only the map will tell: the highest is taken.
    """
    t, c, baseline_v = study.triangle, study.chirp, study.nominal_baseline_v
    sweep = linear_chirp(c.start_hz, c.stop_hz, c.duration_s, UPDATE_HZ)
    highest_v = max(rig.drive_limits.high, -rig.drive_limits.low)
    return [
        Drive("triangle", triangle(t.low_v, t.high_v, t.frequency_hz, t.cycles, UPDATE_HZ),
              t.frequency_hz),
        Drive("free response", np.array([0.0, baseline_v])),
        Drive("chirp", np.concatenate([[baseline_v], baseline_v + c.amplitude_v * sweep]),
              c.stop_hz),
        Drive("step trials", np.array([0.0, baseline_v, highest_v])),
    ]  # fmt: skip


def rating_of_twin(config: TwinConfig, study: Study) -> Rating:
    """What a twin stands in a study, by its own physics held at the extremes of the study.

    The dielectric does not break here: after a breakdown the field would be the one of the
    breakdown, not that of the study.
    """
    bench = native_bench(config, 0, noise=False, breakdown_v_per_m=_NEVER_V_PER_M)
    law = config.law
    drive_v = max(config.acquisition.drive_high_v, -config.acquisition.drive_low_v)
    lengths, longest_m = np.empty(_STEPS), 0.0
    stretch_high = law.length_limits_m.high / law.free_length_m
    rise_v = np.append(np.linspace(0.0, drive_v, _STEPS // 2), np.full(_STEPS // 2, drive_v))
    rest_v, weight_kg = np.zeros(1), config.load.mass_kg
    heaviest_kg = max(study.static_load.masses_kg)
    for mass_kg, values_v in ((heaviest_kg, rest_v), (weight_kg, rest_v), (weight_kg, rise_v)):
        bench.move(values_v, 1, mass_kg * GRAVITY_M_S2, lengths)
        longest_m = max(longest_m, float(lengths.max()))
    output_v = drive_v * config.amplifier.gain * (1.0 + config.amplifier.gain_error)
    return Rating(
        current_limit_a=config.amplifier.current_limit_a,
        slew_v_per_s=config.amplifier.slew_v_per_s,
        bandwidth_hz=config.amplifier.bandwidth_hz,
        capacitance_f=_largest_f(bench, lengths, output_v) + config.amplifier.stray_f,
        thickness_m=_smallest_gap_m(law) if bench.outside else output_v / bench.field_v_m,
        breakdown_v_per_m=law.circuit.breakdown_v_per_m,
        stretch_high=stretch_high,
        stretch=math.inf if bench.outside else longest_m / law.free_length_m,
    )


def _smallest_gap_m(law: ActuatorLaw) -> float:
    """For an actuator that leaves the lengths of its law, where the output is taken away."""
    limits = law.length_limits_m
    return float(law.gap_m(np.array([limits.low, limits.high])).min())


def _largest_f(bench: Bench, lengths_m: NDArray[np.float64], output_v: float) -> float:
    """Capacitance at the end of the motion where it is larger; some actuators contract."""
    ends_m = (float(lengths_m.min()), float(lengths_m.max()))
    return max(bench.capacitance(length_m, output_v) for length_m in ends_m)


def judge_study(study: Study, rig: RigDescription, rating: Rating) -> Feasibility:
    """All checks of a study on a bench; `require` refuses it with the numbers.

    Trials by the printed sensing chain have a carrier of their own, so that each check is the worse
    of two.
    """
    sensing, drives = study.sensing, study_drives(study, rig)
    found = judge(rig, rating, drives, sensing.carrier_hz, sensing.carrier_v)
    if not study.steps.printed_chain_trials:
        return found
    steps = replace(drives[-1], name="step trials by the paper's sensing chain")
    loud = judge(rig, rating, [steps], sensing.carrier_hz, study.steps.printed_chain_carrier_v)
    pairs = zip(found.checks, loud.checks, strict=True)
    return Feasibility(tuple(max(pair, key=lambda check: check.asked) for pair in pairs))


def _page(found: Feasibility) -> str:
    lines = [f"{'':32s} {'asked':>10s} {'allowed':>10s}        in"]
    for c in found.checks:
        word = "" if c.ok else "TOO HIGH. " + c.advice
        asked = "not known" if math.isnan(c.asked) else f"{c.asked:.4g}"
        asked = "no end" if math.isinf(c.asked) else asked
        lines.append(
            f"{c.name:32s} {asked:>10s} {c.allowed:10.4g} {c.unit:5s}  {c.where}  {word}".rstrip()
        )
    return "\n".join([*lines, "", "feasible" if found.ok else "not feasible"])


def _rated(file: RigFile, study: Study, path: Path) -> tuple[RigDescription, Rating] | None:
    """What is known of a rig; None where nobody knows what it stands."""
    if isinstance(file, TwinFile):
        config = file.configuration(path)
        return describe(config), rating_of_twin(config, study)
    given = getattr(file, "rating", None)
    if not isinstance(file, BenchConfig) or not given:
        return None
    section = validated(RatingSection, dict(given), path, "rating")
    return file.describe(), Rating(**section.model_dump())


def judge_rig(file: RigFile, study: Study | StepStudy, path: Path) -> Feasibility | None:
    """All checks of a study on the rig of a file.

    Args:
        file: from `load_rig`.
        study: what will be played.
        path: of the rig file.
    Returns:
        The checks; None where nobody knows what the rig stands.
    """
    if isinstance(study, StepStudy):  # on a chip, whose limits are compiled in
        return None
    rated = _rated(file, study, path)
    return None if rated is None else judge_study(study, *rated)


@click.command("feasibility")
@click.argument("study", type=click.Path(path_type=Path))
@click.option("--rig", required=True, type=click.Path(path_type=Path), help="RIG.toml")
@click.option("--quick", is_flag=True, help="Apply the study's table `quick`.")
@answer_options(out_help="Also write the JSON result to this file.")
def command(study: Path, rig: Path, quick: bool, as_json: bool, out: Path | None) -> None:
    """Whether a bench can play STUDY.toml: current, slew, bandwidth, field, stretch.

    Connects to nothing and applies no voltage. Exits with 2 where the bench cannot.
    """
    plan = load_study(study, quick=quick)
    file = load_rig(rig)
    rated = _rated(file, plan, rig)
    if rated is None:
        raise InputError(
            f"No table [rating] for a rig of kind {file.kind!r}; allowed are a twin, or a bench "
            f"with one. Say there what amplifier and actuator withstand. {rig}"
        )
    found = judge_study(plan, *rated)
    answer = {
        "feasible": found.ok,
        "checks": [asdict(check) | {"ok": check.ok} for check in found.checks],
        "rating": asdict(rated[1]),
    }
    if out is not None:
        write_json(out, answer)
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else _page(found))
    found.require()
