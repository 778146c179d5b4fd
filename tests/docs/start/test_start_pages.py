"""The journeys of docs/start, as they are written: their files, their commands, their numbers."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.docs.page import Page

_GUARD_S = 300.0


def _answers(shell: Any, commands: list[str]) -> dict[str, Any]:
    """Run all lines; the JSON answers of haselab by the file that a command names with --out."""
    found = {}
    for line in commands:
        if not line.startswith("haselab "):
            shell.run_all([line])
            continue
        done = shell.run(f"{line} --json")
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        words = shlex.split(line)
        name = words[words.index("--out") + 1] if "--out" in words else words[1]
        found[name] = json.loads(done.stdout)
    return found


def _stated(page: Page, before: str, after: str) -> float:
    """The number that a page states between two texts."""
    return float(page.text.partition(before)[2].partition(after)[0].split()[-1])


def test_the_first_study_has_the_results_that_the_page_states(make_shell: Callable) -> None:
    page, shell = Page("start/twin-in-five-minutes.md"), make_shell("first")
    (shell.folder / "study.toml").write_text(page.toml[0], encoding="utf-8")
    _answers(shell, page.commands)
    rows = {row["id"]: row["measured"] for row in shell.json("first/results.json")["quantities"]}
    for name, shown in (
        ("S20.omega_n", "32.7 rad/s"), ("S20.zeta", "0.118"), ("S24.error_open", "-0.60"),
        ("S25.error_pid", "-0.002"),
    ):  # fmt: skip
        number = float(shown.split()[0])
        assert shown in page.text and f"{rows[name]['value']:.3g}"  # found, and a number
        last_digit = 10.0 ** -len(shown.split()[0].partition(".")[2])
        assert abs(rows[name]["value"] - number) <= last_digit, name
    assert (shell.folder / "first/actuator.toml").stat().st_size > 0


def test_a_csv_becomes_a_bode_plot_a_model_and_a_prediction(make_shell: Callable) -> None:
    page, shell = Page("start/your-own-csv.md"), make_shell("csv")
    answers = _answers(shell, page.commands)
    model, compared = shell.json("model.json"), answers["compare"]
    values = {name: each["value"] for name, each in model.items()
              if isinstance(each, dict) and "value" in each}  # fmt: skip
    assert abs(values["natural_frequency_rad_s"] - _stated(page, "frequency, ", " rad/s")) < 1e-3
    assert abs(values["damping_ratio"] - _stated(page, "damping ratio, ", ",")) < 1e-4
    assert abs(1e3 * values["gain"] - _stated(page, "the gain, ", " mm/V")) < 0.01
    assert abs(compared["fit_percent"] - _stated(page, "explains ", " %")) < 0.1
    assert abs(100 * compared["inside_band"] - _stated(page, "(`fit_percent`), and ", " %")) < 1.0
    assert "not white" in " ".join(model["notes"])
    drawn = ("bode.svg", "transfer.svg", "test.svg")
    assert all((shell.folder / name).stat().st_size > 0 for name in drawn)


@pytest.mark.slow
def test_a_film_becomes_tracks_and_a_strain(make_shell: Callable) -> None:
    page, shell = Page("start/your-own-video.md"), make_shell("video")
    answers = _answers(shell, page.commands)
    tracks = answers["tracks.csv"]
    valid = _stated(page, "twelve frames with the points on them |", " %")
    assert abs(100 * tracks["valid_fraction"] - valid) < 1.0
    assert abs(tracks["strain"]["largest"] - _stated(page, "largest strain is ", ". Look")) < 1e-3
    assert answers["scaled.csv"]["scale_mm_per_px"] is not None
    for name in ("tracks.html", "tracks.png", "tracks-strain.csv"):
        assert (shell.folder / name).stat().st_size > 0


@contextmanager
def _served(shell: Any, command: str) -> Iterator[None]:
    """A served twin until Ctrl-C, as in a terminal of its own."""
    file = shell.folder / command.split()[-1]
    before = file.stat().st_mtime_ns if file.exists() else 0
    program = str(shell.programs / "haselab")
    words = [program, *shlex.split(command)[1:]]
    with subprocess.Popen(words, cwd=shell.folder, stdout=subprocess.DEVNULL) as process:
        try:
            until = time.monotonic() + _GUARD_S
            while not file.exists() or file.stat().st_mtime_ns == before:
                assert process.poll() is None and time.monotonic() < until, command
                time.sleep(0.1)
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(_GUARD_S)


@pytest.mark.slow
def test_a_bench_is_rehearsed_with_a_fault_and_without(make_shell: Callable) -> None:
    for needed in ("pty", "serial", "pymeasure", "pyvisa_py", "nidaqmx", "grpc"):
        pytest.importorskip(needed, reason="the served twin's drivers")
    page, shell = Page("start/your-own-bench.md"), make_shell("bench")
    twin, faulty, check, sound, plan = page.terminal
    study = Page("start/twin-in-five-minutes.md").toml[0]
    (shell.folder / "study.toml").write_text(study, encoding="utf-8")
    shell.run_all([*page.commands, twin])
    with _served(shell, faulty):
        done = shell.run(check)
        assert done.returncode == 4
        said = page.text.partition('names the wire: "')[2].partition('"')[0].replace("\n", " ")
        assert said in done.stdout and "FAILED  live" in done.stdout
    with _served(shell, sound):
        done = shell.run(check)
        assert done.returncode == 0, done.stderr
        assert shell.run(plan).stdout.splitlines()[-1] == "feasible"


def test_no_page_of_the_section_is_left_out() -> None:
    folder = Path(__file__).resolve().parents[3] / "docs" / "start"
    here = Path(__file__).read_text(encoding="utf-8")
    others = {"install.md"}  # its commands install haselab: they run where wheels are tested
    missing = {each.name for each in folder.glob("*.md")} - others
    assert not {name for name in missing if f"start/{name}" not in here}
