"""Checks of built packages: each returns its result as text, or raises `CheckError`."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tarfile
import time
import zipfile
from pathlib import Path

from wheels import ROOT

__all__ = [
    "CheckError", "check_abi3", "check_citation", "check_contents", "check_description",
    "check_digest", "check_docs", "check_emulated", "check_install", "check_loads",
    "check_metadata", "check_old_processor", "check_platform", "check_sdist", "check_size",
    "is_abi3", "version_of",
]  # fmt: skip

_LARGEST_MB = 5.0
_INSTALL_S = 60.0
_MODULES = ("_camera", "_core", "_identify", "_loops", "_models", "_motion", "_sense", "_track",
            "_twin")  # fmt: skip
_SOURCES = ("core", "firmware/app", "firmware/board", "firmware/protocol", "native/twin",
            "native/motion", "rigs", "examples")  # fmt: skip
_COMMANDS = (
    "doctor",
    "init my-actuator --out actuator.toml",
    "example bench --out bench",
    "rig check bench/bench.toml",
    "example chirp --out chirp",
    "identify transfer chirp/chirp.csv --input Drive --output Displacement --out model.json",
    "export bench/twin-hz.toml --to fmu --out twin.fmu",
    "example peano-hasel --out peano",
    "plan feasibility peano/study.toml --rig peano/rig.toml",
)
# What a site consists of: folders of its pages, folders of other files, files beside the folders.
_PAGE_FOLDERS = ("_modules", "benchmarks", "docs", "examples")
_FILE_FOLDERS = ("_downloads", "_images", "_sources", "_static")
_FILES = ("objects.inv", "searchindex.js")
_WITHOUT_COMPILER = ("cc", "gcc", "c++", "g++", "clang", "clang++")


class CheckError(Exception):
    """A package has a fault; the message describes it."""


def is_abi3(wheel: Path) -> bool:
    """Whether a wheel uses the stable ABI."""
    return "-abi3-" in wheel.name


def check_size(wheel: Path) -> str:
    """A wheel is at most 5 MB large."""
    size_mb = wheel.stat().st_size / 1e6
    if size_mb > _LARGEST_MB:
        raise CheckError(f"{size_mb:.1f} MB; at most {_LARGEST_MB:g} MB")
    return f"{size_mb:.1f} MB"


def check_contents(wheel: Path) -> str:
    """A wheel contains all files of the package, all extensions and the sources of the firmware."""
    with zipfile.ZipFile(wheel) as opened:
        names = set(opened.namelist())
    line = ["git", "-C", str(ROOT), "ls-files", "src/haselab", *_SOURCES]
    listed = subprocess.run(line, check=True, capture_output=True, text=True).stdout.split("\n")
    wanted = {
        name.removeprefix("src/") if name.startswith("src/") else f"haselab/sources/{name}"
        for name in listed
        if name.startswith(("src/", "examples/")) or name.endswith((".c", ".h", ".toml", ".ld"))
    }
    missing = sorted(wanted - names)
    missing += [name for name in _MODULES if not any(f"haselab/{name}." in each for each in names)]
    if "haselab/libraries/haselab_twin.so" not in names:
        missing.append("the library of the FMU")
    if missing:
        raise CheckError(f"{len(missing)} files are missing, such as {missing[0]}")
    return f"{len(names)} files"


def check_metadata(python: Path, files: list[Path]) -> str:
    """The description and the other metadata are accepted by the package index."""
    _run([python, "-m", "twine", "check", "--strict", *files])
    return f"{len(files)} files"


def version_of(sdist: Path) -> str:
    """The version in the name of a source distribution."""
    return sdist.name.removeprefix("haselab-").removesuffix(".tar.gz")


def check_citation(sdist: Path) -> str:
    """CITATION.cff names the version, if it is a release."""
    version = version_of(sdist)
    if "dev" in version:
        return "not a release"
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    cited = next(
        line.partition(":")[2].strip(" '\"") for line in lines if line.startswith("version:")
    )
    if cited != version:
        raise CheckError(f"the version in CITATION.cff is {cited}, but the package's is {version}")
    return version


def check_description(sdist: Path) -> str:
    """The description of a release has no relative link or picture; elsewhere it leads nowhere."""
    if "dev" in version_of(sdist):
        return "not a release"
    with tarfile.open(sdist) as opened:
        metadata = opened.extractfile(f"{sdist.name.removesuffix('.tar.gz')}/PKG-INFO")
        text = metadata.read().decode("utf-8") if metadata else ""
    description = re.sub(r"(?ms)^ *```.*?^ *```$|`[^`\n]*`", "", text.partition("\n\n")[2])
    targets = re.findall(r"\]\(\s*<?([^)\s>]+)", description)
    targets += re.findall(r"(?m)^ {0,3}\[[^]]+\]:\s*<?([^\s>]+)", description)
    targets += re.findall(r"(?i)\b(?:href|src)\s*=\s*[\"']?([^\"'\s>]+)", description)
    relative = [each for each in targets if not re.match(r"#|[a-zA-Z][a-zA-Z0-9+.-]*:", each)]
    if relative:
        raise CheckError(f"{len(relative)} relative links or pictures, such as {relative[0]}")
    return f"{len(targets)} links, none relative"


def check_docs(archive: Path) -> str:
    """The documentation has its search and the start page of each section, and only the site."""
    top, version = f"{archive.stem}/", archive.stem.removeprefix("haselab-").removesuffix("-docs")
    with zipfile.ZipFile(archive) as opened:
        names = [name.removeprefix(top) for name in opened.namelist() if name.startswith(top)]
        foreign = [name for name in opened.namelist() if not name.startswith(top)]
        foreign += [name for name in names if not _belongs_to_site(name)]
        missing = sorted({"index.html", "searchindex.js", *_start_pages()} - set(names))
        if missing or foreign:
            found = f"{missing[0]} is missing" if missing else f"{foreign[0]} is not of the site"
            raise CheckError(f"{len(missing) + len(foreign)} faults, such as: {found}")
        title = re.search(r"<title>(.*?)</title>", opened.read(f"{top}docs/index.html").decode())
    if title is None or f"haselab {version}" not in title[1]:
        raise CheckError(f"the title of docs/index.html does not name haselab {version}")
    pages = sum(name.endswith(".html") for name in names)
    return f"{pages} pages, {archive.stat().st_size / 1e6:.1f} MB"


def _start_pages() -> list[str]:
    """The first page, and those of the sections that it names."""
    lines = (ROOT / "docs/index.rst").read_text(encoding="utf-8").partition(".. toctree::")[2]
    named = re.findall(r"(?m)^   ([\w/-]+)\*?$", lines)
    return ["docs/index.html", *(f"docs/{name}.html" for name in named)]


def _belongs_to_site(name: str) -> bool:
    """Whether a file of an archive can be one of the site."""
    folder, _, rest = name.partition("/")
    if not rest:
        return name.endswith(".html") or name in _FILES
    return folder in _FILE_FOLDERS or (folder in _PAGE_FOLDERS and name.endswith(".html"))


def check_platform(python: Path, wheel: Path) -> str:
    """The wheel fits the platform tag in its file name (auditwheel)."""
    found = " ".join(_run([python, "-m", "auditwheel", "show", wheel]).split())
    tag = next(each for each in wheel.stem.split("-")[-1].split(".") if "_2_" in each)
    if f'platform tag: "{tag}"' not in found:
        raise CheckError(found[:200])
    return tag


def check_abi3(python: Path, wheel: Path) -> str:
    """The wheel uses only the stable ABI (abi3audit)."""
    _run([python, "-m", "abi3audit", "--strict", wheel])
    return "stable ABI of 3.12"


def check_install(python: Path, wheel: Path, folder: Path) -> str:
    """Install the wheel without a compiler; run doctor, a quick study, an FMU and firmware."""
    shutil.rmtree(folder, ignore_errors=True)
    _run([python, "-m", "venv", folder / "venv"])
    environment = {**os.environ, "PATH": str(_programs(folder))}
    begin_s = time.monotonic()
    pip = [folder / "venv/bin/python", "-m", "pip", "install", "--quiet", "--only-binary", ":all:"]
    _run([*pip, wheel, *_same_numpy()], environment)
    took_s = time.monotonic() - begin_s
    haselab, here = folder / "venv/bin/haselab", folder / "work"
    here.mkdir()
    for line in (*_COMMANDS, "reproduce --quick --out study", "scoreboard --help"):
        printed = _run([haselab, *line.split()], environment, here)
        lacks = "needs the Python package" in " ".join(printed.split())
        if line.startswith("reproduce") and lacks:
            raise CheckError(f"the study lacks a package that pip did not install: {printed}")
    built = "firmware not built (no avr-gcc)"
    if shutil.which("avr-gcc"):
        line = ["firmware", "build", "study/actuator.toml", "--build-dir", "chip"]
        _run([haselab, *line], environment, here)
        built = "firmware built"
    if took_s > _INSTALL_S:
        raise CheckError(f"the installation took {took_s:.0f} s; at most {_INSTALL_S:g} s")
    return f"installed in {took_s:.0f} s, {built}"


def check_digest(folder: Path) -> str:
    """The installed wheel gives the same bits as the build from source in .venv."""
    found, wanted = (
        json.loads(_run([python, ROOT / "packaging/digest.py"]))
        for python in (folder / "venv/bin/python", ROOT / ".venv/bin/python")
    )
    different = [name for name in wanted if wanted[name] != found[name]]
    if different:
        raise CheckError(f"other results than the build from source: {', '.join(different)}")
    return f"{len(wanted)} equal digests"


def check_old_processor(folder: Path) -> str:
    """Every extension loads, and the lock-in runs, on a processor without AVX."""
    code = "; ".join(f"import haselab.{name}" for name in _MODULES)
    script = f"{code}\nimport digest\nprint(digest.sensing())\n"
    line = ["qemu-x86_64", "-cpu", "Nehalem", folder / "venv/bin/python", "-W", "ignore"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "packaging")}
    return _run([*line, "-c", script], environment).strip()


def check_emulated(python: Path, wheel: Path, root: Path) -> str:
    """The wheel runs in the file system of another processor, where qemu emulates that.

    Of the digests, only those are compared that depend on no mathematical function of numpy or of
    the C library: both may give other last bits there.
    """
    site, here = root / "opt/haselab", root / "opt/work"
    for folder in (site, here):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    inside = ["chroot", root, "env", "--chdir=/opt/work", "PYTHONPATH=/opt/haselab", "python3"]
    version = _run([*inside, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]).strip()
    system = wheel.stem.rpartition("_2_17_")[2]
    platforms = [f"--platform=manylinux_2_{minor}_{system}" for minor in (17, 27, 28)]
    _run([python, "-m", "pip", "install", "--quiet", "--target", site, *platforms,
          f"--platform=manylinux2014_{system}", f"--python-version={version}",
          "--only-binary=:all:", wheel, *_same_numpy()])  # fmt: skip
    shutil.copy(ROOT / "packaging/digest.py", here)
    found = json.loads(_run([*inside, "digest.py"]))
    wanted = json.loads(_run([ROOT / ".venv/bin/python", ROOT / "packaging/digest.py"]))
    different = [name for name in ("tracking", "loops") if wanted[name] != found[name]]
    if different:
        raise CheckError(f"other results than on this computer: {', '.join(different)}")
    for line in _COMMANDS:
        _run([*inside, "-m", "haselab", *line.split()])
    return f"Python {version}: 2 equal digests, doctor, examples, identification, FMU"


def check_sdist(python: Path, sdist: Path, compilers: tuple[str, str], folder: Path) -> str:
    """The source distribution builds with these compilers; the wheel is complete, and loads."""
    shutil.rmtree(folder, ignore_errors=True)
    environment = {**os.environ, "CC": compilers[0], "CXX": compilers[1]}
    _run([python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation",
          "--wheel-dir", folder, sdist], environment)  # fmt: skip
    wheel = next(folder.glob("*.whl"))
    check_contents(wheel)
    check_loads(python, wheel, folder / "unpacked")
    return wheel.name


def check_loads(python: Path, wheel: Path, folder: Path) -> str:
    """The linker finds all symbols of every extension module."""
    shutil.unpack_archive(wheel, folder, "zip")
    modules = sorted(folder.glob("haselab/*.so"))
    code = "import ctypes, os, sys; [ctypes.CDLL(path, os.RTLD_NOW) for path in sys.argv[1:]]"
    _run([python, "-c", code, *modules])
    return f"{len(modules)} modules"


def _programs(folder: Path) -> Path:
    """A folder with links to the programs of /usr/bin, but without its compilers."""
    programs = folder / "programs"
    programs.mkdir(parents=True)
    for name in ("/usr/bin", "/bin"):
        for path in Path(name).iterdir():
            base = path.name.rpartition("-gnu-")[2] if "linux-gnu" in path.name else path.name
            if base.rstrip("0123456789.").rstrip("-") in _WITHOUT_COMPILER:
                continue
            if not (programs / path.name).is_symlink():
                (programs / path.name).symlink_to(path)
    return programs


def _same_numpy() -> list[str]:
    """Versions of numpy and scipy in .venv; other versions may give different bits."""
    code = "import numpy, scipy; print(f'numpy=={numpy.__version__} scipy=={scipy.__version__}')"
    return _run([ROOT / ".venv/bin/python", "-c", code]).split()


def _run(
    line: list[str | Path], environment: dict[str, str] | None = None, folder: Path | None = None
) -> str:
    done = subprocess.run(
        [str(part) for part in line], env=environment, cwd=folder or Path(ROOT).anchor,
        capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        words = " ".join(str(part) for part in line[:6])
        raise CheckError(f"exit code {done.returncode}: {words}: {said[-1]}")
    return done.stdout
