"""The tasks on an NI board: two inputs, an output, the counter that clocks it, and their timing.

Block clock and sample clock come from one oscillator. The counter divides the 20 MHz timebase by
the samples of a block and starts with the inputs, so its edges stay at their sample. Counting
the sample clock itself would need a route that most devices lack.
"""

from __future__ import annotations

from typing import Any

from haselab.base import InputError
from haselab.rig.drivers import quietly
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.section import NidaqConfig

__all__ = ["TIMEBASE_HZ", "NidaqTasks", "ticks_per_sample"]

TIMEBASE_HZ = 20e6  # that the counters of all devices can count
_OUTPUT_BUFFER = 128  # values that the driver queues at most
_FULL_V = 10.0  # range of the analogue outputs
_EXACT = 1e-6  # of a tick
_SKEW_S = 50e-9  # a tick of the timebase


def ticks_per_sample(config: NidaqConfig) -> int:
    """Compute the ticks of the 20 MHz timebase per sample.

    Args:
        config: section `daq` of the rig file.
    Returns:
        A whole number.
    Raises:
        InputError: the rate does not divide the timebase.
    Example:
        >>> ticks_per_sample(NidaqConfig(rate_hz=200e3))
        100
    """
    ticks = TIMEBASE_HZ / config.rate_hz
    if abs(ticks - round(ticks)) <= _EXACT:
        return round(ticks)
    whole = [TIMEBASE_HZ / k for k in range(20, 20_001) if TIMEBASE_HZ % k == 0]
    lower, upper = (
        max(rate for rate in whole if rate < config.rate_hz),
        min((rate for rate in whole if rate > config.rate_hz), default=whole[0]),
    )
    raise InputError(
        f"daq.rate_hz is {config.rate_hz:g}, but the block clock needs a rate that divides 20 MHz "
        f"exactly. Set daq.rate_hz to {lower:.10g} or {upper:.10g}."
    )


class NidaqTasks:
    """Makes the tasks of one board; the link closes them.

    Args:
        link: to the board.
        config: section `daq` of the rig file.
    Raises:
        InputError: The sample rate does not divide the timebase.
    """

    def __init__(self, link: NidaqLink, config: NidaqConfig) -> None:
        self._link, self._config = link, config
        self.ticks = ticks_per_sample(config)

    @property
    def timebase(self) -> str:
        """Terminal of the counters' timebase."""
        return f"/{self._config.device}/20MHzTimebase"

    @property
    def start_trigger(self) -> str:
        """Terminal that pulses when the inputs start."""
        return f"/{self._config.device}/ai/StartTrigger"

    def output(self) -> Any:
        """Create the task of the output on demand, which can be given a clock."""
        task = self._link.task()
        task.ao_channels.add_ao_voltage_chan(
            f"{self._config.device}/{self._config.output}", min_val=-_FULL_V, max_val=_FULL_V
        )
        return task

    def inputs(self) -> Any:
        """Create the task of both monitors."""
        config, constants = self._config, self._link.constants
        task = self._link.task()
        for name in (config.v_monitor, config.i_monitor):
            task.ai_channels.add_ai_voltage_chan(
                f"{config.device}/{name}",
                terminal_config=constants.TerminalConfiguration[config.wiring],
                min_val=-config.range_v,
                max_val=config.range_v,
            )
        task.timing.cfg_samp_clk_timing(
            config.rate_hz,
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=round(config.buffer_s * config.rate_hz),
        )
        # Idle time is then not an error; losing samples that are read still is (-200279).
        task.in_stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        return task

    def clock(self) -> Any:
        """Create the block clock: a rising edge at the same sample of every block."""
        config = self._config
        task = self._link.task()
        high = config.block_samples // 2
        task.co_channels.add_co_pulse_chan_ticks(
            f"{config.device}/{config.counter}",
            self.timebase,
            initial_delay=config.switch_in_block * self.ticks,
            low_ticks=(config.block_samples - high) * self.ticks,
            high_ticks=high * self.ticks,
        )
        task.timing.cfg_implicit_timing(sample_mode=self._link.constants.AcquisitionType.CONTINUOUS)
        task.triggers.start_trigger.cfg_dig_edge_start_trig(self.start_trigger)
        return task

    def stream(self) -> Any:
        """Create the task of the clocked output: one value per edge of the block clock."""
        config, constants = self._config, self._link.constants
        task = self.output()
        task.timing.cfg_samp_clk_timing(
            config.rate_hz / config.block_samples,
            source=f"/{config.device}/{config.counter.capitalize()}InternalOutput",
            sample_mode=constants.AcquisitionType.CONTINUOUS,
            samps_per_chan=_OUTPUT_BUFFER,
        )
        task.out_stream.regen_mode = constants.RegenerationMode.DONT_ALLOW_REGENERATION
        task.out_stream.output_buf_size = _OUTPUT_BUFFER  # else the first write sizes it
        return task

    def skew_s(self, inputs: Any) -> float | None:
        """Time between the conversions of the two channels, in s; None: not reported."""
        if self._link.simultaneous:
            return 0.0
        rates_hz: list[float] = []
        with self._link.translated_errors():  # the query verifies the task, which may be refused
            inputs.control(self._link.constants.TaskMode.TASK_VERIFY)
        quietly(lambda: rates_hz.append(float(inputs.timing.ai_conv_rate)))
        return 1.0 / rates_hz[0] if rates_hz and rates_hz[0] > 0.0 else None

    def check_skew(self, inputs: Any) -> None:
        """Compare the time between the channels with the rig file's.

        Args:
            inputs: task of the inputs.
        Raises:
            InputError: they differ.
            DeviceError: the device refuses the inputs.
        """
        found_s, measured_s = self.skew_s(inputs), self._config.skew_s
        if found_s is not None and abs(found_s - measured_s) > _SKEW_S:
            raise InputError(
                f"daq.skew_s is {measured_s:g} s, but the {self._link.product} converts the second "
                f"channel {found_s:g} s after the first. Set daq.skew_s = {found_s:g}."
            )

    def first_sample_s(self, inputs: Any) -> float | None:
        """Time from the start trigger to the first conversion, in s; None: not reported."""
        reported: list[float] = []
        quietly(lambda: reported.append(float(inputs.timing.samp_clk_timebase_rate)))
        quietly(lambda: reported.append(float(inputs.triggers.start_trigger.delay)))
        if len(reported) < 2:
            return None
        # Simultaneous devices have no convert clock and thus not this delay.
        quietly(lambda: reported.append(float(inputs.timing.delay_from_samp_clk_delay)))
        return sum(reported[1:]) / reported[0]
