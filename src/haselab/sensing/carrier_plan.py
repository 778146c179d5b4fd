"""Choice of the carrier from the noise and leakage of each candidate."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["CarrierChoice", "CarrierPlan", "CarrierRequest", "evaluate_carrier", "plan_carrier"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_FEWEST_PERIODS = 4.0
_MOST_CANDIDATES = 500
_SMALLEST, _LARGEST = 1e-15, 1e15  # range of any number of a request
_MOST_JUDGED, _SEARCHED = 1e7, 8e7  # samples for one carrier, and for a whole search
_MOST_TURNS = 1e6
_OFFSETS = 16  # simulated times of an output step whose time is not known
_AVERAGED_S = 1.0  # averaging time for a step's leakage
_DISTORTION_ORDERS = range(2, 41)
_HEADROOM = 0.5  # of current limit and range: the rest is reserved for the drive
_SETTLED = 2.0  # time constants 1 / (2 pi damping bandwidth) times 2 pi: e^-12 of a step remains
_EQUAL = 1.03  # of the smallest error: within it a carrier off the harmonics is preferred
_TINY = 0.1  # of the noise: a smaller leakage adds half a percent at most


@dataclass(frozen=True)
class CarrierRequest:
    """Known properties of bench and drive, for the choice of a carrier.

    Args:
        rate_hz: samples per second and channel.
        update_hz: output updates per second; each is a step.
        block_s: length of a block, one capacitance value per block.
        blank_s: time after each update that is blanked.
        update_s: time of the update within its block; None if not known (then nothing is blanked).
        step_v: typical step of the voltage monitor at an update.
        mains_hz: mains frequency.
        mains_v: peak of the mains' fundamental on each monitor; harmonics fall as 1/n.
        distortion: second harmonic of the carrier, relative; the n-th falls as (2/n)^2.
        bandwidth_hz: of the amplifier, second order.
        damping_ratio: of the amplifier.
        capacitance_f: of the actuator.
        series_ohm: of its electrodes.
        noise_v: rms of one reading on each monitor, including quantisation.
        carrier_v: peak of the carrier ahead of the amplifier.
        gain: of the amplifier.
        volt_per_monitor_volt: scale of the voltage monitor.
        ampere_per_monitor_volt: scale of the current monitor.
        current_limit_a: of the amplifier.
        range_v: of the converter, for either sign.
        strain_per_relative: d strain / d ln C; the study's line has strain + 0.276.
    Raises:
        InputError: a value out of range.
    """

    rate_hz: float = 200e3
    update_hz: float = 100.0
    block_s: float = 0.01
    blank_s: float = 0.0
    update_s: float | None = 0.0
    step_v: float = 0.02
    mains_hz: float = 50.0
    mains_v: float = 1e-3
    distortion: float = 1e-3
    bandwidth_hz: float = 6000.0
    damping_ratio: float = 0.6
    capacitance_f: float = 1e-9
    series_ohm: float = 5e3
    noise_v: float = 1e-3
    carrier_v: float = 0.02
    gain: float = 5000.0
    volt_per_monitor_volt: float = 5000.0
    ampere_per_monitor_volt: float = 2e-3
    current_limit_a: float = 12e-3
    range_v: float = 10.0
    strain_per_relative: float = 0.276

    def __post_init__(self) -> None:
        positive = {
            name: getattr(self, name)
            for name in ("rate_hz", "update_hz", "block_s", "mains_hz", "bandwidth_hz", "noise_v",
                         "damping_ratio", "capacitance_f", "carrier_v", "gain", "range_v",
                         "volt_per_monitor_volt", "ampere_per_monitor_volt", "current_limit_a",
                         "strain_per_relative")
        }  # fmt: skip
        at_least_zero = {
            name: getattr(self, name)
            for name in ("blank_s", "step_v", "mains_v", "distortion", "series_ohm")
        }
        for name, value in (positive | at_least_zero).items():
            if not (_SMALLEST <= value <= _LARGEST or (value == 0.0 and name in at_least_zero)):
                allowed = "0 or more" if name in at_least_zero else "above 0"
                raise InputError(
                    f"{name} = {value:g}; it must be {allowed}, with a magnitude between "
                    f"{_SMALLEST:g} and {_LARGEST:g}."
                )
        samples = self.block_s * self.rate_hz
        if not (samples >= 8.0 and self.judged_samples <= _MOST_JUDGED):
            raise InputError(
                f"block_s = {self.block_s:g} s has {samples:.3g} samples and "
                f"{self.block_s * self.update_hz:.3g} updates of the output; it must have at "
                f"least 8 samples, and samples times updates must be at most {_MOST_JUDGED:g} "
                f"({_OFFSETS} times as many count if the update's time is not known). Change "
                "block_s."
            )
        if max(self.update_hz, self.rate_hz / self.mains_hz) > _MOST_TURNS:
            raise InputError(
                f"update_hz = {self.update_hz:g} Hz, and {self.rate_hz / self.mains_hz:g} samples "
                f"in a period of the mains; both must be at most {_MOST_TURNS:g}."
            )
        if not (self.update_s is None or 0.0 <= self.update_s < self.block_s):
            raise InputError(
                f"update_s = {self.update_s:g} s is outside the block, [0, {self.block_s:g}) s. "
                "Give its time in the block, or None if it is not known."
            )
        if self.blank_s > 0.75 * min(self.block_s, 1.0 / self.update_hz):
            raise InputError(
                f"blank_s = {self.blank_s:g} s is more than three quarters of a block of "
                f"{self.block_s:g} s or of an update's period. Blank less, or lengthen the block."
            )
        if self.damping_ratio >= 1.0:
            raise InputError(
                f"damping_ratio = {self.damping_ratio:g} is outside (0, 1). Use 0.99 for more."
            )

    @property
    def judged_samples(self) -> float:
        """Number of samples to evaluate per carrier: those of a block for each possible update."""
        places = _OFFSETS if self.update_s is None else 1
        return self.block_s * self.rate_hz * places * (1.0 + self.block_s * self.update_hz)


@dataclass(frozen=True)
class CarrierChoice:
    """One carrier with its errors: relative to C, rms, for one block.

    Args:
        carrier_hz: its frequency.
        v_peak_v: amplitude on the voltage monitor.
        i_peak_v: amplitude on the current monitor.
        noise: Cramer-Rao bound of the monitors' noise.
        step: residual error of an output step.
        step_average: the part of `step` that remains after averaging over one second.
        mains: residual error of the mains' harmonics.
        alias: residual error of carrier harmonics that alias onto the carrier.
        total: all errors together.
        strain_std: `total` in strain.
        remarks: sources of leakage, one sentence each.
        usable: within current limit and range.
    """

    carrier_hz: float
    v_peak_v: float
    i_peak_v: float
    noise: float
    step: float
    step_average: float
    mains: float
    alias: float
    total: float
    strain_std: float
    remarks: tuple[str, ...]
    usable: bool


@dataclass(frozen=True)
class CarrierPlan:
    """The chosen carrier and all candidates.

    Args:
        chosen: the carrier with the smallest error among those without remarks.
        reasons: reasons for the choice, one sentence each.
        candidates: all evaluated carriers, by frequency.
    """

    chosen: CarrierChoice
    reasons: tuple[str, ...]
    candidates: tuple[CarrierChoice, ...]


def plan_carrier(request: CarrierRequest) -> CarrierPlan:
    """Choose the best carrier between four periods per window and twice the amplifier's bandwidth.

    Args:
        request: known properties of bench and drive.
    Returns:
        The choice with its reasons, and all candidates.
    Raises:
        InputError: no frequency is left between the window and the converter.
    Example:
        >>> plan = plan_carrier(CarrierRequest())
        >>> paper = evaluate_carrier(CarrierRequest(), 2000.0)
        >>> plan.chosen.total < paper.total, paper.remarks[0][:50]
        (True, '2000 Hz is harmonic 20 of the 100 Hz staircase of ')
    """
    window_s = _window_s(request)
    low_hz = _FEWEST_PERIODS / window_s
    high_hz = min(request.rate_hz / 3.0, 2.0 * request.bandwidth_hz)
    if not low_hz < high_hz:
        raise InputError(
            f"No carrier has {_FEWEST_PERIODS:g} periods in the {window_s:g} s that are used "
            "and is "
            f"below {high_hz:g} Hz. Lengthen the block, blank less, or sample faster."
        )
    grid_hz = 0.25 / request.block_s
    most = min(_MOST_CANDIDATES, max(8, int(_SEARCHED / request.judged_samples)))
    grid_hz *= math.ceil((high_hz - low_hz) / grid_hz / most)
    first = math.ceil(low_hz / grid_hz - 1e-9)
    carriers_hz = grid_hz * np.arange(first, math.floor(high_hz / grid_hz + 1e-9) + 1)
    candidates = tuple(evaluate_carrier(request, float(f)) for f in carriers_hz)
    usable = [c for c in candidates if c.usable]
    if not usable:
        raise InputError(
            f"At {request.carrier_v:g} V no carrier stays within half of the current limit "
            f"{request.current_limit_a:g} A and of the range {request.range_v:g} V. Lower "
            "carrier_v."
        )
    free = [c for c in usable if c.step_average < max(_TINY * c.noise, 0.2 * c.step)]
    least = min(c.total for c in free or usable)
    equal = [c for c in free or usable if c.total <= _EQUAL * least]
    bases_hz = (request.update_hz, request.mains_hz)
    chosen = min(
        equal, key=lambda c: (sum(_on_harmonic(c.carrier_hz, b) for b in bases_hz), c.total)
    )
    return CarrierPlan(chosen, _reasons(request, chosen, bool(free)), candidates)


def evaluate_carrier(request: CarrierRequest, carrier_hz: float) -> CarrierChoice:
    """Errors and remarks for one carrier.

    Args:
        request: known properties of bench and drive.
        carrier_hz: the carrier.
    Returns:
        Amplitudes, errors and remarks.
    Raises:
        InputError: fewer than two periods in the window, or above a third of the sampling rate.
    """
    r = request
    periods = carrier_hz * _window_s(r)
    if not carrier_hz > 0.0:
        raise InputError(f"carrier_hz is {carrier_hz:g} Hz; it must be above 0 Hz.")
    if not (periods >= 2.0 and carrier_hz <= r.rate_hz / 3.0):
        raise InputError(
            f"A carrier of {carrier_hz:g} Hz has {periods:.3g} periods in the samples that "
            "are used and "
            f"{r.rate_hz / carrier_hz:.3g} samples per period; at least 2 periods and 3 "
            "samples per "
            "period are needed. Choose another carrier."
        )
    omega = 2.0 * math.pi * carrier_hz
    impedance = r.series_ohm + 1.0 / (1j * omega * r.capacitance_f)
    output_v = r.carrier_v * r.gain * abs(_amplifier(r, 1j * omega))
    v_peak_v = output_v / r.volt_per_monitor_volt
    i_peak_v = output_v / abs(impedance) / r.ampere_per_monitor_volt
    into_c = abs(impedance) / abs(impedance.imag)  # of a relative error of I/V, one quadrature
    window = _window(r, carrier_hz)
    both = math.hypot(1.0 / v_peak_v, 1.0 / i_peak_v)

    noise = r.noise_v * both * into_c * window.noise_gain
    mains = both * into_c * _mains_v(r, window, carrier_hz)
    step = into_c * _mean([_step(r, window, s, output_v, impedance) for s in window.steps_s])
    folded = _folded(r, carrier_hz)
    alias = into_c * r.distortion * math.sqrt(sum((2.0 / n) ** 4 for n in folded))
    total = math.sqrt(noise**2 + mains**2 + step**2 + alias**2)
    left = _left_after_average(r, carrier_hz)
    current_a = i_peak_v * r.ampere_per_monitor_volt
    usable = (
        current_a <= _HEADROOM * r.current_limit_a
        and max(v_peak_v, i_peak_v) <= _HEADROOM * r.range_v
    )
    choice = CarrierChoice(
        carrier_hz=carrier_hz,
        v_peak_v=v_peak_v,
        i_peak_v=i_peak_v,
        noise=noise,
        step=step,
        step_average=step * left,
        mains=mains,
        alias=alias,
        total=total,
        strain_std=r.strain_per_relative * total,
        remarks=(),
        usable=usable,
    )
    return _with_remarks(r, choice, folded, current_a)


# ---- the window -----------------------------------------------------------------------------


@dataclass(frozen=True)
class _Window:
    """Weights of the lock-in for one carrier.

    Args:
        time_s: of the samples of a block. Shape `(N,)`.
        weights: complex; their product with the readings is the phasor. Shape `(N,)`.
        noise_gain: standard deviation of a quadrature over that of a reading.
        steps_s: times of the output's steps; several lists if these are not known.
    """

    time_s: Floats
    weights: Complexes
    noise_gain: float
    steps_s: tuple[Floats, ...]


def _steps_s(r: CarrierRequest, update_s: float) -> Floats:
    """Times of the updates that affect a block, including the last one before it."""
    period_s = 1.0 / r.update_hz
    first_s = update_s - period_s * math.ceil(update_s / period_s)
    return np.arange(first_s, r.block_s, period_s)


def _window(r: CarrierRequest, carrier_hz: float) -> _Window:
    time_s = np.arange(round(r.block_s * r.rate_hz)) / r.rate_hz
    counts = np.ones(time_s.size, dtype=bool)
    levels = [counts]
    if r.update_s is not None:
        steps_s: tuple[Floats, ...] = (_steps_s(r, r.update_s),)
        if r.blank_s > 0.0:
            place_s = (time_s - r.update_s) % (1.0 / r.update_hz)
            counts = place_s >= r.blank_s - 0.5 / r.rate_hz
            period = np.floor((time_s - r.update_s) * r.update_hz + 1e-9)
            levels = [counts & (period == k) for k in np.unique(period[counts])]
    else:
        offsets = (np.arange(_OFFSETS) + 0.5) / _OFFSETS / r.update_hz
        steps_s = tuple(_steps_s(r, float(offset)) for offset in offsets)
    angle = 2.0 * math.pi * carrier_hz * time_s
    ramp = (time_s - float(time_s[counts].mean())) / r.block_s
    columns = np.stack([np.cos(angle), np.sin(angle), ramp], axis=1) * counts[:, np.newaxis]
    basis = np.concatenate([columns, np.stack(levels, axis=1)], axis=1)
    inverse = np.linalg.inv(basis.T @ basis)
    rows = inverse[:2] @ basis.T
    gain = math.sqrt(0.5 * float(inverse[0, 0] + inverse[1, 1]))
    return _Window(time_s, rows[0] - 1j * rows[1], gain, steps_s)


def _window_s(r: CarrierRequest) -> float:
    if r.update_s is None:
        return r.block_s
    return r.block_s - r.blank_s * max(1.0, r.block_s * r.update_hz)


def _mean(values: Sequence[float]) -> float:
    """Root of the mean square."""
    return math.sqrt(sum(value**2 for value in values) / len(values))


# ---- leakage -----------------------------------------------------------------------------


def _amplifier(r: CarrierRequest, s: complex) -> complex:
    w = 2.0 * math.pi * r.bandwidth_hz
    return w * w / (s * s + 2.0 * r.damping_ratio * w * s + w * w)


def _mains_v(r: CarrierRequest, window: _Window, carrier_hz: float) -> float:
    """Error of one quadrature of a monitor's phasor due to the mains' harmonics, rms over phase."""
    count = int(0.5 * r.rate_hz / r.mains_hz)
    if count == 0 or r.mains_v == 0.0:
        return 0.0
    from scipy.signal import CZT  # the import takes half a second

    turn = cmath.exp(2j * math.pi * r.mains_hz / r.rate_hz)
    chirp = CZT(window.weights.size, count, w=turn, a=1.0 / turn)
    ahead, back = chirp(window.weights), chirp(window.weights.conj())
    peaks_v = r.mains_v / np.arange(1, count + 1)
    power = 0.25 * (np.abs(ahead) ** 2 + np.abs(back) ** 2) * peaks_v**2
    return math.sqrt(0.5 * float(power.sum()))


def _step(
    r: CarrierRequest, window: _Window, steps_s: Floats, output_v: float, impedance: complex
) -> float:
    """Relative error of one quadrature of I/V due to the output's steps, rms over their phase.

    Voltage and current of a step through amplifier and load are sums of exponentials. If the
    load responds to the step within the window as it does to the carrier, there is no error.
    """
    w, z = 2.0 * math.pi * r.bandwidth_hz, r.damping_ratio
    fast = complex(-z * w, w * math.sqrt(1.0 - z * z))
    poles = [fast, fast.conjugate()]
    load_s = r.series_ohm * r.capacitance_f
    height_v = r.step_v * r.volt_per_monitor_volt
    power = 0.0
    for step_s in steps_s.tolist():
        after_s = window.time_s - step_s
        started = after_s > 0.0
        after_s = np.where(started, after_s, 0.0)
        voltage = np.ones(after_s.size, dtype=np.complex128)
        current = np.zeros(after_s.size, dtype=np.complex128)
        for pole, other in (poles, poles[::-1]):
            decay = np.exp(pole * after_s)
            voltage += w * w / (pole * (pole - other)) * decay
            current += w * w / (pole - other) / (1.0 + pole * load_s) * decay
        if load_s > 0.0:
            pole = complex(-1.0 / load_s)
            share = w * w / ((pole - poles[0]) * (pole - poles[1])) / load_s
            current += share * np.exp(pole * after_s)
        leak_v = np.sum(window.weights * started * voltage.real) * height_v
        leak_a = np.sum(window.weights * started * current.real) * height_v * r.capacitance_f
        power += float(abs(leak_a * impedance - leak_v) ** 2) / output_v**2
    return math.sqrt(0.5 * power)


def _folded(r: CarrierRequest, carrier_hz: float) -> list[int]:
    """Orders of the carrier's harmonics that alias into its main lobe."""
    found = []
    for n in _DISTORTION_ORDERS:
        away = n * carrier_hz % r.rate_hz
        away = min(away, r.rate_hz - away)
        if n * carrier_hz > 0.5 * r.rate_hz and abs(away - carrier_hz) < 1.0 / _window_s(r):
            found.append(n)
    return found


def _left_after_average(r: CarrierRequest, carrier_hz: float) -> float:
    """Share of a step's error that remains after averaging, since its phase advances each time."""
    count = max(2, round(_AVERAGED_S * r.update_hz))
    turns = np.exp(2j * np.pi * carrier_hz / r.update_hz * np.arange(count))
    return float(abs(turns.mean()))


def _on_harmonic(carrier_hz: float, base_hz: float) -> bool:
    order = carrier_hz / base_hz
    return abs(order - round(order)) < 1e-6 * order


# ---- texts ----------------------------------------------------------------------------------


def _with_remarks(
    r: CarrierRequest, choice: CarrierChoice, folded: list[int], current_a: float
) -> CarrierChoice:
    f = choice.carrier_hz
    remarks = []
    if _on_harmonic(f, r.update_hz):
        effect = (
            f"each step adds an error of {100 * choice.step:.2g} % of C with the same phase, "
            "which averaging does not remove"
            if choice.step > _TINY * choice.noise
            else "its steps are negligible compared with the noise"
        )
        remarks.append(
            f"{f:g} Hz is harmonic {round(f / r.update_hz)} of the {r.update_hz:g} Hz staircase of "
            f"the output: {effect}."
        )
    nearest = round(f / r.mains_hz)
    if nearest >= 1 and abs(nearest * r.mains_hz - f) < 1.0 / _window_s(r):
        remarks.append(
            f"Mains harmonic {nearest} ({nearest * r.mains_hz:g} Hz) is in the main lobe of "
            f"{1.0 / _window_s(r):.3g} Hz to each side: {100 * choice.mains:.2g} % of C."
        )
    if folded:
        orders = ", ".join(str(n) for n in folded)
        remarks.append(
            f"Harmonics {orders} of the carrier alias onto it: {100 * choice.alias:.2g} % of C."
        )
    if not _on_harmonic(r.rate_hz, f):
        remarks.append("A period is not a whole number of samples, as the paper requires.")
    if not choice.usable:
        remarks.append(
            f"It requires {1e3 * current_a:.3g} mA and {choice.i_peak_v:.3g} V of the current "
            "monitor, more than half of the limit or the range."
        )
    return replace(choice, remarks=tuple(remarks))


def _reasons(r: CarrierRequest, chosen: CarrierChoice, free: bool) -> tuple[str, ...]:
    parts = {
        "the monitors' noise": chosen.noise,
        "the output's steps": chosen.step,
        "the mains": chosen.mains,
        "folded harmonics": chosen.alias,
    }
    largest = max(parts, key=lambda name: parts[name])
    reasons = [
        f"Smallest error of a block: {100 * chosen.total:.2g} % of C, strain "
        f"{chosen.strain_std:.2g}; most of it from {largest}."
    ]
    if chosen.step <= _TINY * chosen.noise:
        reasons.append("The output's steps are negligible compared with the noise.")
    elif free:
        reasons.append("The output's steps change their phase from block to block and average out.")
    else:
        reasons.append("Every carrier is affected by the output's steps. Blank after each update.")
    if chosen.step > chosen.noise:
        reasons.append(
            f"The steps cause an error of {100 * chosen.step:.2g} % of C: "
            + (
                "find the time of the updates, or let the lock-in search for them."
                if r.update_s is None
                else f"blank {_SETTLED / (r.damping_ratio * r.bandwidth_hz):.2g} s after each."
            )
        )
    return tuple(reasons)
