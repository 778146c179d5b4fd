"""One simulated bench shared by several servers: its clock, its inputs and its outputs.

Time is counted in samples. With a pace it follows the wall clock, as instruments do; without one
(lock-step) it advances only as far as samples are requested, so that tests have no deadlines.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from haselab.base import Closing, LimitError, SafetyError
from haselab.rig import Frames
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.serve.camera_faults import CameraFaults
from haselab.rig.twin.serve.wiring import Wiring
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench, describe

__all__ = ["TICKS", "UNDERFLOW", "TwinHub"]

UNDERFLOW = -200290  # DAQmx status of an output that ran dry
TICKS = 20  # samples in one mechanical step
_BUFFER_S = 10.0
_RAMP_S, _RAMP_PIECES = 1.0, 50
_SHORTEST_S = 1e-4  # sleep of a reader, and of the pace keeper
_DELAY_S = 1e-3  # shortest noted delay of the pace keeper; also time to take a pending request
_IDLE_S = 0.02  # longest sleep of the pace keeper
_RIGHT = Wiring()
_RAIL_V = 1.0  # smallest voltage of the supply that counts as on


class TwinHub(Closing):
    """The physics, and the settings of the bench's instruments.

    Args:
        config: the physical bench.
        seed: of every random number.
        pace: seconds of the bench in one second of the wall clock; 0: lock-step.
        wiring: between the instruments.
    """

    def __init__(
        self, config: TwinConfig, seed: int, pace: float = 1.0, wiring: Wiring = _RIGHT
    ) -> None:
        if not 0.0 <= pace <= 1000.0:
            raise LimitError(f"The pace is {pace:g}, but it must be within [0, 1000]. Change it.")
        self.description = describe(config)
        if self.description.switch_sample % TICKS:
            raise LimitError(
                f"acquisition.output_delay_s is {config.acquisition.output_delay_s:g} s, but it "
                f"must be a multiple of {TICKS} samples. Round it."
            )
        self.bench = TwinBench(config, seed)
        self.wiring = wiring
        self.rate_hz = self.description.rate_hz
        self.volt_per_code = self.description.volt_per_code
        self._pace = pace
        self._lock = threading.Condition(threading.RLock())
        self._ring = np.zeros((round(_BUFFER_S * self.rate_hz), 2), dtype=np.int16)
        self._sampling = False
        self._acquired = 0  # samples since the inputs were started
        self._origin_s = self.bench.time_s  # bench time of sample 0
        self._period = 0  # samples between two edges of the output's clock, 0: it does not run
        self._first_edge = 0  # of the output's clock, in samples of the bench's life
        self._drive_v = 0.0
        self._queue: deque[tuple[int, float]] = deque()  # since when it is there, and the value
        self._repeated: tuple[float, ...] = ()  # put out again where the queue is empty
        self._streaming = False
        self._put_out = 0
        self.output_status = 0
        self.exposure_s = config.camera.exposure_s
        self.camera_faults = CameraFaults()
        self._taken: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        self._exposed: list[float] = []  # beginnings, in s of the bench's life
        self._rail_v = 0.0
        self._offset_v = 0.0  # of the generator, at the amplifier's input
        self.protected = ""  # why, once the bench has protected itself
        self._closed = threading.Event()
        self._started = time.monotonic()
        self.stalled_s = 0.0  # wall-clock time subtracted because this process ran late
        # delays of this process that were passed on: when, and how long, both in samples
        self._delays: deque[tuple[int, int]] = deque()
        self._before = 0  # samples before the inputs were started
        self._total = 0  # samples of the bench's whole life here
        self._keeper: threading.Thread | None = None
        if pace > 0.0:
            self._keeper = threading.Thread(target=self._keep_pace, name="twin pace")
            self._keeper.start()

    # ---- time ----------------------------------------------------------------------------------

    @property
    def lock_step(self) -> bool:
        """Whether time passes only as samples are requested."""
        return self._pace == 0.0

    def _behind(self) -> int:
        """Samples by which the wall clock is ahead, a multiple of 20.

        An instrument does not stop when the computer is busy, but this one does when its process
        does not run. A delay above one block is therefore subtracted from its clock, and counted,
        so that it does not cause errors in the program under test. A shorter one is subtracted
        only if an output would be late because of it: see `_wait_for_output`.
        """
        elapsed_s = (time.monotonic() - self._started) * self._pace
        behind = int(elapsed_s * self.rate_hz) // TICKS * TICKS - self._total
        excess = behind - self.description.block_samples
        if excess <= 0:
            return behind
        self._pause(excess)
        if self._delays:  # not passed on
            total, samples = self._delays.pop()
            self._delays.append((total, max(samples - excess, 0)))
        return behind - excess // TICKS * TICKS

    def _pause(self, samples: int) -> None:
        lost_s = samples / (self.rate_hz * self._pace)
        self._started += lost_s
        self.stalled_s += lost_s

    def _keep_pace(self) -> None:
        while not self._closed.is_set():
            wait_s = self._follow_clock()
            due_s = time.monotonic() + wait_s
            self._closed.wait(wait_s)
            self._note_delay(time.monotonic() - due_s)

    def _follow_clock(self) -> float:
        """Advance to the present; return the time until the next event, in s."""
        with self._lock:
            self._advance(self._behind())
            behind = self._behind()
            until = self._next_event() if behind >= 0 else 0
            wait_s = (until - behind) / (self.rate_hz * self._pace)
        return min(max(wait_s, _SHORTEST_S), _IDLE_S)

    def _note_delay(self, late_s: float) -> None:
        """Note that this process ran late, and its clients got their blocks late."""
        if late_s < _DELAY_S:
            return
        with self._lock:
            self._delays.append((self._total, int(late_s * self.rate_hz * self._pace)))

    def _wait_for_output(self, passed: int) -> bool:
        """Pause the clock before an edge if the output is missing because this process ran late.

        Its client had that much less time, and its request may be waiting. Delays of the last two
        blocks count, once each.

        Args:
            passed: samples since the edge.
        """
        block = self.description.block_samples
        while self._delays and self._delays[0][0] < self._total - 2 * block:
            self._delays.popleft()
        there = self._queue and self._queue[0][0] <= self._total
        if there or self._repeated or not self._streaming or not self._delays:
            return False
        delayed = min(sum(samples for _, samples in self._delays), block)
        self._delays.clear()
        self._pause(max(delayed, passed + round(_DELAY_S * self.rate_hz * self._pace)))
        return True

    def _next_event(self) -> int:
        """Samples until the next event: an output, or the end of a block."""
        block = self.description.block_samples
        until = [block - self._acquired % block]
        if self._period:
            until.append(self._to_edge() or self._period)
        return min(until)

    def _to_edge(self) -> int:
        """Samples to the next edge of the output's clock; 0: it is now."""
        if self._total <= self._first_edge:
            return self._first_edge - self._total
        return -(self._total - self._first_edge) % self._period

    def _advance(self, samples: int) -> None:
        """Let samples pass; a multiple of 20."""
        while samples > 0:
            piece = min(samples, self.description.block_samples)
            if self._period:
                to_edge = self._to_edge()
                if to_edge == 0:
                    if self._wait_for_output(samples):
                        break
                    self._clock_output()
                    to_edge = self._period
                piece = min(piece, to_edge)
            self._sample(piece)
            samples -= piece
        self._lock.notify_all()

    def _sample(self, samples: int) -> None:
        drive_v = self.wiring.amplifier_input(self._drive_v)
        drive_v += self._offset_v + self._rail_v / self.description.amplifier_gain
        try:
            codes = self.bench.sample(drive_v, samples)
        except SafetyError as error:
            # As on a real bench: both monitors read 0, and the supply has tripped.
            self.protected = str(error)
            self._drive_v = self._rail_v = self._offset_v = 0.0
            self._streaming = False
            self._queue.clear()
            codes = np.zeros((samples, 2), dtype=np.int16)
        sample_s = 1.0 / self.rate_hz
        codes = self.wiring.read(
            codes,
            self._drive_v,
            self.volt_per_code,
            self.description.top_code,
            self._total * sample_s,
            sample_s,
        )
        self._total += samples
        if self._sampling:
            at = (self._acquired + np.arange(samples)) % len(self._ring)
            self._ring[at] = codes
            self._acquired += samples

    def _clock_output(self) -> None:
        if not self._streaming:
            return
        if not self._queue:
            self._queue.extend((self._total, value) for value in self._repeated)
        if self._queue and self._queue[0][0] <= self._total:
            self._drive_v = self._queue.popleft()[1]
            self._put_out += 1
        else:
            self._streaming = False
            self.output_status = UNDERFLOW

    def _catch_up(self) -> None:
        if not self.lock_step:
            self._advance(self._behind())

    @property
    def buffer_samples(self) -> int:
        """Samples that are kept for reading."""
        return len(self._ring)

    # ---- inputs --------------------------------------------------------------------------------

    def start_inputs(self, clock: tuple[int, int] | None = None) -> None:
        """Start the sample clock: sample 0 is now.

        Args:
            clock: first edge and period of an output's clock that waits for this start.
        """
        with self._lock:
            self._catch_up()
            self._sampling = True
            self._acquired = 0
            self._origin_s = self.bench.time_s
            self._before = self._total
            if clock is not None:
                self._first_edge, self._period = self._total + clock[0], clock[1]

    @property
    def sample_zero_s(self) -> float:
        """The computer's monotonic clock at the first sample; NaN in lock-step."""
        if self.lock_step:
            return math.nan
        return self._started + self._before / (self.rate_hz * self._pace)

    def stop_inputs(self) -> None:
        """Stop the sample clock."""
        with self._lock:
            self._sampling = False
            self._lock.notify_all()

    @property
    def acquired(self) -> int:
        """Samples since the inputs were started."""
        with self._lock:
            self._catch_up()
            return self._acquired

    @property
    def origin_s(self) -> float:
        """Time of the bench's life at the first sample, in s."""
        return self._origin_s

    def readings(
        self, start: int, samples: int, timeout_s: float, until: int = 0
    ) -> NDArray[np.int16] | None:
        """Codes from sample `start` on, `(samples, 2)`; waits for them.

        Args:
            start: first sample.
            samples: how many.
            timeout_s: in s.
            until: number of samples that must have been taken, as they come in packets.
        Returns:
            The codes; none if they did not come in time.
        Raises:
            LookupError: they were overwritten, or are more than the buffer holds.
        """
        with self._lock:
            end = start + samples
            if start < 0 or samples > len(self._ring):
                raise LookupError("outside the buffer")
            due = max(end, until)
            if self.lock_step and self._sampling and due > self._acquired:
                self._advance(-(-(due - self._acquired) // TICKS) * TICKS)
            deadline_s = time.monotonic() + timeout_s
            while self._acquired < due:
                self._catch_up()  # samples come within a block too, without an event
                left_s = deadline_s - time.monotonic()
                if self._acquired >= due:
                    break
                if left_s <= 0.0 or not self._sampling or self._closed.is_set():
                    return None
                coming_s = (due - self._acquired) / (self.rate_hz * self._pace)
                self._lock.wait(min(left_s, max(coming_s, _SHORTEST_S)))
            if self._acquired - start > len(self._ring):
                raise LookupError("overwritten")
            return self._ring[(start + np.arange(samples)) % len(self._ring)]

    # ---- outputs -------------------------------------------------------------------------------

    def run_clock(self, first: int, period: int) -> None:
        """The output's clock: an edge so many samples from now, then one every period; 0: none."""
        with self._lock:
            self._catch_up()
            self._first_edge, self._period = self._total + first, period

    def set_output(self, drive_v: float) -> None:
        """Put an output out at once, at the amplifier's input."""
        with self._lock:
            self._catch_up()
            self._drive_v = drive_v
            if self.lock_step:  # such a call takes time, after which the output may be read
                self._advance(self.description.block_samples)

    def queue_output(self, values_v: list[float], under_way: int = 0) -> None:
        """Values for the coming edges of the output's clock.

        Args:
            values_v: in V.
            under_way: samples until they have reached the device.
        """
        with self._lock:
            self._catch_up()
            self._queue.extend((self._total + under_way, value) for value in values_v)

    @property
    def queued(self) -> int:
        """Number of values waiting for an edge."""
        return len(self._queue)

    def stream(self, on: bool, repeated_v: tuple[float, ...] = ()) -> None:
        """Start clocking the queue out, or discard it and keep the output.

        Args:
            on: which.
            repeated_v: put out over and over where the queue is empty; none: it runs dry.
        """
        with self._lock:
            self._catch_up()
            self._streaming = on
            self._repeated = repeated_v
            self._put_out = 0
            self.output_status = 0
            if not on:
                self._queue.clear()

    def spend(self, samples: int) -> None:
        """Advance the clock by the duration of a bus transfer."""
        with self._lock:
            if self.lock_step:
                self._advance(-(-samples // TICKS) * TICKS)
                return
            end = self._total + samples
        self.wait_until(lambda: self._total >= end, samples / (self.rate_hz * self._pace) + 1.0)

    def wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for a condition; in lock-step no time passes, so it is only checked."""
        with self._lock:
            if self.lock_step:
                return condition()
            return self._lock.wait_for(lambda: self._closed.is_set() or condition(), timeout_s)

    @property
    def put_out(self) -> int:
        """Number of values clocked out since the stream was started."""
        with self._lock:
            self._catch_up()
            return self._put_out

    @property
    def streaming(self) -> bool:
        """Whether the queue is being clocked out."""
        return self._streaming

    def carrier(self, frequency_hz: float, amplitude_v: float, offset_v: float = 0.0) -> None:
        """The generator's sine; 0 V: none. Its offset adds to what drives the amplifier."""
        with self._lock:
            self._catch_up()
            amplitude_v *= self.wiring.carrier_gain
            self._offset_v = offset_v * self.wiring.carrier_gain
            if amplitude_v == 0.0:
                self.bench.off()
            else:
                self.bench.sine(frequency_hz, amplitude_v)

    def rail(self, voltage_v: float) -> None:
        """The supply's rail, in series with the amplifier's output, in V."""
        with self._lock:
            self._catch_up()
            self._rail_v = voltage_v if abs(voltage_v) >= _RAIL_V else 0.0

    @property
    def rail_v(self) -> float:
        """The supply's rail, in V."""
        return self._rail_v

    @property
    def output_v(self) -> float:
        """True voltage at the actuator, in V."""
        with self._lock:
            return self.bench.output_v

    @property
    def length_m(self) -> float:
        """True length of the sheet, in m."""
        with self._lock:
            return self.bench.length_m

    # ---- weights and camera ----------------------------------------------------------------------

    def hang(self, mass_kg: float) -> None:
        """Hang a mass, over a second; see `haselab.rig.LoadStand`."""
        with self._lock:
            self._catch_up()
            self.bench.weigh(mass_kg)
        self._ramp(mass_kg * GRAVITY_M_S2)

    def lift(self) -> None:
        """Lift the mass off, over a second."""
        self._ramp(0.0)

    def drop(self) -> None:
        """Release the mass at once."""
        with self._lock:
            self._catch_up()
            self.bench.pull(self.bench.mass_kg * GRAVITY_M_S2)

    def _ramp(self, load_n: float) -> None:
        start_n = self.bench.load_n
        for k in range(1, _RAMP_PIECES + 1):
            with self._lock:
                self._catch_up()
                self.bench.pull(start_n + (load_n - start_n) * k / _RAMP_PIECES)
                if self.lock_step:
                    samples = _RAMP_S / _RAMP_PIECES * self.rate_hz
                    self._advance(round(samples / TICKS) * TICKS)
            if not self.lock_step:
                self._closed.wait(_RAMP_S / _RAMP_PIECES / self._pace)

    def start_camera(self, rate_hz: float) -> None:
        """Start taking frames."""
        with self._lock:
            self._catch_up()
            self.bench.start(rate_hz)
            self._taken = []

    def stop_camera(self) -> None:
        """Stop taking frames."""
        with self._lock:
            self.bench.stop()
            self._taken = []

    def take_frames(self) -> Frames | None:
        """Frames since the last call, timed on the clock of the inputs."""
        with self._lock:
            self._expose()
            taken, self._taken = self._taken, []
            origin_s = self._origin_s
        if not taken:
            return None
        time_s, lengths = (np.concatenate(parts) for parts in zip(*taken, strict=True))
        return Frames(self.bench.render(lengths), time_s - origin_s)

    def _expose(self) -> None:
        """Record the exposures that have ended."""
        exposed = self.bench.exposures()
        if exposed is None:
            return
        self._taken.append(exposed)
        if self.camera_faults.exposure_line_dead:
            return
        half_s = 0.5 * self.exposure_s
        inverted = self.camera_faults.exposure_line_inverted  # its edge then ends an exposure
        self._exposed += (exposed[0] + (half_s if inverted else -half_s)).tolist()

    def exposed_from(self, first: int) -> list[float]:
        """Start times of exposures from this one on, in s since the bench was created."""
        with self._lock:
            self._catch_up()
            self._expose()
            return self._exposed[first:]

    # ---- the end -------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop the clock and take everything to 0 V."""
        self._closed.set()
        if self._keeper is not None:
            self._keeper.join()
        with self._lock:
            self._drive_v = self._rail_v = self._offset_v = 0.0
            self.bench.off()
            self.bench.zero()
            self._lock.notify_all()
