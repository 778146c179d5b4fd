"""The loop at 1 kHz in C: the arithmetic of the slow one, deadlines counted, 0 V at every end."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab import _core
from haselab.base import DeviceError, LimitError, SafetyError
from haselab.control import PidGains, Saturation
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.bench import TwinBench, rig_of
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.runtime.fast_loop import FastLoop, FastOptions, FastReport, make_control
from haselab.runtime.runner import LoopSettings
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Stage
from haselab.sensing import LockinConfig
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
LOOP = LoopSettings(PidGains(0.2, 0.7), Saturation(-0.04, 0.1), EQ4, StrainMap(4.9e8, -0.27))
CARRIER_HZ, CARRIER_V, SAMPLES, RATE_HZ = 10e3, 0.05, 200, 200e3
PERIOD_S = SAMPLES / RATE_HZ
# A machine that is shared may hold a thread up for long: deadlines are counted, not trusted here.
PATIENT = FastOptions(patience_missed=2000)


def config_of(**changes: object) -> TwinConfig:
    config = twin_of_reading("hz")
    daq = config.acquisition.model_copy(
        update={"block_samples": SAMPLES, "output_delay_s": 1e-4} | changes
    )
    return config.model_copy(update={"acquisition": daq})


class Bench:
    """A twin of blocks of 1 ms, with a recorder."""

    def __init__(self, folder: Path, options: FastOptions = PATIENT) -> None:
        config = config_of()
        self.twin = TwinBench(config, 3)
        self.rig = rig_of(self.twin, config)
        d = self.rig.description
        self.sensing = LockinConfig(
            RATE_HZ, SAMPLES, CARRIER_HZ, d.skew_s, d.i_monitor_v_per_a / d.v_monitor_v_per_v,
            blank=(0, d.switch_sample + 60),
        )  # fmt: skip
        self.path = folder / "session.h5"
        header = {"rig": {"rate_hz": RATE_HZ, "volt_per_code": d.volt_per_code}}
        self.session = SessionWriter(
            self.path, [ExperimentPlan("x", "test", 6, {})], SAMPLES, header
        )
        self.options = options

    def run(self, reference: np.ndarray, carrier_v: float = CARRIER_V) -> FastReport:
        loop = FastLoop(self.rig, self.twin, self.sensing, LOOP, self.options)
        with self.session:
            return loop.run("x", reference, carrier_v, self.session)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def capacitance_of(codes: np.ndarray, config: LockinConfig) -> float:
    """Independent route: least squares of numpy in double, the series R-C by complex numbers."""
    counted = codes[config.blank[1] :].astype(float)
    t = np.arange(len(counted)) / config.rate_hz
    angle = config.omega_rad_s * t
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(t), t], axis=1)
    (a, b) = np.linalg.lstsq(basis, counted, rcond=None)[0][:2]
    v, i = a - 1j * b
    z = v / (i * config.admittance_scale_s)
    return float(-1.0 / (config.omega_rad_s * z.imag))


def test_the_body_is_least_squares_and_then_the_functions_of_the_core(bench: Bench) -> None:
    rng, gains, limits = np.random.default_rng(1), LOOP.gains, bench.rig.description.drive_limits
    control = make_control(bench.sensing, LOOP, (limits.low, limits.high))
    pid = _core.Pid(
        kp=gains.kp, ki=gains.ki, kd=gains.kd, period_s=PERIOD_S,
        derivative_filter_s=gains.derivative_filter_s,
        u_low=LOOP.saturation.low, u_high=LOOP.saturation.high,
    )  # fmt: skip
    bench.twin.sine(CARRIER_HZ, CARRIER_V)
    bench.twin.write(1.0)
    bench.twin.wait(0.5)
    for k in range(200):
        codes = bench.twin.read()
        reference = float(np.float32(rng.uniform(0.0, 0.05)))
        output_v, strain, capacitance_f, reason = control.step(codes, reference)
        # 120 products summed in float, of readings ten times the carrier: 10 * 120 * 2^-24.
        assert reason == 0
        assert capacitance_f == pytest.approx(capacitance_of(codes, bench.sensing), rel=7e-5), k
        # From here on the same functions of the core: the same bits.
        m = LOOP.strain_map
        assert strain == _core.strain_from_capacitance(*m.coefficients, capacitance_f)
        volt = _core.voltage_from_strain(
            EQ4.a1_v, EQ4.b1, EQ4.a2_v, EQ4.b2, pid.step(reference, strain)
        )
        assert output_v == _core.limit(volt, limits.low, limits.high)[0]


def test_without_a_reference_the_loop_is_open_and_without_a_strain_the_output_stays(
    bench: Bench,
) -> None:
    control = make_control(bench.sensing, LOOP, (0.0, 2.0))
    rest_v = _core.voltage_from_strain(EQ4.a1_v, EQ4.b1, EQ4.a2_v, EQ4.b2, 0.0)
    bench.twin.sine(CARRIER_HZ, CARRIER_V)
    bench.twin.wait(0.1)
    codes = [bench.twin.read() for _ in range(3)]
    assert control.step(codes[0], math.nan)[0] == rest_v
    driven_v = control.step(codes[1], 0.05)[0]
    assert driven_v != rest_v
    output_v, strain, _, reason = control.step(np.zeros((SAMPLES, 2), np.int16), 0.05)
    assert (output_v, reason) == (driven_v, 1) and math.isnan(strain)
    clipped = codes[2].copy()
    clipped[150, 1] = 32767
    assert control.step(clipped, 0.05)[3] & 4


def test_two_seconds_at_one_kilohertz_lose_no_block(bench: Bench) -> None:
    ticks = 2000
    reference = np.where(np.arange(ticks) < 200, np.nan, 0.02)
    report = bench.run(reference)
    assert report.ticks == ticks and report.blind == 0
    assert report.latency.sum() == report.work.sum() == ticks
    # One that is missed is also late; on a machine of one's own both are 0: see benchmarks/.
    assert 0 <= report.missed <= report.late <= ticks
    with SessionReader(bench.path) as session:
        record = session.experiment("x")
        assert [what for _, what in session.events()] == ["start x", "end x"]
    assert len(record.codes) == ticks
    np.testing.assert_allclose(np.diff(record.block_start_s), PERIOD_S, atol=1e-9)
    np.testing.assert_array_equal(record.reference, reference.astype(np.float32))
    # What was recorded explains every output, bit for bit: nothing is missing and nothing swapped.
    limits = bench.rig.description.drive_limits
    control = make_control(bench.sensing, LOOP, (limits.low, limits.high))
    again = [control.step(*both)[0] for both in zip(record.codes, reference, strict=True)]
    np.testing.assert_array_equal(record.drive_v[1:], again[:-1])
    assert np.ptp(record.drive_v[200:]) > 0.01
    assert bench.twin.output_v == 0.0


def test_the_recorded_drive_is_what_the_monitor_saw(bench: Bench) -> None:
    bench.run(np.full(400, 0.02))
    d = bench.rig.description
    with SessionReader(bench.path) as session:
        record = session.experiment("x")
    volts = record.codes[:, 150:, 0].mean(axis=1) * d.volt_per_code
    volts /= d.v_monitor_v_per_v * d.amplifier_gain
    settled = np.abs(np.diff(record.drive_v, prepend=0.0)) < 0.01
    # The carrier's 2.5 periods leave 2/(5 pi) of its amplitude; amplifier gain errs by 1 %.
    np.testing.assert_allclose(volts[settled], record.drive_v[settled], atol=0.03)


def test_lost_sensing_ends_at_zero_with_its_reason(bench: Bench) -> None:
    with pytest.raises(SafetyError, match=r"No strain in 5 blocks \(amplitude lost\)"):
        bench.run(np.full(500, 0.02), carrier_v=0.0)
    assert bench.twin.output_v == 0.0
    with SessionReader(bench.path) as session:
        assert len(session.experiment("x").codes) == 5


def test_a_recorder_that_does_not_take_its_blocks_is_a_fault(tmp_path: Path) -> None:
    # The first look comes after the ring of 30 ticks has run over.
    bench = Bench(tmp_path, replace(PATIENT, slots=30, take_s=0.3))
    with pytest.raises(DeviceError, match="30 blocks waited for the recorder"):
        bench.run(np.full(500, 0.02))
    assert bench.twin.output_v == 0.0


def test_lost_deadlines_trip(tmp_path: Path) -> None:
    """A body of 1 s a tick cannot be; a tick that is never in time can: patience of one."""
    bench = Bench(tmp_path, replace(PATIENT, patience_missed=1, priority=0))
    loop = FastLoop(bench.rig, bench.twin, bench.sensing, LOOP, bench.options)
    native = bench.twin.native

    class Short:
        """The bench with a clock that runs a thousand times too fast: 1 us a tick."""

        load_n = bench.twin.load_n

        class Native:
            addresses = native.addresses

    _hasten(native.addresses[0], 1e-3)
    try:
        loop._plant = Short()
        loop._plant.native = Short.Native()
        with bench.session, pytest.raises(SafetyError, match="1 ticks missed in a row"):
            loop.run("x", np.full(500, 0.02), CARRIER_V, bench.session)
    finally:
        _hasten(native.addresses[0], 1e3)
    assert bench.twin.output_v == 0.0


def _hasten(address: int, factor: float) -> None:
    """Scale `sample_s` of twin_parameters: found by its value among the doubles of the struct."""
    values = (ctypes.c_double * 64).from_address(address)
    (place,) = [k for k in range(64) if values[k] in (5e-6, 5e-9)]
    values[place] *= factor


def test_an_interrupt_ends_at_zero(tmp_path: Path) -> None:
    def interrupted(_: float) -> None:
        raise KeyboardInterrupt

    bench = Bench(tmp_path, replace(PATIENT, wait=interrupted))
    with pytest.raises(KeyboardInterrupt):
        bench.run(np.full(100_000, 0.02))
    assert bench.twin.output_v == 0.0


def test_a_loop_that_could_ask_for_too_much_is_refused_before_it_starts(bench: Bench) -> None:
    steep = replace(LOOP, voltage_map=VoltageMap(1.9, 3.124, -0.2805, -26.92))
    with pytest.raises(LimitError, match=r"drive voltage = .* is outside"):
        FastLoop(bench.rig, bench.twin, bench.sensing, steep)
    with pytest.raises(LimitError, match=r"leaves two periods of 2000 Hz\. Raise the carrier"):
        FastLoop(bench.rig, bench.twin, replace(bench.sensing, carrier_hz=2000.0), LOOP)


def test_the_delay_for_a_design_is_age_and_switch() -> None:
    bins = np.zeros(2000)
    bins[10] = 100.0  # all between 50 and 55 us
    report = FastReport(100, 0, 0, 0, 0, 54e-6, True, bins, bins, 5e-6, 300e-6, 100e-6)
    assert report.latency_s(0.5) == pytest.approx(55e-6)
    assert report.loop_delay_s == pytest.approx(400e-6)
    slow = replace(report, switch_s=0.0)
    assert slow.loop_delay_s == pytest.approx(355e-6)


def test_a_thread_that_spins_does_the_same_and_may_not_spin_for_ever(tmp_path: Path) -> None:
    bench = Bench(tmp_path, replace(PATIENT, spin_s=0.3e-3))
    report = bench.run(np.full(300, 0.02))
    assert report.ticks == 300
    for spin_s in (-1e-3, 0.95e-3, math.nan):
        other = Bench(tmp_path / f"{spin_s}", replace(PATIENT, spin_s=spin_s))
        with pytest.raises(LimitError, match=r"allowed are 0 to 0\.0009 s, 0\.9 of a tick"):
            other.run(np.full(10, 0.02))


def test_a_bench_that_is_made_safe_by_others_ends_the_loop_at_zero(tmp_path: Path) -> None:
    """The loop in C writes past the gate; what carries its blocks looks at the permission."""
    made_safe = threading.Event()

    def wait(duration_s: float) -> None:
        time.sleep(duration_s)
        if not made_safe.is_set():
            made_safe.set()
            rig.safety.gate.interlock.revoke("Made safe by another program.")

    bench = Bench(tmp_path, replace(PATIENT, wait=wait))
    rig = bench.rig = guard(bench.rig)
    rig.safety.arm(rig.safety.request())
    with pytest.raises(SafetyError, match=r"Made safe from outside.*by another program"):
        bench.run(np.full(5000, 0.02))
    assert bench.twin.output_v == 0.0
    assert rig.safety.stage is Stage.TRIPPED
