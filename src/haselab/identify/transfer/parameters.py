"""Parameters of a fitted transfer function: intervals and identifiability."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from haselab.base import Estimate, JsonObject
from haselab.identify.noise import coloured_covariance
from haselab.identify.transfer.layout import Layout, layout_of
from haselab.identify.transfer.problem import Found, TransferProblem
from haselab.identify.transfer.search import Best
from haselab.identify.transfer.start import delay_margin_s

__all__ = ["covariance_table", "follows_input", "numbers_of", "poles_of", "zeros_of"]

Floats = NDArray[np.float64]
_UNRELATED_P = 1e-6
_WHITE = 1e-3  # whiteness of the residuals above which they count as white
_LARGEST_STD = 1.0  # relative standard deviation of a parameter that is not identifiable
_LARGEST_STD_TIME = 0.5
_TOLD_WELL = 0.1
_ENDLESS = 10.83  # chi-square with one degree, 0.1 %
_REMEDY = {
    "slow_gain": " Add a step record.",
    "slow_time_constant_s": " Add a step record.",
    "delay_s": " Give the delay, or fit no zeros.",
}


def numbers_of(
    layout: Layout, best: Best, inner: Floats
) -> tuple[dict[str, Estimate], Floats, list[str]]:
    """All parameters by name, their covariance, and a note for each that is not identifiable.

    Fixed parameters have no spread.
    """
    numbers = layout.full(best.found.search)
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = best.found.shared
    logarithmic = np.array([name != "delay_s" for name in layout.names])
    values = np.where(logarithmic, np.exp(np.where(logarithmic, numbers, 0.0)), numbers)
    values = np.concatenate([values, factors])
    free = np.concatenate([np.isnan(layout.template), np.isnan(layout.factor_template)])
    slope = np.ones(values.size)
    slope[: numbers.size][logarithmic] = values[: numbers.size][logarithmic]
    covariance = np.zeros((free.size, free.size))
    covariance[np.outer(free, free)] = (inner * np.outer(slope[free], slope[free])).ravel()
    names = (*layout.names, *layout.factor_names)
    blind = _blind(layout, best, values, covariance)
    covariance[blind] = covariance[:, blind] = np.inf
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates: dict[str, Estimate] = {}
    notes = []
    for i, name in enumerate(names):
        unit = "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""
        if blind[i]:
            estimates[name] = Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)
            notes.append(f"{name} is not identifiable from these records.{_REMEDY.get(name, '')}")
        elif i < numbers.size and logarithmic[i]:
            estimates[name] = Estimate.lognormal(values[i], std[i] / values[i], unit)
        else:
            estimates[name] = Estimate.normal(values[i], std[i], unit)
    return estimates, covariance, notes


def covariance_table(estimates: dict[str, Estimate], covariance: Floats) -> JsonObject:
    """The parameters with their covariance as searched: logarithms where these were searched.

    Args:
        estimates: all parameters by name.
        covariance: of `estimates`, in their order. Shape `(P, P)`.
    Returns:
        `names`, `logarithmic`, `values`, `matrix`, see `PlantPosterior`; NaN and infinity where
        a parameter is not identifiable.
    """
    values = np.array([estimate.value for estimate in estimates.values()])
    logarithmic = [
        name.startswith(("natural_frequency", "damping_ratio")) or "time_constant" in name
        for name in estimates
    ]
    slope = np.where(logarithmic, values, 1.0)
    return {
        "names": list(estimates),
        "logarithmic": logarithmic,
        "values": values,
        "matrix": covariance / np.outer(slope, slope),
    }


def _blind(layout: Layout, best: Best, values: Floats, covariance: Floats) -> NDArray[np.bool_]:
    """Mark the parameters that are not identifiable.

    Not identifiable are a frequency or damping with a relative standard deviation above 1, a time
    constant above 0.5 or indistinguishable from infinity, a delay above a tenth of the record, the
    gain of a slow branch whose time constant is not identifiable or that is uncertain by the gain
    of all. A total gain, and a parameter at the end of its range.
    """
    names = (*layout.names, *layout.factor_names)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    longest_s = max(record.duration_s for record in best.records)
    total = sum(abs(v) for n, v in zip(names, values, strict=True) if n.endswith("gain"))
    low, high = best.bounds
    ends = {layout.names[at]: (low[k], high[k]) for k, at in enumerate(layout.free)}
    blind = np.zeros(len(names), dtype=bool)
    for i, name in enumerate(names):
        if name == "delay_s":
            blind[i] = not std[i] <= 0.1 * longest_s
        elif i < len(layout.names):
            lowest, highest = ends.get(name, (-math.inf, math.inf))
            inside = lowest < math.log(values[i]) < highest
            most = _LARGEST_STD_TIME if "time_constant" in name else _LARGEST_STD
            blind[i] = not (inside and std[i] <= most * values[i])
            if not blind[i] and name.startswith("slow") and std[i] > _TOLD_WELL * values[i]:
                blind[i] = _endless(layout, best, i)
        elif name.startswith("slow_gain"):
            constant = names.index(name.replace("gain", "time_constant") + "_s")
            blind[i] = bool(blind[constant]) or not std[i] <= abs(total)
        else:
            blind[i] = not math.isfinite(std[i])
    return blind


def _endless(layout: Layout, best: Best, at: int) -> bool:
    """Whether the time constant is indistinguishable from ten times the longest record."""
    longest_s = max(record.duration_s for record in best.records)
    fixed = {**layout.structure.fixed, layout.names[at]: 10.0 * longest_s}
    held = layout_of(replace(layout.structure, fixed=fixed))
    others = layout.free != at
    bounds = best.bounds[0][others], best.bounds[1][others]
    endless = TransferProblem(held, best.records, delay_margin_s(best.records)).minimise(
        best.found.search[others], bounds, gain=1e-7
    )
    count = sum(record.y.size for record in best.records)
    return endless.cost - best.found.cost < _ENDLESS * best.found.cost / count


def follows_input(best: Best) -> bool:
    """Whether the response to the input differs significantly from zero.

    The size of the fitted response is estimated with its noise as if its shape were known, and
    tested with as many degrees of freedom as there are shape parameters.
    """
    found, columns = best.found, best.columns
    if found.shared.size == 0:
        return True
    searched = found.search.size
    response = [z[:, searched:] @ found.shared for z in columns.sensitivities]
    degrees = searched + found.shared.size
    if best.whiteness_p > _WHITE:
        count = sum(e.size for e in columns.residuals)
        energy = sum(float(shape @ shape) for shape in response)
        variance = found.cost / count / energy if energy > 0.0 else math.inf
    else:
        shapes = [shape[:, None] for shape in response]
        variance = float(coloured_covariance(shapes, columns.residuals, degrees, columns.own)[0, 0])
    return not variance > 0.0 or float(chdtrc(degrees, 1.0 / variance)) < _UNRELATED_P


def poles_of(
    layout: Layout, numbers: Floats, estimates: dict[str, Estimate]
) -> tuple[complex, ...]:
    """Poles, in rad/s; NaN for a slow branch whose time constant is not identifiable."""
    poles = [pole for section in layout.sections for pole in section.poles(numbers)]
    fast = layout.structure.poles
    taus = [e.value for name, e in estimates.items() if name.startswith("slow_time_constant")]
    slow = [complex(-1.0 / tau) if tau == tau else complex(math.nan, math.nan) for tau in taus]
    return (*poles[:fast], *slow)


def zeros_of(layout: Layout, numbers: Floats, found: Found) -> tuple[complex, ...]:
    """Zeros of the fast part, in rad/s."""
    count = layout.structure.zeros
    if count == 0:
        return ()
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = found.shared
    poles = np.array(layout.sections[0].poles(numbers))
    scale = float(np.prod(-poles).real) ** (1.0 / poles.size)
    return tuple(complex(root) for root in np.roots(factors[count::-1]) * scale)
