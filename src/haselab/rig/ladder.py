"""The checks of a rig: dry without high voltage, then live; each says what it measured."""

from __future__ import annotations

import cmath
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import LimitError
from haselab.rig import ClosesLoop, KeepsBlocks, Rig, RigDescription, TellsOff, TellsOutput
from haselab.rig.cameras.source import KnownCamera, RemarkingCamera

__all__ = ["CARRIER_V", "SUPPLY_V", "Rung", "climb_dry", "climb_live", "live_step_v"]

_DRY_BLOCKS = 50
_QUIET_SHARE = 0.01  # of the drive's range: what a monitor may read at rest
_CLOCK_SHARE = 0.1  # clock of the blocks against the computer's, over half a second
_CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # the amplitude is a peak
_CARRIER_SHARE = 0.2  # an amplifier of 6 kHz lifts 2 kHz by 3 %; more than this is a wrong setting
_STEP_SHARE = 0.1  # of the drive's range, put out on the live rung
_STEP_TOLERANCE = 0.02  # gain errors of amplifier and monitor
_SETTLE_S = 0.5e-3
SUPPLY_V = 100.0
_FRAME_RATES_HZ = (100.0, 60.0, 50.0, 30.0, 25.0, 15.0)


@dataclass(frozen=True)
class Rung:
    """One thing that was verified, or was not.

    Args:
        step: mock, dry or live.
        what: was looked at.
        found: in words.
        passed: it is as it should be.
    """

    step: str
    what: str
    found: str
    passed: bool

    def __post_init__(self) -> None:
        object.__setattr__(self, "passed", bool(self.passed))  # numpy's own is no bool for JSON


def _volts(rig: Rig, codes: NDArray[np.int16]) -> NDArray[np.float64]:
    """The voltage monitor in drive volts."""
    d = rig.description
    gain = d.volt_per_code / (d.v_monitor_v_per_v * d.amplifier_gain)
    return np.asarray(codes[:, 0] * gain, dtype=np.float64)


def _amperes(rig: Rig, codes: NDArray[np.int16]) -> NDArray[np.float64]:
    d = rig.description
    return np.asarray(codes[:, 1] * (d.volt_per_code / d.i_monitor_v_per_a), dtype=np.float64)


def _keep(rig: Rig, on: bool) -> None:
    if isinstance(rig.acquisition, KeepsBlocks):
        rig.acquisition.keep(on)


def _span_v(rig: Rig) -> float:
    limits = rig.description.drive_limits
    return limits.high - limits.low


def climb_dry(rig: Rig, *, real_time: bool) -> Iterator[Rung]:
    """Blocks, clock and read-backs at 0 V with no sensing signal.

    Args:
        rig: the bench; nothing is put out.
        real_time: the blocks' clock is to be compared with the computer's.
    Yields:
        What was verified.
    Raises:
        DeviceError: an instrument failed on the way.
    """
    rig.safe()
    _keep(rig, True)
    rig.acquisition.read()
    start_s, wall_s = rig.acquisition.time_s, time.monotonic()
    blocks = [rig.acquisition.read() for _ in range(_DRY_BLOCKS)]
    took_s, wall_s = rig.acquisition.time_s - start_s, time.monotonic() - wall_s
    _keep(rig, False)
    d = rig.description
    shape = blocks[0].shape
    yield Rung("dry", "blocks", f"{len(blocks)} of {shape[0]} x {shape[1]} readings",
               all(b.shape == (d.block_samples, 2) for b in blocks))  # fmt: skip
    gap_s = took_s - _DRY_BLOCKS * d.block_s
    yield Rung("dry", "gaps", f"{1e3 * gap_s:.3g} ms between blocks", abs(gap_s) < 0.5 / d.rate_hz)
    if real_time:
        share = took_s / wall_s - 1.0
        yield Rung("dry", "clock", f"{100.0 * share:+.2g} % against the computer's",
                   abs(share) < _CLOCK_SHARE)  # fmt: skip
    if rig.controller is None:  # a chip's channels are behind filters: its level is read back
        yield from _see_monitors(rig, np.concatenate(blocks))
    yield from _see_frames(rig)
    yield from _read_backs(rig, "dry")


def _see_monitors(rig: Rig, codes: NDArray[np.int16]) -> Iterator[Rung]:
    volt, ampere = _volts(rig, codes), _amperes(rig, codes)
    yield Rung("dry", "voltage monitor", f"mean {volt.mean():.3g} V, std {volt.std():.2g} V of "
               "drive at 0 V", abs(volt.mean()) < _QUIET_SHARE * _span_v(rig))  # fmt: skip
    yield Rung("dry", "current monitor", f"mean {1e6 * ampere.mean():.3g} uA, std "
               f"{1e6 * ampere.std():.2g} uA at 0 V", _moves(codes[:, 1]))  # fmt: skip


def _see_frames(rig: Rig) -> Iterator[Rung]:
    """Frames at the highest usual rate that the camera takes; nothing where there is no camera."""
    rate_hz = _start_camera(rig)
    try:
        found = []
        for _ in range(_DRY_BLOCKS):
            rig.acquisition.read()
            found.append(rig.camera.take())
    finally:
        rig.camera.stop()
    known = rig.camera if isinstance(rig.camera, KnownCamera) else None
    times = [frames.time_s for frames in found if frames is not None]
    if not times:
        if known is not None and known.identity:
            yield Rung("dry", "frames", f"none at {rate_hz:g} Hz", False)
        return
    time_s = np.concatenate(times)
    told = f"{time_s.size} at {rate_hz:g} Hz"
    good = bool((np.diff(time_s) > 0.0).all())
    if known is not None:
        told += f", {known.dropped} lost, times to {1e3 * known.uncertainty_s:.2g} ms"
        good = good and known.dropped == 0
    yield Rung("dry", "frames", told, good)
    if isinstance(rig.camera, RemarkingCamera):
        yield from (Rung("dry", "camera", remark, True) for remark in rig.camera.remarks)


def _start_camera(rig: Rig) -> float:
    for rate_hz in _FRAME_RATES_HZ[:-1]:
        try:
            rig.camera.start(rate_hz)
        except LimitError:
            continue
        return rate_hz
    rig.camera.start(_FRAME_RATES_HZ[-1])
    return _FRAME_RATES_HZ[-1]


def _moves(codes: NDArray[np.int16]) -> bool:
    """An input that is connected shows noise and is not at an end of its range."""
    return bool(np.ptp(codes) > 0 and np.abs(codes.astype(int)).max() < 2**15 - 1)


def _read_backs(rig: Rig, step: str) -> Iterator[Rung]:
    """What the instruments themselves say of their rest."""
    if isinstance(rig.source, TellsOutput):
        told_v = rig.source.read_back()
        yield Rung(step, "output at rest", f"{told_v:.3g} V read back",
                   abs(told_v) < _QUIET_SHARE * _span_v(rig))  # fmt: skip
    if isinstance(rig.generator, TellsOff):
        off = rig.generator.is_off()
        yield Rung(step, "generator at rest", "off" if off else "on", off)
    if rig.supply is not None:
        told_v = rig.supply.read_voltage()
        off = rig.supply.is_off() if isinstance(rig.supply, TellsOff) else told_v == 0.0
        yield Rung(step, "supply at rest", f"{told_v:g} V", off)


def live_step_v(rig: RigDescription) -> float:
    """The drive that the live checks put out, in V ahead of the amplifier."""
    return _STEP_SHARE * rig.drive_limits.high or _STEP_SHARE * rig.drive_limits.low


def climb_live(rig: Rig) -> Iterator[Rung]:
    """Sensing signal, a small step and the supply, each seen by the monitors; then rest again.

    Args:
        rig: the bench; high voltage is put out.
    Yields:
        What was verified.
    Raises:
        DeviceError: an instrument failed on the way.
        SafetyError: the bench protected itself.
    """
    try:
        if rig.controller is not None:
            yield _see_loop(rig, rig.controller)
        else:
            yield _see_carrier(rig)
            yield from _see_step(rig)
        if rig.supply is not None:
            rig.supply.set_voltage(SUPPLY_V)
            told_v = rig.supply.read_voltage()
            rig.supply.off()
            yield Rung("live", "supply", f"{told_v:g} V read back, set were {SUPPLY_V:g} V",
                       abs(told_v - SUPPLY_V) < 0.5 * SUPPLY_V)  # fmt: skip
    finally:
        rig.safe()
    rig.acquisition.read()
    yield from _read_backs(rig, "live")


def _see_loop(rig: Rig, controller: ClosesLoop) -> Rung:
    """Zero strain held for half a second: the chip arms, senses and drives."""
    wanted = max(0.0, controller.strain_limits.low)
    for _ in range(_DRY_BLOCKS):
        controller.follow(wanted)
        rig.acquisition.read()
    drive_v = controller.output_v
    rig.source.zero()
    return Rung("live", "loop", f"{drive_v:.3g} V of drive at a strain of {wanted:g}",
                0.0 < drive_v < rig.description.drive_limits.high)  # fmt: skip


def _phasor(values: NDArray[np.float64], rate_hz: float) -> complex:
    turn = np.exp(-2j * np.pi * _CARRIER_HZ * np.arange(values.size) / rate_hz)
    return complex(2.0 * (values * turn).mean())


def _see_carrier(rig: Rig) -> Rung:
    d = rig.description
    rig.generator.sine(_CARRIER_HZ, CARRIER_V)
    rig.acquisition.read()
    codes = rig.acquisition.read()
    volt = _phasor(_volts(rig, codes), d.rate_hz)
    later = cmath.exp(-2j * math.pi * _CARRIER_HZ * d.skew_s)
    ampere = _phasor(_amperes(rig, codes), d.rate_hz) * later
    farad = 0.0
    if volt != 0.0:
        farad = (ampere / (volt * d.amplifier_gain)).imag / (2.0 * math.pi * _CARRIER_HZ)
    rig.generator.off()
    good = abs(abs(volt) / CARRIER_V - 1.0) < _CARRIER_SHARE and farad > 0.0
    return Rung("live", "sensing signal", f"{1e3 * abs(volt):.3g} mV of {1e3 * CARRIER_V:g} mV, "
                f"{1e12 * farad:.4g} pF", good)  # fmt: skip


def _see_step(rig: Rig) -> Iterator[Rung]:
    d = rig.description
    step_v = live_step_v(d)
    _keep(rig, True)
    rig.acquisition.read()
    rig.source.write(step_v)
    queued = d.switch_sample // d.block_samples
    blocks = [_volts(rig, rig.acquisition.read()) for _ in range(queued + 2)]
    _keep(rig, False)
    rig.source.zero()  # before anything is told: who reads may stop the terminal
    rig.acquisition.read()
    left_v = float(_volts(rig, rig.acquisition.read()).mean())
    volt = np.concatenate(blocks)
    settled = d.switch_sample + round(_SETTLE_S * d.rate_hz)
    at = int(np.argmax(np.abs(volt) > 0.5 * abs(step_v)))
    yield Rung("live", "time of an output", f"sample {at}, the rig file says {d.switch_sample}",
               0 <= at - d.switch_sample < settled - d.switch_sample)  # fmt: skip
    reached_v = float(volt[settled:].mean())
    yield Rung("live", "size of an output", f"{reached_v:.4g} V, set were {step_v:.4g} V",
               abs(reached_v / step_v - 1.0) < _STEP_TOLERANCE)  # fmt: skip
    yield Rung("live", "0 V at once", f"{left_v:.3g} V in the next block",
               abs(left_v) < _QUIET_SHARE * _span_v(rig))  # fmt: skip
