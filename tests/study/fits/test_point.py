"""The operating point: the baseline that centres the strain, and what is out of reach."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from haselab.base import Estimate, Limits, ResultError
from haselab.identify.statics.regions import Region
from haselab.rig import RigDescription
from haselab.study.definition import Study, builtin_study
from haselab.study.experiments.operating_point import hold_drives_v
from haselab.study.fits.cycles import Cycles
from haselab.study.fits.observe import Observation
from haselab.study.fits.point import find_point
from haselab.study.fits.static import Static
from haselab.study.paper.quantity_table import quantities

FREE_M, BLOCK_S, FRAMES_HZ = 0.036, 0.01, 400.0
SQUARE = 0.03  # stretch per square volt
RIG = cast(
    RigDescription,
    SimpleNamespace(
        switch_sample=400, rate_hz=200e3, block_s=BLOCK_S, scale_m_per_px=3.5e-4, mass_kg=0.25,
        drive_limits=Limits("drive", 0.0, 2.0, "V"),
    ),
)  # fmt: skip


def stretch_of(drive_v: Any) -> Any:
    """Length by the free length, without hysteresis."""
    return 1.35 + SQUARE * np.asarray(drive_v) ** 2


def triangle(study: Study) -> Cycles:
    t = study.triangle
    n = round(t.cycles / t.frequency_hz / BLOCK_S)
    start_s = BLOCK_S * np.arange(n)
    turns = start_s * t.frequency_hz % 1.0
    drive_v = 2.0 * (1.0 - np.abs(2.0 * turns - 1.0))
    time_s = np.arange(round(n * BLOCK_S * FRAMES_HZ)) / FRAMES_HZ
    ramp_v = np.interp(time_s, start_s + 0.002 + 0.5 * BLOCK_S, drive_v)
    none = np.empty(0)
    seen = Observation(
        "triangle", {}, start_s, drive_v, none, none, none, none, time_s,
        FREE_M * stretch_of(ramp_v), np.zeros(time_s.size), np.full(time_s.size, 0.25),
        float("nan"), none,
    )  # fmt: skip
    return Cycles.of(seen, study, RIG)


def holds(study: Study) -> list[Observation]:
    """The stretch at rest at each voltage that is held; this sheet has no lag."""
    seen = triangle(study).seen
    return [
        replace(
            seen, drive_v=np.full(50, drive_v), length_m=np.full(50, FREE_M * stretch_of(drive_v))
        )
        for drive_v in hold_drives_v(study)
    ]


def static(low: float, high: float) -> Static:
    ends = [Estimate.normal(value, 0.01, "") for value in (low, high)]
    stretch = np.linspace(1.0, 2.2, 20)
    return Static(
        FREE_M,
        Region(ends[0], ends[1], Estimate.normal(6.0, 0.1, "N"), 1.0),
        3,
        {"S17.region_low": ends[0], "S17.region_high": ends[1]},
        {},
        {"static": {"stretch": stretch, "load_n": 6.0 * (stretch - 1.0)}},
    )


def test_the_baseline_is_where_the_stretch_is_the_centre() -> None:
    study = builtin_study()
    # Centre 1.3892: 1.35 + 0.03 V^2 gives 1.1431 V, set to 0.01 V.
    point = find_point(holds(study), triangle(study), static(1.2, 1.5784), study, RIG)
    assert point.baseline_v == pytest.approx(1.14, abs=1e-9)
    # 0.0031 V off is 0.06 * 1.14 * 0.0031 = 2.1e-4 of stretch, part of 0.1892; between voltages
    # 0.2 V apart a cubic misses the parabola by less than 0.03 * 0.2^2 / 8 = 1.5e-4.
    assert abs(point.quantities["S18.centre_offset"].value) < 2e-3
    low, high = point.quantities["S18.strain_min"].value, point.quantities["S18.strain_max"].value
    assert low == pytest.approx(1.35 / stretch_of(1.14) - 1.0, abs=1e-4)
    assert high == pytest.approx(stretch_of(2.0) / stretch_of(1.14) - 1.0, abs=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_voltages_of_the_smallest_and_the_largest_strain_are_stated(sign: float) -> None:
    """An actuator that contracts has its largest strain at the lowest voltage."""
    study = builtin_study()
    seen = triangle(study)
    length_m = FREE_M * (2.8 * (sign < 0) + sign * stretch_of(seen.ramp_at(seen.seen.frame_time_s)))
    moved = replace(seen, seen=replace(seen.seen, length_m=length_m))
    held = [replace(one, length_m=FREE_M * (2.8 * (sign < 0) + sign * stretch_of(one.drive_v)))
            for one in holds(study)]  # fmt: skip
    ends = sorted([1.4 + sign * (1.2 - 1.4), 1.4 + sign * (1.5784 - 1.4)])
    notes = find_point(held, moved, static(*ends), study, RIG).notes
    volts = [float(notes[f"S18.strain_{end}"].split()[1]) for end in ("min", "max")]
    low_v, high_v = volts[:: int(sign)]
    # the staircase of 10 ms reaches both ends to half a step, and a frame is 2.5 ms away
    assert low_v < 0.02 and high_v > 1.98
    for end in ("min", "max"):
        name = quantities()[f"S18.strain_{end}"].name
        assert "0 V" not in name and "peak" not in name


def test_a_centre_out_of_reach_gives_the_nearest_baseline_and_a_weight() -> None:
    study = builtin_study()
    point = find_point(holds(study), triangle(study), static(1.5, 2.1), study, RIG)
    assert point.baseline_v == pytest.approx(1.4)  # 2 V less the chirp's 0.6 V
    # From 1.38 at 1 V to the centre 1.8: 0.42 * 6 N are 0.257 kg more.
    assert "hang about 0.51 kg" in point.notes["S18.baseline"]
    assert point.quantities["S18.centre_offset"].value < -0.5


def test_a_baseline_that_the_study_gives_is_kept_and_judged() -> None:
    study = builtin_study()
    given = study.operating_point.model_copy(update={"baseline_v": 0.8})
    fixed = study.model_copy(update={"operating_point": given})
    point = find_point(holds(fixed), triangle(fixed), static(1.2, 1.5784), fixed, RIG)
    assert point.baseline_v == 0.8
    assert point.quantities["S18.centre_offset"].value == pytest.approx(
        (stretch_of(0.8) - 1.3892) / 0.1892, abs=2e-3
    )


def test_the_baseline_of_an_actuator_that_contracts_is_found() -> None:
    """The mirrored stretch has its centre at the same voltage."""
    study = builtin_study()
    held = holds(study)
    expected = find_point(held, triangle(study), static(1.2, 1.5784), study, RIG)
    free_m = static(1.2, 1.5784).free_length_m
    mirrored = [replace(one, length_m=2.8 * free_m - one.length_m) for one in held]
    point = find_point(mirrored, triangle(study), static(2.8 - 1.5784, 2.8 - 1.2), study, RIG)
    assert point.baseline_v == pytest.approx(expected.baseline_v)
    ours, theirs = (one.quantities["S18.centre_offset"].value for one in (point, expected))
    assert ours == pytest.approx(-theirs, abs=1e-9)


def test_a_stretch_that_turns_with_the_voltage_is_no_result() -> None:
    study = builtin_study()
    turned = holds(study)
    turned[1] = replace(turned[1], length_m=1.1 * turned[1].length_m)
    with pytest.raises(ResultError, match="must rise, or fall, with the voltage"):
        find_point(turned, triangle(study), static(1.2, 1.6), study, RIG)


def test_the_cycles_that_are_left_out_do_not_count() -> None:
    study = builtin_study()
    cycles = triangle(study)
    longer = cycles.seen.length_m * np.where(cycles.seen.frame_time_s < 4.0, 1.1, 1.0)
    changed = replace(cycles, seen=replace(cycles.seen, length_m=longer))
    assert changed.length_at(1.0) == pytest.approx(cycles.length_at(1.0), rel=1e-12)
