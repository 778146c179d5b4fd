"""The twin as a rig: physics in C that implements the protocols of `haselab.rig`."""

from __future__ import annotations

import math
import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from haselab import _twin
from haselab.actuators import GRAVITY_M_S2
from haselab.base import LimitError, Limits, SafetyError
from haselab.rig import Frames, Rig, RigDescription
from haselab.rig.twin.camera import TwinCamera
from haselab.rig.twin.config import SETTLE_S, TwinConfig
from haselab.rig.twin.frames import DrawnFrames

__all__ = [
    "CARRIER_HIGH_V",
    "CLAMP_KG",
    "GRAVITY_M_S2",
    "TwinBench",
    "describe",
    "instrument_values",
    "make_twin",
    "native_bench",
    "rig_of",
]

CARRIER_HIGH_V = 1.0  # at the input of the amplifier
CLAMP_KG = 0.02  # the lower clamp itself
_SLOWEST_FRAMES_HZ = 0.01  # a lower frame rate is a mistake
_SUB = 20  # samples in one mechanical step, TWIN_SUB of native/twin/twin.h
_THREADS = os.cpu_count() or 1
_RAMP_S = 1.0  # a person takes this long to hang or lift a weight
_LONGEST_WAIT_S = 86400.0
_SMALLEST_F, _LARGEST_F = 1e-12, 1e-6  # of the fixture
_MOST_STEPS = 5_000_000  # mechanical steps per call, to limit memory


def native_bench(
    config: TwinConfig,
    seed: int,
    *,
    noise: bool = True,
    breakdown_v_per_m: float | None = None,
) -> _twin.Bench:
    """Create the C bench of a configuration, unloaded and relaxed at its free length.

    Args:
        config: of the bench; its law is sampled into a table.
        seed: of the monitors' noise.
        noise: False switches the noise off.
        breakdown_v_per_m: replaces that of the law.
    Raises:
        InputError: The twin cannot integrate the law, see `law_table` and `motion_parameters`.
    """
    from haselab.actuators import law_table, motion_parameters  # see TwinConfig.law

    law, daq, amplifier = config.law, config.acquisition, config.amplifier
    circuit = law.circuit
    values = {
        **instrument_values(config, noise),
        "series_ohm": circuit.series_ohm,
        "leakage_ohm": circuit.leakage_ohm,
        "breakdown_v_m": breakdown_v_per_m or circuit.breakdown_v_per_m,
    }
    highest_v = max(daq.drive_high_v, -daq.drive_low_v) + CARRIER_HIGH_V
    table = law_table(law, amplifier.gain * (1.0 + amplifier.gain_error) * highest_v)
    motion = motion_parameters(law)
    motion["inertia_kg"] += config.load.mass_kg + config.load.added_inertia_kg
    return _twin.Bench(values, motion, law.free_length_m, seed, *table.arrays())


def instrument_values(config: TwinConfig, noise: bool) -> dict[str, float]:
    """Parameters of generator, amplifier, monitors, converters and of what no law has."""
    daq, amplifier, extra = config.acquisition, config.amplifier, config.unmodelled
    return {
        "carrier_v": 0.0,
        "carrier_rad_s": 0.0,
        "gain": amplifier.gain * (1.0 + amplifier.gain_error),
        "amplifier_rad_s": 2.0 * math.pi * amplifier.bandwidth_hz,
        "amplifier_damping": amplifier.damping_ratio,
        "slew_v_s": amplifier.slew_v_per_s,
        "current_limit_a": amplifier.current_limit_a,
        "stray_f": amplifier.stray_f,
        "v_monitor": (1.0 + amplifier.v_monitor_gain_error) / amplifier.volt_per_monitor_volt,
        "i_monitor": (1.0 + amplifier.i_monitor_gain_error) / amplifier.ampere_per_monitor_volt,
        "v_monitor_lag_s": amplifier.v_monitor_lag_s,
        "i_monitor_lag_s": amplifier.i_monitor_lag_s,
        "v_offset_v": amplifier.v_monitor_offset_v,
        "i_offset_v": amplifier.i_monitor_offset_v,
        "sample_s": 1.0 / daq.rate_hz,
        "skew_s": daq.skew_s,
        "lsb_v": 2.0 * daq.range_v / 2**daq.bits,
        "top_code": float(daq.top_code),
        "v_noise_v": daq.v_noise_v if noise else 0.0,
        "i_noise_v": daq.i_noise_v if noise else 0.0,
        "capacitance_rise": extra.capacitance_rise,
        "warming_s": extra.warming_s,
        "stiffness_loss": extra.stiffness_loss,
        "ageing_s": extra.ageing_s,
        "begins_s": extra.begins_s,
        "second_kg": extra.resonance_mass_kg,
        "second_rad_s": 2.0 * math.pi * extra.resonance_hz,
        "second_damping": extra.resonance_damping_ratio,
    }


def describe(config: TwinConfig) -> RigDescription:
    """Return the nominal values of this bench, without its errors."""
    daq, amplifier, law = config.acquisition, config.amplifier, config.law
    return RigDescription(
        name=config.name,
        rate_hz=daq.rate_hz,
        block_samples=daq.block_samples,
        switch_sample=round(daq.output_delay_s * daq.rate_hz),
        skew_s=daq.skew_s,
        volt_per_code=2.0 * daq.range_v / 2**daq.bits,
        top_code=daq.top_code,
        amplifier_gain=amplifier.gain,
        v_monitor_v_per_v=1.0 / amplifier.volt_per_monitor_volt,
        i_monitor_v_per_a=1.0 / amplifier.ampere_per_monitor_volt,
        drive_limits=Limits("drive voltage", daq.drive_low_v, daq.drive_high_v, "V"),
        shell_area_m2=law.area_m2,
        lateral_stretch=law.lateral_stretch,
        scale_m_per_px=config.camera.scale_m_per_px,
        mass_kg=config.load.mass_kg,
        amplifier=amplifier.name,
        exposure_s=config.camera.exposure_s,
        actuator_kind=config.kind,
    )


class TwinBench:
    """All instruments of the twin on one clock; implements every protocol of `haselab.rig`.

    Args:
        config: the physical bench.
        seed: of every random number.
        noise: False switches the noise of the monitors off.
    """

    def __init__(self, config: TwinConfig, seed: int, *, noise: bool = True) -> None:
        self._config = config
        self._law = config.law
        self._native = native_bench(config, seed, noise=noise)
        self._description = describe(config)
        self._camera = TwinCamera(
            config.camera,
            0.5 * self._law.width_m,
            self._law.free_length_m,
            seed,
        )
        samples = config.acquisition.block_samples
        self._codes = np.empty((samples, 2), dtype=np.int16)
        self._lengths = np.empty(samples // _SUB)
        self._step_s = _SUB / config.acquisition.rate_hz
        self._before_v = self._after_v = 0.0
        self._load_n = 0.0
        self._mass_kg = config.load.mass_kg
        self._frame_rate_hz = 0.0
        self._next_frame_s = 0.0
        self._frames_taken = 0
        self._renderers: ThreadPoolExecutor | None = None  # threads, created at first use
        self._trace: list[NDArray[np.float64]] = []
        self._trace_start_s = 0.0
        self.hang(config.load.mass_kg)
        self.wait(SETTLE_S)

    # VoltageSource
    def write(self, voltage_v: float) -> None:
        """See `haselab.rig.VoltageSource`."""
        self._description.drive_limits.check(voltage_v)
        self._after_v = float(voltage_v)

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`."""
        self._before_v = self._after_v = 0.0
        self._native.move(np.zeros(1), 1, self._load_n, self._lengths[:1])
        self._remember(self._lengths[:1])

    @property
    def output_v(self) -> float:
        """True voltage at the amplifier's output, in V."""
        return float(self._native.output_v)

    # Acquisition
    @property
    def time_s(self) -> float:
        """Time at the end of the last block, in s."""
        return float(self._native.time_s)

    def read(self) -> NDArray[np.int16]:
        """See `haselab.rig.Acquisition`."""
        self._native.acquire(
            self._before_v,
            self._after_v,
            self._description.switch_sample,
            self._load_n,
            self._codes,
            self._lengths,
        )
        self._before_v = self._after_v
        self._remember(self._lengths)
        self._guard()
        return self._codes.copy()

    def sample(self, drive_v: float, samples: int) -> NDArray[np.int16]:
        """Sample both monitors at a constant output, for a server that counts the time itself.

        Args:
            drive_v: at the amplifier's input, in V; not checked against the output's limits.
            samples: a multiple of 20.
        Returns:
            Codes, shape `(samples, 2)`.
        Raises:
            SafetyError: The bench tripped.
        """
        codes = np.empty((samples, 2), dtype=np.int16)
        lengths = np.empty(samples // _SUB)
        self._native.acquire(drive_v, drive_v, 0, self._load_n, codes, lengths)
        self._before_v = self._after_v = drive_v
        self._remember(lengths)
        self._guard()
        return codes

    @property
    def native(self) -> _twin.Bench:
        """C bench, with the addresses of its parameters and state for the co-simulation."""
        return self._native

    def pull(self, load_n: float) -> None:
        """Change the load at once; no time passes."""
        self._load_n = load_n

    @property
    def load_n(self) -> float:
        """Present load on the lower clamp, in N."""
        return self._load_n

    @property
    def mass_kg(self) -> float:
        """Mass that was hung last, even if it is lifted now."""
        return self._mass_kg

    def weigh(self, mass_kg: float) -> None:
        """Set the hung mass and its inertia; no time passes.

        Raises:
            LimitError: The mass is outside the limits.
        """
        if not 0.0 <= mass_kg <= 20.0:
            raise LimitError(
                f"The mass is {mass_kg:g} kg, but it must be within [0, 20] kg. Use another mass."
            )
        self._mass_kg = mass_kg
        added_kg = self._config.load.added_inertia_kg
        self._native.inertia_kg = max(mass_kg, CLAMP_KG) + added_kg + self._law.moving_mass_kg

    @property
    def length_m(self) -> float:
        """True length of the sheet, in m."""
        return float(self._native.length_m)

    def _guard(self) -> None:
        if not self._native.broken:
            return
        self.zero()
        if self._native.outside:
            limits = self._law.length_limits_m
            raise SafetyError(
                f"The {self._law.kind} left the range of {1e3 * limits.low:.4g} to "
                f"{1e3 * limits.high:.4g} mm in which its law is valid. The output is at 0 V. "
                "Lower the voltage or the load."
            )
        raise SafetyError(
            f"Dielectric breakdown at {self._native.field_v_m / 1e6:.3g} kV/mm (limit "
            f"{self._law.circuit.breakdown_v_per_m / 1e6:.3g} kV/mm). The output is at "
            "0 V. Lower the voltage or the load."
        )

    # FunctionGenerator
    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """See `haselab.rig.FunctionGenerator`."""
        if not (0.0 < frequency_hz < 0.4 * self._description.rate_hz and 0.0 <= amplitude_v <= 1.0):
            raise LimitError(
                f"Sine of {frequency_hz:g} Hz, {amplitude_v:g} V is outside "
                f"(0, {0.4 * self._description.rate_hz:g}] Hz, [0, 1] V. Lower the request."
            )
        self._native.carrier_rad_s = 2.0 * math.pi * frequency_hz
        self._native.carrier_v = amplitude_v

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`."""
        self._native.carrier_v = 0.0

    # ReferenceFixture
    def connect(self, capacitance_f: float | None, series_ohm: float = 0.0) -> None:
        """See `haselab.rig.ReferenceFixture`; cable and fixture stay in parallel with it."""
        if capacitance_f is None:
            capacitance_f, series_ohm = 0.0, 0.0
        elif not (_SMALLEST_F <= capacitance_f <= _LARGEST_F and 0.0 <= series_ohm <= 1e8):
            raise LimitError(
                f"The reference of {capacitance_f:g} F, {series_ohm:g} ohm is outside "
                f"[{_SMALLEST_F:g}, {_LARGEST_F:g}] F, [0, 1e8] ohm. Use another one."
            )
        if self._after_v != 0.0 or self._before_v != 0.0 or self._native.carrier_v != 0.0:
            raise LimitError(
                f"Do not touch the fixture: the output is {self._after_v:g} V and the carrier "
                f"{self._native.carrier_v:g} V. Switch both off first."
            )
        self._native.connect(capacitance_f, series_ohm)

    # Camera
    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`."""
        limit_hz = self._config.camera.rate_hz
        if not _SLOWEST_FRAMES_HZ <= rate_hz <= limit_hz:
            raise LimitError(
                f"The frame rate is {rate_hz:g} Hz, outside [{_SLOWEST_FRAMES_HZ:g}, {limit_hz:g}] "
                "Hz. Lower the request."
            )
        self._frame_rate_hz = rate_hz
        self._next_frame_s = self._trace_start_s = self.time_s
        self._trace = []

    def stop(self) -> None:
        """See `haselab.rig.Camera`."""
        self._frame_rate_hz = 0.0
        self._trace = []

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`."""
        exposed = self.exposures()
        if exposed is None:
            return None
        time_s, positions = exposed
        self._camera.lengths_m.check(positions)
        frames = DrawnFrames(self._camera, self._draw, positions, self._frames_taken, time_s)
        self._frames_taken += len(positions)
        return frames

    def exposures(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """True lengths behind the coming frames: middles `(F,)` in s, lengths `(F, sub)` in m.

        For the camera model and for the noise-free truth of a study; never for an analysis.
        """
        rate_hz, trace = self._frame_rate_hz, self._trace  # STOP in another thread may clear them
        if not trace or rate_hz <= 0.0:
            return None
        lengths = np.concatenate(trace)
        sampled_s = self._trace_start_s + self._step_s * np.arange(1, lengths.size + 1)
        exposure_s = self._config.camera.exposure_s
        over_s = float(sampled_s[-1]) - exposure_s - self._next_frame_s
        count = math.floor(over_s * rate_hz) + 1  # exposures that have ended
        if count < 1:
            return None
        starts_s = self._next_frame_s + np.arange(count) / rate_hz
        wanted_s = self._camera.exposure_times_s(starts_s + 0.5 * exposure_s)
        positions = np.interp(wanted_s, sampled_s, lengths)
        self._next_frame_s = float(starts_s[-1]) + 1.0 / rate_hz
        keep = int(np.searchsorted(sampled_s, self._next_frame_s - self._step_s))
        keep = max(0, min(keep, lengths.size - 1))
        self._trace_start_s += keep * self._step_s
        self._trace = [lengths[keep:]]
        return starts_s + 0.5 * exposure_s, positions

    def render(self, positions: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Render the next frames, from the lengths of `exposures`, in several threads.

        The result does not depend on their number.
        """
        taken = self._draw(positions, self._frames_taken)
        self._frames_taken += len(taken)
        return taken

    def _draw(self, positions: NDArray[np.float64], first: int) -> NDArray[np.uint8]:
        parts = min(_THREADS, len(positions))
        if parts == 1:  # starting a thread takes longer
            taken = self._camera.render(positions, first)
        else:
            camera = self._config.camera
            taken = np.empty((len(positions), camera.height_px, camera.width_px), np.uint8)
            bounds = [len(positions) * k // parts for k in range(parts + 1)]
            renderers = self._renderers or ThreadPoolExecutor(_THREADS)
            try:
                drawn = renderers.map(
                    lambda a, b: self._camera.render(positions[a:b], first + a, taken[a:b]),
                    bounds[:-1],
                    bounds[1:],
                )
                deque(drawn, maxlen=0)  # raises the error of a thread
            except BaseException:  # Ctrl-C as a thread starts: it is not known to the pool, ...
                self._renderers = None
                renderers.shutdown()  # ... would never end, and the process would wait for it
                raise
            self._renderers = renderers
        return taken

    def _remember(self, lengths: NDArray[np.float64]) -> None:
        if self._frame_rate_hz > 0.0:
            self._trace.append(lengths.copy())

    # LoadStand
    def hang(self, mass_kg: float) -> None:
        """See `haselab.rig.LoadStand`."""
        self.weigh(mass_kg)
        self._ramp(mass_kg * GRAVITY_M_S2)

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._ramp(0.0)

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._load_n = self._mass_kg * GRAVITY_M_S2

    def wait(self, duration_s: float) -> None:
        """See `haselab.rig.LoadStand`."""
        if not 0.0 <= duration_s <= _LONGEST_WAIT_S:
            raise LimitError(
                f"The waiting time is {duration_s:g} s, but it must be within [0, "
                f"{_LONGEST_WAIT_S:g}] s. Split it."
            )
        whole, rest = divmod(round(duration_s / self._step_s), _MOST_STEPS)
        for steps in [_MOST_STEPS] * whole + [rest]:
            self._let_pass(steps)

    def _let_pass(self, steps: int) -> None:
        lengths = np.empty(steps)
        self._native.move(np.array([self._after_v]), max(steps, 1), self._load_n, lengths)
        self._before_v = self._after_v
        self._remember(lengths)
        self._guard()

    def _ramp(self, load_n: float) -> None:
        pieces = 50
        start_n = self._load_n
        for k in range(1, pieces + 1):
            self._load_n = start_n + (load_n - start_n) * k / pieces
            self._let_pass(round(_RAMP_S / pieces / self._step_s))


def make_twin(config: TwinConfig, seed: int) -> Rig:
    """Create a simulated bench that is ready for a study: its mass has hung for two minutes."""
    return rig_of(TwinBench(config, seed), config)


def rig_of(bench: TwinBench, config: TwinConfig) -> Rig:
    """Bundle the protocols that one bench implements as a rig."""
    return Rig(describe(config), bench, bench, bench, bench, bench, bench, simulated=True)
