"""The C core on the host: its own tests under the sanitizers, and the same bits everywhere."""

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SOURCES = sorted((ROOT / "core").glob("*.c"))
STRICT = ["-std=c99", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
SANITIZE = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
CC = os.environ.get("CC", "cc")


def run(*command: object) -> str:
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def build(program: Path, folder: Path, *flags: str) -> Path:
    out = folder / program.stem
    run(CC, *STRICT, *flags, f"-I{ROOT / 'core' / 'include'}", program, *SOURCES, "-o", out, "-lm")
    return out


@pytest.mark.parametrize("name", ["test_lockin", "test_map", "test_pid"])
def test_host_tests_pass_under_the_sanitizers(name: str, tmp_path: Path) -> None:
    run(build(HERE / f"{name}.c", tmp_path, *SANITIZE))


def test_every_optimisation_gives_the_same_bits(tmp_path: Path) -> None:
    hashes = {}
    for number, flags in enumerate((["-O0"], ["-O2"], ["-O3"], ["-O3", "-march=native"])):
        folder = tmp_path / str(number)
        folder.mkdir()
        hashes[" ".join(flags)] = run(build(HERE / "fingerprint.c", folder, *flags))
    assert len(set(hashes.values())) == 1, hashes


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem)
def test_the_microcontroller_compiler_takes_the_core_without_a_warning(
    source: Path, tmp_path: Path, installed: Callable[[str, str], str]
) -> None:
    compiler = installed("avr-gcc", "gcc-avr avr-libc")
    include = f"-I{ROOT / 'core' / 'include'}"
    flags = [*STRICT, "-Wdouble-promotion", "-mmcu=atmega2560", "-Os"]
    run(compiler, *flags, include, "-c", source, "-o", tmp_path / "out.o")


def test_the_core_links_nothing_but_itself(
    tmp_path: Path, installed: Callable[[str, str], str]
) -> None:
    """No libm, no heap: the only outside names are the compiler's own float routines."""
    compiler = installed("avr-gcc", "gcc-avr avr-libc")
    include = f"-I{ROOT / 'core' / 'include'}"
    for source in SOURCES:
        out = tmp_path / f"{source.stem}.o"
        run(compiler, *STRICT, "-mmcu=atmega2560", "-Os", include, "-c", source, "-o", out)
        listing = run(installed("avr-nm", "binutils-avr"), "--undefined-only", out).split()
        foreign = {name for name in listing if name != "U" and not name.startswith(("__", "hs_"))}
        assert not foreign, f"{source.name} needs {foreign}"


def test_cppcheck_finds_nothing_in_the_core(installed: Callable[[str, str], str]) -> None:
    options = ["--enable=warning,style,performance,portability", "--error-exitcode=1", "--quiet"]
    include = f"-I{ROOT / 'core' / 'include'}"
    quiet = ["--inline-suppr", "--suppress=missingIncludeSystem", "--suppress=unusedFunction"]
    run(installed("cppcheck", "cppcheck"), "--std=c99", *options, *quiet, include, ROOT / "core")
