"""The device in a loop: its motion in C, one call for each update, and its noise."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from haselab import _twin
from haselab.actuators import GRAVITY_M_S2
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import native_bench
from haselab.scoreboard.devices import Device
from haselab.scoreboard.knowledge import TRAINED
from haselab.scoreboard.loop_class import CARRIER_HZ, CARRIER_V, STEP_S, LoopClass, noise_of

__all__ = ["WITHOUT_EFFECT", "FastPlant", "fast_bench", "relative_noise_of"]

Floats = NDArray[np.float64]
_TRAIN_S, _REST_S = 20.0, 60.0
_RATE_HZ = 200e3  # of the converter: the twin moves in steps of 20 samples
#: Keys of a twin without effect: amplifier and monitors have no errors but noise and gain.
WITHOUT_EFFECT = (
    "dielectric.series_ohm", "dielectric.leakage_ohm", "amplifier.slew_v_per_s",
    "amplifier.current_limit_a", "amplifier.stray_f", "amplifier.v_monitor_gain_error",
    "amplifier.i_monitor_gain_error", "amplifier.v_monitor_lag_s", "amplifier.i_monitor_lag_s",
    "amplifier.v_monitor_offset_v", "amplifier.i_monitor_offset_v", "acquisition.block_samples",
    "acquisition.skew_s", "acquisition.drive_low_v", "acquisition.drive_high_v", "camera",
)  # fmt: skip


def fast_bench(config: TwinConfig) -> _twin.Bench:
    """The mechanics of a twin in C with the carrier on, in steps of 0.1 ms.

    Args:
        config: of the twin. The rate of its converter has no effect on the steps.
    """
    clock = config.acquisition.model_copy(update={"rate_hz": _RATE_HZ})
    bench = native_bench(config.model_copy(update={"acquisition": clock}), 0)
    bench.carrier_v, bench.carrier_rad_s = CARRIER_V, 2.0 * math.pi * CARRIER_HZ
    return bench


def relative_noise_of(loop: LoopClass, device: Device) -> float:
    """Standard deviation of a capacitance over its value, the same at every length.

    Args:
        loop: class.
        device: true.
    """
    middle_f = float(device.law.capacitance_f(device.law.free_length_m))
    return noise_of(loop, device.config, middle_f) / middle_f


class FastPlant:
    """A device without monitors: the mean capacitance of each update is that of its motion.

    What the lock-in adds is its noise. The amplifier is ideal: its lag of 0.04 ms and its slew of
    0.6 ms over the whole range move a length by less than that noise.

    Args:
        device: true.
        loop: timing of the updates.
        rng: of the noise.
        updates: highest number of them.
    """

    def __init__(
        self, device: Device, loop: LoopClass, rng: np.random.Generator, updates: int
    ) -> None:
        self._device, self._loop, self._rng = device, loop, rng
        self._bench = fast_bench(device.config)
        self._lead = max(1 - loop.first, 1)  # lengths before the first update
        self.lengths_m = np.zeros(self._lead + updates * loop.steps)
        waiting, switch_at = divmod(loop.switch_at + round(device.late_s / STEP_S), loop.steps)
        self._timing = loop.steps, switch_at, loop.first, loop.last
        self._outputs = [0.0] * (2 + waiting)  # the oldest acts first
        self._at = self._lead
        self._relative_noise = relative_noise_of(loop, device)
        self._mass_kg = math.nan
        self.hang(device.mass_kg)

    def hang(self, mass_kg: float) -> None:
        """Change the hung mass at once, as a weight that is put on without a shock."""
        if mass_kg != self._mass_kg:
            config, law = self._device.config, self._device.law
            self._mass_kg, self._load_n = mass_kg, GRAVITY_M_S2 * mass_kg
            self._bench.inertia_kg = mass_kg + config.load.added_inertia_kg + law.moving_mass_kg

    def train(self) -> None:
        """Stretch the actuator further than any task, then let it rest (Mullins effect)."""
        mass_kg = self._mass_kg
        self.hang(TRAINED * self._device.mass_kg)
        self.hold(0.0, _TRAIN_S)
        self.hang(mass_kg)
        self.hold(0.0, _REST_S)

    def hold(self, drive_v: float, duration_s: float) -> None:
        """Let time pass at a drive."""
        self._bench.move(np.array([drive_v]), 1, self._load_n,
                         np.empty(round(duration_s / STEP_S)))  # fmt: skip
        self.lengths_m[: self._lead] = self._bench.length_m
        self._outputs = [drive_v] * len(self._outputs)

    def update(self, drive_v: float) -> float:
        """Let one update pass.

        Args:
            drive_v: computed from the update before; it takes effect within this one.
        Returns:
            Capacitance, in F; NaN after a breakdown.
        """
        loop, outputs = self._loop, self._outputs
        outputs.append(drive_v)
        outputs.pop(0)
        farad = self._bench.update(
            outputs[0], outputs[1], self._load_n, self._timing, self.lengths_m, self._at
        )
        self._at += loop.steps
        if self._bench.broken:
            return math.nan
        if self._relative_noise == 0.0:
            return farad
        return farad * (1.0 + self._relative_noise * self._rng.standard_normal())

    @property
    def broken(self) -> str:
        """Why the actuator no longer works; empty: it does."""
        if self._bench.outside:
            return "the length left the range of the law"
        return "dielectric breakdown" if self._bench.broken else ""

    @property
    def true_lengths_m(self) -> Floats:
        """Lengths after each step of the updates so far. Shape `(updates * steps,)`."""
        return self.lengths_m[self._lead : self._at]
