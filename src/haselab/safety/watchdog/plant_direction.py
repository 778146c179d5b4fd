"""Check that the strain responds to the drive, and in the right direction."""

from __future__ import annotations

import functools
import itertools
import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["POINTS", "Reaction", "direction_ratio"]

POINTS = 50  # of a window
_FEWEST = 30
# least change of the drive in a window, as a fraction of the range; below it noise dominates
_LEAST_MOVE = 0.03
_NOISE_STD = 4.0
_AGREE = 2  # evaluations in a row
# the ratio must be larger by this factor if the plant is assumed to start in equilibrium: where it
# is settled, and where it may still ring
_START, _RINGING = 1.5, 4.0

Floats = NDArray[np.float64]
_SUBSETS = [list(s) for n in (3, 2, 1) for s in itertools.combinations(range(3), n)]


@functools.cache
def _projector(count: int, order: int) -> Floats:
    """Matrix that removes a polynomial of this order from `count` values."""
    q, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, count), order + 1))
    return np.asarray(np.eye(count) - q @ q.T)


def _residual(gram: Floats, product: Floats, energy: float) -> float:
    """Least squares with coefficients of at least 0, by trying the sets of active columns.

    Args:
        gram: of the columns, shape `(3, 3)`.
        product: of the columns with the data, shape `(3,)`.
        energy: sum of squares of the data.
    Returns:
        Sum of squares of the residuals.
    """
    least = energy
    for subset in _SUBSETS:
        part = gram[np.ix_(subset, subset)]
        try:
            found = np.linalg.solve(part, product[subset])
        except np.linalg.LinAlgError:
            continue
        if found.min() >= 0.0:
            least = min(least, energy - float(found @ product[subset]))
            if len(subset) == 3:  # the unconstrained minimum meets the constraint
                break
    return max(least, 0.0)


def _free(gram: Floats, product: Floats) -> Floats:
    """Unconstrained least squares; negative coefficients if the columns are linearly dependent."""
    try:
        return np.asarray(np.linalg.solve(gram, product), dtype=np.float64)
    except np.linalg.LinAlgError:
        return -np.ones(len(product))


def direction_ratio(
    static: Floats, strain: Floats, rest: float | None = None, floor: float = 0.0
) -> float:
    r"""How much worse a plant with the right sign explains a window than one with the wrong sign.

    Any plant of second order gives $\varepsilon'' = -2\zeta\omega\,\varepsilon' -
    \omega^2(\varepsilon - g\,x - \varepsilon_0)$. Integrated twice this is linear in three
    coefficients that cannot be negative, for either sign of $g$; initial position and speed and
    $\varepsilon_0$ are a parabola, which is projected out. No parameter of the plant is needed.
    If the window begins with a step of the drive, the step is a parabola too; if the plant was
    in equilibrium before, $\varepsilon_0$ is known and only position and speed are free.

    Args:
        static: static strain of the drive, $x$. Shape `(N,)`.
        strain: measured. Shape `(N,)`.
        rest: $x$ before the window, if the plant was in equilibrium there.
        floor: RMS residual below which the right sign is good enough, and 1 is returned.
    Returns:
        Ratio of the RMS residuals; about 1 or less for a plant that moves the right way.
    """
    once = np.cumsum(strain - strain[0])
    before = static[0] if rest is None else rest
    columns = np.stack(
        [-once, -np.cumsum(once), np.cumsum(np.cumsum(static - before)), strain], axis=1
    )
    columns = _projector(len(strain), 2 if rest is None else 1) @ columns
    causes, effect = columns[:, :-1], columns[:, -1]
    causes /= np.linalg.norm(causes, axis=0) + 1e-30
    gram, energy = causes.T @ causes, float(effect @ effect)
    product = causes.T @ effect
    if _free(gram, product).min() >= 0.0:  # the best of all fits has the right sign
        return 1.0
    right = _residual(gram, product, energy)
    if right <= floor * floor * len(strain):
        return 1.0
    sign = np.array([1.0, 1.0, -1.0])
    wrong = _residual(gram * np.outer(sign, sign), product * sign, energy)
    return math.sqrt(right / wrong) if wrong > 0.0 else 1.0


def _scatter(strain: Floats) -> float:
    """Standard deviation of the noise, from second differences; robust against jumps."""
    return float(np.median(np.abs(np.diff(strain, 2)))) / (0.6745 * math.sqrt(6.0))


class Reaction:
    """Checks the response of the strain in a window of 0.5 s, in points of one or more blocks.

    Args:
        range_: width of the strain range.
        move_share: see `WatchdogSettings`.
        response_share: see `WatchdogSettings`.
        ratio: see `WatchdogSettings.direction_ratio`.
        every: blocks per point.
        rest: static strain of the drive before the loop closes.
        settled: the plant is in equilibrium there; else it may ring.
    """

    def __init__(
        self,
        range_: float,
        move_share: float,
        response_share: float,
        ratio: float,
        every: int,
        rest: float | None = None,
        settled: bool = True,
    ) -> None:
        self._range, self._every, self._rest = range_, every, rest
        self._start = _START if settled else _RINGING
        self._points = 0
        self._move, self._share, self._ratio = move_share * range_, response_share, ratio
        self._static: deque[float] = deque(maxlen=POINTS)
        self._strain: deque[float] = deque(maxlen=POINTS)
        self._sums = [0.0, 0.0, 0]
        self._against = 0
        self._odd = False

    def clear(self) -> None:
        """Restart: the next value does not follow the last one."""
        self._static.clear()
        self._strain.clear()
        self._sums, self._against, self._rest = [0.0, 0.0, 0], 0, None

    def fault(self, static: float, strain: float) -> str:
        """Return why the loop must stop after this block, or an empty text.

        Args:
            static: static strain of the drive.
            strain: measured.
        """
        sums = self._sums
        sums[0] += static
        sums[1] += strain
        sums[2] += 1
        if sums[2] < self._every:
            return ""
        self._static.append(sums[0] / sums[2])
        self._strain.append(sums[1] / sums[2])
        self._sums = [0.0, 0.0, 0]
        self._odd = not self._odd
        self._points += 1
        if self._points > POINTS:
            self._rest = None
        if self._odd or len(self._strain) < _FEWEST:
            return ""
        values = list(self._static) if self._rest is None else [self._rest, *self._static]
        if max(values) - min(values) < _LEAST_MOVE * self._range:
            self._against = 0
            return ""
        return self._judge(np.array(self._static), np.array(self._strain))

    def _judge(self, static: Floats, strain: Floats) -> str:
        if len(strain) == POINTS and (fault := self._dead(static, strain)):
            return fault
        floor = self._ratio * _scatter(strain)  # no fit has smaller residuals than the noise
        ratio = direction_ratio(static, strain, floor=floor)
        if len(strain) > _FEWEST and np.ptp(static[-_FEWEST:]) > _LEAST_MOVE * self._range:
            ratio = max(ratio, direction_ratio(static[-_FEWEST:], strain[-_FEWEST:], floor=floor))
        if self._rest is not None:
            ratio = max(ratio, direction_ratio(static, strain, self._rest, floor) / self._start)
        self._against = self._against + 1 if ratio > self._ratio and self._alive(strain) else 0
        if self._against < _AGREE:
            return ""
        return (
            "Strain moves against the drive: a plant with the wrong sign explains the last "
            f"{len(strain) * self._every} blocks {ratio:.2g} times better than one with the right "
            "sign. Check the strain map, the voltage map and the polarity of the monitors, and "
            "that the sensor measures this actuator without drift or delay."
        )

    def _alive(self, strain: Floats) -> bool:
        """Whether the strain moves now; otherwise it shows no direction."""
        recent = strain[-POINTS // 2 :]
        noise = _scatter(strain)
        return float(np.ptp(recent)) > self._share * self._move + 8.0 * noise

    def _dead(self, static: Floats, strain: Floats) -> str:
        """Check that the strain moved if the drive has left its value of 0.4 s ago permanently."""
        before, after = static[: POINTS // 5], static[2 * POINTS // 5 :]
        move = max(float(after.min() - before.max()), float(before.min() - after.max()))
        if move < self._move:
            return ""
        noise = _scatter(strain)
        means = strain[2 * POINTS // 5 :].reshape(-1, 5).mean(axis=1)
        start = float(strain[POINTS // 5 - 4 : POINTS // 5].mean())
        reacted = max(float(np.ptp(means)), float(np.abs(means - start).max()))
        if reacted > self._share * move + _NOISE_STD * noise / math.sqrt(5.0):
            return ""
        return (
            f"Strain does not respond: it changed by {reacted:.2g} while the drive's static strain "
            f"changed by {move:.2g}. Check that the sensor measures this actuator."
        )
