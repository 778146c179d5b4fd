"""Build the packages into dist/, check them and print a table. A failed check gives exit code 1.

make dist                                 all targets
make dist TARGETS=linux-x86_64            one of them
"""

from __future__ import annotations

import argparse
import itertools
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import checks
from site_archive import build_site, pack_site
from sources import unpack
from wheels import ROOT, TARGETS, build_sdist, build_wheel

WORK, OUT = ROOT / "build" / "dist", ROOT / "dist"
REQUIREMENTS = Path(__file__).with_name("requirements.txt")
Check = tuple[str, str, Callable[[], str]]


def pythons() -> list[Path]:
    """A Python 3.11 and one of 3.12 or later, each in an environment with the build tools."""
    found = []
    for name, versions in (("311", ["3.11"]), ("abi3", ["3.12", "3.13", "3.14"])):
        python = WORK / f"python-{name}" / "bin" / "python"
        if not python.is_file():
            subprocess.run([_interpreter(versions), "-m", "venv", python.parents[1]], check=True)
        pip = [python, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
        subprocess.run([*pip, "-r", REQUIREMENTS], check=True)
        found.append(python)
    return found


def _interpreter(versions: list[str]) -> str:
    """A Python of one of these versions that runs and can make environments."""
    managed = Path.home() / ".pyenv" / "versions"
    installed = itertools.chain.from_iterable(
        [shutil.which(f"python{version}"), *managed.glob(f"{version}*/bin/python")]
        for version in versions
    )
    for path in installed:
        line = [str(path), "-c", "import ensurepip, sysconfig, sys; print(sys.version)"]
        if path and subprocess.run(line, capture_output=True, check=False).returncode == 0:
            return str(path)
    raise SystemExit(
        f"make dist needs Python {' or '.join(versions)}, with its headers. Install it."
    )


def planned(tools: Path, sdist: Path, docs: Path, wheels: dict[Path, Path]) -> Iterator[Check]:
    """The checks, in their order: subject, name, call."""
    yield "all", "metadata", lambda: checks.check_metadata(tools, [sdist, *wheels])
    yield "sdist", "citation", lambda: checks.check_citation(sdist)
    yield "sdist", "description", lambda: checks.check_description(sdist)
    yield "docs", "contents", lambda: checks.check_docs(docs)
    for wheel, python in wheels.items():
        name = "-".join(wheel.name.split("-")[2:4]) + wheel.stem.rpartition("manylinux_2_17")[2]
        folder = WORK / "installed" / name
        yield name, "size", lambda wheel=wheel: checks.check_size(wheel)
        yield name, "contents", lambda wheel=wheel: checks.check_contents(wheel)
        yield name, "auditwheel", lambda wheel=wheel: checks.check_platform(tools, wheel)
        if checks.is_abi3(wheel):
            yield name, "abi3audit", lambda wheel=wheel: checks.check_abi3(tools, wheel)
        if not name.endswith("x86_64"):
            root = WORK / f"root-{name}"
            if root.is_dir():
                yield (
                    name, "emulated",
                    lambda w=wheel, p=python, root=root: checks.check_emulated(p, w, root),
                )  # fmt: skip
            continue
        yield name, "install", lambda w=wheel, p=python, f=folder: checks.check_install(p, w, f)
        yield name, "bits", lambda folder=folder: checks.check_digest(folder)
        if shutil.which("qemu-x86_64"):
            yield name, "old processor", lambda folder=folder: checks.check_old_processor(folder)
    for pair in (("gcc", "g++"), ("clang", "clang++")):
        if shutil.which(pair[1]):
            folder = WORK / "from-source" / pair[0]
            yield (
                "sdist", f"build with {pair[0]}",
                lambda pair=pair, folder=folder: checks.check_sdist(tools, sdist, pair, folder),
            )  # fmt: skip


def main() -> int:
    """Build, check and report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--targets", nargs="*", default=list(TARGETS), choices=list(TARGETS))
    targets = parser.parse_args().targets or list(TARGETS)
    WORK.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(OUT, ignore_errors=True)
    tools = pythons()
    print("dist: source distribution", flush=True)
    sdist = build_sdist(tools[-1], OUT)
    print("dist: documentation", flush=True)
    version = checks.version_of(sdist)
    docs = pack_site(build_site(version, WORK), version, OUT)
    source = unpack(sdist, WORK / "source")
    wheels = {}
    for target, python in itertools.product(targets, tools):
        print(f"dist: {target}, {python.parents[1].name}", flush=True)
        wheels[build_wheel(python, target, source, WORK, OUT)] = python
    failed = 0
    for subject, name, check in planned(tools[-1], sdist, docs, wheels):
        try:
            word, detail = "ok", check()
        except checks.CheckError as error:
            word, detail, failed = "FAILED", str(error), failed + 1
        print(f"{word:7} {subject:21} {name:18} {detail}", flush=True)
    print(f"dist: {len(wheels)} wheels, the source distribution and the documentation are in "
          f"{OUT.name}/; {failed} checks failed.")  # fmt: skip
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
