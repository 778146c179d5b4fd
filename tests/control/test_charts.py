"""The figure of a design shows its own numbers."""

from __future__ import annotations

import numpy as np
import pytest

import haselab as hl
from haselab.control.spec import DesignSpec
from haselab.models.plant import Plant, SlowMode

PLANT = Plant(1.0, 32.1, 0.12, slow_modes=(SlowMode(0.5, 6.0),))
DELAY_S, RATE_HZ = 0.010, 100.0


@pytest.fixture(scope="module")
def design() -> hl.Design:
    return hl.design(PLANT, DesignSpec(rise_time_s=0.75, overshoot=0.07), delay_s=DELAY_S)


def test_the_open_loop_is_the_closed_form(design: hl.Design) -> None:
    """Plant times PID with its filter, the delay, and the hold."""
    magnitude, phase = design.chart().panels[2:]
    hz = magnitude.curves[0].x
    low = hz < 0.015 * RATE_HZ  # where a sampled controller is like a continuous one
    s = 2j * np.pi * hz[low]
    gains = design.gains
    summed = gains.ki / RATE_HZ / -np.expm1(-s / RATE_HZ)  # the integral of a sampled controller
    controller = gains.kp + summed + gains.kd * s / (gains.derivative_filter_s * s + 1.0)
    half = 0.5 * s / RATE_HZ
    hold = np.exp(-half) * np.sinh(half) / half
    loop = controller * PLANT.frequency_response(s.imag) * hold * np.exp(-s * DELAY_S)
    assert np.allclose(magnitude.curves[0].y[low], np.abs(loop), rtol=0.03)
    assert np.allclose(phase.curves[0].y[low], np.degrees(np.unwrap(np.angle(loop))), atol=2.0)


def test_margin_and_crossover_can_be_read_off(design: hl.Design) -> None:
    magnitude, phase = design.chart().panels[2:]
    found = design.nominal.margins
    hz = found.crossover_rad_s / (2.0 * np.pi)
    assert np.interp(hz, magnitude.curves[0].x, magnitude.curves[0].y) == pytest.approx(1, abs=0.01)
    read = 180.0 + np.interp(hz, phase.curves[0].x, phase.curves[0].y)
    assert read == pytest.approx(found.phase_margin_deg, abs=0.5)


def test_the_step_ends_at_the_reference_within_the_limits(design: hl.Design) -> None:
    output, controller = design.chart().panels[:2]
    measured, reference = output.curves
    assert design.spec.step is not None and np.all(reference.y == design.spec.step)
    assert measured.y[-1] == pytest.approx(design.spec.step, rel=0.02)
    limits = design.setting.saturation
    assert (
        controller.curves[0].y.min() >= limits.low and controller.curves[0].y.max() <= limits.high
    )


def test_a_design_can_be_plotted(design: hl.Design) -> None:
    figure = design.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "Output", "Controller", "Magnitude (1)", "Phase (°)",
    ]  # fmt: skip
