"""The Bode diagram in the figure of a transfer function."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Panel
from haselab.identify.transfer.fit import Record, TransferFit, fit_transfer
from haselab.identify.transfer.nonlinear import fit_nonlinear
from haselab.models import Plant

RATE_HZ, NOISE = 100.0, 0.01
GAIN, NATURAL, DAMPING, DELAY_S = 0.5, 15.0, 0.09, 0.012
PLANT = Plant(GAIN, NATURAL, DAMPING, DELAY_S)


def _played(seed: int, late_s: float = 0.0, samples: int = 2000) -> Record:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=samples)
    time_s = np.arange(u.size) / RATE_HZ + late_s
    y = PLANT.simulate(u, RATE_HZ, time_s) + NOISE * rng.normal(size=u.size)
    return Record(u, RATE_HZ, y, time_s)


def _bode(fit: TransferFit) -> tuple[Panel, Panel]:
    magnitude, phase = fit.chart().panels[-2:]
    assert (magnitude.y_label, phase.y_label) == ("Magnitude", "Phase (°)")
    return magnitude, phase


def _closed_form(frequency_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    s = 2j * np.pi * frequency_hz
    resonance = GAIN * NATURAL**2 / (s**2 + 2.0 * DAMPING * NATURAL * s + NATURAL**2)
    return np.asarray(resonance * np.exp(-s * DELAY_S))


def test_model_and_measurement_lie_on_the_closed_form() -> None:
    magnitude, phase = _bode(fit_transfer(_played(3)))
    points, model = magnitude.curves
    true = _closed_form(model.x)
    assert model.std is not None and np.all(model.std > 0.0)
    # Few parameters determine the whole curve, so its errors move together: 4 deviations.
    assert np.all(np.abs(model.y - np.abs(true)) < 4.0 * model.std)
    drawn, turns = phase.curves[1], np.degrees(np.unwrap(np.angle(true)))
    assert drawn.std is not None
    assert np.all(np.abs(drawn.y - turns) < 4.0 * drawn.std + 1e-9)
    # The noise of one line is that of the output over the input's spectrum, which varies: the
    # median of 979 lines is within a few per cent where the actuator responds strongly.
    strong = points.x < 4.0
    ratio = points.y[strong] / np.abs(_closed_form(points.x[strong]))
    assert abs(np.median(ratio) - 1.0) < 0.05
    at = np.interp(phase.curves[0].x, drawn.x, drawn.y)
    assert np.all(np.abs(phase.curves[0].y - at) <= 180.0 + 1e-9)


def test_the_axis_ends_above_what_the_record_shows() -> None:
    """A record at 5 kHz of a chirp to 20 Hz was drawn to 2.5 kHz, with its points in a corner."""
    rate_hz, time_s = 5000.0, np.arange(100_000) / 5000.0
    rng = np.random.default_rng(5)
    u = np.sin(2.0 * np.pi * time_s * (0.5 + 0.5 * 19.5 * time_s / time_s[-1]))
    u = u + 0.01 * rng.normal(size=u.size)
    y = PLANT.simulate(u, rate_hz, time_s) + NOISE * rng.normal(size=u.size)
    magnitude, phase = _bode(fit_transfer(Record(u, rate_hz, y, time_s)))
    for panel in (magnitude, phase):
        assert all(15.0 < curve.x.max() < 45.0 for curve in panel.curves)


def test_without_a_frequency_response_the_model_is_drawn_alone() -> None:
    magnitude, phase = _bode(fit_transfer(_played(3, late_s=0.003)))
    (label,) = (curve.label for curve in magnitude.curves)
    assert label == "model, 95 % (no measured points: the records do not give a frequency response)"
    assert len(phase.curves) == 1


def test_the_points_of_a_hammerstein_model_are_those_of_its_linear_part() -> None:
    """The input goes through the curve first: without it, they lie 3 to 9 % beside the model."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(0.0, 2.0, 80), 50)
    time_s = np.arange(u.size) / RATE_HZ
    y = PLANT.simulate(u**2, RATE_HZ, time_s) + 1e-3 * rng.normal(size=u.size)
    fit = fit_nonlinear(Record(u, RATE_HZ, y, time_s), None, "hammerstein-2")
    points, model = _bode(fit)[0].curves
    assert points.label == "measured"
    # The slope of u^2 at the mean input u0 is 2 u0.
    slope = 2.0 * fit.operating_input
    strong = points.x < 4.0
    ratio = points.y[strong] / (slope * np.abs(_closed_form(points.x[strong])))
    assert np.median(np.abs(ratio - 1.0)) < 0.01
    assert np.allclose(model.y, slope * np.abs(_closed_form(model.x)), rtol=0.01)


def test_a_long_record_has_points_too() -> None:
    """More than 20,000 samples: averaged segments, with a bias of a few per cent at the peak."""
    points = _bode(fit_transfer(_played(3, samples=24000)))[0].curves[0]
    assert points.label == "measured" and points.x.size > 50
    strong = (points.x > 0.1) & (points.x < 4.0)
    ratio = points.y[strong] / np.abs(_closed_form(points.x[strong]))
    assert np.all(np.abs(ratio - 1.0) < 0.1)


def test_several_records_share_one_diagram() -> None:
    fit = fit_transfer([_played(3), _played(4)])
    assert len(_bode(fit)[0].curves) == 2
    assert fit.plot().axes[-1].get_xscale() == "log"


def test_no_diagram_where_a_parameter_is_not_identifiable() -> None:
    fit = fit_transfer(_played(3))
    blind = replace(fit.parameters["gain"], value=math.nan, std=math.inf)
    lost = replace(fit, parameters={**fit.parameters, "gain": blind})
    assert [panel.y_label for panel in lost.chart().panels] == ["Output", "Residual", "Input"]
