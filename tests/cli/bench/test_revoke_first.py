"""`rig safe` ends the permission before anything large is imported."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from haselab.cli.bench.revoke_first import revoke_first
from haselab.rig.chip import key_of_port
from haselab.rig.instruments.nidaq.link import key_of
from haselab.safety.interlock import Interlock

RIG = 'kind = "bench"\n[daq]\nserial_number = "3DA5AA11"\n'
CHIP = 'kind = "chip"\nport = "{}/ttyACM0"\n'


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HASELAB_INTERLOCKS", str(tmp_path / "interlocks"))


def _write(folder: Path, text: str) -> str:
    path = folder / "RIG.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("kind", ["bench", "chip", "mega"])
def test_the_permission_is_revoked_at_once(kind: str, tmp_path: Path) -> None:
    """The permission of the interlock that the drivers use; "mega" is the former name of a chip."""
    key = key_of("3DA5AA11") if kind == "bench" else key_of_port(f"{tmp_path}/ttyACM0")
    interlock = Interlock(key)
    before = interlock.revision
    text = RIG if kind == "bench" else CHIP.format(tmp_path.as_posix()).replace("chip", kind)
    assert revoke_first(["rig", "safe", "--json", _write(tmp_path, text)])
    assert interlock.revision != before
    assert "rig safe" in interlock.reason


@pytest.mark.parametrize(
    "arguments", [["rig", "check"], ["rig", "safe", "--help"], ["run"], ["rig"], []]
)
def test_no_other_command_revokes(arguments: list[str], tmp_path: Path) -> None:
    assert not revoke_first([*arguments, _write(tmp_path, RIG)])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "daq = 3",
        "[daq]",
        "[daq]\nserial_number = 5",
        "\x00",
        "[daq]\nserial_number='x'",
        "kind='chip'",
        "kind='chip'\nport=3",
    ],
)
def test_a_file_that_names_no_device_is_left_to_the_command(text: str, tmp_path: Path) -> None:
    assert not revoke_first(["rig", "safe", _write(tmp_path, text)])


def test_nothing_large_is_imported_before() -> None:
    code = "import sys, haselab.cli.bench.revoke_first; print('numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
