"""The emulated NI devices refuse what real ones refuse; the statuses are those of DAQmx.

The first part makes the calls of the driver as it was before, directly with nidaqmx: each of its
assumptions about a device is refused, or gives another result than it took for granted.
"""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from haselab.rig.bench_config import BenchConfig
from haselab.rig.checks.output_timing import measure_start
from haselab.rig.instruments.nidaq.board import NidaqBoard
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.faults import BenchFaults
from haselab.rig.twin.serve.ni.bus import BoardFaults
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.server import ServedTwin

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
nidaqmx = pytest.importorskip("nidaqmx")
pytest.importorskip("nidaqmx.stream_writers")
pytest.importorskip("nidaqmx.stream_readers")
pytest.importorskip("nidaqmx.system.device")
grpc = pytest.importorskip("grpc")

BOARDS = list(DEVICES)
CONTINUOUS = nidaqmx.constants.AcquisitionType.CONTINUOUS


class Client:
    """nidaqmx on a served board, without our driver."""

    def __init__(self, served: ServedTwin) -> None:
        self.served = served
        self._channel = grpc.insecure_channel(served.daq.address)
        self._tasks: list[Any] = []

    def options(self) -> Any:
        return nidaqmx.GrpcSessionOptions(self._channel, "")

    def task(self) -> Any:
        self._tasks.append(nidaqmx.Task(grpc_options=self.options()))
        return self._tasks[-1]

    def device(self) -> Any:
        return nidaqmx.system.device.Device("Dev1", grpc_options=self.options())

    def inputs(self, rate_hz: float | None = None) -> Any:
        task = self.task()
        for name in ("ai0", "ai1"):
            task.ai_channels.add_ai_voltage_chan(f"Dev1/{name}")
        task.timing.cfg_samp_clk_timing(rate_hz or self.served.hub.rate_hz, sample_mode=CONTINUOUS)
        task.in_stream.overwrite = nidaqmx.constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        return task

    def clock(self, source: str = "20MHzTimebase", counter: str = "ctr0") -> Any:
        """One pulse in 10 ms."""
        task, ticks = self.task(), 100
        if source == "ai/SampleClock":
            ticks = 1
        task.co_channels.add_co_pulse_chan_ticks(
            f"Dev1/{counter}", f"/Dev1/{source}", initial_delay=400 * ticks,
            low_ticks=1000 * ticks, high_ticks=1000 * ticks,
        )  # fmt: skip
        task.timing.cfg_implicit_timing(sample_mode=CONTINUOUS)
        return task

    def edges(self, source: str, *, clock: str = "PFI0", counter: str = "ctr1") -> Any:
        task = self.task()
        channel = task.ci_channels.add_ci_count_edges_chan(f"Dev1/{counter}")
        channel.ci_count_edges_term = f"/Dev1/{source}"
        task.timing.cfg_samp_clk_timing(10e3, source=f"/Dev1/{clock}", sample_mode=CONTINUOUS)
        return task

    def stream(self, buffer_size: int = 0) -> tuple[Any, Callable[[list[float]], int]]:
        """The output clocked by ctr0, and what writes to it."""
        task = self.task()
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        task.timing.cfg_samp_clk_timing(
            100.0, source="/Dev1/Ctr0InternalOutput", sample_mode=CONTINUOUS, samps_per_chan=128
        )
        never = nidaqmx.constants.RegenerationMode.DONT_ALLOW_REGENERATION
        task.out_stream.regen_mode = never
        if buffer_size:
            task.out_stream.output_buf_size = buffer_size
        writer = nidaqmx.stream_writers.AnalogSingleChannelWriter(task.out_stream, auto_start=False)
        writer.verify_array_shape = False
        return task, lambda values: writer.write_many_sample(np.array(values), 1.0)

    def put_out(self, value: float) -> None:
        """On demand, by a task of its own."""
        task = self.task()
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        writer = nidaqmx.stream_writers.AnalogSingleChannelWriter(task.out_stream, auto_start=True)
        writer.verify_array_shape = False
        writer.write_one_sample(value, 1.0)

    @staticmethod
    def read(task: Any, samples: int) -> None:
        reader = nidaqmx.stream_readers.AnalogMultiChannelReader(task.in_stream)
        reader.verify_array_shape = False
        reader.read_many_sample(np.empty((2, samples)), samples, timeout=1.0)

    def close(self) -> None:
        for task in self._tasks:
            with contextlib.suppress(Exception):
                task.close()
        self._channel.close()


@contextlib.contextmanager
def served_board(board: str, **faults: Any) -> Iterator[Client]:
    config, planted = twin_of_reading("hz"), BoardFaults(**faults)
    with ServedTwin(config, 1, pace=0.0, board=board, faults=BenchFaults(board=planted)) as served:
        client = Client(served)
        try:
            yield client
        finally:
            client.close()


@contextlib.contextmanager
def refused(status: int) -> Iterator[None]:
    with pytest.raises(nidaqmx.errors.DaqError, match=r"\w") as caught:
        yield
    assert int(caught.value.error_code) == status


# ---- the driver as it was -----------------------------------------------------------------------


@pytest.mark.parametrize("board", BOARDS)
def test_the_sample_clock_is_no_source_of_the_block_clock(board: str) -> None:
    with served_board(board) as client, refused(-89136):
        client.clock("ai/SampleClock").start()


@pytest.mark.parametrize("board", BOARDS)
def test_the_sample_clock_cannot_be_counted_by_the_exposure_counter(board: str) -> None:
    with served_board(board) as client, refused(-89136):
        client.edges("ai/SampleClock").start()


@pytest.mark.parametrize("board", BOARDS)
def test_one_value_is_too_few_for_an_output_buffer_without_a_size(board: str) -> None:
    """NI-DAQmx C Reference, DAQmxWriteRaw, note: buffered writes need 2 samples or a size."""
    with served_board(board) as client:
        _, write = client.stream()
        with refused(-200547):
            write([0.0])


def test_the_first_write_sizes_the_buffer_and_queued_values_do_not_fit() -> None:
    with served_board("USB-6212") as client:
        clock, inputs, (stream, write) = client.clock(), client.inputs(), client.stream()
        write([0.0, 0.0])
        assert stream.out_stream.output_buf_size == 2  # not the 128 of samps_per_chan
        clock.start()
        inputs.start()
        stream.start()
        with refused(-200292):
            write([0.0] * 50)


def test_two_inputs_at_the_usual_rate_are_too_fast_for_a_pcie_6321() -> None:
    with served_board("PCIe-6321") as client:
        with refused(-200332):
            client.inputs(200e3).start()
        assert client.device().ai_max_multi_chan_rate == 250e3


@pytest.mark.parametrize(
    ("board", "rate_hz", "skew_s"),
    [
        ("USB-6212", 200e3, 2.5e-6),  # evenly spread: no room for 10 us of settling
        ("USB-6212", 10e3, 12.5e-6),  # 2.5 us + 10 us
        ("PXIe-6363", 10e3, 11e-6),  # 1 us + 10 us
        ("PCIe-6321", 100e3, 5e-6),
        ("PCIe-6321", 10e3, 14e-6),
    ],
)
def test_the_skew_is_not_the_same_everywhere(board: str, rate_hz: float, skew_s: float) -> None:
    """USB-621x User Manual p. 4-16, M Series User Manual p. 4-31: 10 us where they fit."""
    rate = DEVICES[board].convert_rate_hz(2, rate_hz)
    assert 1.0 / rate == pytest.approx(skew_s, abs=5e-9)


def test_a_simultaneous_board_has_no_convert_clock() -> None:
    with served_board("USB-6366") as client:
        assert client.device().ai_simultaneous_sampling_supported
        with refused(-200452):
            client.inputs().timing.ai_conv_rate  # noqa: B018


def test_over_usb_a_start_that_is_taken_on_trust_is_in_the_wrong_block() -> None:
    """Counts come late, so that an edge that has passed seems to be ahead."""
    config, faults = twin_of_reading("hz"), BoardFaults(usb_lag_samples=800)
    with ServedTwin(config, 1, pace=0.0, faults=BenchFaults(board=faults)) as served:
        file = BenchConfig.model_validate(tomllib.loads(served.rig_file(ahead_blocks=1)))
        board = NidaqBoard(file.daq, file.describe().drive_limits, 1.0)
        try:
            measured = measure_start(board, file.daq, starts=4)
            assert (measured.seen, measured.late_blocks) == (4, 0)
            board._link.__dict__["usb"] = False  # as on a plug-in board: predicted
            predicted = measure_start(board, file.daq, starts=4)
            assert predicted.late_blocks == 1
        finally:
            board.close()


def test_a_usb_device_that_is_not_queried_stops_sending() -> None:
    """nidaqmx-python issue 931; the threshold is the fault's."""
    with served_board("USB-6212", stall_s=1.0) as client:
        inputs = client.inputs()
        inputs.start()
        client.served.hub.readings(400_000, 2000, 1.0)  # two seconds pass
        with refused(-200284):
            client.read(inputs, 300_000)


def test_tasks_of_a_program_that_has_died_hold_the_device_until_it_is_reset() -> None:
    with served_board("PXIe-6363", orphaned_tasks=True) as client:
        inputs = client.inputs()
        with refused(-50103):
            inputs.start()
        client.device().reset_device()
        inputs.start()


def test_tasks_outlive_the_client_that_made_them() -> None:
    with served_board("USB-6361") as client:
        gone = Client(client.served)
        gone.inputs().start()
        gone._channel.close()  # nobody has said good-bye
        inputs = client.inputs()
        with refused(-50103):
            inputs.start()
        client.device().reset_device()
        inputs.start()


# ---- routes and counters ------------------------------------------------------------------------


@pytest.mark.parametrize("board", BOARDS)
def test_the_routes_that_the_driver_needs_are_there(board: str) -> None:
    device = DEVICES[board]
    for k in range(device.counters):
        assert {"20MHzTimebase", "PFI0"} <= device.sources(f"Ctr{k}Source")
        assert {"ai/StartTrigger", "PFI0"} <= device.sources(f"Ctr{k}Gate")
        assert "ai/StartTrigger" in device.sources(f"Ctr{k}ArmStartTrigger")
        assert f"Ctr{k}InternalOutput" in device.sources("ao/SampleClock")


@pytest.mark.parametrize(
    ("board", "clock", "status"),
    [
        ("USB-6212", "PFI16", -89120),
        ("USB-6212", "RTSI0", -89120),  # no USB device has trigger lines to others
        ("USB-6361", "RTSI0", -89120),
        ("PCIe-6321", "PXI_Trig0", -89120),
        ("PXIe-6363", "RTSI0", -89120),
        ("USB-6212", "100kHzTimebase", -89136),
        ("PCIe-6321", "RTSI0", 0),
        ("PXIe-6363", "PXI_Trig0", 0),
        ("PXIe-6363", "ai/SampleClock", 0),
    ],
)
def test_a_counters_clock_takes_the_terminals_of_its_device(
    board: str, clock: str, status: int
) -> None:
    with served_board(board) as client:
        edges = client.edges("20MHzTimebase", clock=clock)
        with refused(status) if status else contextlib.nullcontext():
            edges.control(nidaqmx.constants.TaskMode.TASK_VERIFY)


@pytest.mark.parametrize(
    ("board", "source", "status"),
    [
        ("USB-6212", "80MHzTimebase", 0),
        ("USB-6212", "100MHzTimebase", -89120),
        ("PXIe-6363", "100MHzTimebase", 0),
        ("PXIe-6363", "80MHzTimebase", -89120),
    ],
)
def test_timebases_are_those_of_the_family(board: str, source: str, status: int) -> None:
    with served_board(board) as client, refused(status) if status else contextlib.nullcontext():
        client.edges(source).control(nidaqmx.constants.TaskMode.TASK_VERIFY)


def test_a_usb_6212_has_two_counters_and_an_x_series_device_four() -> None:
    with served_board("USB-6212") as client, refused(-200170):
        client.edges("20MHzTimebase", counter="ctr2")
    with served_board("USB-6361") as client:
        client.edges("20MHzTimebase", counter="ctr3").start()


def test_a_counter_belongs_to_one_task() -> None:
    with served_board("USB-6212") as client:
        client.clock().start()
        with refused(-50103):
            client.edges("20MHzTimebase", counter="ctr0").start()


def test_a_counter_that_counts_has_no_start_trigger() -> None:
    """Both manuals, "Counter Triggering": it has the arm-start trigger in its place."""
    with served_board("USB-6212") as client, refused(-200452):
        edges = client.edges("20MHzTimebase")
        edges.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")


def test_a_counter_that_is_started_after_the_inputs_waits_for_ever() -> None:
    with served_board("PXIe-6363") as client:
        inputs, clock, (stream, write) = client.inputs(), client.clock(), client.stream(128)
        clock.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        write([0.0, 0.0])
        inputs.start()
        clock.start()
        stream.start()
        client.read(inputs, 10_000)
        assert stream.out_stream.total_samp_per_chan_generated == 0


# ---- output, states, rates ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "values", "status"), [(1, [0.0], -200609), (128, [0.0], -200609), (128, [], -200462)]
)
def test_an_output_starts_with_two_values_at_least(
    size: int, values: list[float], status: int
) -> None:
    with served_board("PCIe-6321") as client:
        stream, write = client.stream(size)
        if values:
            write(values)
        with refused(status):
            stream.start()


def test_more_than_the_buffer_holds_cannot_be_primed() -> None:
    """nidaqmx-python, tests/legacy/test_write_exceptions.py, test_overwrite_during_prime."""
    with served_board("PXIe-6363") as client:
        _, write = client.stream(10)
        with refused(-200293):
            write([0.0] * 11)


def test_a_running_output_keeps_its_buffer_and_stops_where_values_do_not_come() -> None:
    with served_board("PXIe-6363") as client:
        clock, inputs, (stream, write) = client.clock(), client.inputs(), client.stream(128)
        write([0.1, 0.2])
        clock.start()
        inputs.start()
        stream.start()
        with refused(-200557):
            stream.out_stream.output_buf_size = 256
        client.read(inputs, 10_000)
        with refused(-200290):
            write([0.3])
        with refused(-200290):
            stream.stop()


def test_a_stopped_task_that_was_written_to_still_holds_the_output() -> None:
    """Key Concepts, "Transitioning the State Backwards": a write commits, a stop returns."""
    with served_board("USB-6212") as client:
        clock, inputs, (stream, write) = client.clock(), client.inputs(), client.stream(128)
        clock.start()
        inputs.start()
        write([0.0] * 8)
        stream.start()
        stream.stop()
        with refused(-50103):
            client.put_out(0.0)
        stream.control(nidaqmx.constants.TaskMode.TASK_UNRESERVE)
        client.put_out(0.0)


def test_unread_samples_end_an_acquisition_that_may_not_overwrite_them() -> None:
    with served_board("PXIe-6363") as client:
        inputs = client.inputs()
        never = nidaqmx.constants.OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
        inputs.in_stream.overwrite = never
        inputs.start()
        client.served.hub.readings(110_000, 2000, 1.0)  # the driver keeps 100 kS at this rate
        with refused(-200279):
            client.read(inputs, 10)


@pytest.mark.parametrize("board", BOARDS)
def test_a_device_says_what_it_is(board: str) -> None:
    with served_board(board) as client:
        device = client.device()
        assert device.product_type == board
        usb = device.bus_type is nidaqmx.constants.BusType.USB
        assert usb == board.startswith("USB")
        assert device.product_category.name == (
            "M_SERIES_DAQ" if board == "USB-6212" else "X_SERIES_DAQ"
        )
        assert "/Dev1/20MHzTimebase" in device.terminals


def test_an_unknown_board_is_refused() -> None:
    from haselab.base import InputError

    with pytest.raises(InputError, match=r"Board is 'USB-6008', but must be one of USB-6212, "):
        ServedTwin(twin_of_reading("hz"), 1, pace=0.0, board="USB-6008")
