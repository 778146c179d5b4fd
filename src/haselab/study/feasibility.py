"""Check whether a bench can play a study, from the drives that its experiments declare."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab._twin import Bench
from haselab.actuators import ActuatorLaw
from haselab.base import InputError
from haselab.rig import RigDescription
from haselab.rig.bench_config import BenchConfig
from haselab.rig.rig_file import RigFile, TwinFile
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, describe, native_bench
from haselab.safety.feasibility import Drive, Feasibility, Rating, check_feasibility
from haselab.safety.rig_limits import rating_section
from haselab.study.analysis import experiments_of
from haselab.study.definition import StepStudy, Study
from haselab.study.experiments.foreign import declared, foreign

__all__ = [
    "check_drives",
    "check_settings",
    "check_study",
    "check_study_on_rig",
    "rated_rig",
    "rating_of_twin",
    "require_camera",
    "study_drives",
    "study_masses_kg",
]

_NEVER_V_PER_M = 1e15
_STEPS = 200_000  # of the twin's mechanics, 20 s, after which only creep remains


def study_drives(study: Study, rig: RigDescription) -> list[Drive]:
    """All drives of a study, as its experiments declare them.

    Args:
        study: what will be played.
        rig: nominal values of the bench.
    """
    return [
        drive
        for each in experiments_of(study)
        for drive in declared(each, "drives", Drive, partial(each.drives, rig))
    ]


def study_masses_kg(study: Study) -> list[float]:
    """All masses that are hung in a study, besides the rig's own."""
    return [
        mass
        for each in experiments_of(study)
        for mass in declared(each, "masses_kg", (int, float), each.masses_kg)
    ]


def check_settings(study: Study) -> None:
    """Refuse a study from which no result can come, before anything moves.

    Args:
        study: what will be played.
    Raises:
        InputError: it plays nothing, or an experiment's settings give too little data for its fit.
    """
    experiments = experiments_of(study)
    if not any(experiment.recordings() for experiment in experiments):
        tables = " and ".join(f"[{experiment.table}]" for experiment in experiments)
        raise InputError(
            f"The study plays nothing: it has only {tables}. Add an experiment that is played, "
            "such as [steps]."
        )
    for experiment in experiments:
        with foreign(experiment, "check", InputError):
            experiment.check()


def check_drives(study: Study, rig: RigDescription) -> None:
    """Refuse a study now that this rig would refuse hours later.

    Args:
        study: what will be played.
        rig: nominal values of the bench.
    Raises:
        LimitError: a drive is beyond the rig's limits.
        InputError: a mass is negative.
    """
    for drive in study_drives(study, rig):
        rig.drive_limits.check(drive.values_v)
    for mass_kg in study_masses_kg(study):
        if not 0.0 <= mass_kg < math.inf:
            raise InputError(
                f"static_load.masses_kg of the study has a mass of {mass_kg:g} kg. Use masses of "
                "at least 0 kg."
            )


def rating_of_twin(config: TwinConfig, study: Study) -> Rating:
    """Rating of a twin, from its own physics at the extremes of the study.

    Breakdown is switched off for this calculation, because it would limit the field.
    """
    bench = native_bench(config, 0, noise=False, breakdown_v_per_m=_NEVER_V_PER_M)
    law = config.law
    drive_v = max(config.acquisition.drive_high_v, -config.acquisition.drive_low_v)
    lengths, longest_m = np.empty(_STEPS), 0.0
    rise_v = np.append(np.linspace(0.0, drive_v, _STEPS // 2), np.full(_STEPS // 2, drive_v))
    rest_v, weight_kg = np.zeros(1), config.load.mass_kg
    heaviest_kg = max([weight_kg, *study_masses_kg(study)])
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
        stretch_high=law.length_limits_m.high / law.free_length_m,
        stretch=math.inf if bench.outside else longest_m / law.free_length_m,
    )


def _smallest_gap_m(law: ActuatorLaw) -> float:
    """Smallest gap of a law: an actuator that leaves its range of lengths loses its output."""
    limits = law.length_limits_m
    return float(law.gap_m(np.array([limits.low, limits.high])).min())


def _largest_f(bench: Bench, lengths_m: NDArray[np.float64], output_v: float) -> float:
    """Largest capacitance at either end of the motion; some actuators contract."""
    ends_m = (float(lengths_m.min()), float(lengths_m.max()))
    return max(bench.capacitance(length_m, output_v) for length_m in ends_m)


def check_study(study: Study, rig: RigDescription, rating: Rating) -> Feasibility:
    """Check a study against a bench; `require` of the answer raises if a check fails.

    A drive with its own carrier is checked with it; each check reports the worst case.

    Args:
        study: what will be played.
        rig: nominal values of the bench.
        rating: what amplifier and actuator withstand.
    """
    sensing, drives = study.sensing, study_drives(study, rig)
    by_carrier: dict[float, list[Drive]] = {}
    for drive in drives:
        carrier_v = sensing.carrier_v if drive.carrier_v is None else drive.carrier_v
        by_carrier.setdefault(carrier_v, []).append(drive)
    found = [
        check_feasibility(rig, rating, some, sensing.carrier_hz, carrier_v)
        for carrier_v, some in by_carrier.items()
    ]
    together = zip(*(one.checks for one in found), strict=True)
    return Feasibility(tuple(max(same, key=lambda check: check.excess) for same in together))


def rated_rig(file: RigFile, study: Study, path: Path) -> tuple[RigDescription, Rating] | None:
    """Description and rating of a rig; None if the rating is unknown.

    Args:
        file: from `load_rig`.
        study: what will be played.
        path: of the rig file.
    Raises:
        InputError: the study needs a camera, and the rig has none.
    """
    require_camera(file, study, path)
    if isinstance(file, TwinFile):
        config = file.configuration(path)
        return describe(config), rating_of_twin(config, study)
    section = rating_section(file, path)
    if section is None or not isinstance(file, BenchConfig):
        return None
    return file.describe(), Rating(**section.model_dump())


def require_camera(file: RigFile, study: Study, path: Path) -> None:
    """Refuse experiments that would end without frames, after they have applied voltage.

    Args:
        file: from `load_rig`.
        study: what will be played.
        path: of the rig file.
    Raises:
        InputError: the study needs a camera, and the rig has none.
    """
    if not isinstance(file, BenchConfig) or file.camera is not None:
        return
    filmed = [
        f"[{each.table}]"
        for each in experiments_of(study)
        if each.recordings() and hasattr(each.settings, "frame_rate_hz")
    ]
    if filmed:
        raise InputError(
            f"The study cannot be played: {', '.join(filmed)} need a camera to measure the length, "
            f"but the rig file has no section [camera]. Add one. {path}"
        )


def check_study_on_rig(file: RigFile, study: Study | StepStudy, path: Path) -> Feasibility | None:
    """Check a study against the rig of a file.

    Args:
        file: from `load_rig`.
        study: what will be played.
        path: of the rig file.
    Returns:
        The checks; None if the rating of the rig is unknown.
    Raises:
        InputError: see `rated_rig`.
    """
    if isinstance(study, StepStudy):  # for a chip, whose limits are in its firmware
        return None
    rated = rated_rig(file, study, path)
    return None if rated is None else check_study(study, *rated)
