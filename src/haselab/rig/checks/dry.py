"""Checks without high voltage: blocks, clock, inputs at 0 V, frames, read-backs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, LimitError
from haselab.rig import ReportsOutput, ReportsOutputState, Rig
from haselab.rig.cameras.source import KnownCamera, ReportsRemarks
from haselab.rig.check_result import CheckResult
from haselab.rig.checks.board import lateness_check
from haselab.rig.checks.signals import (
    amperes,
    input_volts,
    keep,
    phasor,
    saturated,
    span_v,
    volts,
)
from haselab.rig.instruments.sections import DaqConfig

__all__ = ["QUIET_SHARE", "ChecksPower", "DryPlan", "dry_checks", "quiet_at_input_v", "read_backs"]

_BLOCKS = 50
QUIET_SHARE = 0.01  # fraction of the drive's range that a monitor may read at 0 V
_CLOCK_SHARE = 0.1  # largest relative error of the blocks' clock, over half a second
_FRAME_RATES_HZ = (100.0, 60.0, 50.0, 30.0, 25.0, 15.0)
_LINK = (
    "Frames are lost. Check the camera's link (haselab doctor), or lower the frame rate or the "
    "image size"
)
_SLOW = (
    "The camera does not reach this rate. Shorten camera.exposure_s, or take fewer lines "
    "(camera.height_px)"
)
_FILM_S = 10.0
_RATE_SHARE = 0.1  # largest relative error of the frame rate, over half a second
_MAINS_HZ = (50.0, 60.0, 100.0, 120.0, 150.0, 180.0)  # with the harmonics that rectifiers make
_CURRENT_OFFSET_V = 0.1  # at the input of the current monitor, whose zero cannot be adjusted

_OFFSET = (
    "The output may be energised. Switch the amplifier off and discharge the electrodes. If the "
    "reading stays, the input floats: connect its negative side to ground through 100 kohm to 1 "
    "Mohm (bias return). If it disappears, adjust the amplifier's zero"
)
_HUM = (
    "Connect the shields at one end only, use daq.wiring = 'DIFF', and move the cables away from "
    "transformers"
)


@runtime_checkable
class ChecksPower(Protocol):
    """A supply that can report whether it has power."""

    def check_power(self) -> None:
        """Check that the supply has power.

        Raises:
            DeviceError: It has none.
        """


@dataclass(frozen=True)
class DryPlan:
    """Settings of the dry checks.

    Args:
        real_time: whether to compare the blocks' clock with the computer's.
        daq: section `daq` of a bench in real time, whose samples can be late; None for other rigs.
        frames_hz: rate at which to film for ten seconds; None: half a second at the highest usual
            rate.
    """

    real_time: bool = False
    daq: DaqConfig | None = None
    frames_hz: float | None = None


def dry_checks(rig: Rig, plan: DryPlan) -> Iterator[CheckResult]:
    """Check blocks, clock and read-backs at 0 V without a sensing signal.

    Args:
        rig: the bench; its output stays at 0 V.
        plan: settings of the checks.
    Yields:
        The result of each check.
    Raises:
        DeviceError: An instrument failed during the check.
    """
    rig.safe()
    keep(rig, True)
    rig.acquisition.read()
    start_s, wall_s = rig.acquisition.time_s, time.monotonic()
    blocks = [rig.acquisition.read() for _ in range(_BLOCKS)]
    took_s, wall_s = rig.acquisition.time_s - start_s, time.monotonic() - wall_s
    keep(rig, False)
    d = rig.description
    shape = blocks[0].shape
    yield CheckResult(
        "dry",
        "blocks",
        f"{len(blocks)} of {shape[0]} x {shape[1]} readings",
        all(b.shape == (d.block_samples, 2) for b in blocks),
        "Change daq.block_samples",
        criterion=f"each of {d.block_samples} x 2 readings",
    )
    gap_s = took_s - _BLOCKS * d.block_s
    yield CheckResult(
        "dry",
        "gaps",
        f"{abs(1e3 * gap_s):.3f} ms between blocks",
        abs(gap_s) < 0.5 / d.rate_hz,
        "Close other programs",
        criterion=f"below {0.5e3 / d.rate_hz:.3g} ms, half a sample",
    )
    if plan.real_time:
        share = took_s / wall_s - 1.0
        yield CheckResult(
            "dry",
            "clock",
            f"{100.0 * share:+.2g} % against the computer's",
            abs(share) < _CLOCK_SHARE,
            "The samples do not come at daq.rate_hz. Change it, or close other programs",
            criterion=f"within {100.0 * _CLOCK_SHARE:g} %",
        )
    if plan.daq is not None:
        yield from lateness_check(rig, plan.daq)
    if (
        rig.controller is None
    ):  # a microcontroller's channels are filtered, so its level is read back
        yield from _see_monitors(rig, np.concatenate(blocks))
    yield from _see_frames(rig, plan.frames_hz)
    yield from read_backs(rig, "dry")


def _see_monitors(rig: Rig, codes: NDArray[np.int16]) -> Iterator[CheckResult]:
    volt, ampere = volts(rig, codes), amperes(rig, codes)
    at_input = input_volts(rig, codes)
    for k, what in enumerate(("voltage monitor", "current monitor")):
        stuck = saturated(codes[:, k], rig.description.top_code)
        at_rest_v = float(at_input[:, k].mean())
        quiet_v = (quiet_at_input_v(rig), _CURRENT_OFFSET_V)[k]
        if k == 0:
            found = f"mean {volt.mean():.3g} V, std {volt.std():.2g} V of drive at 0 V"
        else:
            found = f"mean {1e6 * ampere.mean():.3g} uA, std {1e6 * ampere.std():.2g} uA at 0 V"
        advice = ""
        if stuck:
            advice = f"The input is at the end of its range. {_OFFSET}"
        elif np.ptp(codes[:, k]) == 0:
            advice = (
                "The input shows no noise: connect its cable, or use a device that is not simulated"
            )
        elif abs(at_rest_v) >= quiet_v:
            advice = _OFFSET
        criterion = (
            f"noise, inside the range, and a mean of at most {quiet_v:.3g} V at the input; here "
            f"{at_rest_v:.2g} V"
        )
        yield CheckResult("dry", what, found, not advice, advice, criterion=criterion)
    for k, what in enumerate(("voltage monitor", "current monitor")):
        hum_hz, hum_v = _mains(at_input[:, k], rig.description.rate_hz)
        if hum_v > (quiet_at_input_v(rig), _CURRENT_OFFSET_V)[k]:
            quiet_v = (quiet_at_input_v(rig), _CURRENT_OFFSET_V)[k]
            yield CheckResult(
                "dry", f"mains at the {what}", f"{hum_v:.2g} V at {hum_hz:g} Hz", False, _HUM,
                criterion=f"at most {quiet_v:.3g} V at the input",
            )  # fmt: skip


def quiet_at_input_v(rig: Rig) -> float:
    """Largest reading of the voltage monitor at 0 V, in V at its input."""
    return QUIET_SHARE * span_v(rig) * rig.description.monitor_v_per_drive_v


def _mains(values: NDArray[np.float64], rate_hz: float) -> tuple[float, float]:
    """Frequency and amplitude of the strongest mains line in values `(n,)` over half a second."""
    whole = {hz: int(values.size * hz / rate_hz) for hz in _MAINS_HZ}
    found = [
        (abs(phasor(values[: round(whole[hz] * rate_hz / hz)], hz, rate_hz)), hz)
        for hz in _MAINS_HZ
        if whole[hz] > 0
    ]
    amplitude_v, hz = max(found, default=(0.0, 0.0))
    return hz, amplitude_v


def _see_frames(rig: Rig, wanted_hz: float | None) -> Iterator[CheckResult]:
    """Film for half a second at the highest usual rate that the camera accepts, or for ten seconds
    at the given rate; do nothing without a camera.
    """
    known = rig.camera if isinstance(rig.camera, KnownCamera) else None
    if known is not None and not known.identity:
        return
    blocks, block_s = _BLOCKS, rig.description.block_s
    if wanted_hz is not None:
        blocks = round(_FILM_S / block_s)
    times: list[NDArray[np.float64]] = []
    rate_hz = _start_camera(rig, wanted_hz)
    try:
        for _ in range(blocks):
            rig.acquisition.read()
            frames = rig.camera.take()
            times += [] if frames is None else [frames.time_s]
    except DeviceError as error:
        yield CheckResult("dry", "frames", str(error).rstrip("."), False)
        return
    finally:
        rig.camera.stop()
    if not times:
        if known is not None:
            yield CheckResult(
                "dry",
                "frames",
                f"none at {rate_hz:g} Hz",
                False,
                "Check the trigger (camera.trigger), the cable and the exposure time",
            )
        return
    time_s = np.concatenate(times)
    reported = f"{time_s.size} at {rate_hz:g} Hz"
    good = bool((np.diff(time_s) > 0.0).all())
    if time_s.size > 1:
        found_hz = (time_s.size - 1) / float(time_s[-1] - time_s[0])
        reported += f", {found_hz:.4g} Hz found"
        good = good and abs(found_hz / rate_hz - 1.0) < _RATE_SHARE
    if known is not None:
        reported += f", {known.dropped} lost, times to {_duration(known.uncertainty_s)}"
        good = good and known.dropped == 0
    lost = known is not None and known.dropped > 0
    criterion = f"rising times, the rate within {100.0 * _RATE_SHARE:g} %"
    criterion += "" if known is None else ", no lost frame"
    advice = _LINK if lost else _SLOW
    yield CheckResult("dry", "frames", reported, good, advice, criterion=criterion)
    if isinstance(rig.camera, ReportsRemarks):
        yield from (CheckResult("dry", "camera", remark, True) for remark in rig.camera.remarks)


def _duration(seconds: float) -> str:
    return f"{1e3 * seconds:.2g} ms" if seconds >= 1e-4 else f"{1e6 * seconds:.2g} us"


def _start_camera(rig: Rig, wanted_hz: float | None) -> float:
    if wanted_hz is not None:
        rig.camera.start(wanted_hz)
        return wanted_hz
    for rate_hz in _FRAME_RATES_HZ[:-1]:
        try:
            rig.camera.start(rate_hz)
        except LimitError:
            continue
        return rate_hz
    rig.camera.start(_FRAME_RATES_HZ[-1])
    return _FRAME_RATES_HZ[-1]


def read_backs(rig: Rig, step: str) -> Iterator[CheckResult]:
    """Ask the instruments whether their outputs are off.

    Args:
        rig: at 0 V.
        step: of the check.
    Yields:
        Results for output, generator and supply, as far as the bench has them.
    """
    if isinstance(rig.source, ReportsOutput):
        measured_v = rig.source.read_back()
        measured_v = rig.source.read_back()
        yield CheckResult(
            step,
            "output at 0 V",
            f"{measured_v:.3g} V read back",
            abs(measured_v) < QUIET_SHARE * span_v(rig),
            "Switch the amplifier off by hand, then find what else drives its input",
            criterion=f"below {QUIET_SHARE * span_v(rig):.3g} V",
        )
    if isinstance(rig.generator, ReportsOutputState):
        off = rig.generator.is_off()
        yield CheckResult(
            step,
            "generator off",
            "off" if off else "on",
            off,
            "Switch its output off at the front panel",
            criterion="off, as the instrument reports",
        )
    if isinstance(rig.supply, ChecksPower):
        rig.supply.check_power()
    if rig.supply is not None:
        measured_v = rig.supply.read_voltage()
        off = (
            rig.supply.is_off() if isinstance(rig.supply, ReportsOutputState) else measured_v == 0.0
        )
        reports = isinstance(rig.supply, ReportsOutputState)
        yield CheckResult(
            step, "supply off", f"{measured_v:g} V", off, "Pull the supply's power jack",
            criterion="off, as the instrument reports" if reports else "0 V",
        )  # fmt: skip
