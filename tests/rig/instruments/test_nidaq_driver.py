"""The NI driver on emulated devices that are wrong in one way, and its checks of them."""

from __future__ import annotations

import contextlib
import itertools
import threading
import time
import tomllib
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.checks.output_timing import measure_lag, measure_start, recommended_ahead_blocks
from haselab.rig.drivers import quietly
from haselab.rig.instruments.nidaq.board import NidaqBoard
from haselab.rig.instruments.nidaq.exposures import ExposureCounter
from haselab.rig.instruments.nidaq.idle import IdlePoll
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.routes import verify_routes
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.nidaq.tasks import NidaqTasks, ticks_per_sample
from haselab.rig.instruments.sections import ExposureConfig
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.serve.faults import BenchFaults
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.ni.bus import BoardFaults
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.server import ServedTwin, suited_to
from haselab.safety.gate import Gate
from haselab.safety.guardian.make_safe import make_safe

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

BOARDS = list(DEVICES)
GUARD_S = 300.0
TICK_S = 50e-9
LINE = ExposureConfig(input="PFI0", duration_s=1e-3)


@contextlib.contextmanager
def served_board(
    board: str = "USB-6212",
    *,
    ahead_blocks: int = 1,
    pace: float = 0.0,
    config: TwinConfig | None = None,
    **faults: Any,
) -> Iterator[tuple[ServedTwin, BenchConfig]]:
    planted = BoardFaults(**faults)
    with ServedTwin(
        config or twin_of_reading("hz"),
        1,
        pace=pace,
        board=board,
        faults=BenchFaults(board=planted),
    ) as served:
        data = tomllib.loads(served.rig_file(ahead_blocks=ahead_blocks))
        data["daq"]["server_patience_s"] = 30.0  # on a busy machine too
        yield served, BenchConfig.model_validate(data)


@contextlib.contextmanager
def opened(file: BenchConfig, exposure: ExposureConfig | None = None) -> Iterator[NidaqBoard]:
    board = NidaqBoard(file.daq, file.describe().drive_limits, 1.0, exposure)
    try:
        yield board
    finally:
        board.close()


# ---- rates and skew -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rate_hz", "reported"), [(300e3, "250000 or 312500"), (3e3, "2500 or 3125")]
)
def test_a_rate_that_does_not_divide_20_mhz_is_refused_with_the_nearest_ones(
    rate_hz: float, reported: str
) -> None:
    with pytest.raises(InputError, match=rf"daq\.rate_hz is .* divides 20 MHz exactly.*{reported}"):
        ticks_per_sample(NidaqConfig(rate_hz=rate_hz))


def test_a_rate_beyond_the_device_is_refused_with_its_highest_one() -> None:
    with served_board("PCIe-6321") as (_, file):
        fast = file.daq.model_copy(update={"rate_hz": 200e3, "block_samples": 2000})
        with pytest.raises(DeviceError, match=r"PCIe-6321's limit of 125000 Hz .*-200332.*Lower"):
            NidaqBoard(fast, file.describe().drive_limits, 1.0)


@pytest.mark.parametrize("board", BOARDS)
def test_a_skew_that_is_not_the_boards_is_refused_with_the_boards(board: str) -> None:
    with served_board(board) as (served, file):
        true_s = file.daq.skew_s
        assert true_s == pytest.approx(0.0 if board == "USB-6366" else 0.5 / served.hub.rate_hz)
        wrong = file.daq.model_copy(update={"skew_s": true_s + 1e-6})
        with pytest.raises(InputError, match=rf"{board} converts .* Set daq\.skew_s = {true_s:g}"):
            NidaqBoard(wrong, file.describe().drive_limits, 1.0)


@pytest.mark.parametrize("board", BOARDS)
def test_a_twin_is_sampled_as_its_board_can(board: str) -> None:
    daq = suited_to(twin_of_reading("hz"), board).acquisition
    assert daq.rate_hz == (100e3 if board == "PCIe-6321" else 200e3)
    assert daq.block_samples / daq.rate_hz == 0.01


# ---- routes and reserved devices ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("route", "task"),
    [
        ("20MHzTimebase>Ctr0Source", "block clock"),
        ("ai/StartTrigger>Ctr0Gate", "block clock"),
        ("Ctr0InternalOutput>ao/SampleClock", "output"),
        ("20MHzTimebase>Ctr1Source", "exposure counter"),
        ("PFI0>Ctr1Gate", "exposure counter"),
        ("ai/StartTrigger>Ctr1ArmStartTrigger", "exposure counter"),
    ],
)
def test_the_check_of_routes_names_the_task_and_the_route(route: str, task: str) -> None:
    with served_board(refuse_routes=(route,)) as (served, file):
        rows = verify_routes(file.daq, LINE)
        source, _, destination = route.partition(">")
        assert [row.task for row in rows if not row.ok] == [task]
        fault = next(row.fault for row in rows if not row.ok)
        assert f"{source} to {destination} (status -89136)" in fault
        assert "\n" not in fault
        with pytest.raises(DeviceError, match=rf"{source} to {destination} \(status -89136\)"):
            NidaqBoard(file.daq, file.describe().drive_limits, 1.0, LINE)
        assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("board", BOARDS)
def test_the_check_of_routes_changes_no_output_and_leaves_the_device_free(board: str) -> None:
    with served_board(board) as (served, file):
        served.hub.set_output(0.5)
        before_v = served.hub.output_v
        link = NidaqLink(file.daq)
        try:
            for _ in range(2):
                assert [row.fault for row in verify_routes(file.daq, LINE, link)] == [""] * 5
        finally:
            link.close()
        assert served.hub.output_v == pytest.approx(before_v, rel=1e-3)
        with opened(file, LINE) as running:
            assert running.read().shape == (file.daq.block_samples, 2)


def test_orphaned_tasks_are_one_line_and_making_the_bench_safe_helps() -> None:
    with served_board(orphaned_tasks=True) as (_, file):
        with pytest.raises(
            DeviceError, match=r"-50103\)\. .*haselab rig safe RIG\.toml"
        ) as reported:
            RealBench(file, Gate())
        assert "\n" not in str(reported.value)
        assert ("daq", "") in make_safe(file)
        with opened(file) as board:
            board.read()


@pytest.mark.parametrize("code", [-200292, -200293])
def test_a_buffer_that_is_full_after_a_reset_says_to_start_again(code: int) -> None:
    """The panel of a bench that `rig safe` has reset reported the bare status -200293."""
    with served_board() as (_, file), opened(file) as board:
        error = board._link._errors.DaqError("no more space in the buffer", code)
        with (
            pytest.raises(DeviceError, match=rf"full, .*status {code}.* start this program again"),
            board._link.translated_errors(),
        ):
            raise error


def test_a_board_that_was_reset_opens_again_at_zero_without_a_permission() -> None:
    """Its clock begins at 0 s, and nothing that was requested before is put out."""
    with served_board() as (served, file), opened(file, LINE) as board:
        log = board.exposures
        board.keep(True)
        board.write(0.5)
        for _ in range(3):
            board.read()
        assert served.hub._drive_v == 0.5
        other = NidaqLink(file.daq)
        other.reset()  # as `haselab rig safe` does
        other.close()
        with pytest.raises(DeviceError, match="NI board"):
            board.read()
        Gate().instrument(board).reopen()
        assert board.exposures is log, "the camera reads it"
        board.write(0.0)
        for _ in range(3):
            board.read()
            assert served.hub._drive_v == 0.0
        assert 0.0 < board.time_s < 1.0
        board.write(0.5)
        for _ in range(3):
            board.read()
        assert served.hub._drive_v == 0.5


# ---- USB ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lag", [0, 300, 800])
def test_over_usb_outputs_come_in_their_blocks_however_late_its_counts(lag: int) -> None:
    with served_board(ahead_blocks=2, usb_lag_samples=lag) as (_, file), opened(file) as board:
        measured = measure_start(board, file.daq, starts=5)
        assert (measured.seen, measured.late_blocks, measured.missed) == (5, 0, 0)
        # The amplifier of 6 kHz and damping 0.6 crosses one half 1.3 / w after its input's step.
        assert np.all((measured.late_samples > 3) & (measured.late_samples < 14))
        assert measured.spread_samples <= 1


def test_a_lag_that_no_count_shows_is_found_by_the_loop() -> None:
    with served_board(ahead_blocks=3, usb_lag_samples=1800) as (_, file), opened(file) as board:
        assert measure_start(board, file.daq, starts=3).late_blocks == 1


def test_over_usb_counts_that_are_read_slowly_do_not_undo_a_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Reading a count takes 2.8 ms: it counts only if the next one agrees."""
    with served_board() as (served, file), opened(file) as board:
        acquired, write = board._acquired, board._ahead.write_many_sample
        queued: list[int] = []

        def slowly() -> int:
            found = acquired()
            if queued:
                served.hub.spend(560)
            return found

        def noting(values: np.ndarray, timeout_s: float) -> None:
            queued.append(len(values))
            write(values, timeout_s)

        monkeypatch.setattr(board, "_acquired", slowly)
        monkeypatch.setattr(board._ahead, "write_many_sample", noting)
        board._start_stream()
        assert len(queued) == 1


@pytest.mark.parametrize("samples", [500, 1000, 2000])
def test_packets_of_up_to_a_block_do_not_keep_the_output_from_its_blocks(samples: int) -> None:
    with served_board(ahead_blocks=2, slow_transfer=samples) as (_, file), opened(file) as board:
        measured = measure_start(board, file.daq, starts=3)
        assert (measured.seen, measured.late_blocks) == (3, 0)


@pytest.mark.long
@pytest.mark.parametrize("polls", [True, False])
def test_an_idle_usb_device_is_asked_so_that_it_goes_on(
    polls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not polls:
        monkeypatch.setattr(NidaqBoard, "_query_idle", lambda board: None)
    # blocks of 80 ms: in real time, a thread may wait for 5 ms for Python's lock
    slow = TwinConfig.model_validate({"acquisition": {"block_samples": 16000}})
    with (
        served_board(pace=1.0, stall_s=3.0, ahead_blocks=8, config=slow) as (served, file),
        opened(file) as b,
    ):
        b.read()
        end = served.hub.acquired + round(4.5 * file.daq.rate_hz)
        assert served.hub.wait_until(lambda: served.hub._acquired >= end, GUARD_S)
        if polls:
            assert b.read().shape == (file.daq.block_samples, 2)
        else:
            with pytest.raises(DeviceError, match=r"a USB device has stopped \(status -200284\)"):
                for _ in range(400):
                    b.read()


def test_the_idle_poll_leaves_a_busy_device_alone_and_ends_with_the_first_fault() -> None:
    asked, failed = threading.Event(), threading.Event()
    poll = IdlePoll(asked.set, period_s=0.01)
    assert asked.wait(GUARD_S)
    poll.close()

    def fail() -> None:
        failed.set()
        raise DeviceError("The device has gone.")

    poll = IdlePoll(fail, period_s=0.01)
    assert failed.wait(GUARD_S)
    poll._thread.join(GUARD_S)
    assert not poll._thread.is_alive()
    poll.close()


def test_a_plug_in_board_needs_no_idle_poll() -> None:
    with served_board("PXIe-6363") as (_, file), opened(file) as board:
        assert board._idle is None


def test_a_question_of_the_idle_poll_that_hangs_does_not_shorten_the_next_calls_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After a call that was not answered the others have 2 ms; this one is nobody's business."""
    with served_board() as (_, file):
        link = NidaqLink(file.daq.model_copy(update={"server_patience_s": 1.0}))
        inputs = NidaqTasks(link, file.daq).inputs()
        inputs.start()
        hold, calls = threading.Event(), itertools.count()

        def acquired(hub: TwinHub) -> int:
            if next(calls) == 0:
                hold.wait(GUARD_S)
            time.sleep(0.05)
            return 0

        monkeypatch.setattr(TwinHub, "acquired", property(acquired))
        reported: list[Exception | None] = []

        def ask() -> None:
            link.ignore_silence()
            reported.append(quietly(lambda: inputs.in_stream.total_samp_per_chan_acquired))

        thread = threading.Thread(target=ask)
        thread.start()
        thread.join(GUARD_S)
        assert "Deadline" in str(reported[0])
        assert inputs.in_stream.total_samp_per_chan_acquired == 0
        hold.set()
        link.close()


# ---- the exposure counter -----------------------------------------------------------------------


def slow_twin() -> TwinConfig:
    """Sampled at 10 kHz, so that minutes pass quickly; its counters still count 20 MHz."""
    config = twin_of_reading("hz")
    changed = {"rate_hz": 10e3, "block_samples": 400, "skew_s": 0.0}
    return config.model_copy(update={"acquisition": config.acquisition.model_copy(update=changed)})


@pytest.mark.long
@pytest.mark.parametrize("board", ["USB-6212", "PXIe-6363"])
def test_exposures_keep_their_times_when_the_counter_goes_round(board: str) -> None:
    """Every 215 s, while blocks are read and after a long idle time."""
    with served_board(board, config=slow_twin()) as (served, file), opened(file, LINE) as b:
        log = b.exposures
        assert log is not None
        block_s, rate_hz = file.daq.block_samples / file.daq.rate_hz, file.daq.rate_hz

        def idle_until(time_s: float) -> None:
            served.hub.readings(round(time_s * rate_hz), 20, 1.0)
            b.catch_up()
            log.forget()

        def compare() -> None:
            served.hub.start_camera(20.0)
            for _ in range(round(3.0 / block_s)):
                b.read()
            begun_s = np.array(served.hub.exposed_from(0)) - served.hub.origin_s
            told_s = np.array(log.middle_s) - 0.5 * LINE.duration_s
            assert len(told_s) >= 50
            nearest = np.abs(begun_s[:, None] - told_s[None, :]).min(axis=0)
            assert nearest.max() <= TICK_S
            served.hub.stop_camera()

        b.read()
        compare()
        idle_until(213.5)
        compare()  # the counter goes round at 214.75 s
        idle_until(800.0)  # three times more
        compare()


def test_exposures_of_a_long_time_without_a_look_are_dropped() -> None:
    with served_board() as (_, file):
        link = NidaqLink(file.daq)
        counter = ExposureCounter(link, file.daq, LINE)
        counter.start(0.0)
        latched = [7, 9, 11]
        stream = SimpleNamespace(total_samp_per_chan_acquired=3, offset=0)
        counter.task = SimpleNamespace(in_stream=stream)

        def read(data: np.ndarray, count: int, timeout: float) -> None:
            data[:] = latched[-count:]

        counter._reader = SimpleNamespace(read_many_sample_uint32=read)
        counter.collect(round(100.0 * file.daq.rate_hz))  # nobody has looked for 100 s
        assert list(counter.log.middle_s) == []
        latched.append(round(100.1 * 20e6))
        stream.total_samp_per_chan_acquired = 4
        counter.collect(round(100.2 * file.daq.rate_hz))
        assert list(counter.log.middle_s) == pytest.approx([100.1 + 0.5e-3], abs=TICK_S)
        assert stream.offset == 3  # what was dropped is passed over
        link.close()


def test_the_other_edge_of_the_line_is_the_end_of_an_exposure() -> None:
    with served_board("PXIe-6363") as (served, file):
        falling = LINE.model_copy(update={"edge": "falling"})
        with opened(file, falling) as board:
            board.read()
            served.hub.start_camera(50.0)
            for _ in range(20):
                board.read()
            begun_s = np.array(served.hub.exposed_from(0)) - served.hub.origin_s
            assert board.exposures is not None
            told_s = np.array(board.exposures.middle_s) - 0.5 * LINE.duration_s
            late_s = told_s - begun_s[: len(told_s)]
            np.testing.assert_allclose(late_s, served.hub.exposure_s, atol=TICK_S)


# ---- lag and advice -----------------------------------------------------------------------------


def test_the_lag_is_what_the_count_falls_behind_its_own_best() -> None:
    """A count that comes in packets of 10 ms is behind by 10 ms at the most, by 5 in the middle."""
    clock_s = [0.0]

    def pause(time_s: float) -> None:
        clock_s[0] += time_s

    lag = measure_lag(
        lambda: int(clock_s[0] * 100) * 2000,
        200e3,
        duration_s=2.0,
        now=lambda: clock_s[0],
        pause=pause,
    )
    assert lag.highest_s == pytest.approx(10e-3, abs=4.1e-3)  # a look every 4 ms
    assert lag.median_s == pytest.approx(5e-3, abs=4.1e-3)
    assert lag.rate_share == pytest.approx(0.0, abs=5e-3)


def test_a_count_that_stands_still_has_no_lag() -> None:
    times_s = iter(np.arange(0.0, 10.0, 0.1))
    lag = measure_lag(lambda: 5, 200e3, now=lambda: next(times_s), pause=lambda s: None)
    assert (lag.highest_s, lag.rate_share) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("lag_s", "write_s", "ahead"), [(0, 0, 1), (0, 9e-3, 1), (5e-3, 5e-3, 2), (1.0, 0, 10)]
)
def test_as_many_blocks_are_advised_as_lag_and_writing_need(
    lag_s: float, write_s: float, ahead: int
) -> None:
    assert recommended_ahead_blocks(lag_s, write_s, NidaqConfig()) == ahead


@pytest.mark.parametrize(("starts", "step_v"), [(0, 0.1), (5, 1e-4), (5, float("nan"))])
def test_starts_that_could_not_be_seen_are_refused(starts: int, step_v: float) -> None:
    with (
        served_board("PXIe-6363") as (_, file),
        opened(file) as board,
        pytest.raises(LimitError, match=r"starts is .*must be at least.*Raise them"),
    ):
        measure_start(board, file.daq, starts=starts, step_v=step_v)


def test_a_fault_below_zero_is_refused() -> None:
    with pytest.raises(LimitError, match=r"stall_s is -1.0, but must be 0 or more"):
        BoardFaults(stall_s=-1.0)
