"""One rule for every extension point: unknown, repeated and broken objects are named."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import pytest

from haselab.actuators import ACTUATORS
from haselab.base import DeviceError, HaselabError, InputError
from haselab.base.exits import SignalExit
from haselab.base.registry import Registry
from haselab.controllers import CONTROLLERS
from haselab.rig.instruments.registry import INSTRUMENTS
from haselab.store.columns.reader import FORMATS
from haselab.study.registry import EXPERIMENTS

ROOT = Path(__file__).parents[2]
ALL: list[tuple[Registry, type[HaselabError]]] = [
    (ACTUATORS, InputError),
    (CONTROLLERS, InputError),
    (EXPERIMENTS, InputError),
    (FORMATS, InputError),
    (INSTRUMENTS, DeviceError),
]
EACH = pytest.mark.parametrize(("registry", "error"), ALL, ids=[each.what for each, _ in ALL])


class Theirs(EntryPoint):
    """An entry point of another package."""

    dist = SimpleNamespace(name="theirs", version="2.1")


def install(monkeypatch, registry, *points: tuple[str, str]) -> None:
    found = tuple(Theirs(name, place, registry.group) for name, place in points)
    monkeypatch.setattr(registry, "others", lambda: found)


@EACH
def test_its_own_objects_load_and_have_the_package_haselab(registry, error):
    assert set(registry.packages().values()) == {"haselab"}
    assert list(registry.usable()) == list(registry.packages())


@EACH
def test_an_unknown_name_is_refused_with_the_known_ones(registry, error):
    known = ", ".join(registry.packages())
    with pytest.raises(error, match=rf"^No {registry.what} 'x' is registered\. Use one of {known}"):
        registry.find("x")


@EACH
@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("no_such_module:X", r"it does not load \(ModuleNotFoundError: No module named"),
        ("math:no_such_name", r"it does not load \(AttributeError: module 'math' has no"),
        ("math:pi", r"it"),
    ],
)
def test_what_does_not_load_or_does_not_fit_is_named_with_its_package(
    monkeypatch, registry, error, place, said
):
    install(monkeypatch, registry, ("x", place))
    start = rf"^The {registry.what} 'x' of package theirs 2\.1 \({place}\) cannot be used"
    with pytest.raises(error, match=rf"{start}: {said}.*\. Fix or uninstall the package\.$"):
        registry.find("x")
    assert "x" in registry.packages() and "x" not in registry.usable()


@EACH
@pytest.mark.parametrize("code", [0, None, "no licence"])
def test_a_package_that_exits_when_it_is_imported_is_named_like_any_other_fault(
    monkeypatch, tmp_path, registry, error, code
):
    (tmp_path / "leaves.py").write_text(f"import sys\nsys.exit({code!r})\n")
    monkeypatch.syspath_prepend(tmp_path)
    install(monkeypatch, registry, ("x", "leaves:X"))
    said = rf"does not load \(RuntimeError: it called sys\.exit\({code!r}\)\)\. Fix or uninstall"
    with pytest.raises(error, match=said):
        registry.find("x")
    assert "x" not in registry.usable()


@EACH
def test_a_signal_during_an_import_still_ends_the_program(monkeypatch, registry, error):
    install(monkeypatch, registry, ("x", "math:pi"))

    def fault(found, name):
        raise SignalExit(143)

    monkeypatch.setattr(registry, "_fault", fault)
    with pytest.raises(SignalExit, match=r"143"):
        registry.find("x")


@EACH
def test_a_name_that_is_taken_is_refused(monkeypatch, registry, error):
    own = next(iter(registry.packages()))
    install(monkeypatch, registry, (own, "math:pi"))
    with pytest.raises(error, match=r"more than once, by haselab and theirs 2\.1\. Uninstall all"):
        registry.find(own)
