"""Prediction of a record that was not used for the fit, with error and band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import checked
from haselab.identify.fit import Prediction, several
from haselab.identify.hold import held_input
from haselab.identify.record import Record
from haselab.identify.training_output import TrainingOutput
from haselab.models.plant import Plant
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel

__all__ = ["fitted_output", "note_range", "predict"]

Floats = NDArray[np.float64]
_DRAWS = 100
_HALF_WIDTH = 1.959963984540054  # standard deviations of a 95 % interval
_BEYOND = 0.05  # of the width of the fitted range: what noise adds at its ends
_SLOWEST = 10.0  # lengths of a record beyond which a free response counts as a straight line


@checked
def predict(
    model: Plant | RationalModel,
    records: Record | Sequence[Record],
    *,
    posterior: PlantPosterior | None = None,
    noise_std: float = 0.0,
    free_start: bool = True,
    training_output: TrainingOutput | None = None,
    rng: np.random.Generator,
) -> Prediction:
    r"""Simulate records from their inputs and compare the result with their outputs.

    The state before a record is not an error of the model: with `free_start` the initial
    state and a constant are fitted to each record by least squares, as the System Identification
    Toolbox's `compare` does. The band is $1.96\sqrt{\sigma_p^2 + \sigma_n^2}$ with $\sigma_p$ from
    plants drawn from the posterior and $\sigma_n$ from the noise.

    Args:
        model: model under test.
        records: records that were not used for the fit, or one.
        posterior: of the model's parameters; None: no band.
        noise_std: root mean square of the residuals of the fit, in the unit of the output.
        free_start: fit initial state and constant; False: the record starts at 0 in steady state.
        training_output: what is kept of the outputs of the fit; None: not known.
        rng: random generator of the plants.
    Returns:
        The prediction.
    Raises:
        InputError: no record.
    Example:
        >>> plant, time_s = Plant(0.5, 5.0, 0.1), np.arange(400) / 100.0
        >>> u = np.sign(np.sin(time_s))
        >>> record = Record(u, 100.0, 1.0 + plant.simulate(u, 100.0, time_s), time_s)
        >>> found = predict(plant, [record], rng=np.random.default_rng(1))
        >>> round(found.fit_percent, 6), found.status
        (100.0, 'ok')
    """
    records = several(records)
    modelled = [fitted_output(model, record, free_start) for record in records]
    half = None
    if posterior is not None:
        spread = [_spread(posterior, record, free_start, rng) for record in records]
        half = _HALF_WIDTH * np.sqrt(np.concatenate(spread) ** 2 + noise_std**2)
    alone = [_fitted(record.y, _free_columns(np.asarray(model.poles), record))
             for record in records if free_start]  # fmt: skip
    return Prediction.of(
        [record.y for record in records], modelled, half, noise_std=noise_std,
        without_input=alone, training_output=training_output,
    )  # fmt: skip


def note_range(
    found: Prediction, records: Record | Sequence[Record], fitted: tuple[float, float] | None
) -> Prediction:
    """Note inputs that the record of the fit did not reach.

    Args:
        found: the prediction of the records.
        records: with the inputs of the recording, in the unit of `fitted`.
        fitted: lowest and highest input of the fit; None: not known.
    Returns:
        The prediction; with a note if an input is outside by more than 5 % of the range.
    """
    if fitted is None:
        return found
    low = min(float(record.u.min()) for record in several(records))
    high = max(float(record.u.max()) for record in several(records))
    slack = _BEYOND * (fitted[1] - fitted[0])
    if low >= fitted[0] - slack and high <= fitted[1] + slack:
        return found
    note = (
        f"The input goes from {low:.4g} to {high:.4g}, but the model was fitted to inputs from "
        f"{fitted[0]:.4g} to {fitted[1]:.4g}: the prediction may be wrong for this reason alone"
    )
    return replace(found, notes=(*found.notes, note))


def _spread(
    posterior: PlantPosterior, record: Record, free_start: bool, rng: np.random.Generator
) -> Floats:
    """Standard deviation of the prediction over plausible plants. Shape `(M,)`."""
    drawn = [fitted_output(plant, record, free_start) for plant in posterior.draw(_DRAWS, rng)]
    return np.asarray(np.std(drawn, axis=0, ddof=1))


def fitted_output(model: Plant | RationalModel, record: Record, free_start: bool = True) -> Floats:
    """The model's output, with the initial state and constant that fit the record best.

    Args:
        model: that predicts.
        record: its input is played, its output the state is fitted to.
        free_start: fit them; False: the record starts at rest at 0.
    Returns:
        Output. Shape `(M,)`.
    """
    # with a free start the constant includes the response to the level before the record
    level = float(record.u[0]) if free_start else 0.0
    u, rate_hz = held_input(record)
    output = model.simulate(u - level, rate_hz, record.output_time_s)
    if not free_start:
        return output
    columns = _free_columns(np.asarray(model.poles), record)
    return output + _fitted(record.y - output, columns)


def _fitted(values: Floats, columns: Floats) -> Floats:
    """Combination of columns that is nearest to values. Shape `(M,)`."""
    return np.asarray(columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0])


def _free_columns(poles: NDArray[np.complex128], record: Record) -> Floats:
    """A constant and the model's free responses. Shape `(M, P + 1)`."""
    time_s = record.output_time_s - record.output_time_s[0]
    columns = [np.ones_like(time_s)]
    slowest = 1.0 / (_SLOWEST * max(record.duration_s, 1e-9))
    for pole in poles:
        if pole.imag < 0.0 or abs(pole) < slowest:
            continue
        # a growing response is computed backwards in time, so that no column overflows
        shift = time_s if pole.real <= 0.0 else time_s - time_s[-1]
        wave = np.exp(pole.real * shift + 1j * pole.imag * time_s)
        columns.append(wave.real)
        if pole.imag > 0.0:
            columns.append(wave.imag)
    return np.stack(columns, axis=1)
