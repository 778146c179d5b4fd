"""Installing what the tests use: apt's locks, missing packages, and the list of skipped tests."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = ROOT / ".ci" / "apt-install"
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="apt and make are POSIX's")

# Stands in for apt-get: it writes down its calls, and finds a lock taken as often as a file says.
APT_GET = """#!/bin/sh
echo "$*" >>"$FAKE/calls"
left=$(cat "$FAKE/locked")
if [ "$left" -gt 0 ]; then
    echo $((left - 1)) >"$FAKE/locked"
    echo 'E: Could not get lock /var/lib/apt/lists/lock. It is held by process 7 (apt-get)' >&2
    exit 100
fi
case "$*" in *no-such*) echo 'E: Unable to locate package no-such' >&2; exit 100;; esac
"""

Install = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def install(tmp_path: Path) -> Install:
    """Run the script with a fake apt-get, as a user of this number."""

    def run(*packages: str, locked: int = 0, user: int = 0, wait_s: int = 60):
        for name, text in (("apt-get", APT_GET), ("id", f"#!/bin/sh\necho {user}\n")):
            (tmp_path / name).write_text(text, encoding="ascii")
            (tmp_path / name).chmod(0o755)
        (tmp_path / "locked").write_text(str(locked), encoding="ascii")
        (tmp_path / "calls").touch()
        environment = os.environ | {
            "FAKE": str(tmp_path),
            "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}",
            "APT_WAIT_S": str(wait_s),
            "APT_RETRY_S": "0",
        }
        return subprocess.run(
            [str(SCRIPT), *packages],
            env=environment, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip

    return run


def test_a_lock_held_by_another_program_is_waited_for(install: Install, tmp_path: Path) -> None:
    done = install("one", "two", locked=3)
    assert done.returncode == 0
    assert done.stderr.splitlines() == [
        "Installing one two",
        "Waiting up to 60 s: another program uses apt.",
    ]
    calls = (tmp_path / "calls").read_text().splitlines()
    assert len(calls) == 5  # three updates in vain, the update, the installation
    assert all("-o DPkg::Lock::Timeout=60" in call for call in calls)
    assert calls[-1].endswith("install -y --no-install-recommends one two")


def test_a_lock_that_is_never_free_ends_with_its_holder_and_the_line_to_type(
    install: Install,
) -> None:
    done = install("one", locked=10**6, wait_s=0)
    assert done.returncode == 1
    assert done.stderr.splitlines()[1:] == [
        "apt-get could not install one: E: Could not get lock /var/lib/apt/lists/lock. It is held "
        "by process 7 (apt-get)",
        "Type:  sudo apt-get update && sudo apt-get install -y --no-install-recommends one",
    ]


def test_a_package_that_the_distribution_lacks_keeps_no_other_away(
    install: Install, tmp_path: Path
) -> None:
    done = install("one", "no-such", "two")
    assert done.returncode == 1
    assert done.stderr.splitlines()[1:] == [
        "apt-get could not install no-such: E: Unable to locate package no-such",
        "Type:  sudo apt-get update && sudo apt-get install -y --no-install-recommends no-such",
    ]
    calls = (tmp_path / "calls").read_text().splitlines()
    assert [call.split()[-1] for call in calls[-3:]] == ["one", "no-such", "two"]


def test_without_root_nothing_is_called_and_the_line_to_type_is_printed(
    install: Install, tmp_path: Path
) -> None:
    done = install("one", "two", user=1000)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        "Missing: one two. Type:  sudo apt-get install -y --no-install-recommends one two\n"
    )
    assert (tmp_path / "calls").read_text() == ""


def test_make_installs_every_package_that_a_skipped_test_names() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    listed = makefile.partition("TOOLS :=")[2].partition("\n\n")[0]
    packages = {entry.rpartition(":")[2] for entry in listed.split() if ":" in entry}
    packages |= {"gcc", "libc6-dev"}  # without a compiler there is no set-up
    brought = {"binutils-avr"}  # by gcc-avr
    named: set[str] = set()
    for folder, files, pattern in (
        ("tests", "*.py", r"""installed\("[\w.-]+", "([^"]+)"\)"""),
        ("src/haselab/rig", "*.py", r"""find_tool\("[\w.-]+", "([^"]+)"\)"""),
        ("src/haselab/rig", "*.py", r"""apt-get install (?:-y )?([a-z0-9][\w. +-]*)"""),
        ("firmware/board", "board.toml", r"""(?m)^package = "([^"]+)\""""),
    ):
        for path in (ROOT / folder).rglob(files):
            for found in re.findall(pattern, path.read_text(encoding="utf-8")):
                named |= {word for word in found.split() if not word.startswith("-")}
    assert {"gcc-avr", "cppcheck", "clang-tidy", "libaravis-0.8-0", "aravis-tools"} <= named
    assert named <= packages | brought


REPORTED = """
import pytest

@pytest.mark.skipif(True, reason="h5dump is not installed. Run:  apt-get install hdf5-tools")
@pytest.mark.parametrize("number", range(3))
def test_one(number):
    pass

def test_two():
    pytest.skip("no data here")

def test_three():
    pass
"""


def test_the_end_of_a_run_lists_what_was_skipped_and_why(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text((ROOT / "tests/conftest.py").read_text(encoding="utf-8"))
    (tmp_path / "test_some.py").write_text(REPORTED, encoding="ascii")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    plain = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"}

    def end_of(*more: str) -> list[str]:
        done = subprocess.run(
            [*command, *more], cwd=tmp_path, env=plain, capture_output=True, text=True,
            timeout=300, check=True,
        )  # fmt: skip
        return done.stdout.splitlines()

    *_, heading, first, where, second, _, advice, last = end_of("-n", "2")
    assert " 4 skipped " in heading
    assert first == "3 skipped: h5dump is not installed. Run:  apt-get install hdf5-tools"
    assert where == "    in test_some.py"
    assert second == "1 skipped: no data here"
    assert advice == "To install what apt provides:  make tools"
    assert last.startswith("1 passed, 4 skipped")
    *_, heading, last = end_of("-k", "three")
    assert " nothing skipped " in heading
    assert last.startswith("1 passed")


@pytest.mark.parametrize(
    ("fault", "kept"),
    [("none", True), ("set up before the folder was recorded", True), ("moved", False),
     ("Python upgraded", False), ("Python gone", False)],
)  # fmt: skip
def test_an_environment_that_works_no_more_is_created_again(
    fault: str, kept: bool, tmp_path: Path
) -> None:
    (tmp_path / "Makefile").write_bytes((ROOT / "Makefile").read_bytes())
    venv = tmp_path / ".venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], check=True)
    (venv / ".tools").write_text(f"{tmp_path.resolve()}\n", encoding="utf-8")
    if fault == "set up before the folder was recorded":
        (venv / ".tools").write_bytes(b"")
    elif fault == "moved":
        (venv / ".tools").write_text("/another/folder\n", encoding="ascii")
    elif fault == "Python upgraded":
        (venv / "lib").rename(venv / "lib of the last version")
    elif fault == "Python gone":
        (venv / "bin" / "python").unlink()
        (venv / "bin" / "python").symlink_to("/no/such/python")
    done = subprocess.run(
        ["make", "help"], cwd=tmp_path, capture_output=True, text=True, timeout=300, check=True
    )
    assert venv.exists() == kept
    assert ("is created again" in done.stdout) != kept
