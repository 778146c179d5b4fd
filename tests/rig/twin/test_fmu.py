"""The twin as an FMU: in lock-step with the twin itself, in importers that others wrote."""

import ctypes
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

from haselab.base import InputError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.fmu import Fmu, twin_fmu
from haselab.rig.twin.twin_bench import TwinBench
from haselab.store.toml import validated

BLOCK_S = 0.01
CARRIER_V, CARRIER_HZ = 0.1, 2000.0
KINDS = ("planar-hasel", "peano-hasel", "curling-hasel", "dea-stack")
TRUTH = ("length_m", "output_v", "v_reading_v", "i_reading_v")


@dataclass
class Running:
    """An instance in FMPy, by the names of its variables."""

    fmu: FMU2Slave | FMU3Slave
    references: dict[str, int]
    version: str
    time_s: float = 0.0

    def set(self, **values: float) -> None:
        self.set_named(values)

    def set_named(self, values: dict[str, float]) -> None:
        references = [self.references[name] for name in values]
        if self.version == "3":
            self.fmu.setFloat64(references, list(values.values()))
        else:
            self.fmu.setReal(references, list(values.values()))

    def get(self, name: str) -> float:
        get = self.fmu.getFloat64 if self.version == "3" else self.fmu.getReal
        return float(get([self.references[name]])[0])

    def flag(self, name: str) -> bool:
        return bool(self.fmu.getBoolean([self.references[name]])[0])

    def begin(self, start_s: float = 0.0) -> None:
        self.time_s = start_s
        if self.version == "3":
            self.fmu.enterInitializationMode(startTime=start_s)
        else:
            self.fmu.setupExperiment(startTime=start_s)
            self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def step(self, step_s: float = BLOCK_S) -> None:
        self.fmu.doStep(self.time_s, step_s)
        self.time_s += step_s


@dataclass
class Unpacked:
    folder: Path
    version: str

    def instance(self) -> Running:
        about = fmpy.read_model_description(self.folder)
        model = FMU3Slave if self.version == "3" else FMU2Slave
        fmu = model(
            guid=about.guid, unzipDirectory=str(self.folder),
            modelIdentifier=about.coSimulation.modelIdentifier, instanceName="twin",
        )  # fmt: skip
        fmu.instantiate()
        references = {each.name: each.valueReference for each in about.modelVariables}
        return Running(fmu, references, self.version)


def write(folder: Path, fmu: Fmu) -> Path:
    path = folder / "twin.fmu"
    path.write_bytes(fmu.content)
    return path


def unpacked(folder: Path, config: TwinConfig, version: str = "3", seed: int = 1) -> Unpacked:
    path = write(folder, twin_fmu(config, version=version, seed=seed))  # type: ignore[arg-type]
    return Unpacked(Path(fmpy.extract(path, folder / "unpacked")), version)


@pytest.fixture(scope="module", params=["2", "3"])
def planar(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Unpacked:
    return unpacked(tmp_path_factory.mktemp("fmu"), TwinConfig(), request.param)


def drive(kind: str) -> list[float]:
    """Steps and ramps over the whole range of the twin of a kind."""
    high = {"planar-hasel": 1.6, "peano-hasel": 1.4, "curling-hasel": 1.4, "dea-stack": 0.4}[kind]
    ramp = np.linspace(0.0, high, 12)
    return [0.0, 0.0, 0.5 * high, *ramp.tolist(), high, high, 0.2 * high, 0.0, 0.0]


def bench_of(config: TwinConfig, seed: int = 1) -> TwinBench:
    bench = TwinBench(config, seed)
    bench.sine(CARRIER_HZ, CARRIER_V)
    return bench


def last_readings(config: TwinConfig, codes: np.ndarray) -> list[float]:
    return (codes[-1] * (2.0 * config.acquisition.range_v / 2**config.acquisition.bits)).tolist()


@pytest.mark.parametrize("version", ["2", "3"])
def test_the_file_is_valid_by_the_rules_of_the_standard(tmp_path: Path, version: str) -> None:
    path = write(tmp_path, twin_fmu(TwinConfig(), version=version))  # type: ignore[arg-type]
    assert validate_fmu(path) == []


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("version", ["2", "3"])
def test_it_moves_and_reads_as_the_twin_in_lock_step(
    tmp_path: Path, kind: str, version: str
) -> None:
    config = TwinConfig(kind=kind)
    bench = bench_of(config, seed=7)
    twin = unpacked(tmp_path, config, version, seed=7).instance()
    twin.set(carrier_v=CARRIER_V, carrier_hz=CARRIER_HZ)
    twin.begin()
    for drive_v in drive(kind):
        bench.write(drive_v)
        codes = bench.read()
        twin.set(drive_v=drive_v)
        twin.step()
        found = [twin.get(name) for name in TRUTH]
        assert found == [bench.length_m, bench.output_v, *last_readings(config, codes)]
        assert not twin.flag("breakdown")
    twin.fmu.terminate()
    twin.fmu.freeInstance()


def changed(value: float, low: float, high: float) -> float:
    candidates = (0.1 * value, 4.0 * value, 1e-3, 1e-10, 0.5 * high)
    inside = [x for x in candidates if low <= x <= high]
    return next(x for x in inside if x != value)


def with_value(config: TwinConfig, key: str, value: float) -> TwinConfig:
    data = config.model_dump()
    section, _, field = key.partition(".")
    name, _, index = field.partition("[")
    if index:
        values = list(data[section][name])
        values[int(index.rstrip("]"))] = value
        data[section][name] = values
    else:
        data[section][name] = value
    return validated(TwinConfig, data, "test")


# All of what no law has, so that each number matters; the second mass, which is slow, is apart.
BUSY = {
    "unmodelled": {
        "capacitance_rise": 0.1, "warming_s": 100.0, "stiffness_loss": 0.1, "ageing_s": 100.0,
        "begins_s": 10.0,
    },
    "hysteresis": {"force_n": 0.1},
    "dielectric": {"relaxation_share": 0.2},
    "amplifier": {
        "stray_f": 1e-10, "v_monitor_lag_s": 1e-5, "i_monitor_lag_s": 1e-5, "slew_v_per_s": 5e6,
        "current_limit_a": 1e-3,
    },
}  # fmt: skip


@pytest.mark.parametrize("second_mass", [False, True])
def test_every_parameter_acts_as_in_a_twin_file(tmp_path: Path, second_mass: bool) -> None:
    config = validated(TwinConfig, BUSY, "test")
    if second_mass:
        config = with_value(TwinConfig(), "unmodelled.resonance_mass_kg", 0.02)
    fmu = twin_fmu(config)
    extracted = Unpacked(Path(fmpy.extract(write(tmp_path, fmu), tmp_path / "unpacked")), "3")
    about = fmpy.read_model_description(extracted.folder)
    limits = {each.name: (float(each.min or -np.inf), float(each.max or np.inf))
              for each in about.modelVariables}  # fmt: skip
    plain = played(bench_of(config))
    tried, without_effect = 0, []
    for key, value in fmu.parameters.items():
        if key.startswith("unmodelled.resonance") != second_mass:
            continue
        other = changed(value, *limits[key])
        if key == BREAKDOWN:
            other = 0.5 * value  # does not break down yet
        twin = extracted.instance()
        twin.set_named({"carrier_v": CARRIER_V, "carrier_hz": CARRIER_HZ, key: other})
        twin.begin()
        expected = played(bench_of(with_value(config, key, other)))
        found = []
        for drive_v in SHORT:
            twin.set(drive_v=drive_v)
            twin.step()
            found.append([twin.get(name) for name in TRUTH])
        twin.fmu.freeInstance()
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=0.0, err_msg=key)
        tried += 1
        if expected == plain:
            without_effect.append(key)
    assert without_effect == ([] if second_mass else [BREAKDOWN]), "a mistake would not be seen"
    assert tried == 3 if second_mass else tried > 35


BREAKDOWN = "dielectric.breakdown_v_per_m"
SHORT = (0.0, 1.5, 1.5, 1.5, 0.3)


def played(bench: TwinBench) -> list[list[float]]:
    found = []
    for drive_v in SHORT:
        bench.write(drive_v)
        codes = bench.read()
        found.append([bench.length_m, bench.output_v,
                      *last_readings(bench._config, codes)])  # fmt: skip
    return found


def run(
    twin: Running, step_s: float, count: int, drive_at: Callable[[float], float]
) -> list[float]:
    for _ in range(count):
        twin.set(drive_v=drive_at(twin.time_s))
        twin.step(step_s)
    return [twin.get(name) for name in ("length_m", "speed_m_per_s", "output_v", "v_reading_v")]


def test_the_step_size_does_not_change_the_motion(planar: Unpacked) -> None:
    def drive_at(time_s: float) -> float:
        return 1.5 if 0.01999 < time_s < 0.05999 else 0.0

    found = []
    for step_s, count in ((0.02, 5), (0.01, 10), (0.001, 100), (1e-4, 1000)):
        twin = planar.instance()
        twin.set(carrier_v=CARRIER_V, carrier_hz=CARRIER_HZ)
        twin.begin(start_s=-3.0)
        found.append(run(twin, step_s, count, lambda t: drive_at(t + 3.0)))
        twin.fmu.freeInstance()
    # The time of about 122 s is a sum of up to 1000 steps, each rounded to 1.4e-14 s at most, and
    # with it the phase of a carrier of 500 V.
    late_v = 1000 * np.spacing(122.0) * 2.0 * np.pi * CARRIER_HZ * 5000.0 * CARRIER_V
    for other in found[1:]:
        np.testing.assert_allclose(other[:2], found[0][:2], rtol=1e-9)
        assert abs(other[2] - found[0][2]) < late_v
        assert abs(other[3] - found[0][3]) < 1.01 * 20.0 / 2**16  # one code


def test_steps_that_are_no_multiple_of_its_own_end_within_half_a_step(planar: Unpacked) -> None:
    twin = planar.instance()
    twin.begin()
    exact = planar.instance()
    exact.begin()
    for running, step_s, count in ((twin, 0.00033, 300), (exact, 0.0001, 990)):
        run(running, step_s, count, lambda t: 1.5 if t > 0.0495 else 0.0)
    assert twin.time_s == pytest.approx(exact.time_s)
    # Both had the step of the drive within a third of a millisecond of each other.
    apart_m = abs(twin.get("length_m") - exact.get("length_m"))
    assert apart_m < 0.00033 * abs(exact.get("speed_m_per_s")) * 2.0


@pytest.mark.parametrize("serialised", [False, True])
def test_a_restored_state_gives_the_same_bits_again(planar: Unpacked, serialised: bool) -> None:
    twin = planar.instance()
    twin.set(carrier_v=CARRIER_V)
    twin.begin()
    run(twin, 0.01, 5, lambda t: 1.2)
    twin.set(drive_v=0.4)  # set, not yet used
    capital = "FMUState" if planar.version == "3" else "FMUstate"
    state = getattr(twin.fmu, f"get{capital}")()
    then_s = twin.time_s
    if serialised:
        content = getattr(twin.fmu, f"serialize{capital}")(state)
        getattr(twin.fmu, f"free{capital}")(state)
        twin.fmu.freeInstance()
        twin = planar.instance()
        twin.begin()
        name = "deserialize" if planar.version == "3" else "deSerialize"
        state = getattr(twin.fmu, f"{name}{capital}")(content)
        getattr(twin.fmu, f"set{capital}")(state)
        twin.time_s = then_s
        first = run_on(twin)
        reference = planar.instance()
        reference.set(carrier_v=CARRIER_V)
        reference.begin()
        run(reference, 0.01, 5, lambda t: 1.2)
        reference.set(drive_v=0.4)
        assert run_on(reference) == first
        return
    first = run_on(twin)
    getattr(twin.fmu, f"set{capital}")(state)
    twin.time_s = then_s
    assert run_on(twin) == first


def run_on(twin: Running) -> list[float]:
    for _ in range(5):
        twin.step()
    return [twin.get(name) for name in (*TRUTH, "sensed_capacitance_f")]


def test_a_reset_instance_starts_anew(planar: Unpacked) -> None:
    twin = planar.instance()
    twin.set(carrier_v=CARRIER_V)
    twin.begin()
    first = run(twin, 0.01, 5, lambda t: 1.2)
    twin.fmu.reset()
    twin.set(carrier_v=CARRIER_V)
    twin.begin()
    assert run(twin, 0.01, 5, lambda t: 1.2) == first


def test_the_sensed_capacitance_is_the_true_one_within_its_noise(planar: Unpacked) -> None:
    """A quiet twin at rest: 1e-4 by the lock-in in single precision and the leakage."""
    twin = planar.instance()
    twin.set_named(
        {"carrier_v": CARRIER_V, "acquisition.v_noise_v": 0.0, "acquisition.i_noise_v": 0.0}
    )
    twin.begin()
    assert not twin.flag("sensed_valid")
    valid = []
    for k in range(400):
        twin.set(drive_v=1.0 if k > 10 else 0.0)
        twin.step()
        valid.append(twin.flag("sensed_valid"))
    assert all(valid[1:]), "the step of the drive leaves 8 ms of each block"
    assert twin.get("sensed_capacitance_f") == pytest.approx(twin.get("capacitance_f"), rel=1e-3)
    assert twin.get("sensed_resistance_ohm") == pytest.approx(5e3, rel=0.05)
    twin.set(carrier_v=0.0)
    twin.step()
    assert not twin.flag("sensed_valid")


def test_a_breakdown_is_an_output_and_leaves_0_v(tmp_path: Path) -> None:
    twin = unpacked(tmp_path, TwinConfig()).instance()
    twin.set_named({"dielectric.breakdown_v_per_m": 2e6})
    twin.begin()
    run(twin, 0.01, 20, lambda t: 2.0)
    assert twin.flag("breakdown")
    assert abs(twin.get("output_v")) < 1.0


@pytest.mark.parametrize(
    ("values", "step_s", "message"),
    [
        ({"drive_v": 2.5}, 0.01, "drive_v is 2.5 V, but the output gives 0 to 2 V."),
        ({"drive_v": float("nan")}, 0.01, "drive_v is nan V"),
        ({"carrier_v": 3.0}, 0.01, "The carrier is 3 V at 2000 Hz"),
        ({"carrier_hz": 1e6}, 0.01, "The carrier is 0 V at 1e+06 Hz"),
        ({"carrier_hz": -5.0}, 0.01, "at -5 Hz, but it must be within 0 to 1 V, and between 0 and"),
        ({"force_n": float("inf")}, 0.01, "force_n is inf N"),
        ({"force_n": 500.0}, 1.0, "The actuator left the lengths in which its law is valid"),
        ({}, -0.01, "a step that is not negative"),
        ({}, float("nan"), "a step that is not negative"),
    ],
)
def test_a_step_that_no_bench_can_make_is_an_error(
    planar: Unpacked,
    capsys: pytest.CaptureFixture[str],
    values: dict[str, float],
    step_s: float,
    message: str,
) -> None:
    twin = planar.instance()
    twin.begin()
    twin.step()
    twin.set_named(values)
    with pytest.raises(FMICallException, match="status 3"):
        twin.step(step_s)
    assert message in capsys.readouterr().out


def test_a_parameter_out_of_range_and_a_step_into_the_past_are_errors(planar: Unpacked) -> None:
    twin = planar.instance()
    with pytest.raises(FMICallException, match="status 3"):
        twin.set_named({"load.mass_kg": -1.0})
    twin.begin()
    twin.step()
    twin.step()
    with pytest.raises(FMICallException, match="status 3"):
        twin.set_named({"load.mass_kg": 0.3})
    twin.time_s = 0.0
    with pytest.raises(FMICallException, match="status 3"):
        twin.step()


def test_without_its_resources_no_instance_is_made(tmp_path: Path, planar: Unpacked) -> None:
    folder = tmp_path / "broken"
    shutil.copytree(planar.folder, folder)
    (folder / "resources" / "twin.bin").write_bytes(b"HASELFMU")
    with pytest.raises(Exception, match="instantiate"):
        Unpacked(folder, planar.version).instance()


def test_a_simulation_of_another_program_agrees(tmp_path: Path) -> None:
    """libcosim, an importer in C++ for FMI 2.0."""
    cosim = pytest.importorskip("libcosimpy.CosimExecution", reason="libcosimpy: pip install it")
    observers = pytest.importorskip("libcosimpy.CosimObserver")
    slaves = pytest.importorskip("libcosimpy.CosimSlave")
    manipulators = pytest.importorskip("libcosimpy.CosimManipulator")
    path = write(tmp_path, twin_fmu(TwinConfig(), version="2"))
    references = {
        each.name: each.valueReference for each in fmpy.read_model_description(path).modelVariables
    }
    execution = cosim.CosimExecution.from_step_size(step_size=int(1e9 * BLOCK_S))
    slave = execution.add_local_slave(slaves.CosimLocalSlave(fmu_path=str(path), instance_name="t"))
    observer = observers.CosimObserver.create_last_value()
    execution.add_observer(observer)
    manipulator = manipulators.CosimManipulator.create_override()
    execution.add_manipulator(manipulator)
    manipulator.slave_real_values(slave, [references["drive_v"]], [1.2])
    execution.step(step_count=30)
    found = observer.last_real_values(
        slave, [references[name] for name in ("length_m", "output_v")]
    )
    bench = TwinBench(TwinConfig(), 1)
    for _ in range(30):
        bench.write(1.2)
        bench.read()
    assert found == pytest.approx([bench.length_m, bench.output_v], rel=1e-9)


def test_the_same_twin_gives_the_same_bytes_and_a_large_seed_is_refused() -> None:
    assert twin_fmu(TwinConfig()).content == twin_fmu(TwinConfig()).content
    with pytest.raises(InputError, match="The seed is 2147483648, but an FMU takes 0 to"):
        twin_fmu(TwinConfig(), seed=2**31)


def test_calls_before_the_initialisation_or_after_it_are_errors(
    planar: Unpacked, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise they gave numbers: a strain of -1, or a mass that acted from the next get on."""

    def fails(message: str, call: Callable[[], object]) -> None:
        with pytest.raises(FMICallException, match="status 3"):
            call()
        assert message in capsys.readouterr().out

    twin = planar.instance()
    fails("An output was read before the initialisation.", lambda: twin.get("strain"))
    fails("A step was made before the initialisation.", twin.step)
    fails("The initialisation was not entered.", twin.fmu.exitInitializationMode)
    twin.begin()
    first_m = twin.get("length_m")
    fails("load.mass_kg was set during", lambda: twin.set_named({"load.mass_kg": 0.1}))
    fails("The simulation has been initialised before.", lambda: twin.begin(5.0))
    twin.time_s = 0.0
    twin.step()
    assert twin.get("load.mass_kg") == 0.25
    assert twin.get("length_m") == pytest.approx(first_m, rel=1e-4)
    for value in (np.inf, np.nan):
        fresh = planar.instance()
        fails(
            f"amplifier.slew_v_per_s is {value:g}. Set a finite number.",
            lambda x=value, t=fresh: t.set_named({"amplifier.slew_v_per_s": x}),
        )
    for name, value, limits in (
        ("load.mass_kg", -1.0, "above 0, at most 20"),
        ("amplifier.gain_error", 5.0, "within -0.5 to 0.5"),
    ):
        fails(
            f"{name} is {value:g}. Set it {limits}.",
            lambda n=name, x=value, t=fresh: t.set_named({n: x}),
        )


def test_a_step_after_the_end_is_an_error_until_a_reset(
    planar: Unpacked, capsys: pytest.CaptureFixture[str]
) -> None:
    twin = planar.instance()
    twin.begin()
    twin.step()
    found = twin.get("length_m")
    twin.fmu.terminate()
    with pytest.raises(FMICallException, match="status 3"):
        twin.step()
    assert "A step was made after the simulation was terminated." in capsys.readouterr().out
    assert twin.get("length_m") == found, "the last outputs can still be read"
    twin.fmu.reset()
    twin.time_s = 0.0
    twin.begin()
    twin.step()
    assert twin.get("length_m") == found


def test_the_largest_field_stays_when_no_time_passes(planar: Unpacked) -> None:
    twin = planar.instance()
    twin.begin()
    run(twin, BLOCK_S, 3, lambda t: 1.0)
    field = twin.get("field_v_per_m")
    assert field > 1e6
    for step_s in (0.0, 1e-6):
        twin.step(step_s)
        assert twin.get("field_v_per_m") == field


@pytest.mark.parametrize(
    ("limit", "ever_valid"),
    [({"slew_v_per_s": 8e6}, True), ({"slew_v_per_s": 2e6}, False),
     ({"current_limit_a": 2e-3}, False)],
)  # fmt: skip
def test_what_is_sensed_at_a_limit_of_the_amplifier_is_not_valid(
    tmp_path: Path, limit: dict[str, float], ever_valid: bool
) -> None:
    """The carrier of 500 V at 2 kHz needs 6.3e6 V/s and 3 mA; steps of 5 kV need more."""
    config = validated(TwinConfig, {"amplifier": limit}, "test")
    twin = unpacked(tmp_path, config).instance()
    twin.set(carrier_v=CARRIER_V, carrier_hz=CARRIER_HZ)
    twin.begin()
    valid = 0
    for k in range(12):
        twin.set(drive_v=(0.3, 1.3)[k % 2])
        capacitance = []
        for _ in range(100):
            twin.step(1e-4)
            capacitance.append(twin.get("capacitance_f"))
        if twin.flag("sensed_valid"):
            valid += 1
            # The mean over the window is within all that the capacitance was, and 1e-3.
            sensed = twin.get("sensed_capacitance_f")
            assert 0.999 * min(capacitance) < sensed < 1.001 * max(capacitance)
    assert (valid > 0) == ever_valid


def test_a_larger_gain_than_that_of_the_table_is_refused_with_negative_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = {"kind": "peano-hasel", "acquisition": {"drive_low_v": -1.4, "drive_high_v": 0.5}}
    extracted = unpacked(tmp_path, validated(TwinConfig, data, "test"))
    twin = extracted.instance()
    twin.begin()
    twin = extracted.instance()
    twin.set_named({"amplifier.gain": 5010.0})
    with pytest.raises(FMICallException, match="status 3"):
        twin.begin()
    assert "this FMU knows the actuator up to 12000 V" in capsys.readouterr().out


@pytest.mark.parametrize("version", ["2", "3"])
def test_the_folder_may_have_any_name(tmp_path: Path, version: str) -> None:
    folder = tmp_path / "mit Lücke 100%41#?"
    folder.mkdir()
    extracted = unpacked(folder, TwinConfig(), version)
    extracted.instance().fmu.freeInstance()


def test_a_path_that_is_no_uri_is_not_decoded(tmp_path: Path) -> None:
    folder = tmp_path / "100%41"
    folder.mkdir()
    extracted = unpacked(folder, TwinConfig(), "2").folder
    (path,) = (path for path in (extracted / "binaries").rglob("*") if path.is_file())
    library = ctypes.CDLL(str(path))
    library.fmi2Instantiate.restype = ctypes.c_void_p
    resources = str(extracted / "resources").encode()
    found = library.fmi2Instantiate(b"twin", 1, b"", resources, None, 0, 0)
    assert found is not None
    library.fmi2FreeInstance(ctypes.c_void_p(found))


def test_a_state_of_another_fmu_is_refused(tmp_path: Path, planar: Unpacked) -> None:
    capital = "FMUState" if planar.version == "3" else "FMUstate"
    name = "deserialize" if planar.version == "3" else "deSerialize"
    other = unpacked(tmp_path, TwinConfig(), planar.version, seed=2).instance()
    twin = planar.instance()
    state = getattr(other.fmu, f"get{capital}")()
    content = getattr(other.fmu, f"serialize{capital}")(state)
    for call in (
        lambda: getattr(twin.fmu, f"set{capital}")(state),
        lambda: getattr(twin.fmu, f"serialize{capital}")(state),
        lambda: getattr(twin.fmu, f"{name}{capital}")(content),
    ):
        with pytest.raises(FMICallException, match="status 3"):
            call()
