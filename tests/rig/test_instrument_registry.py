"""Which instruments a rig file can name, and what is refused before anything is energised."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from haselab.base import DeviceError, InputError
from haselab.cli.main import main
from haselab.rig.bench_config import BenchConfig
from haselab.rig.instruments.registry import INSTRUMENTS
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin

RIG = """
kind = "bench"
[daq]
[amplifier]
name = "any"
[generator]
address = "TCPIP::127.0.0.1::5025::SOCKET"
[supply]
{supply}
[specimen]
shell_width_m = 0.03
shell_thickness_m = 0.002
mass_kg = 0.25
"""
COMPLETE = """
from typing import Literal
from haselab.rig.instruments import SupplyConfig, SupplyInstrument

class Config(SupplyConfig):
    kind: Literal["mine"] = "mine"
    place: str = "shelf"

class Mine(SupplyInstrument[Config]):
    kind = "mine"
    config = Config

    def open(self, config, context):
        raise NotImplementedError

    def identify(self, config):
        return f"mine on the {config.place}"

    def addresses(self, config):
        return (config.place,)

    def shut_down(self, config, within_s):
        return None
"""
ON_THE_SHELF = 'kind = "mine"\nhighest_v = 1000.0'


class Packages:
    """A folder on the import path into which packages are installed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def install(self, text: str, kind: str = "mine", name: str = "plug_in") -> None:
        """A module and the metadata that pip would write."""
        (self.folder / f"{name}.py").write_text(text)
        metadata = self.folder / f"{name}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[{INSTRUMENTS.group}]\n{kind} = {name}:Mine\n")
        INSTRUMENTS.others.cache_clear()

    def rig(self, supply: str = ON_THE_SHELF) -> Path:
        path = self.folder / "rig.toml"
        path.write_text(RIG.format(supply=supply))
        return path


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    INSTRUMENTS.others.cache_clear()
    yield Packages(folder)
    for name in ("plug_in", "other"):
        sys.modules.pop(name, None)
    INSTRUMENTS.others.cache_clear()


@pytest.mark.parametrize("kind", list(INSTRUMENTS.packages()))
def test_every_driver_of_this_package_loads_as_any_other_does(kind: str) -> None:
    assert INSTRUMENTS.packages()[kind] == "haselab"
    instrument = INSTRUMENTS.find(kind)
    assert instrument.kind == kind
    field = instrument.config.model_fields["kind"]
    assert field.annotation.__args__ == (kind,)


def test_a_rig_file_names_an_instrument_of_another_package(packages: Packages) -> None:
    packages.install(COMPLETE)
    file = load_rig(packages.rig(ON_THE_SHELF + '\nplace = "table"'))
    assert isinstance(file, BenchConfig)
    found = {each.section: each for each in file.instruments()}
    assert found["supply"].instrument.identify(found["supply"].config) == "mine on the table"
    assert set(file.shared_instruments) == {"TCPIP::127.0.0.1::5025::SOCKET", "table"}
    assert file.model_dump()["supply"]["place"] == "table"


@pytest.mark.parametrize(
    ("supply", "message"),
    [
        ('kind = "yours"\nhighest_v = 1.0', r"supply: no supply of kind 'yours'; use one of "
         r"'petapicovoltron', 'mine', or install the package that provides it"),
        ('kind = "aravis"\nhighest_v = 1.0', r"supply: no supply of kind 'aravis'"),
        ('kind = 3\nhighest_v = 1.0', r"supply: no supply of kind '3'"),
        (ON_THE_SHELF + "\nplaice = 1",
         r"supply\.plaice: no such key; the keys are highest_v, kind, place, tolerance_v"),
        ('kind = "mine"', r"\[supply\] has no key highest_v"),
        ("", r"\[supply\] has no key highest_v.*; \[supply\] has no key port"),
    ],
)  # fmt: skip
def test_a_fault_in_its_section_is_named_with_its_place(
    packages: Packages, supply: str, message: str
) -> None:
    packages.install(COMPLETE)
    with pytest.raises(InputError, match=message):
        load_rig(packages.rig(supply))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("def shut_down", "def switch_off", r"it has no shut_down\. Fix or uninstall the package"),
        ("def addresses", "def address", r"it has no addresses\."),
        (
            "from typing",
            "import not_there\nfrom typing",
            r"does not load \(ModuleNotFoundError: No",
        ),
        ("class Mine", "1 / 0\nclass Mine", r"does not load \(ZeroDivisionError: division by zero"),
        ('kind = "mine"\n    config', 'kind = "his"\n    config', r"'mine', but .* kind is 'his'"),
        ("config = Config", "config = dict", r"attribute config is not derived from SupplyConfig"),
        (
            "Mine(SupplyInstrument[Config])",
            "Mine",
            r"not a class derived from one of DaqInstr",
        ),
        ("class Mine", "class His", r"does not load \(AttributeError"),
    ],
)
def test_an_incomplete_driver_is_refused_while_the_file_is_read(
    packages: Packages, old: str, new: str, message: str
) -> None:
    assert old in COMPLETE
    packages.install(COMPLETE.replace(old, new))
    with pytest.raises(DeviceError, match=message) as caught:
        load_rig(packages.rig())
    assert "package plug_in 1.0" in str(caught.value)


def test_no_package_replaces_a_driver_of_this_one(packages: Packages) -> None:
    packages.install(COMPLETE.replace('"mine"', '"petapicovoltron"'), kind="petapicovoltron")
    with pytest.raises(DeviceError, match=r"more than once, by haselab and plug_in 1\.0"):
        load_rig(packages.rig('port = "/dev/ttyACM0"\nhighest_v = 1000.0'))


def test_two_packages_with_one_kind_are_refused(packages: Packages) -> None:
    packages.install(COMPLETE)
    packages.install(COMPLETE, name="other")
    with pytest.raises(DeviceError, match=r"more than once, by other 1\.0 and plug_in 1\.0"):
        load_rig(packages.rig())


def test_a_broken_package_does_not_keep_other_rig_files_from_being_read(
    packages: Packages,
) -> None:
    packages.install("import not_there")
    assert load_rig(packages.rig('port = "/dev/ttyACM0"\nhighest_v = 1000.0')).kind == "bench"


def test_a_guardian_does_not_start_with_a_driver_that_has_no_shutdown(packages: Packages) -> None:
    """The program refuses to energise a bench whose guardians do not start."""
    packages.install(COMPLETE.replace("def shut_down", "def switch_off"))
    done = subprocess.run(
        [sys.executable, "-m", "haselab.safety.guardian.process", str(packages.rig()), "0",
         str(packages.folder / "log")],
        env=os.environ | {"PYTHONPATH": str(packages.folder)}, stdin=subprocess.DEVNULL,
        capture_output=True, text=True, check=False, timeout=300.0,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stdout.startswith("failed The instrument 'mine' of package plug_in 1.0 ")
    assert "it has no shut_down" in done.stdout


@pytest.mark.parametrize(
    ("section", "key", "off"),
    [
        ("supply", "port", ("daq", "generator")),
        ("generator", "address", ("daq", "supply")),
        ("daq", "device", ("supply", "generator")),
    ],
)
def test_rig_safe_shuts_down_the_rest_of_a_bench_whose_package_is_broken(
    packages: Packages, capsys: pytest.CaptureFixture[str], section: str, key: str,
    off: tuple[str, str],
) -> None:  # fmt: skip
    """What has a driver goes off; the other one is named, to be switched off by hand."""
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    packages.install("import not_there")
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served:
        served.hub.bench._native.carrier_v = 0.02
        text = served.rig_file().replace(f"[{section}]", f'[{section}]\nkind = "mine"')
        path = packages.folder / "rig.toml"
        path.write_text(text.replace(f'{key} = "', 'place = "', 1))
        with pytest.raises(SystemExit) as stop:
            main(["rig", "safe", str(path)])
        carrier_v = served.hub.bench._native.carrier_v
    out, err = capsys.readouterr()
    assert stop.value.code == 4
    for each in off:
        assert f"ok      safe  {each}" in out
    assert f"FAILED  safe  {section:32s} The instrument 'mine' of package" in out
    assert f"Not confirmed at 0 V: {section}. Switch the high voltage off by hand." in err
    assert (carrier_v == 0.0) == ("generator" in off)
    assert ("permission NOT revoked: the driver of the board" in out) == (section == "daq")


def test_rig_safe_goes_on_where_another_section_of_the_file_has_a_fault(
    packages: Packages, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as served:
        path = packages.folder / "rig.toml"
        path.write_text(served.rig_file().replace("[specimen]", "[specimen]\nmas_kg = 1.0"))
        with pytest.raises(SystemExit) as stop:
            main(["rig", "safe", str(path)])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert all(f"ok      safe  {name}" in out for name in ("daq", "generator", "supply"))


def test_a_driver_that_raises_anything_is_one_line_and_exit_code_4(
    packages: Packages, capsys: pytest.CaptureFixture[str]
) -> None:
    faulty = COMPLETE + "\n    def check_driver(self):\n        raise KeyError('no such cable')\n"
    packages.install(faulty)
    with pytest.raises(SystemExit) as stop:
        main(["rig", "check", str(packages.rig())])
    assert stop.value.code == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert "The driver of instrument 'mine' failed (KeyError: 'no such cable')." in line


def test_doctor_lists_a_package_and_one_that_does_not_load(
    packages: Packages, capsys: pytest.CaptureFixture[str]
) -> None:
    packages.install(COMPLETE)
    packages.install("import not_there", kind="broken", name="other")
    with pytest.raises(SystemExit) as stop:
        main(["doctor"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "ok  driver     mine         section supply, package plug_in 1.0" in out
    assert "--  driver     broken       The instrument 'broken' of package other 1.0" in out
