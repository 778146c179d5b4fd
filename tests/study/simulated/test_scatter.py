"""What scatters the strain of the chip's loop at rest: noise, the rate limit, or rounding."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from haselab.control import PidGains
from haselab.firmware import CAPACITANCE_NOISE, FrontEnd
from haselab.rig.chip import read_design
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench
from haselab.sensing.quadrature import sense_quadrature
from haselab.study.chip.loops import FAST, StepPlan, desktop_loop
from haselab.study.simulated.agreement import StepCase, predicted_loop
from haselab.study.simulated.scatter import Scatter, predicted_scatter, scatter_of

DATA = Path(__file__).resolve().parents[2] / "firmware" / "data"
STEP_S, HIGH_PASS_HZ, LOW_PASS_HZ = 100 / 16e6, 5e3, 8e3  # of the stages in firmware/sim/cosim.c
STAGES = (50.0, 0.8)
AT = ((59, 99, 139), (79, 119, 159))  # steps of a sampling cycle at which the channels are sampled
CODES_PER_V = 1023 / 5.0


@pytest.fixture(scope="module")
def case() -> StepCase:
    design = read_design(DATA, "pid", FrontEnd())
    s = design.settings
    gains = PidGains(s.kp, s.ki, s.kd, s.derivative_filter_s)
    plan = StepPlan(0.0, 0.04, 6.0, 2.0, design.zero_length_m, 2.0)
    return StepCase(design, gains, twin_of_reading("hz"), plan, 1)


def volts_of_a_capacitor(farad: float, updates: int) -> Iterator[list[NDArray[np.float64]]]:
    """What both channels show of a capacitor in a sampling cycle: three volts each."""
    config = twin_of_reading("hz")
    daq = config.acquisition.model_copy(update={"rate_hz": 160e3, "block_samples": 160})
    bench = TwinBench(config.model_copy(update={"acquisition": daq}), 1)
    bench.connect(farad, 5e3)
    bench.sine(5e3, 0.05)
    keep = 1.0 / (1.0 + 2.0 * math.pi * HIGH_PASS_HZ * STEP_S)
    follow = 1.0 - math.exp(-2.0 * math.pi * LOW_PASS_HZ * STEP_S)
    state = np.zeros((2, 2, 1))
    for _ in range(updates):
        block, shown = np.asarray(bench.read(), dtype=np.float64) * 20.0 / 2**16, []
        for k, (stage, at) in enumerate(zip(STAGES, AT, strict=True)):
            passed, state[k, 0] = lfilter([keep, -keep], [1.0, -keep], block[:, k], zi=state[k, 0])
            out, state[k, 1] = lfilter([follow], [1.0, follow - 1.0], passed, zi=state[k, 1])
            shown.append(stage * out[list(at)] + 2.5)
        yield shown


def test_rounding_adds_a_twentieth_to_the_scatter_of_a_constant_capacitance(case: StepCase) -> None:
    """The same record with the C of the microcontroller and 10 bits, and unrounded in numpy."""
    volts = np.array(list(volts_of_a_capacitor(590e-12, 1200)))[100:]  # (N, 2, 3)
    codes = np.zeros((volts.shape[0], 4, 2), dtype=np.int16)  # the first reading has no weight
    codes[:, 1:] = np.floor(volts * CODES_PER_V).astype(np.int16).transpose(0, 2, 1)
    settings = case.design.settings
    rounded = sense_quadrature(codes.reshape(-1, 2), settings)[1:]
    a, b, c = (np.concatenate([volts[:-1, :, k], volts[1:, :, k]], axis=1).T for k in range(3))
    v, i = (
        a[k] - 2.0 * b[k] + c[k] + a[k + 2] - 2.0 * b[k + 2] + c[k + 2]
        + 1j * (b[k] - a[k] + c[k] - a[k + 2] - b[k + 2] + c[k + 2]) for k in (0, 1)
    )  # fmt: skip
    turn_re, turn_im = settings.sensing[:2]
    ratio = v * i.conj()
    exact = np.abs(i) ** 2 / -(turn_re * ratio.imag + turn_im * ratio.real)
    scatter, unrounded = (float(x.std() / x.mean()) for x in (rounded, exact))
    assert unrounded < scatter < 1.1 * unrounded
    assert 0.7 < scatter / CAPACITANCE_NOISE < 1.0, "what designs and predictions assume"
    # What rounding does is a constant error, of up to a code of the current channel.
    assert abs(rounded.mean() - exact.mean()) < 2.7e-12


def test_without_the_rate_limit_it_is_the_scatter_of_the_linear_loop(case: StepCase) -> None:
    linear = predicted_scatter(case, math.inf)
    run = desktop_loop(case.config, 1, case.design.settings, FAST, case.plan)
    quiet, noisy = (predicted_loop(run, case, noise=noise) for noise in (False, True))
    rest = run.time_s > -3.0
    assert linear == pytest.approx(float(np.std((noisy.strain - quiet.strain)[rest])) / 0.04,
                                   rel=0.25)  # fmt: skip
    assert 0.0015 < linear < 0.003


def test_the_rate_limit_multiplies_the_scatter_and_is_named(case: StepCase) -> None:
    """The co-simulated chip scatters by 0.0075 to 0.0088 of the step, with these gains."""
    found = Scatter(0.008, predicted_scatter(case), predicted_scatter(case, math.inf), 20.0)
    assert 0.006 < found.predicted < 0.011
    assert "faster than its rate limit of 20 V/s" in found.cause
    assert "noise_gain" in found.cause
    gentle = replace(case.design.settings, kp=0.0, ki=2.0, kd=0.0)
    calm = replace(case, design=replace(case.design, settings=gentle))
    free = predicted_scatter(calm, math.inf)
    assert predicted_scatter(calm) == pytest.approx(free, rel=0.05)
    assert Scatter(free, free, free, 20.0).cause == ""


def test_the_scatter_of_a_played_loop_falls_without_the_limit(case: StepCase) -> None:
    """The desktop's loop with the limit of the chip stands for the chip's."""
    with_limit, without = (
        scatter_of(
            desktop_loop(case.config, 1, case.design.settings, replace(FAST, limited=limited),
                         case.plan), case
        ) for limited in (True, False)
    )  # fmt: skip
    assert with_limit.simulated > 2.0 * without.simulated
    assert with_limit.predicted == without.predicted
