"""The bench of the panel in this process, on the twin."""

import errno
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from haselab.api.design import Actuator
from haselab.base import DeviceError, LimitError, SafetyError
from haselab.panel import study_player
from haselab.panel.armed_study import ArmedStudy
from haselab.panel.columns import LiveReader, LiveWriter
from haselab.panel.files import PanelFiles
from haselab.panel.live_bench import LiveBench
from haselab.panel.page_leases import PageLeases
from haselab.panel.pages.study_job import StudyJob
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.guarded import GuardedRig, guard
from tests.panel.running import WAIT_S

LIMIT_V = 2.0


class HangingCall:
    """One call of the bench that hangs, as that of an instrument which does not answer."""

    def __init__(self) -> None:
        self.hangs, self.entered, self.released = (threading.Event() for _ in range(3))

    def of(self, method: Callable[..., Any]) -> Callable[..., Any]:
        """The method; while `hangs` is set, it begins when `released` is set."""

        def hanging(*given: Any) -> Any:
            if self.hangs.is_set():
                self.entered.set()
                assert self.released.wait(WAIT_S)
            return method(*given)

        return hanging


@pytest.fixture
def call() -> Iterator[HangingCall]:
    found = HangingCall()
    yield found
    found.released.set()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[LiveBench, GuardedRig]]:
    """The twin behind the panel, armed for the reference study by the page "page"."""
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    files = PanelFiles(path, None, tmp_path / "out")
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        found = LiveBench(
            rig, writer, prepare=lambda chosen: StudyJob.of(files, load_rig(path), chosen)
        )
        number = found.do("request", "page", {})["number"]
        study = {"study": "reference study", "experiments": ["triangle"]}
        found.do("arm", "page", {"number": number, "limit_v": LIMIT_V, "study": study})
        yield found, rig
        found.close()


@pytest.mark.parametrize("how", ["lost page", "ended"])
def test_a_study_that_computes_with_an_output_is_taken_to_zero_when_it_must_end(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    live, _ = bench
    seen: list[float] = []

    def computing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        """A fit between two experiments, at 1.5 V: no block is read meanwhile."""
        rig.safety.run()
        rig.source.write(1.5)
        rig.acquisition.read()
        end_s = time.monotonic() + 30.0
        while rig.safety.live and time.monotonic() < end_s:
            if how == "ended":
                live.do("lease", "page", {})  # the page is there
            time.sleep(0.05)
        while rig.bench.requested_v != 0.0 and time.monotonic() < end_s:
            time.sleep(0.01)  # 0 V is commanded just after the permission has ended
        seen.append(rig.bench.requested_v)
        rig.source.write(1.5)  # refused

    monkeypatch.setattr(study_player, "run_study", computing)
    if how == "ended":
        threading.Timer(0.5, live.do, ("disarm", "page", {})).start()
    live.step()
    said = {"ended": "The study was ended", "lost page": "No message for "}[how]
    assert live.state.stage == "tripped" and live.state.drive_v == 0.0
    assert said in live.state.reason
    assert seen == [0.0]


@pytest.mark.skipif(not hasattr(time, "pthread_getcpuclockid"), reason="not on this system")
def test_a_twin_says_that_it_computes_and_not_that_it_waits(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the processor time of the thread that plays, so a driver that hangs is no computation."""
    live, rig = bench
    seen: dict[str, bool] = {}
    phase = ["none"]

    def look() -> None:
        while phase[0] != "over":
            seen[phase[0]] = live.state.computing  # the last of each phase
            time.sleep(0.02)

    def playing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            sum(range(1000))
        phase[0] = "waits"
        time.sleep(1.0)
        phase[0] = "over"

    monkeypatch.setattr(study_player, "run_study", playing)
    watching = threading.Thread(target=look)
    watching.start()
    live.step()
    watching.join()
    assert seen == {"none": True, "waits": False}
    assert not live.state.computing
    rig.safety.trip("the end")


def test_a_stop_during_a_computation_shows_the_drive_of_the_output(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, _ = bench
    seen = []

    def computing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        rig.safety.run()
        rig.source.write(1.5)
        rig.acquisition.read()
        seen.append((live.state.stage, live.state.drive_v))
        live.stop("STOP was pressed")
        seen.append((live.state.stage, live.state.drive_v))

    monkeypatch.setattr(study_player, "run_study", computing)
    live.step()
    assert seen == [("running", 1.5), ("tripped", 0.0)]


def test_the_typed_limit_is_that_of_every_output_of_a_study(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, _ = bench
    high = []

    def playing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        high.append((rig.description.drive_limits.high, rig.plain.description.drive_limits.high))
        raise SafetyError("enough")

    monkeypatch.setattr(study_player, "run_study", playing)
    live.step()
    monkeypatch.setattr(StudyJob, "highest_v", lambda self, rig: 1.25)
    number = live.do("request", "page", {})["number"]
    study = {"study": "reference study", "experiments": ["triangle"]}
    live.do("arm", "page", {"number": number, "limit_v": 1.25, "study": study})
    live.step()
    assert high == [(LIMIT_V, LIMIT_V), (1.25, 1.25)]
    assert live.state.high_v == 2.0, "the next run has the limits of the rig"
    assert "enough" in live.state.reason


def test_a_command_is_carried_out_before_the_next_block(tmp_path: Path) -> None:
    """Else a bench that is behind would read hundreds of blocks before it obeys."""
    twin = make_twin(twin_of_reading("hz"), 1)
    bench: Any = twin.acquisition
    read, entered, allowed = bench.read, threading.Event(), threading.Semaphore(0)

    def waiting() -> Any:
        entered.set()
        assert allowed.acquire(timeout=WAIT_S)
        return read()

    bench.read = waiting
    rig = guard(twin)
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer)
        stepping = threading.Thread(target=lambda: [live.step() for _ in range(2)])
        stepping.start()
        assert entered.wait(WAIT_S)
        command = threading.Thread(target=live.do, args=("disarm", "page", {}))
        command.start()
        while not live._turn.locked():
            time.sleep(1e-3)
        allowed.release()  # one block, and no other
        command.join(WAIT_S)
        assert not command.is_alive()
        allowed.release(100)  # also those of the end
        stepping.join(WAIT_S)
        live.close()


def test_a_folder_that_goes_while_a_study_is_played_trips_the_bench(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recorder raises this error when it looks how much space is left."""
    live, rig = bench

    def gone(*given: Any) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "out")

    monkeypatch.setattr(live._player, "play", gone)
    live.step()
    assert live.state.stage == "tripped" and live.state.mode == "idle"
    assert "The recording cannot be written (No such file" in live.state.reason
    assert rig.bench.requested_v == 0.0 and not rig.safety.live


def test_a_driver_that_fails_in_its_own_way_ends_the_study_and_not_the_panel(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, rig = bench

    def failing(*given: Any) -> None:
        raise ZeroDivisionError("float division by zero")

    monkeypatch.setattr(live._player, "play", failing)
    live.step()
    assert live.state.stage == "tripped" and live.state.mode == "idle"
    assert "float division by zero" in live.state.reason
    assert rig.bench.requested_v == 0.0 and not rig.safety.live


def test_a_picture_that_cannot_be_saved_ends_no_run(tmp_path: Path) -> None:
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer, picture=tmp_path / "full" / "camera.jpg")
        number = live.do("request", "page", {})["number"]
        live.do("arm", "page", {"number": number, "limit_v": 1.5})
        taken, take = [], rig.camera.take
        rig.camera.take = lambda: taken.append(take()) or taken[-1]  # type: ignore[method-assign]
        while not any(frames is not None and len(frames.time_s) for frames in taken):
            live.do("lease", "page", {})
            live.step()
        assert live.state.stage == "running" and live.state.mode == "drive"
        live.close()


@pytest.mark.parametrize("how", ["disarm", "stop"])
def test_what_led_to_zero_is_still_shown(tmp_path: Path, how: str) -> None:
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about, path = rig.description, tmp_path / "live"
    with LiveWriter(path, about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer)
        number = live.do("request", "page", {})["number"]
        live.do("arm", "page", {"number": number, "limit_v": 1.5})
        live.do("drive", "page", {"value_v": 1.0})
        while live.state.drive_v < 1.0:
            live.do("lease", "page", {})
            live.step()
        live.do("disarm", "page", {}) if how == "disarm" else live.stop("STOP was pressed")
        for _ in range(3):
            live.step()
        reader = LiveReader(path)
        drive_v = reader.signals(0.0, reader.end_s, 10_000).high[:, 0]
        assert math.isnan(reader.gap_s)
        assert drive_v[-1] == 0.0 and np.nanmax(drive_v) == pytest.approx(1.0)
        reader.close()
        live.close()


@pytest.mark.parametrize(
    ("range_f", "is_shown", "is_extrapolated"),
    [
        ((4e-10, 9.01e-10), True, False),
        ((4.96e-10, 9.01e-10), True, True),
        ((8e-10, 9.01e-10), False, False),
    ],
)
def test_no_strain_is_shown_where_no_loop_would_use_the_map(
    tmp_path: Path,
    actuator_file: Path,
    range_f: tuple[float, float],
    is_shown: bool,
    is_extrapolated: bool,
) -> None:
    """At 0 V, the capacitance of the twin is 4.5e-10 F."""
    loop = Actuator.load(actuator_file).loop()
    loop = replace(loop, strain_map=replace(loop.strain_map, range_f=range_f))
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about, path = rig.description, tmp_path / "live"
    with LiveWriter(path, about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer, lambda: loop)
        number = live.do("request", "page", {})["number"]
        live.do("arm", "page", {"number": number, "limit_v": 1.5})
        for _ in range(20):
            live.do("lease", "page", {})
            live.step()
        reader = LiveReader(path)
        _, _, capacitance_f, strain, _ = reader.signals(0.0, reader.end_s, 10_000).high[-1]
        reader.close()
        assert live.state.extrapolated is is_extrapolated
        live.close()
    low_f, high_f = loop.strain_map.usable_f
    assert bool(low_f <= capacitance_f <= high_f) is is_shown
    assert (not math.isnan(strain)) is is_shown


# Calls in which a bench can be while somebody presses STOP.
HANGING = [
    "reading the actuator file", "checking a study", "beginning a run", "starting the camera",
    "reading a block", "taking a frame",
]  # fmt: skip


@pytest.mark.parametrize("where", HANGING)
def test_stop_commands_zero_while_a_call_hangs_and_nothing_undoes_it(
    tmp_path: Path, call: HangingCall, where: str
) -> None:
    twin = make_twin(twin_of_reading("hz"), 1)
    bench: Any = twin.acquisition
    if where == "starting the camera":
        bench.start = call.of(bench.start)
    elif where == "reading a block":
        bench.read = call.of(bench.read)
    elif where == "taking a frame":
        bench.take = call.of(bench.take)
    rig = guard(twin)
    if where == "beginning a run":
        rig.begin = call.of(rig.begin)  # type: ignore[method-assign]
    read_loop = prepare = lambda *_: None
    if where == "reading the actuator file":
        read_loop = call.of(read_loop)
    elif where == "checking a study":
        prepare = call.of(prepare)
    about, refused = rig.description, []
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer, read_loop, tmp_path / "camera.jpg", prepare)

        def arm() -> None:
            study = {"study": {}} if where == "checking a study" else {}
            try:
                number = live.do("request", "page", {})["number"]
                live.do("arm", "page", {"number": number, "limit_v": 1.5, **study})
            except SafetyError as error:
                refused.append(str(error))

        driving = where in ("reading a block", "taking a frame")
        if driving:
            arm()
            live.do("drive", "page", {"value_v": 1.0})
            while rig.bench.requested_v < 0.5:
                live.step()
        call.hangs.set()
        job = threading.Thread(target=live.step if driving else arm)
        job.start()
        assert call.entered.wait(WAIT_S)
        live.stop("STOP was pressed")
        assert job.is_alive()
        assert rig.bench.requested_v == 0.0 and not rig.safety.live
        assert live.state.stage == "tripped"
        call.released.set()
        job.join(WAIT_S)
        live.step()
        assert rig.bench.requested_v == 0.0 and not rig.safety.live
        is_requested = where == "reading the actuator file"  # which the first step of arming does
        assert live.state.stage == ("requested" if is_requested else "tripped")
        assert live.state.mode == "idle"
        assert live.state.reason.startswith("STOP was pressed")
        assert driving or refused, "what was being armed is refused"
        live.close()


class DriverFaultError(Exception):
    """An exception of a driver that haselab does not know."""


def test_a_driver_that_fails_in_its_own_way_while_arming_leaves_zero(tmp_path: Path) -> None:
    twin = make_twin(twin_of_reading("hz"), 1)
    bench: Any = twin.acquisition

    def faulty(*_: object) -> None:
        raise DriverFaultError("a cable")

    bench.sine = faulty
    rig = guard(twin)
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer)
        number = live.do("request", "page", {})["number"]
        with pytest.raises(DriverFaultError, match="a cable"):
            live.do("arm", "page", {"number": number, "limit_v": 1.5})
        assert not rig.safety.live and live.state.mode == "idle"
        assert rig.bench.requested_v == 0.0
        live.close()


@pytest.mark.parametrize("what", ["read", "take"])
def test_a_call_that_stop_interrupts_in_its_own_way_does_not_end_the_panel(
    tmp_path: Path, what: str
) -> None:
    """Switching off changes the data that a call in another thread uses."""
    twin = make_twin(twin_of_reading("hz"), 1)
    bench: Any = twin.acquisition
    method, live_benches = getattr(bench, what), []

    def interrupted(*given: Any) -> Any:
        if live_benches:
            live_benches.pop().stop("STOP was pressed")
            raise ZeroDivisionError("float division by zero")
        return method(*given)

    setattr(bench, what, interrupted)
    rig = guard(twin)
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer, picture=tmp_path / "camera.jpg")
        number = live.do("request", "page", {})["number"]
        live.do("arm", "page", {"number": number, "limit_v": 1.5})
        live_benches.append(live)
        for _ in range(3):
            live.step()
        assert live.state.stage == "tripped" and live.state.mode == "idle"
        assert live.state.reason.startswith("STOP was pressed")
        assert rig.bench.requested_v == 0.0 and not rig.safety.live
        live.close()


def test_a_camera_of_the_twin_that_is_stopped_during_a_call_gives_no_frame() -> None:
    twin = make_twin(twin_of_reading("hz"), 1)
    bench: Any = twin.acquisition
    bench.start(5.0)
    for _ in range(30):
        bench.read()
    bench._frame_rate_hz = 0.0  # the first thing that `stop` does
    assert bench.take() is None


@pytest.mark.parametrize("limit", [-0.011, 0.006, 0.0130000049, 0.0129999951])
def test_a_strain_at_a_limit_as_the_page_shows_it_is_accepted(
    tmp_path: Path, actuator_file: Path, limit: float
) -> None:
    """The page shows percents with six digits, and divides what is typed by 100."""
    loop = Actuator.load(actuator_file).loop()
    saturation = replace(loop.saturation, low=min(limit, 0.0), high=max(limit, 0.0))
    loop = replace(loop, saturation=saturation)
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        live = LiveBench(rig, writer, lambda: loop)
        number = live.do("request", "page", {})["number"]
        live.do("arm", "page", {"number": number, "limit_v": 2.0})
        live.do("loop", "page", {"strain": float(f"{100.0 * limit:.6g}") / 100.0})
        reference = live.state.reference
        assert reference is not None and 0.0 <= reference / limit <= 1.0
        assert reference == pytest.approx(limit, rel=1e-5)
        with pytest.raises(LimitError, match="The desired strain is"):
            live.do("loop", "page", {"strain": 1.0001 * limit})
        live.close()


def test_a_limit_of_the_board_that_was_not_narrowed_keeps_its_source() -> None:
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    whole = rig.description.drive_limits
    rig.limit_drive(1.5, "the limit typed on the page")
    found = rig.description.drive_limits
    assert (found.low, found.high, found.low_source) == (0.0, 1.5, whole.low_source)
    assert found.high_source == "the limit typed on the page"
    rig.limit_drive(2.0, "the limit typed on the page")
    assert rig.description.drive_limits == rig.plain.description.drive_limits == whole


@pytest.mark.parametrize("is_there", [True, False])
def test_a_study_names_its_recording_only_if_it_is_still_there(
    tmp_path: Path, is_there: bool
) -> None:
    def play(*_: object) -> None:
        raise DeviceError("A disk.")

    if is_there:
        (tmp_path / "session.h5").touch()
    rig: Any = SimpleNamespace(safety=SimpleNamespace(live=False, record_with=lambda note: None))
    study = ArmedStudy(rig, PageLeases(1.0), cast(Any, SimpleNamespace(play=play)))
    job: Any = SimpleNamespace(options=SimpleNamespace(folder=tmp_path))
    said = study.play(job, None)
    assert said == "A disk." + f" The data recorded so far are in {tmp_path}." * is_there
