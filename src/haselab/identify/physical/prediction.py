r"""Predict a motion that an identified physical model was not fitted to.

With the derivatives $J$ of the predicted values by the parameters, whose covariance is $S$, and the
noise $\sigma$ of the measured ones, the 95 % band is

$\pm 1.96 \sqrt{\mathrm{diag}(J S J^\top) + \sigma^2 + m^2}$

where $m$ is the rms of a model error in the worst experiment of the fit, or 0 if the fit has no
model error. Of a model error, $S$ does not allow for the worst of all directions, as the intervals
of the parameters do, but for one that is hidden in no particular direction, see `model_error`.

Correlations matter: errors of the parameters can be large and still cancel in the prediction. The
tracker finds the marks of each session anew, so all lengths of a session share an error of 2 µm.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ActuatorLaw, with_parameters
from haselab.base import InputError, LimitError, ResultError
from haselab.base.chart import Chart, Curve, Panel
from haselab.base.estimate import Z95
from haselab.identify.physical.misfit import (
    CAPACITANCE,
    LENGTH,
    SHARED_PX,
    TRACKED_ZERO_M,
    model_record,
)
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.result import ActuatorFit
from haselab.identify.physical.unknowns import INSTRUMENTS, START_HYSTERESIS, Unknowns

__all__ = ["ChannelNoise", "IdentifiedModel", "MotionPrediction", "PredictedPart", "predict_motion"]

Floats = NDArray[np.float64]
_FAR = 3.5  # standard deviations of an error that all values share, beyond which it is no chance
_NOISE_OFF = 0.1  # relative error of the stated variance of the noise
_MOST_POINTS = 4000  # of a curve in a chart
_MATTERS = 0.5  # of the noise: effect of a parameter without a standard deviation


@dataclass(frozen=True)
class ChannelNoise:
    """Noise and model error of one channel in the records of a fit.

    Args:
        factor: true over stated standard deviation of its noise.
        noise: rms of the noise, in the unit of the channel; NaN if it is not known.
        worst: rms of the residuals in the experiment that the model explains least; NaN if it is
            not known.
        explained: whether the model leaves nothing but noise.
    """

    factor: float = 1.0
    noise: float = float("nan")
    worst: float = float("nan")
    explained: bool = True

    @property
    def model_error(self) -> float:
        """Rms of the error beyond the noise, in the experiment that the model explains least."""
        excess = 0.0 if self.explained else self.worst**2 - self.noise**2
        return float(np.sqrt(excess)) if excess > 0.0 else 0.0

    def std_of(self, stated: Floats, estimated: bool) -> Floats:
        """Standard deviations of the noise of another record.

        Args:
            stated: of its values, in the unit of the channel. Shape `(N,)`.
            estimated: whether they are estimates from the values, see `MotionRecord`.
        Returns:
            Shape `(N,)`; where they are estimates, the noise of the fit if it is known.
        """
        if not estimated:
            return self.factor * stated
        return np.full(stated.size, self.noise) if np.isfinite(self.noise) else stated


@dataclass(frozen=True)
class IdentifiedModel:
    """An identified physical model, as far as predictions need it.

    Args:
        unknowns: at the estimates.
        covariance: of the values; infinite variances where one is not known. Shape `(P, P)`.
        length: noise of the lengths in the records of the fit.
        capacitance: the same of the capacitances.
    """

    unknowns: Unknowns
    covariance: Floats
    length: ChannelNoise = field(default_factory=ChannelNoise)
    capacitance: ChannelNoise = field(default_factory=ChannelNoise)

    @classmethod
    def of(
        cls,
        law: ActuatorLaw,
        values: Mapping[str, float],
        names: Sequence[str],
        matrix: Floats,
        *,
        mass_kg: float,
        length: ChannelNoise | None = None,
        capacitance: ChannelNoise | None = None,
    ) -> IdentifiedModel:
        """Build a model from the values of an actuator file.

        Args:
            law: with the parameters that were not fitted.
            values: of all others, by the names of `ActuatorFit.parameters`.
            names: of rows and columns of the covariance.
            matrix: covariance of these values. Shape `(N, N)`.
            mass_kg: hung mass, the scale of an added inertia.
            length: see `IdentifiedModel`.
            capacitance: likewise.
        Returns:
            The model.
        Raises:
            InputError: A name is unknown, or the covariance is not finite
                and symmetric.
            LimitError: A value is outside its limits.
        """
        bench = (*INSTRUMENTS, START_HYSTERESIS)
        own = {name: value for name, value in values.items() if name not in bench}
        present = with_parameters(law, own)
        # those that the motion depends on come first
        order = (*own, *(name for name in bench if name in values))
        unknowns = Unknowns(present, order, np.array([values[n] for n in order]), mass_kg)
        unknown = sorted(set(names) - set(order))
        if unknown:
            raise InputError(
                f"The covariance names {', '.join(unknown)}, which the parameters lack. Identify "
                "the actuator again."
            )
        own_std = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        safe = np.where(own_std > 0.0, own_std, 1.0)
        scaled = matrix / np.outer(safe, safe)
        if not np.isfinite(scaled).all() or float(np.abs(scaled - scaled.T).max(initial=0)) > 1e-4:
            raise InputError(
                "The covariance of the parameters is not finite and symmetric. Identify the "
                "actuator again."
            )
        covariance = np.diag(np.full(len(order), np.inf))
        at = np.array([order.index(name) for name in names], dtype=np.int64)
        covariance[np.ix_(at, at)] = 0.5 * (matrix + matrix.T)
        return cls(
            unknowns, covariance, length or ChannelNoise(), capacitance or ChannelNoise()
        )  # fmt: skip

    @classmethod
    def of_fit(cls, fit: ActuatorFit) -> IdentifiedModel:
        """The model of a fit.

        Args:
            fit: of other records.
        Returns:
            The model.
        Raises:
            ResultError: the fit has no result.
        """
        unknowns, explained = fit.unknowns(), fit.status == "ok"
        return cls(
            unknowns,
            fit.covariance / np.outer(fit.widening, fit.widening) * (1.0 + fit.hidden_variance),
            ChannelNoise(fit.length_factor, fit.length_noise_m, fit.length_worst_m, explained),
            ChannelNoise(
                fit.capacitance_factor, fit.capacitance_noise_f, fit.capacitance_worst_f, explained
            ),
        )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which parameters have a finite variance. Shape `(P,)`."""
        return np.isfinite(np.diag(self.covariance))


@dataclass(frozen=True)
class PredictedPart:
    """Prediction of one channel in one experiment.

    Args:
        experiment: its name.
        channel: "length" or "capacitance".
        time_s: of the values. Shape `(M,)`.
        measured: in m or F. Shape `(M,)`.
        predicted: likewise. Shape `(M,)`.
        std: of measured minus predicted: of the parameters and of the noise. Shape `(M,)`.
        parameter_std: the part of it that the parameters cause, and of a length, the error that
            all lengths of a session share. Shape `(M,)`.
    """

    experiment: str
    channel: str
    time_s: Floats
    measured: Floats
    predicted: Floats
    std: Floats
    parameter_std: Floats

    @property
    def error(self) -> Floats:
        """Measured minus predicted. Shape `(M,)`."""
        return self.measured - self.predicted

    @property
    def rms_error(self) -> float:
        """Root mean square of the error, noise included."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def largest_error(self) -> float:
        """Largest error, noise included."""
        return float(np.abs(self.error).max())

    @property
    def inside_band(self) -> float:
        """Share of the values inside the 95 % band."""
        return float(np.mean(np.abs(self.error) <= Z95 * self.std))

    @property
    def is_outside(self) -> bool:
        r"""Whether the error is larger than its standard deviation explains.

        With the share $\rho$ of the variance that the parameters cause, the mean of
        $(e/\sigma)^2$ is $1-\rho$ by the noise and $\rho k^2$ by an error of k standard deviations
        that all values share.
        """
        found = float(np.mean((self.error / self.std) ** 2))
        share = float(np.mean((self.parameter_std / self.std) ** 2))
        chance = _FAR * np.sqrt(2.0 / self.error.size)
        return bool(found > (1.0 - share) * (1.0 + _NOISE_OFF + chance) + share * _FAR**2)

    @property
    def span(self) -> float:
        """Range of the measured values."""
        return float(np.ptp(self.measured))

    @property
    def fit_percent(self) -> float:
        """100 (1 - rms error / standard deviation of the measured values)."""
        spread = float(np.std(self.measured))
        return 100.0 * (1.0 - self.rms_error / spread) if spread > 0.0 else float("-inf")


@dataclass(frozen=True)
class MotionPrediction:
    """Prediction of a record, experiment by experiment.

    Args:
        parts: of all experiments, first all lengths, then all capacitances.
        offset_m: constant that was added to the predicted lengths, if it was free.
        undetermined: parameters without a standard deviation that matter here.
        shapes: the lengths of `parts` again, without the constant by which all of the record
            differ; none if it was free.
    """

    parts: tuple[PredictedPart, ...]
    offset_m: float = 0.0
    undetermined: tuple[str, ...] = ()
    shapes: tuple[PredictedPart, ...] = ()

    def together(self, channel: str) -> PredictedPart | None:
        """All experiments of a channel; None where it was not recorded.

        Args:
            channel: "length" or "capacitance".
        """
        chosen = [part for part in self.parts if part.channel == channel]
        if not chosen:
            return None
        arrays = ("time_s", "measured", "predicted", "std", "parameter_std")
        joined = {name: np.concatenate([getattr(p, name) for p in chosen]) for name in arrays}
        return PredictedPart("", channel, **joined)

    @property
    def all_parts(self) -> tuple[PredictedPart, ...]:
        """Each channel with all experiments together."""
        found = (self.together(channel) for channel in (LENGTH, CAPACITANCE))
        return tuple(part for part in found if part is not None)

    @property
    def outside(self) -> tuple[PredictedPart, ...]:
        """Experiments whose error is larger than its standard deviation explains."""
        return tuple(part for part in self.parts if part.is_outside)

    @property
    def status(self) -> str:
        """ "ok", or why the model does not predict this record."""
        if self.undetermined:
            return (
                f"the prediction depends on {', '.join(self.undetermined)}, which the fit did not "
                "determine. Identify the actuator from records that do"
            )
        for part in self.all_parts:
            if part.is_outside and part.fit_percent < 0.0:
                return (
                    f"the predicted {part.channel} is worse than the mean of the record. Check the "
                    "voltage, its unit, the mass and that this is the actuator of the model"
                )
        whole = [part for part in self.all_parts if part.is_outside]
        worst = min(self.outside or whole, key=lambda part: part.inside_band, default=None)
        if worst is None:
            return self._shape_status
        where = f" of {worst.experiment}" if worst.experiment else ""
        return (
            f"model error: only {100.0 * worst.inside_band:.0f} % of the {worst.channel} values"
            f"{where} are inside the 95 % band ({len(self.outside)} of {len(self.parts)} "
            "experiments and channels have a larger error than it explains). Identify the actuator "
            "from records of such drives and loads too"
        )

    @property
    def _shape_status(self) -> str:
        """ "ok", or that the lengths have another shape, which an uncertain zero would hide."""
        outside = [part for part in self.shapes if part.is_outside]
        if not outside:
            return "ok"
        worst = min(outside, key=lambda part: part.inside_band)
        return (
            f"model error: without a common offset, only {100.0 * worst.inside_band:.0f} % of the "
            f"length values of {worst.experiment} are inside their 95 % band, which is then "
            f"±{1e6 * Z95 * float(np.median(worst.std)):.2g} um. The wider band of all lengths is "
            "that of their zero. Identify the actuator from records of such drives and loads too"
        )

    def chart(self, title: str) -> Chart:
        """Measured and predicted values with their band, one experiment after the other.

        Args:
            title: of the figure.
        Returns:
            A panel of each channel, and one of its error.
        """
        panels = []
        for whole in self.all_parts:
            chosen = [part for part in self.parts if part.channel == whole.channel]
            every = max(1, -(-whole.time_s.size // _MOST_POINTS))
            time_s = _joined_times(chosen)[::every]
            scale, unit = (1e3, "mm") if whole.channel == LENGTH else (1e12, "pF")
            cut = (slice(None, None, every),)
            name = whole.channel.capitalize()
            panels.append(Panel("Time, waits left out (s)", f"{name} ({unit})", (
                Curve(time_s, scale * whole.measured[cut], "measured", "points"),
                Curve(time_s, scale * whole.predicted[cut], "predicted, 95 % band",
                      std=scale * whole.std[cut]),
            )))  # fmt: skip
            panels.append(Panel("Time, waits left out (s)", f"Error ({unit})", (
                Curve(time_s, scale * whole.error[cut], "measured less predicted", "points"),
                Curve(time_s, 0.0 * time_s, "95 % band", std=scale * whole.std[cut]),
            )))  # fmt: skip
        return Chart(title, tuple(panels))


def _joined_times(parts: Sequence[PredictedPart]) -> Floats:
    """Times of experiments that follow each other without the waits."""
    found, begin_s = [], 0.0
    for part in parts:
        found.append(begin_s + part.time_s - part.time_s[0])
        step_s = float(np.median(np.diff(part.time_s))) if part.time_s.size > 1 else 0.0
        begin_s = float(found[-1][-1]) + step_s
    return np.concatenate(found)


def predict_motion(
    model: IdentifiedModel,
    record: MotionRecord,
    *,
    experiments: Collection[str] = (),
    free_offset: bool = False,
    longest_m: float = 0.0,
) -> MotionPrediction:
    """Predict a record from its voltages and loads, and compare it with what was measured.

    Args:
        model: that was identified from other records.
        record: of the same actuator.
        experiments: that are compared; empty: all. What acted in the others still counts, because
            the actuator remembers it.
        free_offset: whether a constant is estimated by which all lengths differ, such as after the
            camera was moved.
        longest_m: length to which the actuator had been stretched before the record, which softened
            it; 0: no longer than at its beginning.
    Returns:
        The prediction with its band.
    Raises:
        InputError: An experiment is not in the record, or has neither lengths nor capacitances.
        ResultError: The model has no motion under this drive.
    """
    _check_names(record, experiments)
    unknowns = model.unknowns
    try:
        found = model_record(unknowns, record, strict=True, longest_m=longest_m)
    except LimitError as error:
        raise ResultError(
            f"The model predicts no motion under this drive: {str(error).rstrip('.')}. Check "
            "the voltage, its unit and the mass"
        ) from error
    known, slopes = model.known, unknowns.slopes
    spread = model.covariance[np.ix_(known, known)] / np.outer(slopes[known], slopes[known])

    def std_of(by: Floats) -> Floats:
        return np.asarray(np.sqrt(np.maximum(((by @ spread) * by).sum(axis=1), 0.0)))

    estimated = record.std_estimated
    noise_m = np.hypot(
        model.length.std_of(record.length_std_m, estimated), SHARED_PX * record.pixel_m
    )
    noise_m = np.hypot(noise_m, model.length.model_error)
    noise_f = np.hypot(
        model.capacitance.std_of(record.capacitance_std_f, estimated),
        model.capacitance.model_error,
    )
    wanted = [k for k, name in enumerate(record.experiments)
              if not experiments or name in experiments]  # fmt: skip
    frames = np.isin(record.length_experiment, wanted)
    offset_m, length_by = 0.0, found.length_by
    length_std = np.hypot(std_of(length_by[:, known]), TRACKED_ZERO_M)
    # an error that all lengths share would hide one of their shape
    shape_m, shape_std = found.length_m, length_std
    if frames.any():
        weights = np.where(frames, noise_m**-2.0, 0.0)
        weights /= weights.sum()
        constant_m = float(weights @ (record.length_m - found.length_m))
        shape_m, shape_by = found.length_m + constant_m, length_by - weights @ length_by
        shape_std = std_of(shape_by[:, known])
        if free_offset:
            offset_m, length_by, length_std = constant_m, shape_by, shape_std
            found = replace(found, length_m=shape_m)
    capacitance_std = std_of(found.capacitance_by[:, known])
    idle = np.flatnonzero(~known)
    effects = np.vstack([
        length_by[np.ix_(frames, idle)] / noise_m[frames, None],
        (found.capacitance_by[:, idle] / noise_f[:, None])
        [np.isin(record.capacitance_experiment, wanted)],
    ]) * unknowns.widths[idle]  # fmt: skip
    matters = (
        np.sqrt(np.mean(effects**2, axis=0)) > _MATTERS if effects.size else np.zeros(idle.size)
    )
    middle_s = 0.5 * (record.drive.edge_s[1:] + record.drive.edge_s[:-1])
    channels = (
        (LENGTH, record.length_experiment, record.length_time_s, record.length_m,
         found.length_m, noise_m, length_std),
        (CAPACITANCE, record.capacitance_experiment, record.over_windows(middle_s[record.sensed]),
         record.capacitance_f, found.capacitance_f, noise_f, capacitance_std),
    )  # fmt: skip
    parts, shapes = [], []
    for channel, member, time_s, measured, predicted, noise, std in channels:
        for k in wanted:
            at = np.flatnonzero(member == k)
            if not at.size:
                continue
            part = PredictedPart(
                record.experiments[k], channel, time_s[at], measured[at], predicted[at],
                np.hypot(noise[at], std[at]), std[at],
            )  # fmt: skip
            parts.append(part)
            if channel == LENGTH and not free_offset:
                shapes.append(replace(
                    part, predicted=shape_m[at], std=np.hypot(noise[at], shape_std[at]),
                    parameter_std=shape_std[at],
                ))  # fmt: skip
    undetermined = [unknowns.names[k] for k, yes in zip(idle, matters, strict=True) if yes]
    return MotionPrediction(tuple(parts), offset_m, tuple(undetermined), tuple(shapes))


def _check_names(record: MotionRecord, experiments: Collection[str]) -> None:
    unknown = [name for name in experiments if name not in record.experiments]
    if unknown:
        raise InputError(
            f"{record.name} has no experiment {', '.join(unknown)} that can be predicted. It has "
            f"{', '.join(record.experiments)}."
        )
    for name in experiments:
        k = record.experiments.index(name)
        if not (record.length_experiment == k).any() | (record.capacitance_experiment == k).any():
            raise InputError(
                f"Experiment {name} of {record.name} has neither lengths nor capacitances. Choose "
                "another one."
            )
