"""A transfer function at the lines of a measured response: basis functions and initial guesses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.identify.frequency.line_noise import LineNoise
from haselab.identify.projection import Basis
from haselab.identify.transfer.layout import Layout, Section

__all__ = ["ResponseProblem"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_REFINEMENTS = 6
_DELAYS = 8
_FINER = 2
_LATE = 32  # quarter turns of the dominant frequency, the end of the finer delay grid
_DAMPINGS = (0.03, 0.2, 1.0)
_FREQUENCIES = 24


@dataclass(frozen=True)
class ResponseProblem:
    """Weighted lines and the structure to fit.

    Args:
        layout: order of the parameters.
        s: Laplace variable of the lines, in rad/s. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
        weight: one over the standard deviation of real and imaginary part, for initial guesses.
            Shape `(K,)`.
        noise: noise model of the lines.
    """

    layout: Layout
    s: Complexes
    response: Complexes
    weight: Floats
    noise: LineNoise

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Bounds of the searched parameters within which the lines can identify them."""
        omega_rad_s = self.s.imag
        slowest, fastest = float(omega_rad_s.min()), float(omega_rad_s.max())
        step = float(np.median(np.diff(omega_rad_s)))
        pairs = []
        for at in self.layout.free:
            name = self.layout.names[at]
            if name == "delay_s":
                pairs.append((-math.pi / fastest, math.pi / step))
            elif name.startswith("natural_frequency"):
                pairs.append((math.log(0.1 * slowest), math.log(10.0 * fastest)))
            elif name.startswith("damping_ratio"):
                pairs.append((math.log(1e-5), math.log(100.0)))
            else:
                pairs.append((math.log(0.1 / fastest), math.log(100.0 / slowest)))
        low, high = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        return low, high

    @property
    def middle_rad_s(self) -> float:
        """Dominant frequency, in rad/s."""
        power = np.abs(self.response * self.weight) ** 2
        return float(np.sqrt((self.s.imag**2 * power).sum() / power.sum()))

    def basis(self, search: Floats) -> Basis:
        """Weighted functions of frequency, real parts first, then imaginary parts."""
        value, slope = self._functions(self.layout.full(search))
        slope = slope[self.layout.free]
        free = np.isnan(self.layout.factor_template)
        given = np.where(free, 0.0, self.layout.factor_template)
        empty = np.zeros((2 * self.s.size, 0))
        return Basis(
            self._real(self.response),
            self._real(value[:, free].T).T,
            empty,
            np.moveaxis(self._real(np.moveaxis(slope[:, :, free], 1, 2)), -1, 1),
            self._real(value @ given),
            self._real(slope @ given),
        )

    def modelled(self, search: Floats, factors: Floats) -> Complexes:
        """Response of the model at the lines. Shape `(K,)`."""
        all_factors = self.layout.factor_template.copy()
        all_factors[np.isnan(all_factors)] = factors
        return np.asarray(self._functions(self.layout.full(search))[0] @ all_factors)

    def _functions(self, numbers: Floats) -> tuple[Complexes, Complexes]:
        """Basis functions `(K, S)` and their parameter derivatives `(L, K, S)`."""
        turn = np.exp(-self.s * numbers[-1])
        values, slopes = [], []
        for section in self.layout.sections:
            for power in range(section.zeros + 1):
                value, logarithmic = self._function(section, numbers, power)
                values.append(value * turn)
                slopes.append(logarithmic * (value * turn)[None, :])
        value, slope = np.stack(values, axis=1), np.stack(slopes, axis=2)
        slope[-1] = -self.s[:, None] * value
        return value, slope

    def _real(self, values: Complexes) -> Floats:
        """Weighted real and imaginary parts, one after the other along the last axis."""
        return self.noise.whiten(np.concatenate([values.real, values.imag], axis=-1))

    def _function(
        self, section: Section, numbers: Floats, power: int
    ) -> tuple[Complexes, Complexes]:
        r"""$(s/\omega)^{power}\,a_0/A(s)$ with $\omega^n = a_0$, and its log-derivatives."""
        value = np.ones(self.s.size, dtype=np.complex128)
        slope = np.zeros((numbers.size, self.s.size), dtype=np.complex128)
        size = 0.0
        for at_omega, at_zeta in section.pairs:
            z, zeta = self.s / math.exp(numbers[at_omega]), math.exp(numbers[at_zeta])
            bottom = z * z + 2.0 * zeta * z + 1.0
            value = value / bottom
            slope[at_omega] = (2.0 * z * z + 2.0 * zeta * z) / bottom
            slope[at_zeta] = -2.0 * zeta * z / bottom
            slope[at_omega] -= power * 2.0 / section.order
            size += 2.0 * numbers[at_omega]
        for at_tau in section.reals:
            z = self.s * math.exp(numbers[at_tau])
            value = value / (z + 1.0)
            slope[at_tau] = -z / (z + 1.0) + power / section.order
            size -= numbers[at_tau]
        return value * (self.s / math.exp(size / section.order)) ** power, slope

    def starting_points(self) -> Iterator[Floats]:
        """Initial guesses: rational functions by linearised least squares for several delays.

        Source: Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963), 56.
        """
        structure, delays = self.layout.structure, self._delays()
        for delay_s in delays:
            for extra in {0, structure.slow_modes}:
                poles = self._poles(structure.poles + extra, delay_s)
                for numbers in self._arranged(poles, delay_s):
                    yield numbers[self.layout.free]

    def later_starting_points(self) -> Iterator[Floats]:
        """A finer and longer grid of delays; none when the delay is known."""
        delays = self._delays()
        fine_s = delays[1] / _FINER if len(delays) > 1 else 0.0
        for k in range(_LATE * _FINER if fine_s else 0):
            poles = self._poles(self.layout.structure.poles, k * fine_s)
            for numbers in self._arranged(poles, k * fine_s):
                yield numbers[self.layout.free]

    def more_starting_points(self) -> Iterator[Floats]:
        """A grid of poles, for up to two fast ones."""
        structure, delays = self.layout.structure, self._delays()
        if structure.poles > 2:
            return
        low, high = float(self.s.imag.min()), float(self.s.imag.max())
        for omega in np.geomspace(low, 2.0 * high, _FREQUENCIES):
            for zeta in _DAMPINGS:
                pair = np.roots([1.0, 2.0 * zeta * omega, omega**2])[: structure.poles]
                for numbers in self._arranged(pair.astype(np.complex128), delays[0]):
                    yield numbers[self.layout.free]

    def _delays(self) -> list[float]:
        """The known delay, or a grid of quarter turns of the dominant frequency."""
        known = self.layout.template[-1]
        if not math.isnan(known):
            return [float(known)]
        return [0.25 * 2.0 * math.pi / self.middle_rad_s * k for k in range(_DELAYS)]

    def _poles(self, order: int, delay_s: float) -> Complexes:
        scale = float(self.s.imag.max()) / 3.0
        powers = (self.s / scale)[:, None] ** np.arange(order + 1)
        response = self.response * np.exp(self.s * delay_s)
        columns = np.hstack([-powers[:, :order] * response[:, None], powers[:, :order]])
        target = powers[:, order] * response
        weight = self.weight / np.abs(np.polyval(np.poly(-np.ones(order)), self.s / scale))
        roots = np.zeros(order, dtype=np.complex128)
        for _ in range(_REFINEMENTS):
            rows, wanted = columns * weight[:, None], target * weight
            rows = np.vstack([rows.real, rows.imag])
            size = np.sqrt((rows**2).sum(axis=0)) + 1e-300
            goal = np.concatenate([wanted.real, wanted.imag])
            factors = np.linalg.lstsq(rows / size, goal, rcond=1e-12)[0] / size
            roots = np.roots(np.concatenate([[1.0], factors[:order][::-1]])).astype(np.complex128)
            roots = -np.abs(roots.real) - 1e-6 * np.abs(roots) - 1e-9 + 1j * roots.imag
            weight = self.weight / np.abs(np.polyval(np.poly(roots), self.s / scale))
        return np.asarray(roots * scale, dtype=np.complex128)

    def _arranged(self, poles: Complexes, delay_s: float) -> Iterator[Floats]:
        """Poles in the order of the layout; slow branches from the slowest poles or a grid."""
        structure = self.layout.structure
        count = structure.slow_modes
        pairs = [(abs(p), -p.real / abs(p)) for p in poles if p.imag > 1e-9 * abs(p)]
        reals = sorted(-p.real for p in poles if abs(p.imag) <= 1e-9 * abs(p))
        taken = count if poles.size > structure.poles else 0
        if len(reals) < taken:
            return
        slow, reals = reals[:taken], reals[taken:]
        while len(pairs) < structure.poles // 2 and len(reals) >= 2:
            a, b = reals.pop(0), reals.pop(0)
            pairs.append((math.sqrt(a * b), 0.5 * (a + b) / math.sqrt(a * b)))
        if len(pairs) != structure.poles // 2 or len(reals) != structure.poles % 2:
            return
        fast = [math.log(x) for pair in sorted(pairs) for x in (pair[0], max(pair[1], 1e-4))]
        fast += [-math.log(rate) for rate in reals]
        slowest = float(self.s.imag.min())
        ladder = [tuple(slow)] if taken == count else [
            tuple(slowest * step / 3.0**k for k in range(count)) for step in (0.3, 1.0, 3.0)
        ]  # fmt: skip
        for rates in ladder:
            yield np.array([*fast, *(-math.log(rate) for rate in rates), delay_s])
