"""What all fits share: numbers with their covariance, a summary, a figure, new data."""

from __future__ import annotations

import html
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError, checked
from haselab.base.chart import Chart
from haselab.identify.band import BandCheck
from haselab.identify.noise import fit_percent
from haselab.identify.training_output import TrainingOutput, hash_output, share_used

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["CurveFit", "Fit", "Prediction", "RecordFit", "propagated", "rescaled", "several"]

Floats = NDArray[np.float64]
Recorded = TypeVar("Recorded")
Part = TypeVar("Part")
_QUALITIES = ("fit_percent", "r_squared", "residual_whiteness_p", "chi_squared_ratio")
_NAME_WIDTH = 28
_USED = 0.05  # share of samples that a fit has used, from which a prediction is no validation
_NO_BETTER = 0.95  # rms error over that of a prediction without the input


@dataclass(frozen=True)
class Prediction:
    """Measured data beside what a model says of them.

    Args:
        status: "ok", or why this is no validation of the model.
        used_for_fit: share of the samples that the fit has used, recognised by their values; NaN
            where it is not known what the model was fitted to, where the steps of the converter
            hide it, and where no samples can be compared.
        fit_percent: NRMSE fit: 100 is perfect, 0 no better than the mean.
        rms_error: root mean square of measured minus predicted, in the unit of the output.
        inside_band: share of the samples inside the 95 % band; NaN where there is no band.
        predicted: of all records, one after the other. Shape `(M,)`.
        half_band: half the width of the band at each sample. Shape `(M,)`; empty without a band.
        measured: of all records. Shape `(M,)`.
        notes: remarks for the user, one sentence or two each.
    """

    status: str
    used_for_fit: float
    fit_percent: float
    rms_error: float
    inside_band: float
    predicted: Floats = field(repr=False)
    half_band: Floats = field(repr=False)
    measured: Floats = field(repr=False)
    notes: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        measured: Sequence[Floats],
        modelled: Sequence[Floats],
        half_band: Floats | None = None,
        *,
        noise_std: float = 0.0,
        without_input: Sequence[Floats] = (),
        training_output: TrainingOutput | None = None,
    ) -> Prediction:
        """Judge the modelled outputs of some records.

        Args:
            measured: outputs of each record. Shape `(M_r,)` each.
            modelled: the same by the model. Shape `(M_r,)` each.
            half_band: half the width of the band, of all records. None: there is no band.
            noise_std: standard deviation of the noise that the band contains.
            without_input: outputs by what is fitted to each record alone, such as its initial
                state. Shape `(M_r,)` each; empty: nothing is.
            training_output: what is kept of the outputs of the fit; None: not known.
        Returns:
            Both, with the error between them.
        """
        used = math.nan if training_output is None else share_used(measured, training_output)
        percent = fit_percent(measured, modelled)
        errors = [y - m for y, m in zip(measured, modelled, strict=True)]
        half = np.zeros(0) if half_band is None else half_band
        band = BandCheck.of(errors, half, noise_std) if half.size else None
        alone = [y - m for y, m in zip(measured, without_input, strict=False)]
        status = _status(used, percent) or (band.error if band is not None else "")
        note = band.note if band is not None and not band.error else ""
        return cls(
            status=status or _idle_input(_rms(errors), _rms(alone)) or "ok",
            used_for_fit=used,
            fit_percent=percent,
            rms_error=_rms(errors),
            inside_band=math.nan if band is None else band.inside,
            predicted=np.concatenate(list(modelled)),
            half_band=half,
            measured=np.concatenate(list(measured)),
            notes=(note,) if note else (),
        )

    def summary(self) -> str:
        """The numbers as plain text, which `print` shows."""
        names = ("fit_percent", "rms_error", "inside_band", "used_for_fit")
        rows = [f"{name:{_NAME_WIDTH}s} {getattr(self, name):12.5g}" for name in names]
        return "\n".join([f"{type(self).__name__}: {self.status}", *rows])

    def __str__(self) -> str:
        return self.summary()


def _rms(errors: Sequence[Floats]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(errors) ** 2))) if errors else math.inf


def _status(used: float, percent: float) -> str:
    """Why a prediction is worth nothing; empty if it is."""
    if used > _USED:
        return (
            f"not a validation: {100.0 * used:.0f} % of the samples were used for the fit. Use "
            "another record"
        )
    if percent < 0.0:
        return (
            "the prediction is worse than the mean of the record. Check the columns, their units "
            "and the operating point"
        )
    return ""


def _idle_input(rms: float, alone: float) -> str:
    """Say that the input of a record, through the model, explains nothing of its output."""
    if rms <= _NO_BETTER * alone:
        return ""
    return (
        "not a validation: the initial state and the constant, which are fitted to this record, "
        f"explain it without the input as well as with it (rms error {alone:.3g} and {rms:.3g}). "
        "Use a record in which the input changes more, check the units of input and output, or "
        "use --at-rest (Python: free_start=False) if the record began at rest"
    )


def _no_covariance() -> Floats:
    return np.zeros((0, 0))


@dataclass(frozen=True, kw_only=True)
class Fit(ABC):
    """A fitted model.

    Args:
        status: "ok", or why there is no result.
        parameters: every parameter by name. One that is not identifiable is NaN with an infinite
            interval.
        covariance: of `parameters`, in their order; infinite where one is not identifiable.
            Shape `(P, P)`.
        residuals: measured minus modelled, of each record. Shape `(M_r,)` each.
        notes: remarks for the user, one sentence each.
    """

    status: str
    parameters: dict[str, Estimate] = field(default_factory=dict)
    covariance: Floats = field(default_factory=_no_covariance, repr=False)
    residuals: tuple[Floats, ...] = field(default=(), repr=False)
    notes: tuple[str, ...] = ()

    @property
    def succeeded(self) -> bool:
        """Whether the fit has a usable result."""
        return self.status == "ok"

    @abstractmethod
    def answer(self) -> JsonObject:
        """The result by name, as the commands write it.

        Returns:
            Numbers, estimates, texts, and tables of them; `haselab.base.to_plain` makes JSON of it.
        """

    @abstractmethod
    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """Measured data, model and residuals as data of a figure.

        Args:
            names: of what the model maps from and to. None: its usual names.
        Returns:
            The chart.
        Raises:
            ResultError: the fit has no result.
        """

    def plot(self) -> Figure:
        """Draw measured data, model and residuals.

        Returns:
            A matplotlib figure: a notebook shows it, and `savefig` writes it.
        Raises:
            ResultError: the fit has no result.
        """
        return self.chart().plot()

    def summary(self) -> str:
        """The numbers with their 95 % intervals and units, as a table of plain text.

        Returns:
            What `print` shows. All numbers are in the attributes.
        """
        lines = [f"{type(self).__name__}: {self.status}"]
        if self.parameters:
            head = f"{'':{_NAME_WIDTH}s} {'value':>12s}  {'95 % interval':^27s} unit"
            lines += [head, *(_row(*row) for row in self._rows())]
        lines += [f"{name:{_NAME_WIDTH}s} {value:12.5g}" for name, value in self._qualities()]
        return "\n".join([*lines, *(f"Note: {note}" for note in self.notes)])

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        """The summary as a notebook shows it."""
        cells = ["<tr><th></th><th>value</th><th>95 % interval</th><th>unit</th></tr>"]
        for row in self._rows():
            cells.append(
                "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>"
            )
        qualities = ", ".join(f"{name} {value:.5g}" for name, value in self._qualities())
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in self.notes)
        return (
            f"<p><b>{type(self).__name__}</b>: {html.escape(self.status)}</p>"
            f"<table>{''.join(cells)}</table><p>{qualities}</p><ul>{notes}</ul>"
        )

    def _rows(self) -> Iterator[tuple[str, str, str, str]]:
        """Name, value, interval and unit of each parameter."""
        for name, estimate in self.parameters.items():
            if math.isnan(estimate.value):
                yield name, "", "not identifiable", estimate.unit
                continue
            low, high = estimate.ci95
            yield name, f"{estimate.value:.6g}", f"{low:.6g} to {high:.6g}", estimate.unit

    def _qualities(self) -> Iterator[tuple[str, float]]:
        """Name and value of each figure of merit that this fit has."""
        for name in _QUALITIES:
            value = getattr(self, name, math.nan)
            if not math.isnan(value):
                yield name, value

    def _require(self) -> None:
        """Refuse to use a fit that has no usable result."""
        self._present(self if self.succeeded else None)

    def _present(self, part: Part | None) -> Part:
        """A part of the result; refuse to use a fit that lacks it."""
        if part is None:
            raise ResultError(f"The fit gives no model: {self.status}")
        return part


def _row(name: str, value: str, interval: str, unit: str) -> str:
    return f"{name:{_NAME_WIDTH}s} {value:>12s}  {interval:^27s} {unit}".rstrip()


class RecordFit(Fit, Generic[Recorded]):
    """A fit of what an input does to an output in time."""

    @abstractmethod
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """Output of the model for a new input.

        Args:
            u: input, held between its samples. Shape `(N,)`.
            rate_hz: sampling rate, in Hz. None: as in the record of the fit.
        Returns:
            Output at the same moments, from rest. Shape `(N,)`.
        Raises:
            ResultError: the fit has no result.
            InputError: a wrong shape, or a rate that the model cannot take.
        """

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """Measured outputs that the fit has used; empty where it does not keep them."""
        return ()

    @property
    def training_output(self) -> TrainingOutput | None:
        """Hashes of the outputs that the fit has used; None where it does not keep them."""
        found = hash_output(self.fitted_outputs, self.residuals)
        return found if found.hashes.size else None

    @abstractmethod
    def _modelled(self, record: Recorded) -> tuple[Floats, Floats]:
        """Measured and modelled output of a record, initial state and constant fitted to it."""

    @checked
    def compare(self, records: Recorded | Sequence[Recorded]) -> Prediction:
        """Predict records that were not used for the fit, and compare with their outputs.

        The initial state and the constant of each record are fitted to it first, because they
        are no property of the model.

        Args:
            records: new ones, of the kind that the fit took.
        Returns:
            The fit in percent, the error, and the predicted output; `status` says whether these are
            new records and the prediction is better than their mean.
        Raises:
            ResultError: the fit has no result.
            InputError: no record.
        """
        self._require()
        pairs = [self._modelled(record) for record in several(records)]
        return Prediction.of(
            [y for y, _ in pairs], [m for _, m in pairs], training_output=self.training_output
        )


class CurveFit(Fit):
    """A fit of a curve through pairs of numbers."""

    @abstractmethod
    def simulate(self, x: ArrayLike) -> Floats:
        """Value of the curve.

        Args:
            x: abscissas, as the fit took them. Shape `(N,)`.
        Returns:
            Values. Shape `(N,)`.
        Raises:
            ResultError: the fit has no result.
        """

    @checked
    def compare(self, x: ArrayLike, y: ArrayLike) -> Prediction:
        """Predict pairs that were not used for the fit, and compare.

        Args:
            x: abscissas. Shape `(N,)`.
            y: measured values. Shape `(N,)`.
        Returns:
            The fit in percent, the error, and the predicted values.
        Raises:
            ResultError: the fit has no result.
            InputError: unequal lengths.
        """
        self._require()
        measured = np.asarray(y, dtype=np.float64)
        modelled = self.simulate(x)
        if measured.shape != modelled.shape or measured.size == 0:
            raise InputError(
                f"x has shape {modelled.shape} and y {measured.shape}. Give one y for each x."
            )
        return Prediction.of([measured], [modelled])


def several(records: Recorded | Sequence[Recorded]) -> list[Recorded]:
    """One record, or several, as a list.

    Args:
        records: a record or a sequence of them.
    Returns:
        At least one record.
    Raises:
        InputError: an empty sequence, or something else than records.
    """
    found = list(records) if isinstance(records, Sequence) else [records]
    for each in found:
        if not (is_dataclass(each) and hasattr(each, "y")):
            raise InputError(
                f"{type(each).__name__} is no record. Make records of columns with "
                "haselab.records(data, input, output)."
            )
    if not found:
        raise InputError("records is empty. Give one record or more.")
    return found


def propagated(slopes: Floats, covariance: Floats) -> Floats:
    """Covariance of numbers that follow from others, to first order.

    Args:
        slopes: derivatives of the new numbers by the old ones. Shape `(Q, P)`.
        covariance: of the old ones; infinite where one is not identifiable. Shape `(P, P)`.
    Returns:
        Covariance; NaN where a number depends on one that is not identifiable. Shape `(Q, Q)`.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray(slopes @ covariance @ slopes.T)


def rescaled(covariance: Floats, std: Floats) -> Floats:
    """A covariance with other standard deviations and the same correlations.

    Args:
        covariance: to be changed. Shape `(P, P)`.
        std: standard deviations wanted. Infinite: not identifiable. Shape `(P,)`.
    Returns:
        Covariance, infinite in the rows and columns of an infinite `std`. Shape `(P, P)`.
    """
    blind = ~np.isfinite(std)
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    usable = (own > 0.0) & np.isfinite(own) & ~blind
    factor = np.where(usable, np.where(blind, 0.0, std) / np.where(usable, own, 1.0), 0.0)
    scaled = np.where(np.isfinite(covariance), covariance, 0.0) * np.outer(factor, factor)
    np.fill_diagonal(scaled, np.where(blind, 0.0, std) ** 2)
    scaled[blind] = scaled[:, blind] = np.inf
    return np.asarray(scaled)
