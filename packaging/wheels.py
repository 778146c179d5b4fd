"""Build the source distribution and the wheels of TARGETS with `zig cc`.

Zig contains the headers and symbols of each version of the C library for each processor. So one
computer builds the wheels for all targets, and they need glibc 2.17 or newer. requirements.txt pins
the version of zig.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ROOT", "TARGETS", "Target", "build_sdist", "build_wheel", "run"]

ROOT = Path(__file__).resolve().parents[1]
TOOLS = Path(__file__).with_name("zig")


@dataclass(frozen=True)
class Target:
    """A system for which wheels are built.

    Args:
        triple: name of the system for `zig cc`, with the oldest supported C library.
        system: its name in CMake.
        processor: its name in CMake.
        platform_tag: of the wheel's file name.
        suffix: of an extension module for one Python version.
    """

    triple: str
    system: str
    processor: str
    platform_tag: str
    suffix: str


TARGETS = {
    "linux-x86_64": Target(
        "x86_64-linux-gnu.2.17", "Linux", "x86_64",
        "manylinux_2_17_x86_64.manylinux2014_x86_64", "x86_64-linux-gnu",
    ),
    "linux-aarch64": Target(
        "aarch64-linux-gnu.2.17", "Linux", "aarch64",
        "manylinux_2_17_aarch64.manylinux2014_aarch64", "aarch64-linux-gnu",
    ),
}  # fmt: skip


def build_sdist(python: Path, out: Path) -> Path:
    """Build the source distribution.

    Args:
        python: with the packages of requirements.txt.
        out: folder for the file.
    Returns:
        The archive.
    """
    run([python, "-m", "build", "--sdist", "--no-isolation", "--outdir", out, ROOT])
    return max(out.glob("haselab-*.tar.gz"), key=lambda path: path.stat().st_mtime)


def build_wheel(python: Path, name: str, source: Path, work: Path, out: Path) -> Path:
    """Build one wheel, for the Python version of an interpreter.

    Args:
        python: 3.11, or 3.12 and later for the stable ABI; with the packages of requirements.txt.
        name: of the target.
        source: unpacked source distribution.
        work: folder that keeps compiled files for the next call.
        out: folder for the wheel.
    Returns:
        The wheel.
    """
    target = TARGETS[name]
    version = _ask(python, "import sys; print('%d%d' % sys.version_info[:2])")
    work = work / f"{name}-{version}"
    fresh = work / "wheel"
    shutil.rmtree(fresh, ignore_errors=True)
    (work / "tools").mkdir(parents=True, exist_ok=True)
    _write_tools(python, target, work / "tools")
    defines = {
        "CMAKE_TOOLCHAIN_FILE": TOOLS / "toolchain.cmake",
        "HASELAB_EXTRA_SOURCES": TOOLS / "runtime.c",
        "SKBUILD_SOABI": f"cpython-{version}-{target.suffix}",
    }
    environment = {
        "HASELAB_SYSTEM": target.system,
        "HASELAB_PROCESSOR": target.processor,
        "HASELAB_TOOLS": str(work / "tools"),
    }
    settings = [f"-Ccmake.define.{key}={value}" for key, value in defines.items()]
    run(
        [python, "-m", "build", "--wheel", "--no-isolation", "--outdir", fresh,
         f"-Cbuild-dir={work / 'build'}", "-Cinstall.strip=false", *settings, source],
        environment,
    )  # fmt: skip
    built = next(fresh.glob("*.whl"))
    tags = ["--platform-tag", target.platform_tag, "--remove"]
    tagged = _ask(python, None, "-m", "wheel", "tags", *tags, str(built))
    out.mkdir(parents=True, exist_ok=True)
    return Path(shutil.move(fresh / tagged.splitlines()[-1], out / tagged.splitlines()[-1]))


def _write_tools(python: Path, target: Target, folder: Path) -> None:
    """Write the programs that the toolchain file names, each a call of zig."""
    zig = _ask(python, "import ziglang; print(ziglang.__path__[0])") + "/zig"
    # Zig compiles its C++ library for each optimisation level, so CMake's own tests use -O2 too.
    compile_for = f"-target {target.triple} -O2 -fno-sanitize=undefined -rtlib=none"
    lines = {
        "cc": f"cc {compile_for}",
        "c++": f"c++ {compile_for}",
        "ar": "ar",
        "ranlib": "ranlib",
        "rc": "rc",
    }
    for name, line in lines.items():
        path = folder / name
        text = f'#!/bin/sh\nexec "{zig}" {line} "$@"\n'
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            path.chmod(0o755)


def _ask(python: Path, code: str | None, *arguments: str) -> str:
    line = [str(python), *(["-c", code] if code else []), *arguments]
    return subprocess.run(line, check=True, capture_output=True, text=True).stdout.strip()


def run(line: list[str | Path], more: dict[str, str] | None = None) -> None:
    """Run a program; if it fails, show what it wrote and end.

    Args:
        line: the program and its arguments.
        more: variables added to the environment.
    Raises:
        SystemExit: the program failed.
    """
    done = subprocess.run(
        [str(part) for part in line], env={**os.environ, **(more or {})}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        sys.stderr.write(done.stdout[-6000:] + done.stderr[-6000:])
        raise SystemExit(f"{line[2]} failed with exit code {done.returncode}.")
