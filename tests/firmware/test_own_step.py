"""A controller of one's own in C: the numbers of its Python step, within the firmware's limits."""

from __future__ import annotations

import ctypes
import importlib.util
import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.controllers import ControllerSetting, Measurement
from haselab.firmware import (
    ChipSettings,
    ControllerStep,
    FrontEnd,
    settings_crc,
    settings_from_dict,
    settings_header,
)
from haselab.firmware.messages import Fault, KeepAlive, Run, State, Status
from haselab.rig.chip import CoSim, build_firmware, read_design, source_folder
from haselab.rig.twin.twin_bench import TwinBench
from haselab.store.actuator_file import read_run, write_sections
from haselab.study.chip.trials import Chip

ROOT = source_folder()
DATA = Path(__file__).resolve().parent / "data"
EXAMPLE = ROOT / "examples/plugins/haselab-mycontroller/src/haselab_mycontroller"
C_FILE = EXAMPLE / "mycontroller.c"
PARAMETERS = (("gain_per_s", 2.0), ("smoothing_s", 0.05))
STEP = ControllerStep("mycontroller", PARAMETERS, C_FILE.read_text())
WILD = """#include "hs_controller.h"
void hs_controller_init(const hs_controller_setting *setting, hs_controller_state *state)
{
    state->x[0] = setting->u_start;
}
float hs_controller_step(const hs_controller_setting *setting, hs_controller_state *state,
                         float reference, const hs_measurement *measurement)
{
    (void)setting; (void)state; (void)reference; (void)measurement;
    BODY
}
"""


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("mycontroller_example", EXAMPLE / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Setting(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in ("period_s", "u_low", "u_high", "u_start")] + [
        ("parameter", ctypes.c_float * 8)
    ]  # fmt: skip


class Seen(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in ("strain", "capacitance_f", "voltage_v")] + [
        ("update", ctypes.c_uint32), ("valid", ctypes.c_uint8),
    ]  # fmt: skip


def test_the_c_step_of_the_example_is_its_python_step_in_single_precision(
    example: ModuleType, tmp_path: Path
) -> None:
    library = tmp_path / "own.so"
    subprocess.run(
        ["cc", "-std=c99", "-ffp-contract=off", "-shared", "-fPIC", "-Wall", "-Wextra",
         "-Wconversion", "-Wdouble-promotion", "-Werror", f"-I{ROOT / 'core/include'}",
         str(C_FILE), "-o", str(library)], check=True,
    )  # fmt: skip
    own = ctypes.CDLL(str(library))
    own.hs_controller_step.restype = ctypes.c_float
    own.hs_controller_step.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_float,
                                       ctypes.c_void_p]  # fmt: skip
    setting = Setting(1e-3, -0.05, 0.1, -0.05, (ctypes.c_float * 8)(2.0, 0.05))
    state = (ctypes.c_float * 16)()
    own.hs_controller_init(ctypes.byref(setting), state)
    controller = example.KIND.choose(dict(PARAMETERS)).make()
    controller.start(ControllerSetting(1e-3, -0.05, 0.1, -0.05))
    rng = np.random.default_rng(3)
    for k, strain in enumerate(rng.uniform(-0.05, 0.1, 2000)):
        reference, valid = (0.05 if k < 1000 else 0.0), k % 7 != 0
        seen = Seen(strain, 6e-10, 1.0, k, valid)
        ours = own.hs_controller_step(
            ctypes.byref(setting), state, reference, ctypes.byref(seen)
        )  # fmt: skip
        theirs = controller.step(
            reference, Measurement(float(strain), 6e-10, 1.0, 1e-3 * k, valid)
        )  # fmt: skip
        # 2000 additions of numbers below 0.15, each rounded by at most 2^-25 of it.
        assert abs(ours - theirs) < 2 * 2000 * 0.15 * 2.0**-24


def test_the_example_is_as_short_as_the_page_says() -> None:
    assert len((EXAMPLE / "__init__.py").read_text().splitlines()) <= 40
    assert len(C_FILE.read_text().splitlines()) <= 60


def test_parameters_and_source_are_in_the_settings_and_their_checksum(
    settings: ChipSettings,
) -> None:
    own = replace(settings, own=STEP)
    text = settings_header(own)
    assert re.search(r"\.controller\.own\.parameter = \{2\.e\+00f, 5\.e-02f\},", text)
    assert ".own.pid" not in text
    others = [
        replace(STEP, parameters=(("gain_per_s", 2.5), ("smoothing_s", 0.05))),
        replace(STEP, source=STEP.source + "\n"),
    ]
    crc = {settings_crc(replace(settings, own=other)) for other in [*others, STEP, None]}
    assert len(crc) == 4


def test_a_recording_holds_source_and_parameters(settings: ChipSettings) -> None:
    chip = Chip(replace(settings, own=STEP), 0.05)
    assert Chip.from_dict(chip.to_dict()).settings == chip.settings
    assert settings_from_dict(chip.to_dict()["settings"]).own == STEP


def actuator_file(folder: Path, alternative: str) -> Path:
    """The actuator file of the tests' run, with one more controller."""
    path = folder / "actuator.toml"
    write_sections(path, read_run(DATA))
    held = path.read_text()
    path.write_text(f"{held}\n[[controller.alternatives]]\n{alternative}" if alternative else held)
    return path


def test_a_pi_of_the_file_gives_its_gains(tmp_path: Path) -> None:
    path = tmp_path / "actuator.toml"
    write_sections(path, read_run(DATA))
    pi = {"kind": "pi", "parameters": {"kp": 0.25, "ki": 2.0}}
    write_sections(path, {"controller": {**read_run(DATA)["controller"], "alternatives": [pi]}})
    found = read_design(path, "pi", FrontEnd()).settings
    assert (found.kp, found.ki, found.kd, found.own) == (0.25, 2.0, 0.0, None)


def test_a_c_file_gets_the_numbers_of_the_section_in_their_order(tmp_path: Path) -> None:
    path = actuator_file(tmp_path, 'kind = "nobody-has-it"\nparameters = {b = 3, a = 0.5}\n')
    found = read_design(path, "nobody-has-it", FrontEnd(), C_FILE).settings
    assert found.own == ControllerStep(
        "nobody-has-it", (("b", 3.0), ("a", 0.5)), C_FILE.read_text()
    )
    primary = read_design(path, "pid", FrontEnd()).settings
    assert (found.strain_low, found.strain_high) == (primary.strain_low, primary.strain_high)


def test_a_c_file_gets_the_gains_of_a_registered_kind_that_is_named(tmp_path: Path) -> None:
    path = actuator_file(tmp_path, "")
    found = read_design(path, "pid", FrontEnd(), C_FILE).settings
    gains = read_design(path, "pid", FrontEnd()).settings
    assert found.own is not None
    assert dict(found.own.parameters)["kp"] == gains.kp
    assert [name for name, _ in found.own.parameters] == ["kp", "ki", "kd", "derivative_filter_s"]


def test_the_name_of_the_c_file_is_the_kind_where_none_is_given(tmp_path: Path) -> None:
    path = actuator_file(tmp_path, 'kind = "mycontroller"\nparameters = {gain_per_s = 3.0}\n')
    found = read_design(path, None, FrontEnd(), C_FILE).settings
    assert found.own == ControllerStep("mycontroller", (("gain_per_s", 3.0),), C_FILE.read_text())


@pytest.mark.parametrize(
    ("alternative", "kind", "source", "said"),
    [
        ("", "own", None, r"no controller of kind 'own', only pid, pi"),
        ('kind = "open-loop"', "open-loop", None, "'open-loop' has no C step"),
        ('kind = "lqr"', "lqr", None, "No controller 'lqr' is registered"),
        ('kind = "lqr"\nparameters = {gain = "much"}', "lqr", C_FILE, "number"),
        ("", None, DATA / "model.json", r"does not define hs_controller_init\(\)"),
        ("", "pid", DATA / "none.c", "none.c"),
        ("", "lqr", C_FILE, "no controller of kind 'lqr'"),
        ('kind = "lqr"\n' + "\n".join(f"parameters.p{k} = 1" for k in range(9)), "lqr", C_FILE,
         "has 9 parameters; the firmware passes at most 8"),
    ],
)  # fmt: skip
def test_what_cannot_be_built_is_refused_in_one_line(
    tmp_path: Path, alternative: str, kind: str | None, source: Path | None, said: str
) -> None:
    path = actuator_file(tmp_path, alternative)
    with pytest.raises(InputError, match=said):
        read_design(path, kind, FrontEnd(), source)


def test_without_a_section_the_c_file_gives_the_kind(tmp_path: Path) -> None:
    path = actuator_file(tmp_path, "")
    found = read_design(path, None, FrontEnd(), C_FILE).settings
    assert found.own == ControllerStep("mycontroller", (), C_FILE.read_text())


def test_a_fault_in_the_c_file_is_reported_with_its_line(
    settings: ChipSettings, firmware: object, tmp_path: Path
) -> None:
    wrong = ControllerStep("wrong", (), WILD.replace("BODY", "return missing;"))
    with pytest.raises(ResultError, match=r"controller\.c:\d+:\d+: error: .*missing"):
        build_firmware(replace(settings, own=wrong), tmp_path)


@pytest.fixture
def wild(
    request: pytest.FixtureRequest,
    settings: ChipSettings,
    cosim_program: Path,
    twin: TwinBench,
    tmp_path: Path,
) -> Iterator[CoSim]:
    """A chip with a controller that does something that it should not."""
    step = ControllerStep("wild", (), WILD.replace("BODY", request.param))
    try:
        built = build_firmware(replace(settings, own=step), tmp_path)
    except InputError as error:
        pytest.skip(str(error))
    with CoSim(cosim_program, built.elf, twin) as chip:
        chip.run(0.02)
        chip.arm()
        chip.execute(Run(0.03))
        for _ in range(4):
            chip.query(KeepAlive(), 0.05)  # no answer from one that hangs
        yield chip


def last_status(chip: CoSim) -> Status:
    return next(m for m in reversed(chip.messages) if isinstance(m, Status))


@pytest.mark.parametrize("wild", ["volatile float x = 0.0f; return x / x;"], indirect=True)
def test_a_drive_that_is_not_a_number_trips_at_0_v(wild: CoSim) -> None:
    assert (last_status(wild).state, last_status(wild).fault) == (State.TRIPPED, Fault.NOT_FINITE)
    assert not wild.outputs[-1].on


@pytest.mark.parametrize("wild", ["return 1e6f;"], indirect=True)
def test_the_drive_stays_within_the_table_and_its_rate(wild: CoSim, settings: ChipSettings) -> None:
    assert last_status(wild).state == State.RUNNING
    codes = np.array([out.code for out in wild.outputs])
    per_v = 4096 / 2.048
    assert codes.max() <= settings.table_v[-1] * per_v
    assert np.diff(codes).max() <= settings.rise_v_per_s * 1e-3 * per_v + 1


@pytest.mark.parametrize("wild", ["for (;;) { measurement = 0; }"], indirect=True)
def test_an_endless_controller_ends_at_0_v(wild: CoSim) -> None:
    assert not wild.outputs[-1].on
    assert wild.outputs[-1].code == 0
