"""Exact discretisation of any rational plant with hold and delay, by the matrix exponential."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from haselab.base import InputError
from haselab.control.gains import PidGains
from haselab.control.linear import LinearController
from haselab.control.plants.modes import Modes
from haselab.models.plant import Plant
from haselab.models.rational import RationalModel

__all__ = [
    "AnyPlant",
    "HeldModel",
    "PlantScale",
    "corners_of",
    "delay_in_updates",
    "frequency_variants",
    "sampled_response_of",
    "static_gain",
]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
AnyPlant = Plant | RationalModel
_WHOLE = 1e-9  # of a sample: tolerance for whole delays


@dataclass(frozen=True)
class HeldModel:
    r"""A plant between a zero-order hold and a sampler with delay.

    $x_{k+1} = \Phi x_k + \Gamma u_k,\quad v_k = C x_k + D u_k$, and $v_k$ is the value that a
    controller reads `samples` samples later, 1 or more. A measurement without delay is sampled
    just before the new output, so a feed-through appears one sample later.

    Args:
        step: $\Phi$. Shape `(n, n)`.
        push: $\Gamma$. Shape `(n,)`.
        read: C, including the lead by a fraction of a sample. Shape `(n,)`.
        feed: D.
        samples: whole samples of delay, 1 or more.
    """

    step: Floats
    push: Floats
    read: Floats
    feed: float
    samples: int

    @classmethod
    def of(
        cls,
        model: RationalModel,
        *,
        period_s: float,
        measurement_delay_s: float,
        feedthrough: float = 0.0,
    ) -> HeldModel:
        """Discretise a model, to the output that a loop measures; see `LoopSetting.feedthrough`.

        Raises:
            InputError: a feedthrough, but the model integrates.
        Source: variation of constants in controllable form, with time scaled by the poles'
            magnitude.
        """
        a, b, c, d, omega = _scaled_states(model)
        delay_s = model.delay_s + measurement_delay_s
        samples = delay_in_updates(delay_s, period_s)
        lead_s = min(samples * period_s - delay_s, period_s)
        step, push = _held(a, b, omega * period_s)
        lead, lead_push = _held(a, b, omega * lead_s)
        kept = 1.0 - feedthrough
        feed = kept * (float(c @ lead_push) + d)
        if feedthrough:
            feed += feedthrough * static_gain(model)
        return cls(step, push, kept * (c @ lead), feed, samples)

    def response(self, omega_rad_s: ArrayLike, period_s: float) -> Complexes:
        """Response from held input to sampled output, in (0, pi / period_s]. Shape `(...)`."""
        z = np.exp(1j * np.asarray(omega_rad_s, dtype=float) * period_s)
        if self.push.size == 0:
            return np.asarray(z**-self.samples * self.feed)
        size = self.push.size
        shifted = z[..., None, None] * np.eye(size) - self.step
        right = np.broadcast_to(self.push[:, None], (*z.shape, size, 1))
        states = np.linalg.solve(shifted, right)[..., 0]
        return np.asarray(z**-self.samples * (states @ self.read + self.feed))


def static_gain(plant: AnyPlant) -> float:
    """Static gain, for the feedthrough of a measurement.

    Args:
        plant: plant.
    Returns:
        The gain.
    Raises:
        InputError: the plant integrates.
    """
    if isinstance(plant, Plant):
        return plant.static_gain
    if plant.denominator[-1] == 0.0:
        raise InputError(
            "The feedthrough of the sensed strain needs a finite static gain, but the model "
            "integrates. Set feedthrough = 0 in [sensing.strain_map]."
        )
    return plant.numerator[-1] / plant.denominator[-1]


def _scaled_states(model: RationalModel) -> tuple[Floats, Floats, Floats, float, float]:
    """Controllable form with time scaled by omega: A, b, c, d, omega."""
    bottom, top = np.array(model.denominator), np.array(model.numerator)
    order = bottom.size - 1
    sizes = np.abs(model.poles)
    omega = float(np.exp(np.log(sizes[sizes > 0.0]).mean())) if (sizes > 0.0).any() else 1.0
    bottom = bottom * omega ** -np.arange(order + 1.0)
    top = np.concatenate([np.zeros(order + 1 - top.size), top])
    top = top * omega ** -np.arange(order + 1.0)
    d = float(top[0])
    a, b = np.zeros((order, order)), np.zeros(order)
    if order:
        a[:-1, 1:] = np.eye(order - 1)
        a[-1] = -bottom[:0:-1]
        b[-1] = 1.0
    return a, b, (top - d * bottom)[:0:-1], d, omega


def _held(a: Floats, b: Floats, time: float) -> tuple[Floats, Floats]:
    """Transition matrix over `time`, and the state after a unit input of that length."""
    size = b.size
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a * time, b * time
    power = expm(block)
    return np.asarray(power[:size, :size]), np.asarray(power[:size, size])


@dataclass(frozen=True)
class PlantScale:
    """Scales of a plant: the range of a search for gains.

    Args:
        gain: static gain with its sign; for an integrating plant the gain at `slow_rad_s`.
        least_gain: smallest gain up to `fast_rad_s` that a controller may have to compensate.
        slow_rad_s: slowest pole other than 0.
        fast_rad_s: fastest pole.
    """

    gain: float
    least_gain: float
    slow_rad_s: float
    fast_rad_s: float

    @classmethod
    def of(cls, plant: AnyPlant) -> PlantScale:
        """Compute the scales of a plant."""
        sizes = np.abs(np.asarray(plant.poles, dtype=complex))
        sizes = sizes[sizes > 0.0] if (sizes > 0.0).any() else np.ones(1)
        slow, fast = float(sizes.min()), float(sizes.max())
        with np.errstate(divide="ignore", invalid="ignore"):  # a pole may be on the axis
            response = np.abs(plant.frequency_response(np.geomspace(slow, fast, 20)))
        response = response[np.isfinite(response)] if np.isfinite(response).any() else np.ones(1)
        if isinstance(plant, Plant):
            return cls(plant.static_gain, float(response.min()), slow, fast)
        bottom = np.array(plant.denominator)
        last = int(np.flatnonzero(bottom)[-1])
        ratio = plant.numerator[-1] / float(bottom[last])
        integrators = bottom.size - 1 - last
        gain = ratio / slow**integrators
        return cls(gain, float(response.min()), slow, fast)


def _slowed(plant: AnyPlant, factor: float) -> AnyPlant:
    """Scale the frequencies of a plant, with the same static gain and delay.

    For a `Plant` only the resonance changes, not its slow branches.
    """
    if isinstance(plant, Plant):
        omega = plant.natural_frequency_rad_s * factor
        return replace(plant, natural_frequency_rad_s=omega)
    top, bottom = (
        tuple((np.array(c) * factor ** np.arange(float(len(c)))).tolist())
        for c in (plant.numerator, plant.denominator)
    )
    gain = factor ** (len(bottom) - len(top))
    return replace(plant, numerator=tuple(gain * t for t in top), denominator=bottom)


def frequency_variants(plant: AnyPlant, spread: float) -> tuple[AnyPlant, ...]:
    """A plant, and with its frequencies lowered and raised.

    Args:
        plant: nominal plant, the first of the result.
        spread: change of the frequencies, relative to them.
    Returns:
        Three plants; one without a spread.
    """
    factors = (1.0 - spread, 1.0 + spread) if spread else ()
    return (plant, *(_slowed(plant, factor) for factor in factors))


def sampled_response_of(
    plant: AnyPlant,
    omega_rad_s: ArrayLike,
    rate_hz: float,
    delay_s: float,
    feedthrough: float = 0.0,
) -> Complexes:
    """Sampled frequency response with hold, delayed by `delay_s` plus the plant's own delay.

    It is that of the output that a loop measures, see `LoopSetting.feedthrough`. It is not finite
    at an undamped pole.
    """
    if isinstance(plant, Plant):
        modes = Modes.of(plant)
        with np.errstate(divide="ignore", invalid="ignore"):
            moved = modes.sampled_response(omega_rad_s, rate_hz, delay_s + plant.delay_s)
        if feedthrough == 0.0:
            return moved
        late = delay_in_updates(plant.delay_s + delay_s, 1.0 / rate_hz)
        turned = np.exp(-1j * np.asarray(omega_rad_s, dtype=float) * (late / rate_hz))
        return np.asarray((1.0 - feedthrough) * moved + feedthrough * plant.static_gain * turned)
    held = _held_model(plant, 1.0 / rate_hz, delay_s, feedthrough)
    return held.response(omega_rad_s, 1.0 / rate_hz)


def delay_in_updates(delay_s: float, period_s: float) -> int:
    """Updates from an output until a measurement that contains it.

    Args:
        delay_s: of plant and measurement, in s.
        period_s: of the loop, in s.
    Returns:
        Number of updates, 1 or more.
    """
    return math.floor(delay_s / period_s + _WHOLE) + 1


@lru_cache(maxsize=64)
def _held_model(
    model: RationalModel, period_s: float, delay_s: float, feedthrough: float
) -> HeldModel:
    """The samples of a model; the response of one loop is evaluated dozens of times."""
    return HeldModel.of(
        model, period_s=period_s, measurement_delay_s=delay_s, feedthrough=feedthrough
    )


def corners_of(plant: AnyPlant, gains: PidGains | LinearController | None = None) -> Complexes:
    """Corner frequencies of a response: poles and zeros of plant and controller other than 0."""
    roots = [np.asarray(plant.poles, dtype=complex)]
    model = plant if isinstance(plant, RationalModel) else RationalModel.from_plant(plant)
    roots.append(model.zeros)
    if isinstance(gains, LinearController):
        roots.append(gains.corners_rad_s)
    elif gains is not None:
        tau = gains.derivative_filter_s
        top = [gains.kp * tau + gains.kd, gains.kp + gains.ki * tau, gains.ki]
        roots += [np.roots(top).astype(complex), np.array([-1.0 / tau] if tau else [], complex)]
    found = np.concatenate(roots)
    return np.asarray(found[np.abs(found) > 0.0])
