"""Controller design by optimisation: largest low-frequency gain within margins and step."""

from __future__ import annotations

import dataclasses
import html
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from haselab.base import InputError, ResultError
from haselab.base.chart import Chart
from haselab.control.candidates import Task, plant_crossover, score
from haselab.control.charts import step_chart
from haselab.control.gains import PidGains
from haselab.control.plants.general import AnyPlant, PlantScale
from haselab.control.plants.general_loops import (
    closed_loop_poles,
    plant_output,
    trace_general,
)
from haselab.control.reach import integrates
from haselab.control.simulate import LoopSetting, simulate_loop
from haselab.control.spec import DesignSpec
from haselab.control.stability.margins import Margins, loop_margins
from haselab.control.stability.plausible import PlausibleMargins
from haselab.control.step_metrics import StepNumbers, step_metrics
from haselab.models.plant import Plant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Design",
    "Prediction",
    "design_pi",
    "design_pid",
    "design_task",
    "evaluate_gains",
    "predict",
]

_NAME_WIDTH = 28
_MEMBERS = 12  # candidates per generation and unknown
_GENERATIONS = 45
_MOST_DELAY = 50  # updates; above, a search takes minutes
_AGAIN, _SMALL_EXCESS = 2, 1e-3  # searches for less overshoot; excess that counts as none
_DECAYS = 6.0  # time constants after which a response of the size of the step has settled
_LONGEST_RECORD = 16.0  # of the demanded record, simulated for the settling time
_MOST_SAMPLES = 250_000  # of such a record
_LARGEST_GAIN = 1e30  # of a plant; far above, products of gains overflow


@dataclass(frozen=True)
class Prediction:
    """Predicted performance of a controller with one plant.

    Args:
        natural_frequency_rad_s: of the plant, in rad/s.
        margins: of the sampled loop with its delay.
        step: metrics of the simulated step, including saturation.
        u_peak: largest magnitude of the output in that step, in strain.
    """

    natural_frequency_rad_s: float
    margins: Margins
    step: StepNumbers
    u_peak: float


@dataclass(frozen=True)
class Design:
    """A controller with its predicted performance.

    Args:
        gains: controller.
        spec: the specification.
        setting: rate, measurement delay and saturation that it was designed for.
        nominal: prediction for the given plant.
        spread: predictions over the spread of natural frequency and feedthrough, the nominal one
            first.
        shortfalls: unmet demands, as text; empty if all are met.
        plant: that it was designed for.
        plausible: margins on plants drawn from the posterior; None without one.
    """

    gains: PidGains
    spec: DesignSpec
    setting: LoopSetting
    nominal: Prediction
    spread: tuple[Prediction, ...]
    shortfalls: tuple[str, ...]
    plant: AnyPlant = field(repr=False)
    plausible: PlausibleMargins | None = None

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """Predicted step and open loop of the given plant, as data of a figure.

        Args:
            names: of the axes of the controller's and the plant's output.
        Returns:
            The chart.
        """
        assert self.spec.step is not None  # of a design that was made
        crossover_rad_s = self.nominal.margins.crossover_rad_s
        return step_chart(
            self.plant, self.gains, self.setting, self.spec.step, crossover_rad_s, names
        )

    def plot(self) -> Figure:
        """Draw the predicted step, and the open loop with its delay.

        Returns:
            A matplotlib figure: a notebook shows it, and `savefig` writes it.
        """
        return self.chart().plot()

    def summary(self) -> str:
        """Gains, margins and the predicted step, as a table of plain text.

        Returns:
            What `print` shows. All numbers are in the attributes.
        """
        margins, step, gains = self.nominal.margins, self.nominal.step, self.gains
        derivative = {
            "kd": (gains.kd, "s"),
            "derivative_filter_s": (gains.derivative_filter_s, "s"),
        }
        rows = {
            "kp": (gains.kp, ""),
            "ki": (gains.ki, "1/s"),
            **(derivative if gains.kd else {}),
            "phase_margin_deg": (margins.phase_margin_deg, "deg"),
            "gain_margin_db": (margins.gain_margin_db, "dB"),
            "delay_margin_s": (margins.delay_margin_s, "s"),
            "peak_sensitivity": (margins.peak_sensitivity, ""),
            "crossover_rad_s": (margins.crossover_rad_s, "rad/s"),
            "rise_time_s": (step.rise_time_s, "s"),
            "raw_rise_time_s": (step.raw_rise_time_s, "s"),
            "overshoot": (step.overshoot, ""),
            "settling_time_s": (step.settling_time_s, "s"),
        }
        lines = [f"{n:{_NAME_WIDTH}s} {v:12.6g}  {unit}".rstrip() for n, (v, unit) in rows.items()]
        loop, limits = self.setting, self.setting.saturation
        lines.append(
            f"For a step of {self.spec.step:g} with an output of {limits.low:g} to "
            f"{limits.high:g}, {loop.rate_hz:g} Hz and a delay of {loop.measurement_delay_s:g} s. "
            "Gains: unit of the model's input per unit of its output."
        )
        if self.plausible is not None:
            share = 100.0 * self.plausible.share.value
            lines.append(f"{share:.3g} % of the plausible plants keep the margins.")
        if step.remark:
            lines.append(f"Note: {step.remark}.")
        if self.shortfalls:
            lines.append(f"Demands not met: {'; '.join(self.shortfalls)}")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.summary())}</pre>"


def design_pi(
    plant: AnyPlant,
    spec: DesignSpec,
    setting: LoopSetting,
    *,
    rng: np.random.Generator,
) -> Design:
    """Design a PI controller for a sampled loop.

    Args:
        plant: plant, its static gain above zero.
        spec: demands.
        setting: rate, measurement delay (without the hold, which is added) and saturation.
        rng: random generator of the search.
    Returns:
        The design; `shortfalls` lists the demands that no PI controller could meet.
    Raises:
        InputError: the plant's gain is not positive.
        ResultError: no stable loop was found.
    Source: reference study, section V: more gain at low frequency by loop shaping; the search
        maximises the integral gain under robustness limits (Astrom, Panagopoulos and Hagglund,
        Automatica 34, 1998).
    """
    return design_task(Task(plant, setting, spec), rng, derivative=False)


def design_pid(
    plant: AnyPlant,
    spec: DesignSpec,
    setting: LoopSetting,
    *,
    rng: np.random.Generator,
) -> Design:
    """Design a PID controller (derivative of the filtered measurement) for a sampled loop.

    Args:
        plant: plant, its static gain above zero.
        spec: demands.
        setting: rate, measurement delay (without the hold, which is added) and saturation.
        rng: random generator of the search.
    Returns:
        The design; `shortfalls` lists the demands that no PID controller could meet. Gains of zero
        are allowed, since a resonance may be better left undamped.
    Raises:
        InputError: the plant's gain is not positive.
        ResultError: no stable loop was found.
    Source: as for `design_pi`.
    """
    return design_task(Task(plant, setting, spec), rng, derivative=True)


def predict(
    plant: AnyPlant, gains: PidGains, setting: LoopSetting, *, step: float, record_s: float = 25.0
) -> Prediction:
    """Predict the margins of a sampled loop and the metrics of its simulated step.

    Args:
        plant: plant.
        gains: controller.
        setting: rate, measurement delay and saturation.
        step: reference step, in strain.
        record_s: length of the simulated record from the step on, in s.
    Returns:
        The prediction. Step metrics are NaN where the loop is unstable.
    Example:
        >>> found = predict(Plant(1.0, 32.0, 0.3), PidGains(0.0, 3.0), LoopSetting(), step=0.04)
        >>> round(found.step.rise_time_s, 1), found.margins.stable
        (0.7, True)
    """
    found = loop_margins(plant, gains, setting)
    if not found.stable:
        nothing = StepNumbers(*[math.nan] * len(dataclasses.fields(StepNumbers)))
        return Prediction(_frequency(plant), found, nothing, math.nan)
    first, peak = _simulated(plant, gains, setting, step, record_s)
    longer_s = min(_DECAYS * _slowest_s(plant, gains, setting), _LONGEST_RECORD * record_s)
    longer_s = min(longer_s, _MOST_SAMPLES / setting.rate_hz)
    if gains.ki == 0.0 or longer_s <= record_s:
        return Prediction(_frequency(plant), found, first, peak)
    numbers, _ = _simulated(plant, gains, setting, step, longer_s)
    # The error and the rise are those of the record that the demands refer to.
    settled = dataclasses.replace(first, settling_time_s=numbers.settling_time_s)
    return Prediction(_frequency(plant), found, settled, peak)


def _slowest_s(plant: AnyPlant, gains: PidGains, setting: LoopSetting) -> float:
    """Longest time constant of the closed loop, in s."""
    poles = closed_loop_poles(plant, [gains], setting)
    size = min(float(np.abs(poles).max()), 1.0 - 1e-12)
    return -1.0 / setting.rate_hz / math.log(size) if size > 0.0 else 0.0


def _simulated(
    plant: AnyPlant, gains: PidGains, setting: LoopSetting, step: float, record_s: float
) -> tuple[StepNumbers, float]:
    """Metrics of a simulated step, and the largest magnitude of the output in it.

    With integral action the response ends at the reference.
    """
    before = round(setting.rate_hz)
    reference = np.r_[np.zeros(before), np.full(round(record_s * setting.rate_hz), step)]
    reaches = gains.ki > 0.0
    if not isinstance(plant, Plant):
        measured, u = trace_general(plant, [gains], reference, setting)
        time_s = np.arange(reference.size) / setting.rate_hz
        output = plant_output(plant, measured[0], u[0], setting)
        general = step_metrics(time_s, output, reference, reaches=reaches).trials[0]
        return general, float(np.abs(u).max())
    trace = simulate_loop(plant, gains, reference, setting)
    desired = np.repeat(reference, setting.points_per_sample)
    numbers = step_metrics(trace.time_s, trace.y, desired, reaches=reaches).trials[0]
    return numbers, float(np.abs(trace.u).max())


def _frequency(plant: AnyPlant) -> float:
    """Natural frequency, in rad/s; for a general plant that of its fastest pole."""
    if isinstance(plant, Plant):
        return plant.natural_frequency_rad_s
    return PlantScale.of(plant).fast_rad_s


def _reachable(task: Task, gain: float) -> None:
    """Refuse a step that the limits do not allow."""
    limits, step = task.setting.saturation, task.step
    low, high = sorted((gain * limits.low, gain * limits.high))
    if integrates(task.plant) or low <= step <= high:
        return
    raise ResultError(
        f"The output saturates: the demanded step of {step:g} needs a controller output of "
        f"{step / gain:.3g}, but the limits are {limits.low:g} to {limits.high:g}. State a step of "
        f"{low:.3g} to {high:.3g} in the demands (step), or widen the limits."
    )


def _positive(plant: AnyPlant) -> None:
    """Refuse a plant that no controller with integral action and gains above 0 stabilises.

    The constant term of the closed loop's characteristic polynomial is ki times that of the
    numerator, and has the sign of the leading term, 1, if the loop is stable. The static gain may
    be negative: an odd number of unstable poles makes it so.
    """
    if isinstance(plant, Plant):
        gains = {"gain": plant.gain, "static gain": plant.static_gain}
    else:
        static, last = PlantScale.of(plant).gain, plant.numerator[-1]
        gains = {"static gain": static} if static * last > 0.0 else {"numerator's last term": last}
    if 0.0 in gains.values():
        raise InputError(
            "The plant has a zero at s = 0: with a constant input its output returns to 0, so no "
            "controller holds a step. Choose another output, or identify without this zero."
        )
    for what, gain in gains.items():
        if gain < 0.0:
            raise InputError(
                f"plant {what} = {gain:g}; it must be above 0, as the controller gains are. "
                "If the sensor reads less while the actuator lengthens, identify again with a "
                "minus before the name of the output column. If the input has the other sign, put "
                "the minus before its column, give --limits as -HIGH -LOW, and negate the "
                "controller's output on the bench."
            )


def design_task(task: Task, rng: np.random.Generator, *, derivative: bool) -> Design:
    """Design a controller for a task, optionally with a share of plausible plants as a demand.

    Args:
        task: plant, setting, specification.
        rng: random generator of the search.
        derivative: whether a derivative term is allowed.
    Returns:
        The design; `shortfalls` does not include the share, which the caller evaluates on other
        plants.
    Raises:
        InputError: the plant's gain is not positive, or its delay is too long.
        ResultError: no stable loop was found, or the limits do not allow the step.
    """
    scale = PlantScale.of(task.plant)
    _positive(task.plant)
    resonance = task.plant.gain if isinstance(task.plant, Plant) else scale.gain
    for what, gain in (("gain", resonance), ("static gain", scale.gain)):
        if not 1.0 / _LARGEST_GAIN <= abs(gain) <= _LARGEST_GAIN:
            raise InputError(
                f"plant {what} = {gain:g}; it must be {1.0 / _LARGEST_GAIN:g} to "
                f"{_LARGEST_GAIN:g}. Choose other units for the input and output."
            )
    _reachable(task, scale.gain)
    delay_s = task.plant.delay_s + task.setting.measurement_delay_s
    if delay_s * task.setting.rate_hz > _MOST_DELAY:
        raise InputError(
            f"The loop's delay of {delay_s:g} s is {delay_s * task.setting.rate_hz:.0f} updates at "
            f"{task.setting.rate_hz:g} Hz, but the limit of a design is {_MOST_DELAY}. Lower the "
            "rate, or shorten the delay."
        )
    wide = not isinstance(task.plant, Plant)
    found = _searched(task, rng, _Space(task, derivative, wide))
    if found.shortfalls and not wide:  # retry with a wider range of gains
        other = _searched(task, rng, _Space(task, derivative, wide=True))
        worse = len(other.shortfalls) >= len(found.shortfalls)
        found = found if worse and found.nominal.margins.stable else other
    found = _with_peaks(found, task, rng, _Space(task, derivative, wide))
    if not found.nominal.margins.stable:
        raise ResultError(
            f"no stable {'PID' if derivative else 'PI'} loop was found at a delay of "
            f"{task.setting.measurement_delay_s:g} s. Shorten the delay, or check the sign and "
            f"the poles of the plant."
        )
    return found


def _with_peaks(found: Design, task: Task, rng: np.random.Generator, space: _Space) -> Design:
    """Search again for less overshoot if a search has missed peaks between its samples.

    An output that its loop does not see may ring faster than the loop is.
    """
    if not task.setting.feedthrough or task.spec.overshoot is None:
        return found
    for _ in range(_AGAIN):
        worst = max(item.step.overshoot for item in found.spread)
        over = worst - task.spec.overshoot
        if not _SMALL_EXCESS < over < task.spec.overshoot:
            return found
        lower = dataclasses.replace(task.spec, overshoot=task.spec.overshoot - over)
        searched = _searched(dataclasses.replace(task, spec=lower), rng, space)
        found = evaluate_gains(task, searched.gains)
    return found


def _searched(task: Task, rng: np.random.Generator, space: _Space) -> Design:
    """The best controller of a search space, with its predictions."""

    def cost(points: NDArray[np.float64]) -> NDArray[np.float64]:
        found = score([space.gains(point) for point in points.T], task)
        if task.spec.rise_time_tolerance is None:
            aim = 1.0 - np.log(found.low_frequency_gain) / 50.0
        else:
            aim = np.minimum(found.peak_sensitivity / 100.0, 1.0)
        return np.where(found.miss > 1e-9, 10.0 + found.miss, aim)

    best = differential_evolution(
        cost,
        [(0.0, 1.0)] * space.unknowns,
        popsize=_MEMBERS,
        maxiter=_GENERATIONS,
        tol=1e-6,
        rng=rng,
        polish=False,
        vectorized=True,
        updating="deferred",
    )
    return evaluate_gains(task, space.gains(best.x))


def evaluate_gains(task: Task, gains: PidGains) -> Design:
    """Predict what given gains achieve in a task.

    Args:
        task: plant, setting, specification.
        gains: of the controller.
    Returns:
        The gains with their predictions, as those of a design.
    """
    spread = tuple(
        predict(plant, gains, setting, step=task.step, record_s=task.horizon_s())
        for plant, setting in task.variants()
    )
    spec = dataclasses.replace(task.spec, step=task.step, noise_gain=task.noise_gain)
    shortfalls = _shortfalls(task, gains, spread)
    return Design(gains, spec, task.setting, spread[0], spread, shortfalls, task.plant)


@dataclass(frozen=True)
class _Space:
    """Map from the unit cube to gains: kp and kd reach zero, ki and the filter are logarithmic.

    The wide space is scaled by the plant's response, for a static gain far from that at
    the resonance, light damping, or a general plant.
    """

    task: Task
    derivative: bool
    wide: bool = False

    @property
    def unknowns(self) -> int:
        return 4 if self.derivative else 2

    def gains(self, point: NDArray[np.float64]) -> PidGains:
        """Controller at a point; rounded to four digits, as it is printed."""
        plant, period_s = self.task.plant, 1.0 / self.task.setting.rate_hz
        if self.wide or not isinstance(plant, Plant):
            return self._wide_gains(point, period_s)
        wn, gain = plant.natural_frequency_rad_s, plant.static_gain
        ki = 0.02 / gain * (5.0 * wn / 0.02) ** float(point[1])
        kp = _from_zero(float(point[0]), 10.0 / gain)
        if not self.derivative:
            return PidGains(_digits(kp), _digits(ki))
        kd = _from_zero(float(point[2]), 10.0 / (plant.gain * wn))
        slowest = max(3.0 / wn, 2.0 * period_s)
        filter_s = 0.5 * period_s * (2.0 * slowest / period_s) ** float(point[3])
        return PidGains(_digits(kp), _digits(ki), _digits(kd), _digits(filter_s))

    def _wide_gains(self, point: NDArray[np.float64], period_s: float) -> PidGains:
        scale = PlantScale.of(self.task.plant)
        gain = abs(scale.gain)  # negative with an odd number of unstable poles
        least = 1e-2 / gain
        most = 10.0 / min(gain, scale.least_gain)
        fastest = min(scale.fast_rad_s, math.pi / period_s)
        kp = _logarithmic(float(point[0]), least, most)
        slowest_ki, fastest_ki = 1e-2 * scale.slow_rad_s * least, fastest * most
        ki = slowest_ki * (fastest_ki / slowest_ki) ** float(point[1])
        if not self.derivative:
            return PidGains(_digits(kp), _digits(ki))
        kd = _logarithmic(float(point[2]), least / fastest, most / scale.slow_rad_s)
        longest = max(3.0 / fastest, 2.0 * period_s)
        filter_s = 0.5 * period_s * (2.0 * longest / period_s) ** float(point[3])
        return PidGains(_digits(kp), _digits(ki), _digits(kd), _digits(filter_s))


def _logarithmic(share: float, low: float, high: float) -> float:
    """Zero over the first tenth of the unit interval, then `low` to `high` in the logarithm."""
    return low * (high / low) ** ((share - 0.1) / 0.9) if share > 0.1 else 0.0


def _from_zero(share: float, largest: float) -> float:
    """Zero over the first tenth of the unit interval, then a cube up to `largest`."""
    return largest * share**3 if share > 0.1 else 0.0


def _digits(value: float) -> float:
    return float(f"{value:.4g}")


def _shortfalls(task: Task, gains: PidGains, spread: tuple[Prediction, ...]) -> tuple[str, ...]:
    """Demands that the exact predictions miss by more than the search's resolution, as text."""
    spec, rate_hz = task.spec, task.setting.rate_hz
    at_least = (
        ("phase margin", min(p.margins.phase_margin_deg for p in spread), spec.phase_margin_deg),
        ("gain margin in dB", min(p.margins.gain_margin_db for p in spread), spec.gain_margin_db),
    )
    at_most = [
        (
            "peak sensitivity",
            max(p.margins.peak_sensitivity for p in spread),
            spec.peak_sensitivity,
        ),
        ("noise gain", gains.jump_gain(rate_hz), task.noise_gain),
        (
            "steady-state error",
            max(abs(p.step.steady_state_error) for p in spread),
            spec.steady_state_error,
        ),
    ]
    if spec.overshoot is not None:
        at_most.append(("overshoot", max(p.step.overshoot for p in spread), spec.overshoot))
    rise_s = spread[0].step.rise_time_s
    if spec.rise_time_s is not None and spec.rise_time_tolerance is None:
        slowest_s = max(p.step.rise_time_s for p in spread)
        at_most.append(("rise time in s", slowest_s, spec.rise_time_s))
    short = [(n, got, f"{least:g} or more") for n, got, least in at_least if got < 0.99 * least]
    short += [(n, got, f"{most:g} or less") for n, got, most in at_most if got > 1.01 * most + 1e-3]
    if spec.rise_time_s is not None and spec.rise_time_tolerance is not None:
        within = spec.rise_time_tolerance + 0.01
        if not abs(rise_s / spec.rise_time_s - 1.0) <= within:
            short.append(("rise time in s", rise_s, f"{spec.rise_time_s:g} within {within:.0%}"))
    for item, (plant, setting) in zip(spread, task.variants(), strict=True):
        own = plant_crossover(plant, setting)
        if spec.keep_crossover and not item.margins.crossover_rad_s >= 0.99 * own:
            got = item.margins.crossover_rad_s
            short.append(("crossover in rad/s", got, f"{own:.3g} or more"))
    return tuple(f"{name} {got:.3g}; demanded: {wanted}" for name, got, wanted in short)
