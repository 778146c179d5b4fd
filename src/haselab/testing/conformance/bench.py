"""Conformance tests of a whole bench, for any instruments."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from haselab.base import DeviceError, LimitError
from haselab.rig.instruments.instrument import DaqInstrument
from haselab.rig.protocols import Rig
from haselab.rig.rig_file import load_rig, opened_rig
from haselab.safety.gate import Gate
from haselab.testing.conformance.instruments import WITHIN_S, InstrumentConformance

__all__ = [
    "CARRIER_HZ",
    "CARRIER_V",
    "BenchConformance",
    "DaqConformance",
    "carrier_v",
    "drive_v",
    "pass_queue",
]

CARRIER_HZ, CARRIER_V = 2000.0, 0.02
_SETTLED_S = 0.5e-3  # after an output has changed
_SHARE = 0.01  # gain error and noise of a voltage monitor


def drive_v(rig: Rig, blocks: int = 1) -> NDArray[np.float64]:
    """The voltage monitor in V of drive, shape `(blocks, samples)`."""
    d = rig.description
    codes = np.stack([rig.acquisition.read() for _ in range(blocks)])
    return np.asarray(codes[:, :, 0] * (d.volt_per_code / d.monitor_v_per_drive_v), float)


def pass_queue(rig: Rig) -> None:
    """Read the blocks that pass while outputs are queued in the device."""
    for _ in range(rig.description.switch_sample // rig.description.block_samples):
        rig.acquisition.read()


def carrier_v(rig: Rig) -> float:
    """Amplitude of the sensing signal in one settled block, in V of drive."""
    rig.acquisition.read()
    block = drive_v(rig)[0]
    turn = np.exp(-2j * np.pi * CARRIER_HZ * np.arange(block.size) / rig.description.rate_hz)
    return float(2.0 * abs((block * turn).mean()))


class BenchConformance:
    """Tests of drive output, acquisition and sensing signal, through the voltage monitor.

    Use it for a driver of a data acquisition device or a function generator. It needs the drive
    output and the generator connected to the voltage monitor, through an amplifier or a divider as
    the rig file says.
    """

    @pytest.fixture
    def rig(self, rig_file: Path) -> Iterator[Rig]:
        """Open the bench of a rig file, armed."""
        with opened_rig(load_rig(rig_file), rig_file, gate := Gate()) as rig:
            gate.permit(gate.interlock.revision)
            yield rig

    # ---- drive output --------------------------------------------------------------------------

    @pytest.mark.parametrize("beyond", ["above", "below", "nan", "inf"])
    def test_an_output_outside_the_limits_is_refused_and_the_old_one_stays(
        self, rig: Rig, beyond: str
    ) -> None:
        """This includes NaN."""
        limits = rig.description.drive_limits
        refused = {
            "above": np.nextafter(limits.high, np.inf),
            "below": np.nextafter(limits.low, -np.inf),
            "nan": float("nan"),
            "inf": float("inf"),
        }[beyond]
        rig.source.write(0.5 * limits.high)
        rig.acquisition.read()
        with pytest.raises(LimitError, match=r"."):
            rig.source.write(refused)
        pass_queue(rig)
        np.testing.assert_allclose(drive_v(rig, 2), 0.5 * limits.high, rtol=_SHARE)

    def test_both_ends_of_the_limits_are_allowed(self, rig: Rig) -> None:
        """The limits are inclusive."""
        limits = rig.description.drive_limits
        for end_v in (limits.low, limits.high):
            rig.source.write(end_v)
            rig.acquisition.read()
            pass_queue(rig)
            np.testing.assert_allclose(drive_v(rig), end_v, rtol=_SHARE, atol=_SHARE)

    def test_a_new_output_takes_effect_at_the_switch_sample_of_the_next_block(
        self, rig: Rig
    ) -> None:
        """`RigDescription.switch_in_block` is the last sample that shows the old output."""
        d = rig.description
        rig.acquisition.read()
        rig.source.write(1.0)
        pass_queue(rig)
        block = drive_v(rig)[0]
        settled = d.switch_in_block + round(_SETTLED_S * d.rate_hz)
        early = np.abs(block[: d.switch_in_block + 1]) >= _SHARE
        assert not early.any(), (
            f"sample {early.argmax()} of the block shows the new output, but sample "
            f"{d.switch_in_block} (daq.output_delay_s) must be the last one with the old output"
        )
        np.testing.assert_allclose(block[settled:], 1.0, rtol=_SHARE)

    def test_of_several_outputs_within_a_block_the_last_one_counts(self, rig: Rig) -> None:
        """Earlier requests in the same block are discarded."""
        for output_v in (1.5, 0.2, 1.0):
            rig.source.write(output_v)
        rig.acquisition.read()
        pass_queue(rig)
        np.testing.assert_allclose(drive_v(rig), 1.0, rtol=_SHARE)

    @pytest.mark.parametrize("pending", [False, True])
    def test_zero_is_0_v_at_once_and_stays_so(self, rig: Rig, pending: bool) -> None:
        """A value that was requested before `zero` is never put out."""
        rig.source.write(1.0)
        rig.acquisition.read()
        pass_queue(rig)
        if pending:
            rig.source.write(2.0)
        rig.source.zero()
        assert np.abs(drive_v(rig, 3)).max() < _SHARE
        rig.source.zero()
        assert np.abs(drive_v(rig, 1)).max() < _SHARE

    def test_safe_ends_drive_and_carrier(self, rig: Rig) -> None:
        """Every run ends with `safe`."""
        rig.generator.sine(CARRIER_HZ, CARRIER_V)
        rig.source.write(1.0)
        for _ in range(5):
            rig.acquisition.read()
        rig.safe()
        rig.acquisition.read()
        assert np.abs(drive_v(rig)).max() < _SHARE
        assert carrier_v(rig) < 0.05 * CARRIER_V
        rig.safe()

    # ---- acquisition ---------------------------------------------------------------------------

    def test_a_block_has_its_shape_and_the_clock_advances_by_it(self, rig: Rig) -> None:
        """No gap, no repetition."""
        d = rig.description
        rig.acquisition.read()  # may skip blocks while the output is started
        start_s = rig.acquisition.time_s
        for count in range(1, 21):
            codes = rig.acquisition.read()
            assert codes.shape == (d.block_samples, 2)
            assert codes.dtype == np.int16
            # A clock that adds up blocks in seconds may round once per block.
            slack_s = 2.0 * count * np.spacing(start_s + 1.0)
            elapsed_s = rig.acquisition.time_s - start_s
            assert elapsed_s == pytest.approx(count * d.block_s, rel=0, abs=slack_s)

    def test_a_block_belongs_to_its_reader(self, rig: Rig) -> None:
        """The next block does not overwrite it."""
        first = rig.acquisition.read()
        kept = first.copy()
        rig.source.write(1.0)
        rig.acquisition.read()
        np.testing.assert_array_equal(first, kept)

    # ---- sensing signal ------------------------------------------------------------------------

    def test_the_carrier_follows_the_generator(self, rig: Rig) -> None:
        """Its amplitude is a peak, at the amplifier's input."""
        assert carrier_v(rig) < 0.05 * CARRIER_V
        for amplitude_v in (CARRIER_V, 2.0 * CARRIER_V):
            rig.generator.sine(CARRIER_HZ, amplitude_v)
            # An amplifier of 6 kHz raises 2 kHz by 3 %; 10 % is acceptable.
            assert carrier_v(rig) == pytest.approx(amplitude_v, rel=0.1)
        rig.generator.off()
        assert carrier_v(rig) < 0.05 * CARRIER_V

    def test_the_carrier_is_continuous_from_block_to_block(self, rig: Rig) -> None:
        """A phase jump between blocks would leave a residual amplitude; noise is white."""
        d = rig.description
        rig.generator.sine(CARRIER_HZ, CARRIER_V)
        rig.acquisition.read()
        block = drive_v(rig, 4).ravel()
        angle = 2.0 * np.pi * CARRIER_HZ * np.arange(block.size) / d.rate_hz
        basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1)
        left = block - basis @ np.linalg.lstsq(basis, block, rcond=None)[0]
        assert np.abs(left).max() < 6.0 * left.std()

    @pytest.mark.parametrize(
        ("frequency_hz", "amplitude_v"),
        [(1e9, 0.02), (0.0, 0.02), (2e3, -1.0), (2e3, 1e3), (float("nan"), 0.02)],
    )
    def test_a_sine_outside_the_limits_is_refused_and_the_old_one_stays(
        self, rig: Rig, frequency_hz: float, amplitude_v: float
    ) -> None:
        """Checked with the voltage monitor."""
        rig.generator.sine(CARRIER_HZ, CARRIER_V)
        with pytest.raises(LimitError, match=r"."):
            rig.generator.sine(frequency_hz, amplitude_v)
        assert carrier_v(rig) == pytest.approx(CARRIER_V, rel=0.1)


class DaqConformance(InstrumentConformance):
    """Tests of the connection to a data acquisition device, and of its shutdown.

    Blocks and outputs are tested by `BenchConformance`, so derive a class from that, too.
    """

    section = "daq"

    @pytest.fixture
    def output_v(self) -> Callable[[], float] | None:
        """Override it: the output in V, read at the emulator or with a meter, not by the driver."""
        return None

    def test_the_rig_file_gives_the_key_of_the_device(
        self, instrument: DaqInstrument[Any], config: Any
    ) -> None:
        """`haselab rig safe` revokes the permission by it while the device does not respond."""
        connection = instrument.connect(config)
        try:
            key = connection.key
        finally:
            connection.close()
        found = instrument.key_of(config)
        assert found in (None, key), f"key_of gives {found!r}, but the device has the key {key!r}"

    def test_a_shutdown_from_outside_ends_at_0_v(
        self,
        instrument: DaqInstrument[Any],
        config: Any,
        rig_file: Path,
        output_v: Callable[[], float] | None,
    ) -> None:
        """The run that uses it reads 0 V afterwards, or an error says that the device is lost."""
        with opened_rig(load_rig(rig_file), rig_file, gate := Gate()) as rig:
            gate.permit(gate.interlock.revision)
            rig.source.write(1.0)
            rig.acquisition.read()
            pass_queue(rig)
            np.testing.assert_allclose(drive_v(rig)[0, -1], 1.0, rtol=_SHARE)
            instrument.shut_down(config, WITHIN_S)
            if output_v is not None:
                assert abs(output_v()) < _SHARE
            try:
                assert np.abs(drive_v(rig, 2)[-1]).max() < _SHARE
            except DeviceError as error:
                if output_v is None:
                    pytest.skip(
                        f"the device is lost, so only a fixture output_v can confirm 0 V: {error}"
                    )
