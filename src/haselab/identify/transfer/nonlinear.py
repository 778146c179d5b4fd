"""Nonlinear alternatives to a linear transfer function, and the criterion to prefer one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, checked
from haselab.identify.fit import several
from haselab.identify.model_choice import APART
from haselab.identify.noise import fit_percent
from haselab.identify.nonlinear.hammerstein import DEGREES, fit_hammerstein
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit, fitted_count, fitted_part, no_fit
from haselab.identify.nonlinear.oscillator import fit_duffing, fit_output_curve
from haselab.identify.record import Record
from haselab.identify.transfer.checks.clipping import richer_fits
from haselab.identify.transfer.fit import TransferFit, with_record_notes
from haselab.identify.transfer.layout import TransferStructure, layout_of
from haselab.identify.transfer.problem import TransferProblem
from haselab.identify.transfer.search import best_fit
from haselab.identify.transfer.start import delay_margin_s

__all__ = [
    "NONLINEAR",
    "beats_linear",
    "fit_nonlinear",
    "linear_candidates",
    "nonlinear_candidates",
]

Floats = NDArray[np.float64]
NONLINEAR = ("hammerstein-2", "hammerstein-3", "duffing", "duffing-asymmetric", "wiener")
_WORSE = 4.0  # twice the loss of logarithmic likelihood on held-out rows that noise can explain
_WHITE = 1e-3
_ONE = ("natural_frequency_rad_s", "damping_ratio", "gain", "delay_s")


@checked
def fit_nonlinear(
    records: Record | Sequence[Record], structure: TransferStructure | None, kind: str
) -> NonlinearFit:
    """Fit one nonlinear model.

    Args:
        records: experiments, or one.
        structure: structure of the linear part. Default: one resonance with a delay.
        kind: one of `NONLINEAR`: a polynomial of degree 2 or 3 of the input, a spring with a cubic
            or a quadratic and a cubic part, a curve of the output.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: an unknown kind, or a structure that the model does not support.
    """
    if kind not in NONLINEAR:
        raise InputError(f"nonlinear = {kind}; it must be one of {', '.join(NONLINEAR)}.")
    family, _, which = kind.partition("-")
    if family == "hammerstein":
        fit = fit_hammerstein(records, structure, int(which))
    elif family == "wiener":
        fit = fit_output_curve(records, structure)
    else:
        fit = fit_duffing(records, structure, (2, 3) if which else (3,))
    return _noted(fit, several(records))


def _noted(fit: NonlinearFit, records: Sequence[Record]) -> NonlinearFit:
    """Add the notes of the records to a fit."""
    noted = with_record_notes(fit, records)
    assert isinstance(noted, NonlinearFit)
    return noted


def nonlinear_candidates(
    records: Sequence[Record], structures: Sequence[TransferStructure], linear: TransferFit
) -> list[NonlinearFit]:
    """All nonlinear models: one resonance, and curves of the input ahead of each structure.

    Once one model leaves white residuals, its delay is the start of the others.

    Args:
        records: experiments.
        structures: of the linear part; the structure of `linear` first.
        linear: the best linear fit.
    """
    first = structures[0]
    fixed = {name: value for name, value in first.fixed.items() if name in _ONE}
    one = replace(first, poles=2, zeros=0, slow_modes=0, fixed=fixed)
    start = best_fit(layout_of(one), records)
    if linear.best is not None and one == first:
        start = linear.best
    fits = []
    if start is not None:
        fits = [
            fit_duffing(records, one, (3,), start),
            fit_duffing(records, one, (2, 3), start),
            fit_output_curve(records, one, linear=start),
        ]
    clear = any(f.residual_whiteness_p > _WHITE for f in (linear, *fits) if f.succeeded)
    for structure in structures:
        known = []
        if clear and linear.best is not None and structure == linear.structure:
            known = [linear.best.found.search]
        for degree in DEGREES:
            try:
                fits.append(fit_hammerstein(records, structure, degree, known))
            except InputError as error:
                fits.append(no_fit(structure, f"hammerstein-{degree}", str(error)))
    return [_noted(fit, records) for fit in fits]


def linear_candidates(linear: TransferFit) -> list[TransferFit]:
    """Linear fits with one more parameter: what they explain is not a nonlinearity."""
    if linear.best is None or linear.residual_whiteness_p > _WHITE:
        return []
    measured = [r.y for r in linear.records]
    fits = []
    for structure, best in richer_fits(layout_of(linear.structure), linear.best):
        residuals = best.columns.residuals
        modelled = [y - e for y, e in zip(measured, residuals, strict=True)]
        fits.append(
            TransferFit(
                status="ok",
                structure=structure,
                fit_percent=fit_percent(measured, modelled),
                residual_whiteness_p=best.whiteness_p,
                residuals=residuals,
                best=best,
            )
        )
    return fits


def beats_linear(
    candidate: NonlinearFit, bic: float, linear: TransferFit | None, linear_bic: float
) -> bool:
    """Whether a nonlinear model is preferred to the best linear one.

    Its BIC has to be lower by 6 (odds of 20 to 1), and on the last quarter of each record,
    simulated by a fit to the rest, it must not be worse. Without a linear fit it has to leave white
    residuals.
    """
    if not candidate.succeeded:
        return False
    if linear is None:
        return candidate.residual_whiteness_p > _WHITE
    if not bic < linear_bic - APART:
        return False
    ours, theirs = candidate.validation_errors, _held_out_errors(linear)
    if ours is None or theirs is None:
        return True
    count = sum(e.size for e in ours)
    energies = [sum(float(e @ e) for e in errors) for errors in (ours, theirs)]
    return count * math.log(max(energies[0], 1e-300) / max(energies[1], 1e-300)) < _WORSE


def _held_out_errors(fit: TransferFit) -> list[Floats] | None:
    """Errors of a linear fit on the last quarter, simulated by a fit to the rest."""
    if fit.best is None:
        return None
    records = fit.records
    early = fitted_part(records)
    if early is None:
        return None
    layout = layout_of(fit.structure)
    margin_s = delay_margin_s(records)
    found = TransferProblem(layout, early, margin_s).minimise(
        fit.best.found.search, fit.best.bounds, gain=1e-7
    )
    modelled = TransferProblem(layout, records, margin_s).predict(found)
    return [(r.y - m)[fitted_count(r) :] for r, m in zip(records, modelled, strict=True)]
