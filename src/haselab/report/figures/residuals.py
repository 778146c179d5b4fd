"""Figure 10: the residuals of the fits."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase

from haselab.report.analysis import Array, LeftOutError
from haselab.report.figures.plan import FigurePlan, Panel
from haselab.report.folder import RunFolder
from haselab.report.style import BLUE, PALETTE, RED, label_text, legend_below, thinned

__all__ = ["PLAN"]

_SAMPLES_DRAWN = 3000
_FEWEST = 32  # values from which noise is estimated


def _rms(residual: Array) -> str:
    finite = residual[np.isfinite(residual)]
    return f"rms {np.sqrt(np.mean(finite**2)):.2g}" if finite.size else "no overlap"


def _parts(residual: Array, unit: str) -> str:
    """Misfit and noise of residuals in the order of time, apart.

    White noise is what third differences leave, of variance 20; what is smooth is misfit.
    """
    finite = residual[np.isfinite(residual)]
    if finite.size < _FEWEST:
        return f"{_rms(residual)} {unit}"
    noise = float(np.mean(np.diff(finite, 3) ** 2)) / 20.0
    misfit = max(float(np.mean(finite**2)) - noise, 0.0)
    return f"misfit {np.sqrt(misfit):.2g} {unit}, noise {np.sqrt(noise):.2g} {unit} rms"


def _at(x: Array, fit_x: Array, fit_y: Array) -> Array:
    """The fitted curve at the abscissas of the data, NaN outside its range."""
    order = np.argsort(fit_x)
    return np.interp(x, fit_x[order], fit_y[order], left=np.nan, right=np.nan)


def _finish(host: FigureBase, axes: Axes, x_label: str, y_label: str) -> None:
    axes.axhline(0.0, color="black", linewidth=0.6)
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    legend_below(host, axes, 2)


def _chirp(host: FigureBase, run: RunFolder) -> None:
    section = run.section("chirp")
    time_s = section.array("time_s")
    strain = section.array("strain", like=time_s)
    fits = section.sections("fits")
    if not fits:
        raise LeftOutError("'chirp' in analysis.json has no 'fits'.")
    step = thinned(time_s.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    for at, (name, fit) in enumerate(fits.items()):
        residual = 100.0 * (strain - fit.array("strain", like=time_s))
        colour = PALETTE[(0, 2, 3, 4)[at % 4]]
        label = label_text(f"{name}: {_parts(residual, '%')}")
        axes.plot(time_s[step], residual[step], color=colour, linewidth=0.8, label=label)
    _finish(host, axes, "Time (s)", "Residual strain (%)")


def _voltage_map(host: FigureBase, run: RunFolder) -> None:
    section = run.section("voltage_map")
    strain = section.array("strain")
    fit_strain = section.array("fit_strain")
    fit_v = section.array("fit_voltage_v", like=fit_strain)
    residual = section.array("voltage_v", like=strain) - _at(strain, fit_strain, fit_v)
    step = thinned(strain.size, _SAMPLES_DRAWN)
    axes = host.subplots()
    label = _parts(residual, "V")
    axes.plot(100.0 * strain[step], residual[step], color=BLUE, linewidth=0.7, label=label)
    _finish(host, axes, "Strain (%)", "Residual voltage (V)")


def _static(host: FigureBase, run: RunFolder) -> None:
    section = run.section("static")
    stretch = section.array("stretch")
    fit_stretch = section.array("fit_stretch")
    fit_n = section.array("fit_load_n", like=fit_stretch)
    residual = section.array("load_n", like=stretch) - _at(stretch, fit_stretch, fit_n)
    std = section.optional("load_std_n", like=stretch)
    axes = host.subplots()
    axes.errorbar(
        stretch,
        residual,
        yerr=std,
        fmt="o",
        color=BLUE,
        markersize=3,
        capsize=2,
        label=f"{_rms(residual)} N",
    )
    _finish(host, axes, "Stretch λ (1)", "Residual load (N)")


def _free_response(host: FigureBase, run: RunFolder) -> None:
    trials = run.section("free_response").sections("trials")
    fitted = {name: trial for name, trial in trials.items() if "creeping_m" in trial}
    if not fitted:
        raise LeftOutError("'free_response' in analysis.json has no trial with 'creeping_m'.")
    axes = host.subplots()
    for at, (name, trial) in enumerate(fitted.items()):
        time_s = trial.array("time_s")
        moved = trial.array("displacement_m", like=time_s)
        residual = 1e3 * (moved - trial.array("creeping_m", like=time_s))
        colour = (BLUE, RED)[at % 2]
        label = f"trial {name}: {_parts(residual, 'mm')}"
        axes.plot(time_s, residual, color=colour, linewidth=0.8, label=label)
    _finish(host, axes, "Time after the drop (s)", "Residual (mm)")


PLAN = FigurePlan(
    "residuals",
    "Figure 10",
    "residuals",
    "Residuals, measured minus fitted. A: chirp, for each model; remaining structure shows "
    "dynamics that the model lacks. B: voltage map; the two branches are the hysteresis. C: static "
    "load test. D: free response. Misfit is the smooth part of the residuals, noise the part that "
    "changes at random from one value to the next.",
    (
        Panel("A", "Chirp", _chirp, wide=True, height_in=2.6),
        Panel("B", "Voltage map", _voltage_map, height_in=2.6),
        Panel("C", "Load test", _static, height_in=2.6),
        Panel("D", "Free response", _free_response, wide=True, height_in=2.4),
    ),
)
