"""Tests of one instrument: registry, identification, output, shutdown."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
import pytest

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.opened import OpenedCamera
from haselab.rig.instruments.devices import GeneratorDevice, SupplyDevice
from haselab.rig.instruments.instrument import (
    CameraContext,
    Instrument,
    OpenContext,
    OutputInstrument,
)
from haselab.rig.instruments.registry import instrument_of
from haselab.rig.rig_file import load_rig

__all__ = [
    "WITHIN_S",
    "BlockTimer",
    "CameraConformance",
    "GeneratorConformance",
    "InstrumentConformance",
    "SupplyConformance",
]

WITHIN_S = 3.0  # as long as the guardians retry a refused connection
_REACH_S = 10.0  # longest time for a supply to reach its set point, or to discharge


class InstrumentConformance:
    """Tests of any instrument: registry, identification, driver."""

    section: ClassVar[str]  # of RIG.toml: daq, generator, supply or camera

    @pytest.fixture
    def file(self, rig_file: Path) -> BenchConfig:
        """Read the rig file as all commands do."""
        file = load_rig(rig_file)
        assert isinstance(file, BenchConfig), f'kind must be "bench". {rig_file}'
        return file

    @pytest.fixture
    def config(self, file: BenchConfig) -> Any:
        """The section of this instrument."""
        config = getattr(file, self.section)
        assert config is not None, f"the rig file has no section {self.section}"
        return config

    @pytest.fixture
    def instrument(self, config: Any) -> Instrument[Any]:
        """Find the driver of the section."""
        return instrument_of(self.section, config)

    def test_the_driver_loads_on_this_computer(self, instrument: Instrument[Any]) -> None:
        """`haselab rig check` lists what `check_driver` returns."""
        assert all(isinstance(name, str) for name in instrument.check_driver())

    def test_it_identifies_itself_in_one_line(
        self, instrument: Instrument[Any], config: Any
    ) -> None:
        """`haselab doctor --rig` prints the identity."""
        identity = instrument.identify(config)
        assert identity.strip() and "\n" not in identity

    def test_another_serial_number_is_refused(
        self, instrument: Instrument[Any], config: Any
    ) -> None:
        """A rig file that names another instrument must not energise this one."""
        if "serial_number" not in type(config).model_fields:
            return  # it has no serial number
        other = config.model_copy(update={"serial_number": "0BADC0DE"})
        with pytest.raises(InputError, match="0BADC0DE"):
            instrument.identify(other)

    def test_its_address_stays_the_same(self, instrument: Instrument[Any], config: Any) -> None:
        """Two programs recognise by the address that they use one instrument on two benches."""
        if isinstance(instrument, OutputInstrument):
            addresses = instrument.addresses(config)
            assert addresses == instrument.addresses(config.model_copy())
            assert all(isinstance(each, str) and each for each in addresses)


class _OffConformance(InstrumentConformance):
    """Tests of an instrument with an output: switching off, and confirming it."""

    def energise(self, device: Any) -> None:
        """Switch the output on."""
        raise NotImplementedError

    @pytest.fixture
    def device(self, instrument: Instrument[Any], config: Any, file: BenchConfig) -> Iterator[Any]:
        """Open the instrument, and close it after the test."""
        device = cast(Any, instrument).open(config, OpenContext(file.describe()))
        with contextlib.closing(device):
            yield device

    def test_it_is_off_after_opening(self, device: Any) -> None:
        """Regardless of the state before."""
        assert device.is_off()

    def test_opening_switches_off_what_was_left_on(
        self, instrument: Any, config: Any, file: BenchConfig
    ) -> None:
        """This includes what this driver left on when it was closed without `off`."""
        first = instrument.open(config, OpenContext(file.describe()))
        self.energise(first)
        first.close()
        second = instrument.open(config, OpenContext(file.describe()))
        with contextlib.closing(second):
            assert second.is_off()

    def test_it_reports_that_it_is_on(self, device: Any) -> None:
        """`is_off` queries the instrument; it does not repeat what was requested."""
        self.energise(device)
        assert not device.is_off()

    def test_off_is_off_and_may_be_repeated(self, device: Any) -> None:
        """`off` never raises."""
        self.energise(device)
        device.off()
        assert device.is_off()
        device.off()
        assert device.is_off()

    def test_off_does_not_raise_on_a_closed_connection(self, device: Any) -> None:
        """A failing instrument must not stop the shutdown of the others."""
        device.close()
        device.off()
        device.close()

    def test_a_closed_connection_is_not_reported_as_off(self, device: Any) -> None:
        """An instrument that does not respond is not confirmed off."""
        device.close()
        with pytest.raises(DeviceError, match=r"."):
            device.is_off()

    def test_shut_down_from_outside_switches_off_an_output_in_use(
        self, device: Any, instrument: OutputInstrument[Any], config: Any
    ) -> None:
        """The guardians and `haselab rig safe` do this while the program is still connected."""
        self.energise(device)
        instrument.shut_down(config, WITHIN_S)
        assert device.is_off()

    @pytest.fixture
    def stuck_on(self) -> Callable[[], None]:
        """Makes the instrument ignore every command for off. Override it with your emulator."""
        pytest.skip(
            "no fixture stuck_on: not tested whether shut_down confirms that the output is off"
        )

    def test_an_output_that_stays_on_is_not_reported_as_off(
        self,
        stuck_on: Callable[[], None],
        device: Any,
        instrument: OutputInstrument[Any],
        config: Any,
    ) -> None:
        """A shutdown that does not confirm it would leave high voltage on in silence."""
        self.energise(device)
        stuck_on()
        with pytest.raises(DeviceError, match=r"."):
            instrument.shut_down(config, WITHIN_S)

    def test_identifying_leaves_an_output_that_is_off(
        self, device: Any, instrument: OutputInstrument[Any], config: Any
    ) -> None:
        """`haselab doctor` may run at any time."""
        assert device.is_off()
        instrument.identify(config)
        assert device.is_off()


class SupplyConformance(_OffConformance):
    """Tests of a high-voltage supply."""

    section = "supply"

    def energise(self, device: SupplyDevice) -> None:
        """Put out a tenth of the rig file's limit."""
        device.set_voltage(self.some_v)

    @pytest.fixture(autouse=True)
    def _choose_voltage(self, config: Any) -> None:
        self.some_v = 0.1 * config.highest_v

    @pytest.mark.parametrize("share", [1.001, -0.001, math.nan, math.inf])
    def test_a_voltage_outside_the_limits_is_refused_and_the_old_one_stays(
        self, device: SupplyDevice, config: Any, share: float
    ) -> None:
        """The rig file's limit applies even if the instrument could exceed it."""
        self.energise(device)
        _wait_for(device, self.some_v)
        with pytest.raises(LimitError, match=r"."):
            device.set_voltage(share * config.highest_v)
        assert abs(device.read_voltage() - self.some_v) <= device.tolerance_v

    def test_it_reaches_its_set_point_and_runs_down(self, device: SupplyDevice) -> None:
        """According to its own meter."""
        self.energise(device)
        _wait_for(device, self.some_v)
        device.off()
        _wait_for(device, 0.0)

    def test_its_tolerance_is_a_voltage(self, device: SupplyDevice) -> None:
        """It is the largest reading of its meter while it is off."""
        assert 0.0 < device.tolerance_v < math.inf


def _wait_for(device: SupplyDevice, wanted_v: float) -> None:
    """Wait until the meter shows this voltage."""
    end_s = time.monotonic() + _REACH_S
    while abs(device.read_voltage() - wanted_v) > device.tolerance_v:
        assert time.monotonic() < end_s, f"{device.read_voltage():g} V instead of {wanted_v:g} V"
        time.sleep(0.02)


class GeneratorConformance(_OffConformance):
    """Tests of a function generator."""

    section = "generator"

    def energise(self, device: GeneratorDevice) -> None:
        """Put out a sine of 1 kHz, far below the limits."""
        device.sine(1000.0, 0.02)

    @pytest.mark.parametrize(
        ("frequency_hz", "amplitude_v"),
        [(1e9, 0.02), (0.0, 0.02), (2e3, -1.0), (2e3, 1e3), (math.nan, 0.02), (2e3, math.nan)],
    )
    def test_a_sine_outside_the_limits_is_refused_and_the_old_one_stays(
        self, device: GeneratorDevice, frequency_hz: float, amplitude_v: float
    ) -> None:
        """It is neither switched off nor changed."""
        self.energise(device)
        with pytest.raises(LimitError, match=r"."):
            device.sine(frequency_hz, amplitude_v)
        assert not device.is_off()

    def test_an_amplitude_of_zero_is_the_output_off(self, device: GeneratorDevice) -> None:
        """A residual amplitude would be sensed."""
        self.energise(device)
        device.sine(1000.0, 0.0)
        assert device.is_off()


class CameraConformance(InstrumentConformance):
    """Of a camera: its frames are grey pictures in the order of their times.

    `rate_hz` is one that the camera takes; override it where 50 frames/s are too many.
    """

    section = "camera"
    rate_hz: ClassVar[float] = 50.0
    blocks_s: ClassVar[float] = 0.01  # between two looks at the camera

    @pytest.fixture
    def now(self) -> BlockTimer:
        """The acquisition's clock."""
        return BlockTimer(self.blocks_s)

    @pytest.fixture
    def opened(self, instrument: Instrument[Any], config: Any, now: BlockTimer) -> Iterator[Any]:
        """The camera, opened; it is closed after the test."""
        opened = cast(Any, instrument).open(config, CameraContext(clock=now))
        try:
            yield opened
        finally:
            opened.close()

    def test_it_takes_no_frames_before_it_is_started(self, opened: OpenedCamera) -> None:
        """Opening alone leaves the camera as it is."""
        assert opened.camera.take() is None

    def test_its_frames_are_grey_pictures_in_the_order_of_their_times(
        self, opened: OpenedCamera, now: BlockTimer
    ) -> None:
        """Of one size, in 8 bit, each with its time on the acquisition's clock."""
        images, time_s = self.taken(opened, now)
        assert len(images) == len(time_s) >= 5
        assert images.dtype == np.uint8 and images.ndim == 3
        assert (np.diff(time_s) > 0.0).all()
        period_s = float(np.median(np.diff(time_s)))
        assert abs(period_s * self.rate_hz - 1.0) < 0.1
        assert opened.uncertainty_s() >= 0.0 and opened.dropped() >= 0

    def test_it_starts_again_after_a_stop(self, opened: OpenedCamera, now: BlockTimer) -> None:
        """Every experiment starts and stops the camera; no frame of before comes later."""
        _, first_s = self.taken(opened, now)
        _, second_s = self.taken(opened, now)
        assert second_s[0] >= first_s[-1]

    @pytest.mark.parametrize("rate_hz", [0.0, -1.0, math.nan, math.inf, 1e9])
    def test_a_rate_that_it_does_not_have_is_refused(
        self, opened: OpenedCamera, rate_hz: float
    ) -> None:
        """Neither clipped nor ignored."""
        with pytest.raises(LimitError, match=r"."):
            opened.camera.start(rate_hz)

    def test_closing_may_be_repeated(self, opened: OpenedCamera) -> None:
        """`close` never raises."""
        opened.close()
        opened.close()

    def taken(self, opened: OpenedCamera, now: BlockTimer) -> tuple[Any, Any]:
        """Half a second of frames: pictures and times."""
        opened.camera.start(self.rate_hz)
        parts = []
        for _ in range(round(0.5 / self.blocks_s)):
            now.pass_block()
            found = opened.camera.take()
            if found is not None:
                parts.append(found)
        opened.camera.stop()
        assert parts, "no frame in half a second"
        images = np.concatenate([part.images for part in parts])
        return images, np.concatenate([part.time_s for part in parts])


class BlockTimer:
    """The clock of an acquisition whose blocks end as time passes on the wall.

    Args:
        block_s: length of a block, in s.
    """

    def __init__(self, block_s: float) -> None:
        self._block_s, self._blocks = block_s, 0
        self._start_s = self._seen_s = time.monotonic()

    def pass_block(self) -> None:
        """Wait until the next block has ended."""
        self._blocks += 1
        time.sleep(max(0.0, self._start_s + self._blocks * self._block_s - time.monotonic()))
        self._seen_s = time.monotonic()

    def __call__(self) -> tuple[float, float]:
        """See `BlockClock`."""
        return self._blocks * self._block_s, self._seen_s
