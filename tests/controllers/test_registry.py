"""Kinds of controllers: declared parameters, built-in kinds, and kinds of other packages."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from haselab import _core
from haselab.base import InputError
from haselab.cli.doctor.extensions import extension_findings
from haselab.controllers import (
    CONTROLLERS,
    ChosenController,
    ControllerKind,
    ControllerSetting,
    Measurement,
    OpenLoop,
    Parameter,
    chosen_controller,
    pid_controller,
)
from haselab.store.toml import toml_text

SETTING = ControllerSetting(0.01, -0.05, 0.1, 0.02)
SEEN = Measurement(0.01, 6e-10, 1.5, 3.0)
FOREIGN = ControllerKind("foreign", OpenLoop, (Parameter("rate", "1/s", None, 0.0, 10.0),))
NAMELESS = 3
FAR_AHEAD = ControllerKind("foreign", OpenLoop, preview_s=1e9)
WORDS_AHEAD = ControllerKind("foreign", OpenLoop, preview_s=cast(float, "0.1"))
NAMES_ONLY = ControllerKind("foreign", OpenLoop, cast(tuple[Parameter, ...], ("gain",)))


class TheirPoint(EntryPoint):
    dist = SimpleNamespace(name="theirs", version="1.0")


@pytest.fixture
def installed(monkeypatch):
    """Packages of other people, as importlib.metadata shows them."""

    def install(**points: str) -> None:
        found = [TheirPoint(name, value, CONTROLLERS.group) for name, value in points.items()]
        monkeypatch.setattr(CONTROLLERS, "others", lambda: found)

    return install


def test_the_built_in_pid_gives_the_core_s_bits():
    controller = pid_controller(0.85, 1.5, 0.15, 0.02).make()
    controller.start(SETTING)
    core = _core.Pid(0.85, 1.5, 0.15, 0.01, 0.02, -0.05, 0.1)
    core.reset(0.02)
    rng = np.random.default_rng(1)
    for strain in rng.normal(0.0, 0.05, 200):
        measured = replace(SEEN, strain=float(strain))
        assert controller.step(0.04, measured) == core.step(0.04, float(strain))


def test_a_lost_measurement_leaves_the_pid_as_it_is():
    through, gap = (pid_controller(0.5, 2.0).make() for _ in range(2))
    for controller in (through, gap):
        controller.start(SETTING)
        controller.step(0.04, SEEN)
    gap.step(0.04, replace(SEEN, strain=0.9, valid=False))
    assert gap.step(0.04, SEEN) == through.step(0.04, SEEN)


def test_open_loop_puts_out_the_reference():
    controller = chosen_controller({"kind": "open-loop"}).make()
    controller.start(SETTING)
    assert controller.step(0.037, SEEN) == 0.037


def test_a_section_survives_its_way_through_toml():
    chosen = pid_controller(0.85, 1.5, 0.1, 0.02)
    text = toml_text({"controller": chosen.table()})
    assert chosen_controller(tomllib.loads(text)["controller"]) == chosen


def test_what_a_design_writes_beside_the_parameters_is_none_of_them():
    table = {"kind": "pi", "parameters": {"kp": 1.0, "ki": 2.0}, "margins": {"gain_db": 9.0}}
    assert chosen_controller(table) == chosen_controller({"kind": "pi", "kp": 1.0, "ki": 2.0})


def test_the_summary_has_kind_values_and_units():
    assert chosen_controller({"kind": "pi", "kp": 0.85, "ki": 1.5}).summary() == (
        "pi, kp = 0.85, ki = 1.5 1/s"
    )


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"kp": 1.0}, r"has no kind\. Set kind to one of: open-loop, pi, pid"),
        ({"kind": 3}, r"has no kind"),
        ({"kind": "lqr"}, r"No controller 'lqr' is registered\. Use one of open-loop, pi"),
        ({"kind": "pi", "kp": 1.0}, r"ki \(1/s\) is missing"),
        ({"kind": "pi", "kp": -1.0, "ki": 2.0}, r"kp = -1 is outside 0 to 1e\+09"),
        ({"kind": "pi", "kp": math.nan, "ki": 2.0}, r"kp = nan is outside"),
        ({"kind": "pi", "kp": True, "ki": "2"}, r"kp = True is not a number; ki = '2' is not"),
        ({"kind": "pi", "kp": 1.0, "ki": 2.0, "kd": 0.1},
         r"kd is not a parameter; the parameters are kp, ki"),
        ({"kind": "open-loop", "kp": 1.0}, r"the parameters are none"),
    ],
)  # fmt: skip
def test_a_wrong_section_is_refused_in_one_line(table, said):
    with pytest.raises(InputError, match=said) as refused:
        chosen_controller(table, "study.toml")
    assert "\n" not in str(refused.value)


def test_a_kind_of_another_package_is_found_by_its_entry_point(installed):
    installed(foreign=f"{__name__}:FOREIGN")
    assert "foreign" in CONTROLLERS.packages()
    chosen = chosen_controller({"kind": "foreign", "rate": 2})
    assert chosen == ChosenController(FOREIGN, (("rate", 2.0),))


def test_a_package_that_does_not_import_is_named_only_when_it_is_asked_for(installed):
    installed(broken="no_such_module_at_all:KIND")
    assert CONTROLLERS.find("pid").name == "pid"
    with pytest.raises(InputError, match=r"'broken' of package theirs 1\.0 \(no_such_.*NotFound"):
        CONTROLLERS.find("broken")


def test_doctor_names_what_loads_and_what_does_not(installed):
    installed(broken="no_such_module_at_all:KIND", foreign=f"{__name__}:FOREIGN")
    broken, foreign = extension_findings()
    assert (broken.name, broken.found, broken.advice) == (
        "broken",
        False,
        "Fix or uninstall the package.",
    )
    assert "it does not load (ModuleNotFoundError: No module" in broken.detail
    assert foreign.found
    assert foreign.detail.endswith("; no C step; parameters: rate")


def test_an_entry_point_that_is_no_kind_is_refused(installed):
    installed(nameless=f"{__name__}:NAMELESS", other=f"{__name__}:FOREIGN")
    with pytest.raises(InputError, match=r"'nameless'.* it is of the type 'int', not a Contr"):
        CONTROLLERS.find("nameless")
    with pytest.raises(InputError, match=r"controller 'other' .*its name is 'foreign'"):
        CONTROLLERS.find("other")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("FAR_AHEAD", r"its preview_s is 1000000000\.0, but must be 0 to 60"),
        ("WORDS_AHEAD", "its preview_s is '0.1', but must be 0 to 60"),
        ("NAMES_ONLY", "its parameters are not a tuple of Parameter"),
    ],
)
def test_attributes_of_a_kind_with_wrong_values_are_refused(installed, name, said):
    installed(foreign=f"{__name__}:{name}")
    with pytest.raises(InputError, match=said):
        CONTROLLERS.find("foreign")


def test_a_built_in_name_cannot_be_taken(installed):
    installed(pid=f"{__name__}:FOREIGN")
    with pytest.raises(InputError, match=r"'pid' is .* more than once, by haselab and theirs 1\.0"):
        CONTROLLERS.find("pid")


def test_a_parameter_takes_numbers_of_numpy_and_no_number_that_a_double_cannot_hold():
    kind = CONTROLLERS.find("pi")
    assert kind.choose({"kp": np.int64(1), "ki": np.float32(0.5)}).values == (
        ("kp", 1.0),
        ("ki", 0.5),
    )
    with pytest.raises(InputError, match=r"kp = 1000.* is not a number"):
        kind.choose({"kp": 10**400, "ki": 1.0})
