"""Result of a fit with a static curve or a nonlinear spring."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError, checked
from haselab.identify.fit import Prediction, RecordFit
from haselab.identify.noise import fit_percent
from haselab.identify.nonlinear.input_curve import InputCurve
from haselab.identify.prediction import note_range
from haselab.identify.record import Record, finite_vector
from haselab.identify.residual_tests import input_correlation_p
from haselab.identify.transfer.fit import TransferFit
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.parameters import covariance_table
from haselab.models import Plant
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel

__all__ = ["Nonlinear", "NonlinearFit", "fitted_count", "fitted_part", "no_fit", "remarks"]

Floats = NDArray[np.float64]
_COLOURED = 0.05
_HELD_OUT = 0.25  # share of each record that is held out for validation


class Nonlinear(Protocol):
    """A nonlinear model that can be fitted to some outputs and simulated on all."""

    def simulated_after(self, records: Sequence[Record]) -> list[Floats] | None:
        """Outputs simulated with a fit to the first three quarters; None: no fit."""

    def simulated(self, u: Floats, rate_hz: float) -> Floats:
        """Output for a new input, from rest at the input 0."""

    def modelled(self, record: Record) -> Floats:
        """Output for a new record with the initial state and constant that suit it best."""


@dataclass(frozen=True, kw_only=True)
class NonlinearFit(TransferFit):
    """A linear part with one nonlinearity; `gain`, poles and zeros are those of the linearisation.

    Args:
        kind: its name, see `NONLINEAR` of `transfer_nonlinear`.
        equation: the model equation.
        operating_input: input about which the linear part is valid.
        curve: names of the numbers of the nonlinearity, which `parameters` holds.
        fitted_records: the experiments.
        count: number of all fitted parameters.
        model: fitted model, for validation on the held-out rows.
    """

    kind: str = ""
    equation: str = ""
    operating_input: float = math.nan
    curve: tuple[str, ...] = ()
    fitted_records: tuple[Record, ...] = field(default=(), repr=False)
    count: int = 0
    model: Nonlinear | None = field(default=None, repr=False)

    @property
    def records(self) -> tuple[Record, ...]:
        """The experiments."""
        return self.fitted_records

    @property
    def _linear_records(self) -> tuple[Record, ...]:
        """The records after the curve of a Hammerstein model, else the experiments."""
        if not self.kind.startswith("hammerstein"):
            return self.records
        factors = [self.parameters[name].value for name in ("gain", *self.curve)]
        curve = InputCurve(self.operating_input, tuple(each / factors[0] for each in factors))
        try:
            return tuple(curve.apply_to(record) for record in self.records)
        except InputError:  # the curve makes an input constant
            return self.records

    @property
    def parameter_count(self) -> int:
        """Count of all fitted parameters, the state and offset of each record included."""
        return self.count

    @cached_property
    def validation_fit_percent(self) -> float:
        """NRMSE fit of the last quarter of each record, simulated by a fit to the rest."""
        errors = self.validation_errors
        if errors is None:
            return math.nan
        measured = [r.y[r.y.size - e.size :] for r, e in zip(self.records, errors, strict=True)]
        return fit_percent(measured, [y - e for y, e in zip(measured, errors, strict=True)])

    @cached_property
    def validation_errors(self) -> list[Floats] | None:
        """Errors of the simulation of the last quarter; None where the rest is too short."""
        if self.model is None or any(fitted_count(r) < 8 for r in self.records):
            return None
        modelled = self.model.simulated_after(self.records)
        if modelled is None:
            return None
        return [(r.y - m)[fitted_count(r) :] for r, m in zip(self.records, modelled, strict=True)]

    @cached_property
    def input_correlation_p(self) -> float:
        """Probability of such residuals if they are uncorrelated with the input."""
        return input_correlation_p(self.records, self.residuals) if self.records else math.nan

    @property
    def linear(self) -> TransferFit:
        """The linear part about the operating point, with its covariance.

        Raises:
            ResultError: the fit has no result, or the slope of the curve is not different from 0.
        """
        self._require()
        gain = self.parameters["gain"]
        if gain.ci95[0] <= 0.0 <= gain.ci95[1]:
            raise ResultError(
                f"The slope of the output over the input at {self.operating_input:.4g} does not "
                "differ from 0, so no linear model describes small changes there. Record around "
                "the input that the loop will use."
            )
        names = [name for name in self.parameters if name not in self.curve]
        at = [list(self.parameters).index(name) for name in names]
        return TransferFit(
            status=self.status,
            structure=self.structure,
            parameters={name: self.parameters[name] for name in names},
            covariance=self.covariance[np.ix_(at, at)],
            poles=self.poles,
            zeros=self.zeros,
            fit_percent=self.fit_percent,
        )

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; the nonlinearity is a part of it."""
        inputs = finite_vector("u", u, 1)
        return self._usable().simulated(inputs, self._rate_hz(rate_hz))

    @checked
    def compare(self, records: Record | Sequence[Record]) -> Prediction:
        """See `RecordFit`; there is no band."""
        return note_range(RecordFit.compare(self, records), records, self.input_range)

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        return record.y, self._usable().modelled(record)

    def _usable(self) -> Nonlinear:
        return self._present(self.model)

    @property
    def plant(self) -> Plant:
        """The linear part as a plant."""
        return self.linear.plant

    @property
    def rational(self) -> RationalModel:
        """The linear part as a rational model."""
        return self.linear.rational

    @property
    def posterior(self) -> PlantPosterior:
        """The parameters of the linear part with their covariance."""
        return self.linear.posterior

    def answer(self) -> JsonObject:
        """The JSON keys of the linearised transfer function, and the nonlinearity."""
        linear = [name for name in self.parameters if name not in self.curve]
        at = [list(self.parameters).index(name) for name in linear]
        table = {name: self.parameters[name] for name in linear}
        return {
            **super().answer(),
            "covariance": covariance_table(table, self.covariance[np.ix_(at, at)]),
            "nonlinear": {
                "kind": self.kind,
                "equation": self.equation,
                "operating_input": self.operating_input,
                **{name: self.parameters[name] for name in self.curve if name in self.parameters},
            },
        }


def fitted_count(record: Record) -> int:
    """Number of outputs before the held-out part."""
    return int((1.0 - _HELD_OUT) * record.y.size)


def fitted_part(records: Sequence[Record]) -> list[Record] | None:
    """The records without the held-out part; None where the rest is too short."""
    if any(fitted_count(r) < 8 or np.ptp(r.y[: fitted_count(r)]) == 0.0 for r in records):
        return None
    return [
        replace(r, y=r.y[: fitted_count(r)], output_time_s=r.output_time_s[: fitted_count(r)])
        for r in records
    ]


def remarks(whiteness_p: float, gain: Estimate) -> list[str]:
    """Notes on limitations of a nonlinear fit and of its linear part."""
    said = []
    if whiteness_p < _COLOURED:
        said.append("The residuals are not white: the model does not explain everything.")
    if gain.ci95[0] <= 0.0 <= gain.ci95[1]:
        said.append(
            "The gain does not differ from 0 at the operating point: there is no linear model to "
            "design with. Record around the input that the loop will use."
        )
    return said


def no_fit(structure: TransferStructure, kind: str, reason: str) -> NonlinearFit:
    """A fit without a result."""
    return NonlinearFit(status=f"no result: {reason}", structure=structure, kind=kind)
