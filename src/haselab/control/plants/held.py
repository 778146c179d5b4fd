"""Discretisation of many plants with held input and any delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.models.plant import Plant

__all__ = ["HeldPlants"]


@dataclass(frozen=True)
class HeldPlants:
    r"""Real difference equations of plants with delayed output, exact between samples.

    The states of the resonance are output and rate over $\omega_n$, which have one real form for
    any damping. Output that a controller reads `delay` samples later, after a sample with input
    $u$: $v = z_1 + \sum_i s_i + f u$; then $z \leftarrow A z + b u$, $s_i \leftarrow d_i s_i + p_i
    u$. With the delay $D = n T - a$, $0 < a \le T$, the state is the plant's own, advanced freely
    by $a$: so a fraction of a sample costs one product per step.

    Args:
        free: matrix A, row by row. Shape `(B, 4)`.
        push: b. Shape `(B, 2)`.
        feed: f. Shape `(B,)`.
        slow_decay: d; 0 for a branch that the plant does not have. Shape `(B, M)`.
        slow_push: p. Shape `(B, M)`.
        rest: states in steady state for a unit input, z then s. Shape `(B, 2 + M)`.
        static_gain: output in steady state for a unit input. Shape `(B,)`.
        samples: n, 1 or more. Shape `(B,)`.
    """

    free: NDArray[np.float64]
    push: NDArray[np.float64]
    feed: NDArray[np.float64]
    slow_decay: NDArray[np.float64]
    slow_push: NDArray[np.float64]
    rest: NDArray[np.float64]
    static_gain: NDArray[np.float64]
    samples: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        plants: Sequence[Plant],
        *,
        period_s: float,
        measurement_delay_s: float,
        feedthrough: float = 0.0,
    ) -> HeldPlants:
        """Discretise `plants`, with as many slow branches as the largest number among them.

        The output is what a loop measures, see `LoopSetting.feedthrough`.

        Source: variation of constants; $e^{Mt} = e^{-\\zeta\\omega_n t}(\\cosh x\\, I
        + \\sinh x\\, N/\\sqrt{\\zeta^2 - 1})$ with $N^2 = (\\zeta^2 - 1) I$ (Cayley-Hamilton).
        """
        gain, omega, zeta, delay_s = np.array(
            [(p.gain, p.natural_frequency_rad_s, p.damping_ratio, p.delay_s) for p in plants]
        ).T
        slow_gain, tau = _slow(plants)
        samples = np.floor((delay_s + measurement_delay_s) / period_s + 1e-9) + 1.0
        lead_s = np.minimum(samples * period_s - delay_s - measurement_delay_s, period_s)
        step, lead = _free(omega, zeta, np.full(omega.size, period_s)), _free(omega, zeta, lead_s)
        static_gain = gain + slow_gain.sum(axis=1)
        gain, slow_gain = (1.0 - feedthrough) * gain, (1.0 - feedthrough) * slow_gain
        push = gain[:, None] * (np.array([1.0, 0.0]) - step[:, :, 0])
        rest = gain[:, None] * lead[:, :, 0]
        slow_left = np.exp(-lead_s[:, None] / tau)
        slow_rest = slow_gain * slow_left
        return cls(
            free=step.reshape(-1, 4),
            push=np.einsum("bij,bj->bi", lead, push),
            feed=gain * (1.0 - lead[:, 0, 0])
            - (slow_gain * np.expm1(-lead_s[:, None] / tau)).sum(1)
            + feedthrough * static_gain,
            slow_decay=np.exp(-period_s / tau) * (slow_gain != 0.0),
            slow_push=-slow_rest * np.expm1(-period_s / tau),
            rest=np.concatenate([rest, slow_rest], axis=1),
            static_gain=static_gain,
            samples=samples.astype(np.int64),
        )


def _slow(plants: Sequence[Plant]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gains and time constants, `(B, M)`; gain 0 if a plant has fewer."""
    branches = max(len(p.slow_modes) for p in plants)
    none = [(0.0, 1.0)]
    rows = [
        [(mode.gain, mode.time_constant_s) for mode in p.slow_modes]
        + none * (branches - len(p.slow_modes))
        for p in plants
    ]
    pairs = np.array(rows, dtype=float).reshape(len(plants), branches, 2)
    return pairs[..., 0], pairs[..., 1]


def _free(
    omega: NDArray[np.float64], zeta: NDArray[np.float64], time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Transition matrix of output and rate over omega for `time_s`. Shape `(B, 2, 2)`."""
    root = np.sqrt(zeta.astype(complex) ** 2 - 1.0)
    x = root * omega * time_s
    slowly = np.exp(-omega * time_s / (zeta + root))  # the slower pole, without cancellation
    swing = np.where(np.abs(x) < 1e-9, 1.0, x)
    # sinh(x) / x and cosh(x), each by exp(-zeta omega t)
    ratio = slowly * np.where(swing == x, -np.expm1(-2.0 * swing) / (2.0 * swing), 1.0)
    even = (0.5 * slowly * (1.0 + np.exp(-2.0 * x))).real
    odd = (ratio * omega * time_s).real
    return np.stack(
        [np.stack([even + zeta * odd, odd], -1), np.stack([-odd, even - zeta * odd], -1)], -2
    )
