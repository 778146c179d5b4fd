r"""Iterative learning for periodic work: what repeats in the error is removed before it happens.

The reference of an inner `observer` gets a correction $c$ that is learned from period to period,
each harmonic $h$ of the period apart:

$C_h \leftarrow C_h + \gamma_j\,Q_h\,E_h$

with the error $E_h$ of the sensed length in the period $j$. $Q$ is 1 up to `cutoff_hz` and 0 above:
a filter without phase, because the whole period is known. Where the inner loop answers its
reference by $T$, a harmonic of the error shrinks by $|1 - \gamma_j T_h|$ in a period, and the
falling gain $\gamma_j$ averages the noise.

Source: D. A. Bristow, M. Tharayil, A. G. Alleyne, IEEE Control Syst. Mag. 26 (2006), 96.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import ResultError
from haselab.controllers.adaptive.model_loop import play_on_model
from haselab.controllers.adaptive.period import PeriodFinder
from haselab.controllers.kind import ControllerKind
from haselab.controllers.observer import ObserverController
from haselab.controllers.observer_design import OBSERVER, design_observer
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = [
    "LEARNING",
    "LearningController",
    "PeriodLearner",
    "answer_of_reference",
    "design_learning",
]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_SHORTEST_S, _LONGEST_S, _MOST = 0.5, 20.0, 2000  # updates
_FIRST, _LEAST_GAIN = 1.25, 0.15  # gain 1/1.25, 1/2.25, ... and at least 0.15
_WORSE = 2.0  # times the least error: the correction of that period is restored
_USABLE = 0.6  # of a period: with less, nothing is learned
_AT_LIMIT = 1e-3  # of the range of the drive
_QUIETER = 8.0  # of the expected load: changes that repeat are learned
_SHRINKS = 1.0  # |1 - T| of a harmonic that is learned is below
_POINTS = (0.1, 0.5, 0.9)  # of the reachable range
_SPREAD = ((1.0, 0.0), (1.1, 0.0), (0.9, 0.2), (1.0, 0.5))  # stiffness; longer delay, of it
_HIGHEST_HZ = 40.0  # faster waves of all frequencies together are no smooth reference
_TRIED_S, _PERIODS, _WAVE, _HIGHEST = 0.5, 3, 3e-5, 0.4  # strain; of the rate of the updates


class PeriodLearner:
    """The correction of a periodic reference, learned from the errors of each period.

    Args:
        period_s: of the updates.
        later_s: from the time of a desired strain to that of the strain measured with it.
        cutoff_hz: highest harmonic that is learned.
    """

    def __init__(self, period_s: float, later_s: float, cutoff_hz: float) -> None:
        self._period_s, self._later_s, self._cutoff_hz = period_s, later_s, cutoff_hz
        longest = min(round(_LONGEST_S / period_s), _MOST)
        self._finder = PeriodFinder(round(_SHORTEST_S / period_s), longest)
        self._past = np.full((2, longest), np.nan)  # desired and measured, the oldest first
        self._count = 0
        self._forget(0)

    def _forget(self, count: int) -> None:
        self._count, self._at, self._learned, self._share = count, 0, 0, 1.0
        self._table = np.zeros(count)
        self._best: tuple[float, Floats] = math.inf, self._table

    def next(self, wanted: tuple[float, ...], strain: float) -> tuple[float, ...]:
        """Desired strains with their corrections.

        Args:
            wanted: of this update and of those that come.
            strain: measured in this update; NaN: nothing is learned from it.
        """
        count = self._finder.next(wanted[0])
        if count != self._count:
            self._forget(count)
        if count and self._at == 0:
            self._learn()
        self._past[:, :-1] = self._past[:, 1:]
        self._past[:, -1] = wanted[0], strain
        if not count:
            return wanted
        at, self._at = self._at, (self._at + 1) % count
        return tuple(v + float(self._table[(at + k) % count]) for k, v in enumerate(wanted))

    def _learn(self) -> None:
        """Correct the table by the errors of the period that has ended."""
        wanted, strain = self._past[:, -self._count :]
        known = np.isfinite(strain)
        if np.count_nonzero(known) < _USABLE * self._count:
            return
        hertz = np.fft.rfftfreq(self._count, self._period_s)
        late = np.exp(-2j * np.pi * hertz * self._later_s)
        measured = np.fft.irfft(np.fft.rfft(wanted) / late, self._count)
        measured[known] = strain[known]
        spectrum = np.fft.rfft(wanted) - np.fft.rfft(measured) * late
        spectrum[hertz > self._cutoff_hz] = 0.0
        error = np.fft.irfft(spectrum, self._count)
        size = float(np.sqrt(np.mean(error**2)))
        if size > _WORSE * self._best[0]:
            self._table, self._share = self._best[1].copy(), 0.5 * self._share
            self._best = size, self._best[1]
            return
        if size < self._best[0]:
            self._best = size, self._table.copy()
        gain = max(1.0 / (_FIRST + self._learned), _LEAST_GAIN)
        self._learned += 1
        self._table = self._table + self._share * gain * error


class LearningController:
    """An `observer` whose reference is corrected by what it missed in the periods before.

    Args:
        bandwidth_rad_s: see `ObserverController`.
        load_n: see there.
        shake_m_s2: see there.
        reserve: see there.
        cutoff_hz: highest harmonic that is learned.
    """

    def __init__(
        self, bandwidth_rad_s: float, load_n: float, shake_m_s2: float, reserve: float,
        cutoff_hz: float,
    ) -> None:  # fmt: skip
        self._inner = ObserverController(bandwidth_rad_s, load_n, shake_m_s2, reserve)
        self._cutoff_hz = cutoff_hz

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        assert setting.actuator is not None, "the kind needs it"
        self._known, self._setting = setting.actuator, setting
        self._learner = PeriodLearner(setting.period_s, _later_s(setting), self._cutoff_hz)
        self._drive_v = setting.drive_start
        self._inner.start(setting)

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the inner observer."""
        return self._inner.estimated_load_kg

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; nothing is learned without a valid measurement or at a limit."""
        usable = measurement.valid and not self._at_limit(measurement.strain)
        strain = measurement.strain if usable else math.nan
        wanted = self._learner.next((reference, *measurement.preview), strain)
        self._drive_v = self._inner.step(wanted[0], replace(measurement, preview=wanted[1:]))
        return self._drive_v

    def _at_limit(self, strain: float) -> bool:
        """Whether the last drive was at a limit of the loop or of the field."""
        low_v, high_v = max(self._setting.drive_low, 0.0), self._setting.drive_high
        margin_v = _AT_LIMIT * (high_v - low_v)
        high_v = min(high_v, self._known.highest_drive_v(self._known.length_m(strain)))
        return not low_v + margin_v <= self._drive_v <= high_v - margin_v


def _later_s(setting: ControllerSetting) -> float:
    """From the time of a desired strain, a block's beginning, to that of its measured strain."""
    age_s = setting.sensed_before_s
    return setting.period_s - (0.5 * setting.period_s if age_s is None else age_s)


def answer_of_reference(
    values: Mapping[str, float], setting: ControllerSetting, strain: float,
    other: tuple[float, float],
) -> tuple[Floats, Complexes]:  # fmt: skip
    """How the inner loop answers small waves of its reference, on the identified motion.

    Args:
        values: parameters of the inner `observer`.
        setting: of the loop.
        strain: about which it moves.
        other: stiffness of the actuator over the identified one; delay beyond the stated one, s.
    Returns:
        Frequencies in Hz, up to 0.4 of the rate of the updates and to 40 Hz, and the response
        there.
    """
    count = round(_TRIED_S / setting.period_s)
    last = min(int(_HIGHEST * count), round(_HIGHEST_HZ * count * setting.period_s))
    order = np.arange(1, last + 1)
    turns = np.outer(np.arange(count) / count, order) + 0.5 * order**2 / last  # Schroeder
    wave = _WAVE * np.cos(2.0 * np.pi * turns).sum(axis=1)
    wanted = strain + np.tile(wave, _PERIODS)
    inner = ObserverController(**values)
    ahead = OBSERVER.preview_steps(setting.period_s)
    found = play_on_model(inner, setting, wanted, ahead, other)[-count:]
    hertz = order / (count * setting.period_s)
    late = np.exp(-2j * np.pi * hertz * _later_s(setting))
    answer = np.fft.rfft(found)[1 : last + 1] / np.fft.rfft(wave)[1 : last + 1] * late
    return hertz, answer


def design_learning(setting: ControllerSetting) -> Mapping[str, float]:
    """Take the design of `observer`, make it quieter, and learn the harmonics whose error shrinks.

    The expected load is an eighth of that of `observer`: what repeats is learned, and noise moves
    the actuator less. A harmonic is learned if its error shrinks in each period (|1 - T| < 1), and
    so do those of all lower ones: at three strains of the reachable range, with the identified
    stiffness, with 10 % more, with 10 % less and a delay that is longer by a fifth, and with a
    delay that is longer by half.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `LearningController`.
    Raises:
        ResultError: The inner loop is not stable, or the error of no harmonic shrinks in all cases.
    """
    inner = dict(design_observer(setting))
    inner["load_n"] = float(f"{inner['load_n'] / _QUIETER:.4g}")
    known = setting.actuator
    assert known is not None
    low, high = known.reachable()
    delay_s = (setting.delay_s or 0.0) + 0.5 * setting.period_s
    hertz, worst = np.zeros(0), np.zeros(1)
    for share in _POINTS:
        for stiffness, longer in _SPREAD:
            hertz, answer = answer_of_reference(
                inner, setting, low + share * (high - low), (stiffness, longer * delay_s)
            )
            worst = np.maximum(worst, np.abs(1.0 - answer))
    last = int(np.argmax(worst >= _SHRINKS)) if (worst >= _SHRINKS).any() else worst.size
    if not last:
        raise ResultError(
            "Learning would not reduce the error of any harmonic of the reference for all "
            "actuators that the design considers. Shorten the delay of the loop."
        )
    return {**inner, "cutoff_hz": float(f"{hertz[last - 1]:.4g}")}


LEARNING = ControllerKind(
    "learning",
    LearningController,
    (*OBSERVER.parameters, replace(OBSERVER.parameters[0], name="cutoff_hz", unit="Hz")),
    output="voltage",
    needs_actuator=True,
    design=design_learning,
    preview_s=OBSERVER.preview_s,
)
