"""The closed loop at 1 kHz: its body in C, in a thread that waits for absolute deadlines.

Python starts it, carries its blocks to the recorder, and ends it; no tick waits for Python.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from haselab import _core, _realtime
from haselab.base import DeviceError, LimitError, SafetyError
from haselab.rig import Rig
from haselab.runtime.runner import LoopSettings, Recorder
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.loop_model import LoopModel, loop_model
from haselab.safety.watchdog.loop_watchdog import LoopSample, LoopWatchdog
from haselab.sensing import LockinConfig, reason_text

__all__ = ["FastLoop", "FastOptions", "FastReport", "SteppedPlant", "make_control"]

_DONE, _STOPPED, _SENSING_LOST, _DEADLINES, _PROTECTED, _OVERRUN = range(1, 7)
_LARGEST_CODE = 32767
_REACH_POINTS = 1001
_MOST_SPIN = 0.9


class SteppedPlant(Protocol):
    """A bench whose physics C code can step: the twin."""

    @property
    def load_n(self) -> float:
        """What hangs on the lower clamp, in N."""

    @property
    def native(self) -> Any:
        """Its C bench, with the addresses of parameters and state."""


@dataclass(frozen=True)
class FastOptions:
    """How the loop runs.

    Args:
        patience: blocks without a strain that trip it.
        patience_missed: missed ticks in a row that trip it.
        slots: blocks that may wait for the recorder.
        priority: of the thread among those in real time, 1 to 99; 0 asks for none. Where the
            system refuses it the loop runs without, and the report says so.
        spin_s: before each tick, in which the thread looks at the clock instead of sleeping: it
            then misses fewer ticks, on a virtual machine above all, and takes that share of one
            processor. At most 0.9 of a tick: the system stops real-time threads that never sleep.
        take_s: between two looks at what has come in.
        wait: lets time pass.
        safety: limits, where the rig is not guarded and has none.
    """

    patience: int = 5
    patience_missed: int = 50
    slots: int = 2000
    priority: int = 50
    spin_s: float = 0.0
    take_s: float = 0.02
    wait: Callable[[float], None] = time.sleep
    safety: SafetySettings = field(default_factory=SafetySettings)


@dataclass(frozen=True)
class FastReport:
    """How the deadlines were kept.

    Args:
        ticks: blocks that were closed.
        late: outputs later than the sample at which they were to take effect.
        missed: outputs later than the whole block in which they were to take effect.
        most_missed: the most of them in a row.
        blind: blocks without a strain.
        longest_s: the longest latency, from a block's last sample to the new output, in s.
        has_priority: the thread was one of real time.
        latency: counts of latencies in bins of `bin_s`, the last for all beyond.
        work: the same from waking up to the output: what the loop itself takes.
        bin_s: width of a bin, in s.
        age_s: of the samples that counted, at their block's end, mean, in s.
        switch_s: from a block's end to when an output takes effect that is on time, in s.
    """

    ticks: int
    late: int
    missed: int
    most_missed: int
    blind: int
    longest_s: float
    has_priority: bool
    latency: NDArray[np.float64]
    work: NDArray[np.float64]
    bin_s: float
    age_s: float
    switch_s: float

    def latency_s(self, share: float) -> float:
        """Latency that this share of the ticks did not exceed, in s; to a bin's upper end."""
        return self._quantile(self.latency, share)

    def work_s(self, share: float) -> float:
        """The same from waking up to the output, in s."""
        return self._quantile(self.work, share)

    @property
    def loop_delay_s(self) -> float:
        """Age of the strain when its output takes effect, in s: what a design must reckon with."""
        return self.age_s + max(self.switch_s, self.latency_s(0.5))

    def _quantile(self, bins: NDArray[np.float64], share: float) -> float:
        return float(np.searchsorted(np.cumsum(bins), share * bins.sum()) + 1) * self.bin_s


def make_control(
    config: LockinConfig, loop: LoopSettings, limits: tuple[float, float]
) -> _realtime.Control:
    """The loop's body: monitors, capacitance, strain, PID, voltage map, limits.

    Args:
        config: of the sensing; what is blanked must lie at the block's start.
        loop: controller and maps.
        limits: lowest and highest drive, in V.
    Returns:
        The body in C.
    Raises:
        LimitError: fewer than two periods of the carrier count, or samples are blanked elsewhere.
    """
    start, first = config.blank
    count = config.block_samples - first
    if start != 0 or count * config.carrier_hz < 2.0 * config.rate_hz:
        raise LimitError(
            f"Blanked samples [{start}, {first}) leave {count} of {config.block_samples}; allowed "
            f"is what starts at 0 and leaves two periods of {config.carrier_hz:g} Hz. Raise the "
            "carrier or shorten the blanking."
        )
    angle = config.omega_rad_s / config.rate_hz * np.arange(count)
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones(count), np.arange(count)], axis=1)
    inverse = np.linalg.inv(basis.T @ basis)[:2]
    scale, stray, gains = config.admittance_scale_s, config.stray_s, loop.gains
    strain, voltage = loop.strain_map, loop.voltage_map
    return _realtime.Control(
        samples=config.block_samples,
        first=first,
        cosine=_floats(basis[:, 0]),
        sine=_floats(basis[:, 1]),
        inverse=_floats(inverse.ravel()),
        impedance=_floats(
            [scale.real, scale.imag, stray.real, stray.imag, config.omega_rad_s,
             config.min_amplitude_codes]
        ),
        strain_map=_floats(strain.coefficients[:3]),
        pid=_floats(
            [gains.kp, gains.ki, gains.kd, config.block_s, gains.derivative_filter_s,
             loop.saturation.low, loop.saturation.high]
        ),
        voltage_map=_floats([voltage.a1_v, voltage.b1, voltage.a2_v, voltage.b2]),
        limits=_floats(limits),
        full_scale=int(min(config.full_scale, _LARGEST_CODE)),
    )  # fmt: skip


def _floats(values: Any) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, dtype=np.float32)


class FastLoop:
    """A closed loop of one block a tick on a bench that C code steps.

    Args:
        rig: the bench, armed; every way out ends at 0 V, read back. Only one that is simulated in
            this process may come plain: it is guarded and armed here.
        plant: the same bench.
        config: of the sensing, for the rig's blocks.
        loop: controller and maps.
        options: patience, priority, ring.
    Raises:
        LimitError: the loop could ask for more than the drive's limits, or the carrier is too low
            for the block.
    """

    def __init__(
        self,
        rig: Rig,
        plant: SteppedPlant,
        config: LockinConfig,
        loop: LoopSettings,
        options: FastOptions | None = None,
    ) -> None:
        self._options = options or FastOptions()
        self._arms = not isinstance(rig, GuardedRig)
        self._rig = rig if isinstance(rig, GuardedRig) else guard(rig, Safety(self._options.safety))
        self._plant, self._config = plant, config
        limits, v = rig.description.drive_limits, loop.voltage_map
        reach = np.linspace(loop.saturation.low, loop.saturation.high, _REACH_POINTS)
        limits.check(
            [_core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, float(u)) for u in (*reach, 0.0)]
        )
        self._control = make_control(config, loop, (limits.low, limits.high))
        self._loop = loop

    def _model(self, carrier_v: float) -> LoopModel:
        """For the watchdog, without the monitor's level: late ticks are counted, not tripped."""
        rig, loop = self._rig.description, self._loop
        return loop_model(
            rig,
            loop.voltage_map,
            (loop.saturation.low, loop.saturation.high),
            (self._config.carrier_hz, carrier_v),
            rig.block_s,
            None,
        )

    def _check_spin(self, spin_s: float) -> None:
        high_s = _MOST_SPIN * self._rig.description.block_s
        if not 0.0 <= spin_s <= high_s:
            raise LimitError(
                f"spin_s = {spin_s:g} s, allowed are 0 to {high_s:g} s, {_MOST_SPIN:g} of a tick. "
                "Shorten it."
            )

    def run(
        self, name: str, reference: NDArray[np.float64], carrier_v: float, recorder: Recorder
    ) -> FastReport:
        """Close the loop for one reference a tick, and record every block.

        Args:
            name: of the experiment in the session.
            reference: desired strain, shape `(ticks,)`; NaN opens the loop at zero strain.
            carrier_v: peak amplitude of the sensing signal ahead of the amplifier, in V.
            recorder: where the blocks go.
        Returns:
            How the deadlines were kept.
        Raises:
            SafetyError: sensing lost, deadlines lost, or the bench protected itself.
            DeviceError: the recorder failed, or did not take the blocks in time.
        """
        options = self._options
        self._check_spin(options.spin_s)
        parameters, state = self._plant.native.addresses
        native = _realtime.Loop(
            self._control, parameters, state, self._plant.load_n,
            self._rig.description.switch_sample, _floats(reference),
            options.slots, options.patience, options.patience_missed, options.priority,
            round(1e9 * options.spin_s),
        )  # fmt: skip
        start_s = self._rig.acquisition.time_s
        safety = self._rig.safety
        settings = safety.settings
        watchdog = LoopWatchdog(self._model(carrier_v), settings.loop, settings.rating)
        if self._arms:
            arm_simulated(self._rig)
        safety.run()
        with OrderlyEnd(lambda _: self._stop(native)):
            self._rig.generator.sine(self._config.carrier_hz, carrier_v)
            recorder.event(start_s, f"start {name}")
            native.start()
            reason, fault = self._carry(native, name, recorder, watchdog)
        recorder.flush(name)
        if fault:
            raise safety.trip(fault)
        report = self._report(native)
        self._judge(native.outcome, name, reason, report)
        recorder.event(self._rig.acquisition.time_s, f"end {name}")
        return report

    def _stop(self, native: _realtime.Loop) -> None:
        """The loop ends, then the bench is taken to 0 V."""
        try:
            native.stop()
            native.join()
        finally:
            try:
                self._rig.safe()
            finally:
                self._rig.safety.end_run()

    def _carry(
        self, native: _realtime.Loop, name: str, recorder: Recorder, watchdog: LoopWatchdog
    ) -> tuple[int, str]:
        """Take blocks to the recorder until the loop has ended.

        Returns:
            The last block's reason, and why the watchdog stopped the loop, empty if it did not.
        """
        samples = self._config.block_samples
        room = self._options.slots
        codes, rows = np.empty((room, samples, 2), np.int16), np.empty((room, 6))
        reason, fault = 0, ""
        while True:
            ended = native.outcome  # asked first: what comes in before it is taken below
            count = native.take(codes, rows)
            for block, row in zip(codes[:count].copy(), rows[:count], strict=True):
                recorder.append_block(name, block, row[0], row[1], row[2])
                reason = int(row[5])
                sample = LoopSample(float(row[3]), None, float(row[1]), float(row[2]))
                fault = fault or watchdog.fault(block, sample)
            if fault:
                native.stop()
            if ended:
                return reason, fault
            self._rig.safety.sign_of_life(self._options.take_s)
            self._options.wait(self._options.take_s)

    def _report(self, native: _realtime.Loop) -> FastReport:
        counts, config = native.counts(), self._config
        bins = np.empty((2, _realtime.BINS, 1))
        native.histogram(False, bins[0])
        native.histogram(True, bins[1])
        counted = config.block_samples - config.blank[1]
        return FastReport(
            ticks=counts["ticks"],
            late=counts["late"],
            missed=counts["missed"],
            most_missed=counts["most_missed"],
            blind=counts["blind"],
            longest_s=1e-9 * counts["longest_ns"],
            has_priority=bool(counts["has_priority"]),
            latency=bins[0, :, 0],
            work=bins[1, :, 0],
            bin_s=1e-9 * _realtime.BIN_NS,
            age_s=0.5 * counted / config.rate_hz,
            switch_s=self._rig.description.switch_sample / config.rate_hz,
        )

    def _judge(self, outcome: int, name: str, reason: int, report: FastReport) -> None:
        if outcome in (_DONE, _STOPPED):
            return
        ended = f"{name!r} ended after {report.ticks} ticks; the output was commanded to 0 V."
        if outcome == _SENSING_LOST:
            raise SafetyError(
                f"No strain in {self._options.patience} blocks ({reason_text(reason)}): {ended} "
                "Check the function generator and the monitors' cables."
            )
        if outcome == _DEADLINES:
            raise SafetyError(
                f"{report.most_missed} ticks missed in a row, allowed are "
                f"{self._options.patience_missed - 1}: {ended} Leave this machine to the loop, or "
                "allow its thread real time (ulimit -r)."
            )
        if outcome == _PROTECTED:
            raise SafetyError(f"The bench protected itself: {ended} Lower the voltage or the load.")
        raise DeviceError(
            f"{self._options.slots} blocks waited for the recorder: {ended} Use a faster disk."
        )
