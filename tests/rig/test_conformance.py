"""What every back end promises its users: one suite, run on each of them."""

import functools
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from haselab.base import HaselabError, InputError, LimitError
from haselab.rig import ReportsOutput, ReportsOutputState, Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile, opened_chip
from haselab.rig.real_bench import RealBench
from haselab.rig.replay import ReplayBench
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.server import ServedTwin
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.gate import Gate
from haselab.testing.conformance import (
    BenchConformance,
    DaqConformance,
    GeneratorConformance,
    InstrumentConformance,
    SupplyConformance,
)
from haselab.testing.conformance.bench import CARRIER_HZ, CARRIER_V, carrier_v, drive_v, pass_queue

FRAME_RATE_HZ = 100.0


@dataclass(frozen=True)
class Bench:
    """A back end with two independent meters on it, and what its time is made of."""

    rig: Rig
    output_v: Callable[[], float]
    length_m: Callable[[], float]
    time_step_s: float


def twin(seed: int, opened: ExitStack) -> Bench:
    rig = make_twin(twin_of_reading("hz"), seed)
    step_s = 20 / rig.description.rate_hz  # mechanics go in steps of twenty samples
    return Bench(rig, lambda: rig.source.output_v, lambda: rig.source.length_m, step_s)


def wire(board: str, seed: int, opened: ExitStack) -> Bench:
    """The twin behind gRPC, SCPI and a serial port; nidaqmx, PyMeasure, pyserial before them.

    In lock-step: its time passes as it is asked for, so that a busy machine is never late.
    """
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    served = opened.enter_context(ServedTwin(twin_of_reading("hz"), seed, pace=0.0, board=board))
    data = tomllib.loads(served.rig_file(ahead_blocks=1 + seed % 2))
    data["daq"]["server_patience_s"] = 30.0  # a busy machine is no fault
    config = BenchConfig.model_validate(data)
    bench = opened.enter_context(RealBench(config, gate := Gate()))
    gate.permit(gate.interlock.revision)
    rig = bench.rig
    return Bench(
        rig, lambda: served.hub.output_v, lambda: served.hub.length_m, rig.description.block_s
    )


def chip(seed: int, opened: ExitStack) -> Bench:
    """The microcontroller in co-simulation: it finds its output itself, and accepts only 0 V."""
    data = Path(__file__).resolve().parents[1] / "firmware" / "data"
    file = ChipFile.model_validate({"kind": "chip", "run": str(data), "simulator": {"seed": seed}})
    try:
        rig = opened.enter_context(opened_chip(file, data / "chip.toml", gate := Gate())).rig
        gate.permit(gate.interlock.revision)
    except InputError as error:
        pytest.skip(str(error))
    return Bench(rig, lambda: 0.0, lambda: 0.0, 125e-6)


BACK_ENDS = {"twin": twin} | {
    f"wire to {board}": functools.partial(wire, board) for board in DEVICES
}


@pytest.fixture(params=[*BACK_ENDS, "chip", "replay"])
def any_bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    """Also a replay and a chip, for promises that need no output that can be asked for."""
    with ExitStack() as opened:
        if request.param == "replay":
            path = request.getfixturevalue("recording")
            rig = opened.enter_context(ReplayBench(path)).rig
            yield Bench(rig, lambda: 0.0, lambda: 0.0, rig.description.block_s)
        elif request.param == "chip":
            yield chip(1, opened)
        else:
            yield BACK_ENDS[request.param](1, opened)


@pytest.fixture(params=list(BACK_ENDS))
def make(request: pytest.FixtureRequest) -> Iterator[Callable[..., Bench]]:
    with ExitStack() as opened:
        yield lambda seed=1: BACK_ENDS[request.param](seed, opened)


@pytest.fixture
def bench(make: Callable[..., Bench]) -> Bench:
    return make()


class TestBackEnds(BenchConformance):
    """The promises that a driver's own tests can check too, on every back end of this package."""

    @pytest.fixture
    def rig(self, bench: Bench) -> Rig:
        return bench.rig


@pytest.fixture(scope="module")
def served_twin() -> Iterator[ServedTwin]:
    """A served twin, whose instruments the registry opens one by one."""
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served:
        yield served


@pytest.fixture(scope="module")
def served_file(served_twin: ServedTwin, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its rig file."""
    path = tmp_path_factory.mktemp("served") / "rig.toml"
    path.write_text(served_twin.rig_file())
    return path


class TestServedSupply(SupplyConformance):
    # One twin serves all these tests; instruments/test_supply_traps.py has one that stays on.
    test_an_output_that_stays_on_is_not_reported_as_off = None  # type: ignore[assignment]

    @pytest.fixture
    def rig_file(self, served_file: Path) -> Path:
        return served_file


class TestServedGenerator(GeneratorConformance):
    # instruments/test_generator_traps.py has one that stays on.
    test_an_output_that_stays_on_is_not_reported_as_off = None  # type: ignore[assignment]

    @pytest.fixture
    def rig_file(self, served_file: Path) -> Path:
        return served_file


class TestServedBoard(DaqConformance):
    @pytest.fixture
    def rig_file(self, served_file: Path) -> Path:
        return served_file

    @pytest.fixture
    def output_v(self, served_twin: ServedTwin) -> Callable[[], float]:
        return lambda: float(served_twin.hub.output_v)


class TestServedCamera(InstrumentConformance):
    section = "camera"

    @pytest.fixture
    def rig_file(self, served_file: Path) -> Path:
        return served_file


# ---- drive output ---------------------------------------------------------------------------


@pytest.mark.parametrize("pending", [False, True])
def test_zero_is_0_v_at_once_and_stays_so(bench, pending):
    bench.rig.source.write(1.0)
    bench.rig.acquisition.read()
    pass_queue(bench.rig)
    if pending:
        bench.rig.source.write(2.0)
    assert bench.output_v() == pytest.approx(1.0 * bench.rig.description.amplifier_gain, rel=0.01)
    bench.rig.source.zero()
    assert bench.output_v() == pytest.approx(0.0, abs=1e-6)
    assert np.abs(drive_v(bench.rig, 3)).max() < 0.01
    bench.rig.source.zero()
    assert bench.output_v() == pytest.approx(0.0, abs=1e-6)


def test_safe_ends_drive_carrier_and_camera(bench):
    bench.rig.generator.sine(CARRIER_HZ, CARRIER_V)
    bench.rig.camera.start(FRAME_RATE_HZ)
    bench.rig.source.write(1.0)
    for _ in range(5):
        bench.rig.acquisition.read()
    bench.rig.safe()
    bench.rig.acquisition.read()
    assert bench.output_v() == pytest.approx(0.0, abs=1e-6)
    assert carrier_v(bench.rig) < 0.05 * CARRIER_V
    assert bench.rig.camera.take() is None
    bench.rig.safe()


@pytest.mark.parametrize("make", [name for name in BACK_ENDS if "wire" in name], indirect=True)
def test_a_reported_output_is_the_true_one(bench):
    source, generator = bench.rig.source, bench.rig.generator
    assert isinstance(source, ReportsOutput)
    assert isinstance(generator, ReportsOutputState)
    source.write(1.0)
    assert source.read_back() == pytest.approx(1.0, rel=0.01)
    generator.sine(CARRIER_HZ, CARRIER_V)
    assert not generator.is_off()
    bench.rig.safe()
    assert source.read_back() == pytest.approx(0.0, abs=0.01)
    assert generator.is_off()


# ---- acquisition ----------------------------------------------------------------------------


def test_a_block_has_its_shape_and_the_clock_advances_by_it(any_bench):
    d = any_bench.rig.description
    any_bench.rig.acquisition.read()  # may pass blocks over while the output is started
    start_s = any_bench.rig.acquisition.time_s
    for count in range(1, 21):
        codes = any_bench.rig.acquisition.read()
        assert codes.shape == (d.block_samples, 2)
        assert codes.dtype == np.int16
        # A clock in seconds that sums up blocks may round once a block.
        slack_s = 2.0 * count * np.spacing(start_s + 1.0)
        assert any_bench.rig.acquisition.time_s - start_s == pytest.approx(
            count * d.block_s, rel=0, abs=slack_s
        )


# ---- sensing signal -------------------------------------------------------------------------


# ---- camera ---------------------------------------------------------------------------------


def test_there_are_no_frames_before_start_and_after_stop(any_bench):
    any_bench.rig.acquisition.read()
    assert any_bench.rig.camera.take() is None
    any_bench.rig.camera.start(FRAME_RATE_HZ)
    any_bench.rig.camera.stop()
    any_bench.rig.acquisition.read()
    assert any_bench.rig.camera.take() is None


def test_frames_neither_skip_nor_repeat_however_they_are_taken(bench):
    rig = bench.rig
    rng = np.random.default_rng(7)
    rig.camera.start(FRAME_RATE_HZ)
    start_s = rig.acquisition.time_s
    times = []
    for _ in range(12):
        for _ in range(int(rng.integers(0, 9))):
            rig.acquisition.read()
        frames = rig.camera.take()
        if frames is not None:
            assert frames.images.dtype == np.uint8
            assert len(frames.images) == len(frames.time_s) > 0
            assert frames.time_s[-1] <= rig.acquisition.time_s
            times.append(frames.time_s)
    time_s = np.concatenate(times)
    period_s = 1.0 / FRAME_RATE_HZ
    assert start_s <= time_s[0] <= start_s + period_s
    np.testing.assert_allclose(np.diff(time_s), period_s, atol=1e-3 * period_s)
    assert rig.acquisition.time_s - time_s[-1] < 2.0 * period_s


def test_frames_go_on_while_the_stand_is_at_work_and_at_zero(bench):
    rig = bench.rig
    rig.camera.start(FRAME_RATE_HZ)
    start_s = rig.acquisition.time_s
    rig.stand.wait(0.1234)
    rig.stand.lift()
    rig.source.zero()
    rig.acquisition.read()
    rig.source.zero()
    rig.stand.wait(0.05)
    frames = rig.camera.take()
    elapsed_s = rig.acquisition.time_s - start_s
    np.testing.assert_allclose(np.diff(frames.time_s), 1.0 / FRAME_RATE_HZ, atol=1e-5)
    # Each frame whose exposure has ended is there; at most the one under way is not.
    assert elapsed_s * FRAME_RATE_HZ - 1.0 <= len(frames.time_s) <= elapsed_s * FRAME_RATE_HZ + 1.0


def test_a_second_start_takes_frames_from_then_on(bench):
    rig = bench.rig
    rig.camera.start(FRAME_RATE_HZ)
    rig.stand.wait(0.1)
    rig.camera.stop()
    rig.stand.wait(1.0)
    rig.camera.start(FRAME_RATE_HZ)
    start_s = rig.acquisition.time_s
    rig.stand.wait(0.1)
    frames = rig.camera.take()
    assert frames.time_s[0] >= start_s
    assert frames.time_s[-1] <= rig.acquisition.time_s


def test_a_frame_rate_that_cannot_be_is_refused(any_bench):
    for rate_hz in (0.0, -1.0, 1e9, float("nan")):
        with pytest.raises(LimitError, match=r"The frame rate is .*"):
            any_bench.rig.camera.start(rate_hz)


# ---- stand ----------------------------------------------------------------------------------


def test_the_stand_moves_the_length_the_right_way(bench):
    stand = bench.rig.stand

    def after(action: Callable[[], None]) -> float:
        action()
        stand.wait(20.0)
        return bench.length_m()

    light_m = after(lambda: stand.hang(0.1))
    heavy_m = after(lambda: stand.hang(0.5))
    lifted_m = after(stand.lift)
    dropped_m = after(stand.drop)
    assert lifted_m < light_m < heavy_m
    # Lifting and dropping leaves the weight that hung there; creep of 20 s remains.
    assert dropped_m == pytest.approx(heavy_m, rel=0.01)


def test_voltage_lengthens_also_while_time_passes_without_reading(bench):
    rest_m = bench.length_m()
    bench.rig.source.write(1.5)
    bench.rig.stand.wait(5.0)
    driven_m = bench.length_m()
    bench.rig.source.zero()
    bench.rig.stand.wait(20.0)
    assert driven_m > 1.01 * rest_m
    # Virgin elastomer softens for good (Mullins) and creeps: most of the way back, not all.
    assert bench.length_m() - rest_m < 0.5 * (driven_m - rest_m)


def test_waiting_takes_its_time(bench):
    start_s = bench.rig.acquisition.time_s
    bench.rig.stand.wait(0.25)
    assert bench.rig.acquisition.time_s - start_s == pytest.approx(0.25, abs=bench.time_step_s)


def test_a_mass_or_a_time_that_cannot_be_is_refused(any_bench):
    stand = any_bench.rig.stand
    before = (any_bench.length_m(), any_bench.rig.acquisition.time_s)
    for action in (stand.hang, stand.wait):
        for value in (-1.0, float("nan"), float("inf")):
            with pytest.raises(LimitError, match=r"must be within \[0, "):
                action(value)
    assert (any_bench.length_m(), any_bench.rig.acquisition.time_s) == before


# ---- repeatability --------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bits_in_blocks_and_frames(make):
    def session(seed: int) -> tuple[np.ndarray, np.ndarray]:
        rig = make(seed).rig
        rig.generator.sine(CARRIER_HZ, CARRIER_V)
        rig.camera.start(FRAME_RATE_HZ)
        rig.source.write(1.0)
        codes = np.stack([rig.acquisition.read() for _ in range(10)])
        frames = rig.camera.take()
        assert frames is not None
        return codes, frames.images

    first, again, other = session(3), session(3), session(4)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)
    for one, two in zip(first, other, strict=True):
        assert (one != two).mean() > 0.2


def test_every_refusal_is_an_error_of_the_house(any_bench):
    for act in (
        lambda: any_bench.rig.source.write(99.0),
        lambda: any_bench.rig.generator.sine(-1.0, 0.02),
        lambda: any_bench.rig.camera.start(-1.0),
        lambda: any_bench.rig.stand.hang(-1.0),
    ):
        with pytest.raises(HaselabError, match=r"outside|must be within") as caught:
            act()
        assert caught.value.exit_code == 2
