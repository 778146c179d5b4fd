"""Faults of a whole run, as a user meets them: one line, the contract's exit code, data kept."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter
from haselab.study import definition

_QUICK = ["reproduce", "--quick", "--no-physical-model", "--keep-video", "none"]


def haselab(*arguments: str, start: str = "") -> list[str]:
    code = f"import sys; {start}\nfrom haselab.cli.main import main; main(sys.argv[1:])"
    return [sys.executable, "-c", code, *arguments]


def ended(command: list[str], code: int, words: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    lines = done.stderr.strip().splitlines()
    assert done.returncode == code, done.stderr
    assert len(lines) == 1
    assert words in lines[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[load]\nmas_kg = 1\n", "load.mas_kg"),
        ("[load]\nmass_kg = -0.2\n", "load.mass_kg"),
        ("[acquisition]\ndrive_high_v = 50\n", "acquisition.drive_high_v"),
        ("[load\n", "Not a TOML file"),
    ],
)
def test_a_twin_that_cannot_be_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    twin = tmp_path / "twin.toml"
    twin.write_text(text)
    ended(haselab(*_QUICK, "--twin", str(twin), "--out", str(tmp_path / "out")), 2, words)
    assert not (tmp_path / "out").exists()


def test_a_study_above_the_voltage_limit_is_refused(tmp_path: Path) -> None:
    builtin = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
    text = builtin.read_text().replace("high_v = 2.0", "high_v = 2.5")
    (tmp_path / "study.toml").write_text(text)
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    command = ["run", str(tmp_path / "study.toml"), "--rig", str(tmp_path / "rig.toml")]
    ended(haselab(*command, "--quick", "--out", str(tmp_path / "out")), 2,
          "highest drive voltage is 2.5 V in triangle (limit 2 V)")  # fmt: skip


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX's")
def test_a_full_disk_keeps_what_was_recorded(tmp_path: Path) -> None:
    limit = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (12_000_000, 12_000_000))"
    )
    ended(haselab(*_QUICK, "--out", str(tmp_path), start=limit), 4, "disk is full")
    with SessionReader(tmp_path / "session.h5") as session:
        assert len(session.experiment("triangle").codes) >= 10
    for command in ("analyse", "report"):
        ended(haselab(command, str(tmp_path)), 2, "triangle was cut short")


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_in_mid_run_keeps_what_was_recorded(tmp_path: Path, number: int) -> None:
    command = haselab(*_QUICK, "--out", str(tmp_path))
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        path, until = tmp_path / "session.h5", time.monotonic() + 300.0
        # The empty recording of the study takes 3.6 MB, a block 8 kB.
        while not (path.exists() and path.stat().st_size > 8_000_000):
            assert run.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        os.kill(run.pid, number)
        printed = run.communicate(timeout=300)[1].strip().splitlines()
    assert run.returncode == 130
    assert len(printed) == 1
    assert printed[0].startswith("haselab: Interrupted. Output at 0 V; ")
    assert printed[0].endswith(f"The data recorded so far are kept in {tmp_path}.")
    with SessionReader(path) as session:
        assert len(session.experiment("triangle").codes) >= 100
        assert any("output at 0 V" in what for _, what in session.events())


def test_a_session_cut_short_is_one_line_at_any_length(tmp_path: Path) -> None:
    whole = tmp_path / "session.h5"
    with SessionWriter(whole, [ExperimentPlan("triangle", "triangle", 6, {})], 2000, {}):
        pass
    data = whole.read_bytes()
    for share in (0.0, 0.001, 0.1, 0.5, 0.9, 0.999):
        cut = tmp_path / "cut.h5"
        cut.write_bytes(data[: int(share * len(data))])
        with pytest.raises(InputError, match="The file is not a complete haselab session"):
            SessionReader(cut)
