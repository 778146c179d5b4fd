"""The result of a fit of a physical model: estimates, their covariance, and what they rest on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import (
    ADDED_INERTIA,
    DRIFT_UNITS,
    DRIFTS,
    GRAVITY_M_S2,
    ActuatorLaw,
    OperatingPoint,
    linearise,
)
from haselab.base import Estimate, JsonObject, LimitError
from haselab.base.chart import Chart, Curve, Panel
from haselab.identify.fit import Fit
from haselab.identify.noise import coloured_covariance
from haselab.identify.physical.information import (
    Source,
    covariance_of,
    covariance_of_runs,
    determined_by,
    largest_std,
    vague_information,
)
from haselab.identify.physical.misfit import CAPACITANCE, LENGTH, Misfit, Segment
from haselab.identify.physical.misstated import (
    WrongScale,
    clock_std,
    misstated_std,
    scale_error,
)
from haselab.identify.physical.model_error import hidden_std, widen_std
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.residuals import (
    channel_of,
    channel_residuals,
    noise_of,
    notes_of,
    rms_of,
    status_of,
    typical_of,
    worst_of,
)
from haselab.identify.physical.rivals import Rival, find_simpler_laws
from haselab.identify.physical.search import SearchResult
from haselab.identify.physical.unknowns import (
    SENSING_SCALE,
    START_HYSTERESIS,
    Unknowns,
    shares_of,
)

__all__ = ["ActuatorFit", "result_of"]

Floats = NDArray[np.float64]
_POINTS = 5  # voltages of the linear models
_UNSETTLED = 0.3  # standard deviations that the search would still have to move a value
_SEEN = 3.0  # standard deviations from 0: an effect that is seen


@dataclass(frozen=True, kw_only=True)
class ActuatorFit(Fit):
    """One physical model of an actuator.

    Args:
        status: "ok"; what the model does not explain; or why there is no result.
        parameters: by the names of TWIN.toml, and of the instruments; the standard deviation of one
            that is not identifiable is infinite.
        covariance: of `parameters`, in their order. It grows by what the model does not explain.
            It is finite: before the records, each is assumed to be within ten widths of its start.
        residuals: over their standard deviations, one array for each of `channels`.
        notes: remarks for the user, one sentence each.
        law: with the estimated parameters.
        kind: of the actuator.
        not_identifiable: names of parameters that these records do not determine, or whose values
            the search had not settled.
        length_rms_m: of the residuals of the lengths.
        capacitance_rms_f: of those of the capacitances.
        length_noise_m: from differences of neighbours, which a slow misfit does not change.
        capacitance_noise_f: likewise.
        length_factor: true over stated standard deviation of the noise of the lengths; 1 if all
            records are tables, which do not state it.
        capacitance_factor: the same of the capacitances.
        length_worst_m: rms of the residuals in the experiment that the model explains least.
        capacitance_worst_f: the same of the capacitances.
        widening: of the standard deviations, by which a model error, or a misstated gain or mass,
            raised those of `covariance`.
        hidden_variance: of the parameters by a model error of no particular direction, over that
            by the noise; see `model_error`.
        evaluations: of the model, until it was found.
        chi_squared_ratio: mean square of the residuals over their standard deviations.
        residual_whiteness_p: probability of the less probable channel under white noise.
        channels: experiment and channel of each array of residuals.
        linear_models: at the hung mass and some voltages up to the highest that acted.
        mass_kg: that hangs.
        rejected_laws: those that the records contradict decisively.
        determined_by: by parameter, the segments that determine it; none if it is not identifiable.
        excess_variance: typical variance of the parameters over that with white residuals.
        contradicted: the records contradict the law, so that there is no result.
    """

    law: ActuatorLaw | None = None
    kind: str = ""
    added_inertia_kg: float = 0.0
    not_identifiable: tuple[str, ...] = ()
    length_rms_m: float = float("nan")
    capacitance_rms_f: float = float("nan")
    length_noise_m: float = float("nan")
    capacitance_noise_f: float = float("nan")
    length_factor: float = float("nan")
    capacitance_factor: float = float("nan")
    length_worst_m: float = float("nan")
    capacitance_worst_f: float = float("nan")
    widening: Floats = field(default_factory=lambda: np.ones(0), repr=False)
    hidden_variance: float = 0.0
    evaluations: int = 0
    chi_squared_ratio: float = float("nan")
    residual_whiteness_p: float = float("nan")
    channels: tuple[tuple[str, str], ...] = ()
    linear_models: tuple[OperatingPoint, ...] = ()
    mass_kg: float = float("nan")
    rejected_laws: tuple[Rival, ...] = ()
    determined_by: Mapping[str, tuple[Source, ...]] = field(default_factory=dict)
    excess_variance: float = 1.0
    contradicted: bool = False

    @property
    def succeeded(self) -> bool:
        """Whether there are parameters, with or without a model error."""
        return bool(self.parameters)

    def unknowns(self) -> Unknowns:
        """What was estimated, at the estimates.

        Raises:
            ResultError: the fit has no result.
        """
        self._require()
        assert self.law is not None
        drifts = {name: found.value for name, found in self.parameters.items() if name in DRIFTS}
        start = Unknowns.of(
            self.law, added_inertia_kg=self.added_inertia_kg, mass_kg=self.mass_kg, drifts=drifts
        )
        values = np.array([self.parameters[name].value for name in start.names])
        return replace(start, values=values)

    def answer(self) -> JsonObject:
        """See `Fit`."""
        return {
            "kind": self.kind,
            "parameters": self.parameters,
            "not_identifiable": list(self.not_identifiable),
            "determined_by": {
                name: [source.answer() for source in sources]
                for name, sources in self.determined_by.items()
            },
            "linear_models": [
                {
                    "voltage_v": point.voltage_v,
                    "mass_kg": self.mass_kg,
                    "gain": point.gain_m_per_v,
                    "poles": _pairs(point.poles),
                    "zeros": _pairs(point.zeros),
                }
                for point in self.linear_models
            ],
            "residual_rms": {
                "length_m": self.length_rms_m,
                "capacitance_f": self.capacitance_rms_f,
            },
            "noise_rms": {
                "length_m": self.length_noise_m,
                "capacitance_f": self.capacitance_noise_f,
            },
            "residual_whiteness_p": self.residual_whiteness_p,
            "rejected_laws": [
                {"law": rival.law, "log_evidence": rival.log_evidence}
                for rival in self.rejected_laws
            ],
            "evaluations": self.evaluations,
            "notes": list(self.notes),
            "status": self.status,
        }

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """Root mean square of the residuals over the noise, experiment by experiment.

        Args:
            names: not used; the axes are the experiments.
        Returns:
            Bars of lengths and of capacitances.
        Raises:
            ResultError: the fit has no result.
        """
        self._require()
        experiments = list(dict.fromkeys(name for name, _ in self.channels))
        curves = []
        for channel in (LENGTH, CAPACITANCE):
            found = {name: rms_of([part]) for (name, of), part in zip(
                self.channels, self.residuals, strict=True) if of == channel}  # fmt: skip
            x = np.array([experiments.index(name) for name in found], dtype=np.float64)
            curves.append(Curve(x, np.array(list(found.values())), channel, "bars"))
        panel = Panel("", "residual / noise (rms)", curves, ticks=experiments)
        return Chart(f"Residuals of the {self.kind}", [panel])


def result_of(
    misfit: Misfit,
    found: SearchResult,
    rejected: Sequence[Rival],
    preferred: Sequence[Rival],
    scaled: WrongScale | None = None,
    *,
    clock: float = 0.0,
) -> ActuatorFit:
    """The fit of a minimum.

    Args:
        misfit: with the estimated noise.
        found: the minimum.
        rejected: laws that the records contradict.
        preferred: laws that the records prefer.
        scaled: lengths of a wrong scale, if the minimum is theirs.
        clock: relative standard deviation of the stated times.
    Returns:
        Estimates, or the reason why there are none.
    """
    unknowns = found.unknowns
    segments = misfit.segments
    seen = channel_residuals(misfit, found)
    lengths, capacitances = seen.lengths, seen.capacitances
    length_noise, capacitance_noise = noise_of(lengths), noise_of(capacitances)
    prior = vague_information(unknowns)
    covariance = _covariance(found, segments, prior)
    if misfit.runs.size > misfit.runs.max() + 1:
        in_runs = covariance_of_runs(found.jacobian, misfit.runs, prior)
        covariance = widen_std(covariance, np.sqrt(np.diag(in_runs)))
    own_std = np.sqrt(np.diag(covariance))
    scale = unknowns.value(SENSING_SCALE)
    if scale_error(scale, float(own_std[unknowns.names.index(SENSING_SCALE)])) == 0.0:
        scale = 1.0  # poorly determined, as by one voltage and one load: no contradiction
    status, usable = status_of(seen, scale, preferred, converged=found.converged)
    if not usable:
        return ActuatorFit(
            status=status,
            kind=unknowns.law.kind,
            evaluations=found.evaluations,
            contradicted=seen.contradicts,
        )
    white = covariance_of([found.jacobian, np.diag(np.sqrt(prior))])
    energy = seen.excess_energy if status != "ok" else 0.0
    if scaled is not None:
        status, energy = scaled.status, max(energy, scaled.energy)
    if status != "ok":
        covariance = widen_std(covariance, hidden_std(found.jacobian, energy, prior))
    scale_std = float(np.sqrt(np.diag(covariance))[unknowns.names.index(SENSING_SCALE)])
    error = scale_error(unknowns.value(SENSING_SCALE), scale_std)
    timed_std = np.hypot(np.sqrt(np.diag(covariance)), clock_std(misfit, found, clock, prior))
    misstated = misstated_std(misfit, found, error, prior)
    covariance = widen_std(covariance, np.maximum(timed_std, misstated))
    std = np.sqrt(np.diag(covariance))
    widening = np.divide(std, own_std, where=np.isfinite(own_std), out=np.ones(std.size))
    described = {about.key: about for about in unknowns.law.described()}
    units = {key: about.unit for key, about in described.items()}
    units |= {ADDED_INERTIA: "kg", "camera.latency_s": "s", "camera.offset_m": "m",
              "camera.scale": "", "sensing.latency_s": "s", "sensing.scale": "",
              START_HYSTERESIS: "N", **DRIFT_UNITS}  # fmt: skip
    slopes = unknowns.slopes
    weak = (std > largest_std(unknowns)) | (np.abs(found.left) > _UNSETTLED * std)
    weak |= _unseen(unknowns, std)
    parameters = {}
    for k, name in enumerate(unknowns.names):
        unit = units[name.partition("[")[0]]
        if unknowns.by_logarithm[k] or unknowns.inverse_exponent[k]:
            share = np.inf if weak[k] else std[k] * abs(slopes[k]) / unknowns.values[k]
            parameters[name] = (
                Estimate.inverse(
                    unknowns.values[k],
                    share,
                    unit,
                    described[name].high,
                    unknowns.inverse_exponent[k],
                )
                if unknowns.inverse_exponent[k]
                else Estimate.lognormal(unknowns.values[k], share, unit)
            )
        else:
            known_std = np.inf if weak[k] else std[k]
            parameters[name] = Estimate.normal(unknowns.values[k], known_std, unit)
    sources = determined_by(unknowns, _by_segment(segments, found.jacobian))
    names = np.array(unknowns.names)
    std_m = misfit.length_factor * typical_of([r.length_std_m for r in misfit.records])
    std_f = misfit.capacitance_factor * typical_of([r.capacitance_std_f for r in misfit.records])
    law = unknowns.present_law()
    values = covariance * np.outer(slopes, slopes)
    return ActuatorFit(
        status=status,
        notes=(*notes_of(error, seen, misfit.records), *_inertia_note(unknowns, std)),
        parameters=parameters,
        covariance=values,
        residuals=tuple(found.residuals[part.rows] for part in segments if part.experiment),
        channels=tuple((part.experiment, part.channel) for part in segments if part.experiment),
        length_rms_m=std_m * rms_of(lengths),
        length_noise_m=std_m * length_noise,
        capacitance_rms_f=std_f * rms_of(capacitances),
        capacitance_noise_f=std_f * capacitance_noise,
        length_factor=_factor(misfit.length_factor, segments, LENGTH, found.residuals),
        capacitance_factor=_factor(
            misfit.capacitance_factor, segments, CAPACITANCE, found.residuals
        ),
        length_worst_m=std_m * worst_of(lengths),
        capacitance_worst_f=std_f * worst_of(capacitances),
        widening=widening,
        hidden_variance=energy / std.size,
        residual_whiteness_p=seen.whiteness_p,
        law=law,
        kind=law.kind,
        mass_kg=unknowns.mass_kg,
        added_inertia_kg=unknowns.value(ADDED_INERTIA),
        linear_models=_linear_models(law, unknowns, misfit.records),
        not_identifiable=tuple(names[weak].tolist()),
        determined_by={
            name: () if weak[k] else sources[name] for k, name in enumerate(unknowns.names)
        },
        excess_variance=_excess_variance(covariance, white, ~weak),
        evaluations=found.evaluations,
        rejected_laws=_each_once([*rejected, *find_simpler_laws(found, values)]),
        chi_squared_ratio=float(np.mean(found.residuals**2)),
    )


def _inertia_note(unknowns: Unknowns, std: Floats) -> tuple[str, ...]:
    """A note if the inertia without weight is below 0, which no bench has."""
    at = unknowns.names.index(ADDED_INERTIA)
    added_kg = float(unknowns.values[at])
    own_std_kg = float(std[at] * abs(unknowns.slopes[at]))
    if not added_kg < -_SEEN * own_std_kg:
        return ()
    return (
        f"{ADDED_INERTIA} is {added_kg:.3g} kg, {-added_kg / own_std_kg:.3g} standard deviations "
        "below 0, but no inertia is negative. A dimension, the density or the actuator's own mass "
        "in [actuator.parameters], a mass or the clock is wrong, and so may be moduli, "
        "permittivity and damping. Their intervals do not allow for it.",
    )


def _factor(assumed: float, segments: Sequence[Segment], channel: str, residuals: Floats) -> float:
    """True over stated standard deviation of the noise; 1 where no record states it."""
    stated = [part for part in segments if not part.std_estimated]
    noise = noise_of(channel_of(stated, channel, residuals))
    if np.isfinite(noise):
        return assumed * noise
    return 1.0 if channel_of(segments, channel, residuals) else float("nan")


def _unseen(unknowns: Unknowns, std: Floats) -> NDArray[np.bool_]:
    """Which parameters are those of an effect that may be absent, such as softening.

    A small effect may be the end of a larger one at another stretch or time, which no standard
    deviation about its estimate covers.
    """
    names = list(unknowns.names)
    unseen = np.zeros(len(names), dtype=bool)
    for k, name in enumerate(names):
        for share in set(shares_of(name)) - {name}:
            if share in names:
                at = names.index(share)
                spread = std[at] * abs(unknowns.slopes[at])
                if not abs(unknowns.values[at]) > _SEEN * spread:
                    unseen[[k, at]] = True
    return unseen


def _each_once(rivals: Sequence[Rival]) -> tuple[Rival, ...]:
    """The first of those with the same law: of an added effect, the evidence at its addition."""
    found: dict[str, Rival] = {}
    for rival in rivals:
        found.setdefault(rival.law, rival)
    return tuple(found.values())


def _covariance(found: SearchResult, segments: Sequence[Segment], prior: Floats) -> Floats:
    """Of what varies."""
    return coloured_covariance(
        [found.jacobian[part.rows] for part in segments],
        [found.residuals[part.rows] for part in segments],
        found.unknowns.values.size,
        prior=prior,
    )


def _excess_variance(covariance: Floats, white: Floats, known: NDArray[np.bool_]) -> float:
    """Typical ratio of the variances of what is identifiable; at least 1."""
    ratio = (np.diag(covariance) / np.diag(white))[known]
    return max(1.0, float(np.median(ratio))) if ratio.size else 1.0


def _by_segment(segments: Sequence[Segment], values: Floats) -> dict[tuple[str, str], Floats]:
    """Rows of each experiment and channel; those of experiments of one name together."""
    found: dict[tuple[str, str], list[Floats]] = {}
    for part in segments:
        found.setdefault((part.experiment, part.channel), []).append(values[part.rows])
    return {name: np.vstack(parts) for name, parts in found.items()}


def _pairs(values: NDArray[np.complex128]) -> list[list[float]]:
    return [[float(value.real), float(value.imag)] for value in values]


def _linear_models(
    law: ActuatorLaw, unknowns: Unknowns, records: Sequence[MotionRecord]
) -> tuple[OperatingPoint, ...]:
    """At the hung mass, for motion within the lengths that were reached."""
    highest_v = max(float(np.abs(record.drive.voltage_v).max()) for record in records)
    longest_m = max((float(r.length_m.max()) for r in records if r.length_m.size), default=None)
    inertia_kg = unknowns.mass_kg + unknowns.value(ADDED_INERTIA)
    found = []
    for voltage_v in np.linspace(0.0, highest_v, _POINTS).tolist():
        try:
            found.append(
                linearise(
                    law, voltage_v, unknowns.mass_kg * GRAVITY_M_S2, inertia_kg,
                    longest_m=longest_m,
                )
            )  # fmt: skip
        except LimitError:
            break
    return tuple(found)
