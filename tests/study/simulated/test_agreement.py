"""The simulated step of an actuator file against its prediction, and why the two differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.control import PidGains
from haselab.firmware import FrontEnd
from haselab.rig.chip import read_design
from haselab.rig.twin.config import Load, Shell, TwinConfig, twin_of_reading
from haselab.study.chip.loops import FAST, LoopRun, StepPlan, desktop_loop
from haselab.study.simulated.agreement import (
    Agreement,
    StepCase,
    agreement_of,
    check_stable,
    largest_noise,
    predicted_loop,
    tolerance,
)

DATA = Path(__file__).resolve().parents[2] / "firmware" / "data"


def case_of(
    config: TwinConfig, *, data: Path = DATA, precondition_v: float = 2.0, step: float = 0.04
) -> StepCase:
    design = read_design(data, "pid", FrontEnd())
    s = design.settings
    gains = PidGains(s.kp, s.ki, s.kd, s.derivative_filter_s)
    plan = StepPlan(0.0, step, 6.0, 4.0, design.zero_length_m, precondition_v)
    return StepCase(design, gains, config, plan, 1)


def with_gains(case: StepCase, gains: PidGains) -> StepCase:
    changed = replace(case.design.settings, kp=gains.kp, ki=gains.ki, kd=gains.kd,
                      derivative_filter_s=gains.derivative_filter_s)  # fmt: skip
    return replace(case, design=replace(case.design, settings=changed), gains=gains)


def played(case: StepCase) -> LoopRun:
    return desktop_loop(case.config, case.seed, case.design.settings, FAST, case.plan)


def compared(case: StepCase) -> Agreement:
    """The loop of the desktop at the chip's rate stands for the chip's."""
    run = played(case)
    return agreement_of(run, run, case)


@pytest.mark.parametrize(("reading", "data"), [("hz", DATA), ("rad", DATA / "rad")])
def test_the_step_of_the_studys_controller_is_the_predicted_one(reading: str, data: Path) -> None:
    case = case_of(twin_of_reading(reading), data=data)
    check_stable(case)
    found = compared(case)
    assert found.agrees and found.causes == ()
    # What is left is the noise of the strain and the capacitance map, 1 % of the step each, and the
    # softening of the twin's elastic law over the step.
    assert found.deviation < 0.06
    # The tolerance of a step at rest, 4 %, up to that of the largest change by the frequency.
    assert 0.04 < found.covered < 0.2


def test_the_prediction_comes_to_rest_at_the_reference() -> None:
    case = case_of(twin_of_reading("hz"))
    expected = predicted_loop(played(case), case)
    at_s = expected.time_s
    # The slow mode of 5 s has e^-1.2 of a small part left before the step, and less after it.
    assert np.abs(expected.strain[(at_s > -1.0) & (at_s < 0.0)]).max() < 1e-3
    assert np.abs(expected.strain[at_s > 3.0] - 0.04).max() < 1e-3
    assert case.deviation(expected, expected) == 0.0


def test_the_tolerated_noise_holds_for_other_noise_and_for_each_length() -> None:
    """The largest of 30 other noises stays below it; that of one drawn noise did not."""
    case = case_of(twin_of_reading("hz"))
    for before_s, after_s in ((6.0, 4.0), (4.0, 1.5)):
        short = replace(case, plan=replace(case.plan, hold_s=before_s, last_s=after_s))
        run = played(short)
        quiet = predicted_loop(run, short)
        drawn, tolerated = [], []
        for seed in range(30 if before_s == 4.0 else 3):
            other = replace(short, seed=seed)
            drawn.append(other.deviation(predicted_loop(run, other, noise=True), quiet))
            tolerated.append(largest_noise(run, other))
        assert max(drawn) < min(tolerated)
        assert drawn[0] < max(drawn), "one drawn noise is no bound"
        assert max(tolerated) < 1.3 * min(tolerated)


def test_a_twin_that_softens_in_the_step_is_named() -> None:
    found = compared(case_of(twin_of_reading("hz"), precondition_v=0.0))
    assert not found.agrees
    (why,) = found.causes
    assert "Mullins effect; --precondition is 0 V" in why


def test_another_actuator_is_named_with_its_resonance() -> None:
    config = twin_of_reading("hz")
    changed = {"load": Load(mass_kg=0.15), "shell": Shell(shear_modulus_pa=25e3)}
    found = compared(case_of(config.model_copy(update=changed)))
    assert not found.agrees
    assert "the twin has a natural frequency of" in found.causes[0]
    assert "but [model] has 32." in found.causes[0]


def test_a_loop_that_is_unstable_on_the_twin_is_refused_before_the_simulation() -> None:
    slow = case_of(twin_of_reading("rad"))
    with pytest.raises(ResultError, match=r"unstable on this twin.*5\.\d+ to 5\.\d+ rad/s.*--twin"):
        check_stable(slow)
    wild = with_gains(case_of(twin_of_reading("hz")), PidGains(5.0, 500.0))
    with pytest.raises(
        ResultError, match=r"\[model\] and \[controller\] is unstable at the chip's"
    ):
        check_stable(wild)


def test_noise_that_drives_the_rate_limit_is_named() -> None:
    """The gains of a design for 1 kHz and 1.8 ms: noise of one update asks for 20 V/s and more."""
    case = case_of(twin_of_reading("hz"))
    found = compared(with_gains(case, PidGains(0.8887, 20.48, 0.04146, 0.002)))
    assert not found.agrees
    assert "at most 20 V/s" in found.causes[-1] and "noise_gain" in found.causes[-1]


def test_a_strain_map_of_another_actuator_is_named() -> None:
    case = case_of(twin_of_reading("hz"))
    run = played(case)
    tables = case.design.tables
    sensing = tables.sensing
    assert sensing is not None and sensing.strain_map is not None
    shifted = sensing.strain_map.model_copy(update={"offset": sensing.strain_map.offset + 0.02})
    moved = tables.model_copy(
        update={"sensing": sensing.model_copy(update={"strain_map": shifted})}
    )
    off = replace(run, strain=run.strain - 0.02)
    found = agreement_of(run, off, replace(case, design=replace(case.design, tables=moved)))
    assert any("capacitance-to-strain map is off by" in why for why in found.causes)


def with_map(case: StepCase, factor: float, band: tuple[float, float] | None = None) -> StepCase:
    """A strain map whose strains are all wrong by a factor, in the file and in the firmware."""
    tables, settings = case.design.tables, case.design.settings
    assert tables.sensing.strain_map is not None
    known = tables.strain_map()
    scaled = [factor * value for value in known.coefficients]
    names = ("slope_per_f", "offset", "curvature_per_f2", "cubic_per_f3")
    changed = tables.sensing.strain_map.model_copy(
        update=dict(zip(names, scaled, strict=True)) | {"band": band}
    )
    moved = tables.model_copy(
        update={"sensing": tables.sensing.model_copy(update={"strain_map": changed})}
    )
    settings = replace(settings, strain_map=(scaled[0], scaled[1], scaled[2], scaled[3]))
    return replace(case, design=replace(case.design, tables=moved, settings=settings))


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_strain_map_that_is_wrong_by_a_tenth_is_no_error_of_the_frequency(factor: float) -> None:
    """At the end, the strain is 1/1.1 or 1/0.9 of the step, plus 1 % of noise and of the map."""
    case = with_map(case_of(twin_of_reading("hz")), factor)
    run = played(case)
    found = agreement_of(run, run, case)
    assert not found.agrees
    assert any("capacitance-to-strain map is off by" in why for why in found.causes)
    late = run.time_s > 2.0
    off = case.differences(run, predicted_loop(run, case))[late]
    assert float(off.mean()) == pytest.approx(abs(1.0 / factor - 1.0), abs=0.02)
    # A frequency that is wrong by 15 % changes a tenth of the step, but not at the end.
    tolerated = tolerance(run, case)
    assert tolerated[run.time_s > 0.0].max() > 0.12
    assert tolerated[late].max() < 0.06 < off.min()


def test_the_tolerance_at_rest_is_that_of_map_and_chip() -> None:
    """One code of the current channel is 2.7 pF; the band of the map is 2 % of the step."""
    case = with_map(case_of(twin_of_reading("hz")), 1.0, band=(-0.0008, 0.0004))
    front = case.design.settings.front_end
    farad_per_code = 500e-12 / front.current_codes(500e-12)
    assert farad_per_code == pytest.approx(2.7e-12, rel=0.02)
    slopes = [abs(case.design.tables.strain_map().slope_at(f)) for f in np.r_[4.5:7:100j] * 1e-10]
    assert case.map_band == pytest.approx(0.02)
    assert min(slopes) < case.sensing_error * 0.04 / farad_per_code < max(slopes)
    tolerated = tolerance(played(case), case)
    at_rest = np.hypot(case.map_band, case.sensing_error)
    assert at_rest < tolerated[-1] < at_rest + 0.02  # noise


def test_a_loop_that_is_unstable_within_its_spread_is_not_compared() -> None:
    case = case_of(twin_of_reading("hz"))
    case = with_gains(case, replace(case.gains, ki=2.5 * case.gains.ki))
    check_stable(case)
    found = compared(case)
    assert not found.agrees and found.causes == ()
    assert "differs from [model] by 15 % (frequency_spread), the loop is unstable" in (
        found.says_nothing
    )


def test_a_band_as_large_as_the_step_is_not_compared() -> None:
    """A strain that does not move would agree."""
    found = compared(with_map(case_of(twin_of_reading("hz")), 1.0, band=(-0.05, 0.05)))
    assert not found.agrees and found.causes == ()
    assert "125 % for the band of the strain map" in found.says_nothing
    assert "a strain that does not move would agree" in found.says_nothing
