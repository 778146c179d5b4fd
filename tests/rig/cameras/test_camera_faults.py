"""Faults planted in the served twin's camera: what a bench says of each."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import pytest

from haselab.base import DeviceError, InputError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.pairing import ExposureTrial, starts_with_edge
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.serve.camera_faults import CameraFaults
from haselab.rig.twin.serve.faults import BenchFaults
from haselab.rig.twin.serve.server import ServedTwin
from haselab.safety.gate import Gate

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

CONFIG = twin_of_reading("hz")
RATE_HZ = 50.0


def filmed(
    faults: CameraFaults,
    blocks: int = 160,
    *,
    line: bool = False,
    config: TwinConfig = CONFIG,
    **camera: object,
) -> dict[str, Any]:
    """What a bench tells of its camera after so many blocks of 10 ms."""
    with ServedTwin(config, 1, pace=0.0, faults=BenchFaults(camera=faults)) as twin:
        data = tomllib.loads(twin.rig_file(ahead_blocks=1))
        data["daq"]["server_patience_s"] = 30.0  # a busy machine is no fault
        data["camera"] |= {"timed": True} | camera
        if line:
            data["exposure"] = {"input": "PFI0", "duration_s": config.camera.exposure_s}
        with RealBench(BenchConfig.model_validate(data), Gate()) as bench:
            bench.camera.start(RATE_HZ)
            times_s: list[float] = []
            for _ in range(blocks):
                bench.rig.acquisition.read()
                frames = bench.camera.take()
                times_s += [] if frames is None else frames.time_s.tolist()
            bench.camera.stop()
            seen = bench.camera
            return {
                "times_s": np.array(times_s),
                "dropped": seen.dropped,
                "remarks": seen.remarks,
                "rate_hz": seen.rate_hz,
                "lag_s": seen.lag_s,
            }


def test_a_healthy_camera_films_at_its_rate_and_says_nothing():
    reported = filmed(CameraFaults())
    assert len(reported["times_s"]) >= 75  # 80, less what waits for its block
    assert (reported["dropped"], reported["remarks"]) == (0, ())
    assert reported["rate_hz"] == pytest.approx(RATE_HZ)
    np.testing.assert_allclose(np.diff(reported["times_s"]), 1.0 / RATE_HZ, atol=1e-6)


def test_a_camera_that_is_slower_than_it_was_set_is_reported_with_its_rate():
    with pytest.raises(
        DeviceError,
        match=r"at 31 Hz instead of the requested 50 Hz\. Shorten camera\.exposure",
    ) as caught:
        filmed(CameraFaults(real_rate_hz=31.0))
    assert "\n" not in str(caught.value)


def test_frames_that_are_lost_on_the_way_are_counted_and_their_cause_is_reported():
    reported = filmed(CameraFaults(lost_share=0.05))
    assert 0 < reported["dropped"] < 10
    with pytest.raises(DeviceError, match=r"frames are lost .* frames were lost\. Check the net"):
        filmed(CameraFaults(lost_share=0.3))


def test_stamps_in_ticks_are_reported_with_the_setting_that_fixes_them():
    with pytest.raises(DeviceError, match=r"ticks of about 1\.25e\+08 Hz\. Set camera\.tick_hz"):
        filmed(CameraFaults(stamps_in_ticks=125e6))
    reported = filmed(CameraFaults(stamps_in_ticks=125e6), tick_hz=125e6)
    assert reported["rate_hz"] == pytest.approx(RATE_HZ)
    reported = filmed(CameraFaults(stamps_in_ticks=125e6), stamps="arrival")
    assert reported["rate_hz"] == pytest.approx(RATE_HZ)


def test_a_camera_without_stamps_is_timed_by_arrival_and_reported():
    reported = filmed(CameraFaults(stamps_in_ticks=0.0))
    assert reported["rate_hz"] == pytest.approx(RATE_HZ)
    assert len(reported["remarks"]) == 1 and "sends no time stamps" in reported["remarks"][0]


def test_frames_that_come_late_are_late_by_what_was_planted():
    early, late = (filmed(CameraFaults(late_s=late_s)) for late_s in (0.0, 5e-3))
    off_s = late["times_s"][: len(early["times_s"])] - early["times_s"][: len(late["times_s"])]
    np.testing.assert_allclose(off_s, 5e-3, atol=1e-6)


def test_a_dead_exposure_line_is_one_line():
    with pytest.raises(DeviceError, match=r"has no exposure in the recorded signal .* Check the w"):
        filmed(CameraFaults(exposure_line_dead=True), line=True)


def test_an_inverted_exposure_line_is_found_by_two_exposure_times():
    half_sample_s = 0.5 / CONFIG.acquisition.rate_hz
    for inverted in (False, True):
        trials = []
        for exposure_s in (1e-3, 2e-3):
            camera = CONFIG.camera.model_copy(update={"exposure_s": exposure_s})
            reported = filmed(
                CameraFaults(exposure_line_inverted=inverted),
                blocks=60,
                line=True,
                config=CONFIG.model_copy(update={"camera": camera}),
            )
            trials.append(ExposureTrial(exposure_s, reported["lag_s"]))
        # Each edge is known to half a sample, and the readout takes 1 ms.
        assert starts_with_edge(*trials, uncertainty_s=2 * half_sample_s) is not inverted
        wrong_s = 0.0 if not inverted else 1e-3
        assert trials[0].lag_s == pytest.approx(1e-3 - wrong_s, abs=2 * half_sample_s)


@pytest.mark.parametrize(
    "faults",
    [{"lost_share": 1.0}, {"real_rate_hz": 0.0}, {"stamps_in_ticks": -1.0}, {"late_s": -1e-3}],
)
def test_a_fault_that_is_none_is_refused(faults):
    with pytest.raises(InputError, match=next(iter(faults))):
        CameraFaults(**faults)
