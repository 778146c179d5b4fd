"""No command overwrites a result: it refuses with exit code 2, or --force moves the old aside."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest

from haselab.base import Estimate, InputError
from haselab.cli.main import cli, main
from haselab.cli.output import OutputRule, reserved
from haselab.cli.readable import readable

sys.path.insert(0, str(Path(__file__).parent / "study"))
from test_study_run import UNDER_WAY, started, tiny_study

HASELAB = [sys.executable, "-m", "haselab.cli"]
posix = pytest.mark.skipif(os.name == "nt", reason="signals are POSIX's")

# What each command needs before it is called; its files need not exist: the place of the result
# is checked before they are opened. {out} is a file with a result.
COMMANDS = {
    "reproduce": "--out {folder}",
    "run": "study.toml --rig rig.toml --out {folder}",
    "analyse": "somewhere --out {folder}",
    "sense": "a.csv --out {out}",
    "calibrate": "--rig twin --capacitor 1e-9 --out {out}",
    "plan feasibility": "study.toml --rig rig.toml --out {out}",
    "plan carrier": "--rate-hz 2e5 --out {out}",
    "plan-experiment": "m.json --rig r.toml --goal x --out {out}",
    "track": "v.avi --out {out}",
    "identify transfer": "a.csv --out {out}",
    "init": "leg --out {out}",
    "compare": "m.json a.csv --out {out}",
    "design": "m.json --structure pi --out {out}",
    "margins": "m.json --kp 1 --ki 1 --out {out}",
    "export": "m.json --to json --out {out}",
    "scoreboard": "--quick --out {folder}",
    "session export": "run --to csv --out {folder}",
    "session import": "a.csv --out {folder}",
    "example": "chirp --out {folder}",
    "recover": "run --out {out}",
    "report": "run --out {out}",
    "twin new": "--out {out}",
    "twin serve": "rig.toml --out {out}",
    "rig check": "rig.toml --out {out}",
    "rig status": "--out {out}",
    "firmware build": "run --out {out}",
    "firmware simulate": "run --out {out}",
    "firmware flash": "{out} --port x --yes --out {out}",
    "doctor": "--out {out}",
}


def code_of(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def bytes_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*")) if path.is_file()
    }  # fmt: skip


def _commands(group: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    context = click.Context(group)
    if isinstance(group, click.Group):
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            assert command is not None
            yield from _commands(command, (*words, name))
    elif any("--out" in parameter.opts for parameter in group.params):
        yield words


def _command(words: tuple[str, ...]) -> click.Command:
    command: click.Command = cli
    for word in words:
        assert isinstance(command, click.Group)
        found = command.get_command(click.Context(command), word)
        assert found is not None
        command = found
    return command


def test_every_command_that_writes_has_force() -> None:
    for words in _commands(cli):
        options = {option for parameter in _command(words).params for option in parameter.opts}
        assert "--force" in options, words


@pytest.mark.parametrize("words", COMMANDS)
def test_an_existing_result_is_refused_and_stays_as_it_is(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if not any(words == " ".join(each) for each in _commands(cli)):
        pytest.skip("this installation has no such command")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "session.h5").write_bytes(b"recorded")
    (tmp_path / "out").write_text("a result")
    before = bytes_of(tmp_path)
    line = COMMANDS[words].format(folder="folder", out="out")
    code = code_of(*words.split(), *line.split())
    said = capsys.readouterr().err
    assert code == 2, said
    assert "was not changed" in said or "names a file that is read" in said, said
    assert bytes_of(tmp_path) == before


def test_all_commands_are_in_the_list_above_or_share_their_code() -> None:
    listed = {tuple(words.split()) for words in COMMANDS}
    identify = {words for words in _commands(cli) if words[0] == "identify"}
    # the first acts at once, see below; the second continues its folder, see test_campaign_command
    special = {("rig", "safe"), ("campaign",)}
    assert set(_commands(cli)) - identify - special <= listed


def test_force_moves_the_old_result_aside_and_a_failure_brings_it_back(tmp_path, capsys):
    table, out = tmp_path / "a.csv", tmp_path / "out.csv"
    phase = 2.0 * np.pi * 2000.0 * np.arange(40000) / 2e5
    wave = np.stack([np.sin(phase), np.cos(phase)], axis=1)  # the current leads, as it must
    np.savetxt(table, wave, delimiter=",", header="v_monitor_v,i_monitor_v", comments="")
    ask = ("sense", table, "--carrier-hz", 2000, "--rate-hz", 2e5, "--out", out)
    out.write_text("old")
    assert code_of(*ask) == 2
    assert out.read_text() == "old"
    assert code_of(*ask[:1], tmp_path / "missing.csv", *ask[2:], "--force") == 2
    assert out.read_text() == "old"
    assert "no new result was written" in capsys.readouterr().err
    assert code_of(*ask, "--force") == 0
    assert len(out.read_text().splitlines()) == 21  # a header and 20 blocks of 10 ms
    assert (tmp_path / "out.csv.previous-1").read_text() == "old"
    assert "out.csv.previous-1" in capsys.readouterr().err


def test_force_does_not_move_what_the_command_reads(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "session.h5").write_text("x")
    code = code_of("session", "export", folder / "session.h5", "--to", "csv", "--out", folder,
                   "--force")  # fmt: skip
    assert code == 2
    assert "which this command reads" in capsys.readouterr().err
    assert bytes_of(tmp_path)["run/session.h5"]


def test_files_beside_the_table_of_track_count_as_results(tmp_path, capsys):
    (tmp_path / "t-strain.csv").write_text("x")
    assert code_of("track", "v.avi", "--out", tmp_path / "t.csv") == 2
    (tmp_path / "page.html").write_text("x")
    assert code_of("track", "v.avi", "--out", tmp_path / "u.csv", "--report",
                   tmp_path / "page.html") == 2  # fmt: skip
    assert "--report names an existing result" in capsys.readouterr().err


def test_force_does_not_move_what_a_rig_file_names(tmp_path, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "session.h5").write_text("x")
    rig = tmp_path / "replay.toml"
    rig.write_text('kind = "replay"\nsession = "run/session.h5"\n')
    before = bytes_of(tmp_path)
    assert code_of("run", tmp_path / "s.toml", "--rig", rig, "--out", folder, "--force") == 2
    assert f"which {rig} names" in capsys.readouterr().err
    assert bytes_of(tmp_path) == before


def test_a_link_that_leads_nowhere_is_refused_by_every_kind_of_command(tmp_path, capsys):
    (tmp_path / "link").symlink_to("missing")
    for line in (("reproduce", "--quick"), ("sense", "a.csv"), ("session", "import", "a.csv")):
        assert code_of(*line, "--out", tmp_path / "link") == 2
        assert "disk space" not in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["link"]


def test_a_failure_removes_what_was_made_to_keep_the_name(tmp_path):
    out = tmp_path / "new" / "a.csv"
    assert code_of("sense", "none.csv", "--carrier-hz", 2000, "--out", out) == 2
    assert code_of("session", "export", tmp_path / "none", "--to", "mat", "--out", out) == 2
    assert code_of("analyse", tmp_path / "none", "--out", tmp_path / "new") == 2
    assert list(tmp_path.iterdir()) == []


@posix
@pytest.mark.parametrize("kind", ["file", "folder"])
@pytest.mark.parametrize("force", [False, True])
def test_of_two_commands_that_write_one_name_the_second_is_refused(tmp_path, capsys, kind, force):
    """The first one holds the name while the second one starts and ends."""
    out = tmp_path / "out"
    first = reserved(OutputRule(kind), {"out": out}, force=force)
    more = ("--force",) if force else ()
    line = {"file": ("sense", "none.csv"), "folder": ("analyse", tmp_path / "none")}[kind]
    with first:
        done = subprocess.run(
            [*HASELAB, *map(str, line), "--out", str(out), *more], capture_output=True, text=True,
            timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 2
        assert "--out" in done.stderr or "Another program is writing to this" in done.stderr
        (out if kind == "file" else out / "results.json").write_text("of the first")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@posix
def test_of_commands_that_start_together_one_writes_each_name(tmp_path):
    """Ten threads ask for one new name at the same time; one gets it, and its content stays."""
    for kind in ("file", "folder"):
        out, at_once = tmp_path / f"a {kind}", threading.Barrier(10)
        won = []

        def ask(number: int, kind=kind, out=out, at_once=at_once, won=won) -> None:
            at_once.wait()
            with contextlib.suppress(InputError), reserved(
                OutputRule(kind), {"out": out}, force=False
            ):  # fmt: skip
                (out if kind == "file" else out / "x").write_text(str(number))
                won.append(str(number))

        threads = [threading.Thread(target=ask, args=(number,)) for number in range(10)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [(out if kind == "file" else out / "x").read_text()] == won


# ---- runs, as processes -------------------------------------------------------------------------


@posix
def test_a_run_onto_a_recording_is_refused_whatever_state_it_is_in(tmp_path):
    """Recording, sealed after Ctrl-C, killed: each time the second run changes nothing."""
    out = tmp_path / "out"
    command = [*HASELAB, *tiny_study(tmp_path), "--keep-video", "none", "--out", str(out)]

    def second(*more: str) -> str:
        done = subprocess.run([*command, *more], capture_output=True, text=True, timeout=300,
                              check=False)  # fmt: skip
        assert done.returncode == 2
        return done.stderr

    with ended(subprocess.Popen(command, stderr=subprocess.PIPE)) as first:
        started(out / "session.h5", first, UNDER_WAY)
        first.send_signal(signal.SIGSTOP)  # it holds its lock, and does not end before the others
        os.waitid(os.P_PID, first.pid, os.WSTOPPED | os.WNOWAIT)
        before = bytes_of(out)
        assert "Another program is writing to this folder" in second()
        assert "Another program is writing to this folder" in second("--force")
        assert bytes_of(out) == before
        first.send_signal(signal.SIGCONT)
        first.send_signal(signal.SIGINT)
        first.communicate(timeout=300)
    manifest = json.loads((out / "manifest.json").read_text())
    digest = hashlib.sha256((out / "session.h5").read_bytes()).hexdigest()
    assert manifest["state"] == "SEALED"
    assert manifest["files"]["session.h5"]["sha256"] == digest
    before = bytes_of(out)
    assert "was not changed" in second()
    assert bytes_of(out) == before

    aside = tmp_path / "out.previous-1"
    with subprocess.Popen([*command, "--force"], stderr=subprocess.PIPE) as killed:
        started(aside / "session.h5", killed, 0)
        started(out / "session.h5", killed, UNDER_WAY)
        killed.kill()
    assert bytes_of(aside) == before
    before = bytes_of(out)
    assert "was not changed" in second()
    assert bytes_of(out) == before


@contextlib.contextmanager
def ended(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is killed where the test fails: a stopped one would never end."""
    with process:
        try:
            yield process
        finally:
            process.kill()


@posix
def test_of_two_runs_that_start_together_one_records(tmp_path):
    out = tmp_path / "out"
    command = [*HASELAB, *tiny_study(tmp_path), "--keep-video", "none", "--out", str(out)]
    both = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(2)]
    try:
        until = time.monotonic() + 300.0
        while all(process.poll() is None for process in both):
            assert time.monotonic() < until
            time.sleep(0.05)
        loser = next(process for process in both if process.poll() is not None)
        winner = both[1 - both.index(loser)]
        assert loser.returncode == 2
        started(out / "session.h5", winner, UNDER_WAY)
        winner.send_signal(signal.SIGINT)
        winner.communicate(timeout=300)
        assert json.loads((out / "manifest.json").read_text())["state"] == "SEALED"
    finally:
        for process in both:
            process.kill()
            process.communicate()


@pytest.mark.parametrize("works", [True, False])
def test_missing_folders_of_out_and_plot_are_created_and_removed_if_nothing_is_written(
    works, tmp_path
) -> None:
    gain = "gain = 1.0\n" if works else ""
    model = tmp_path / "a.toml"
    model.write_text(f"[model]\n{gain}natural_frequency_rad_s = 30.0\ndamping_ratio = 0.1\n")
    out, plot = tmp_path / "one" / "b.toml", tmp_path / "two" / "three" / "b.svg"
    code = code_of("design", model, "--rate-hz", 100, "--delay-s", 0.0075, "--out", out,
                   "--plot", plot)  # fmt: skip
    assert code == (0 if works else 2)
    assert (out.is_file(), plot.is_file()) == (works, works)
    assert (out.parent.exists(), plot.parents[1].exists()) == (works, works)


@pytest.mark.parametrize("form", [Estimate.normal, Estimate.lognormal])
def test_an_estimate_with_an_infinite_interval_is_shown_as_not_identifiable(form) -> None:
    (line,) = readable({"stiffness": form(4.2, float("inf"), "N/m")})
    assert "not identifiable" in line and "4.2 N/m is arbitrary" in line and "[" not in line
