"""Packages: the version, what each file contains, and processors without AVX."""

import importlib
import io
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from types import ModuleType

import pytest

import haselab
from haselab.pipelines.examples.packages import PACKAGES

ROOT = Path(__file__).resolve().parents[1]
PACKAGING = ROOT / "packaging"
Installed = Callable[[str, str], str]


def run(line: list[object], folder: Path | None = None, **environment: str) -> str:
    done = subprocess.run(
        [str(word) for word in line], cwd=folder, env=os.environ | environment, check=False,
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


def module(name: str) -> ModuleType:
    """A module of make dist."""
    sys.path.insert(0, str(PACKAGING))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(PACKAGING))


@pytest.fixture(scope="module")
def checks() -> ModuleType:
    """The checks of make dist."""
    return module("checks")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory, installed: Installed) -> Path:
    """A wheel from the compiled files of the set-up."""
    installed("git", "git")
    folder = tmp_path_factory.mktemp("wheel")
    programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet"]
    options = ["--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder]
    run([*pip, *options, ROOT], PATH=programs)
    return next(folder.glob("*.whl"))


def test_the_version_is_that_of_the_installed_package() -> None:
    assert haselab.__version__ == metadata.version("haselab")
    assert "__version__" in dir(haselab)


def test_the_version_comes_from_the_tag(tmp_path: Path, installed: Installed) -> None:
    git = [installed("git", "git"), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    ask = [sys.executable, "-m", "setuptools_scm"]
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for line in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "-m", "one"]):
        run([*git, *line], tmp_path)
    assert run(ask, tmp_path).startswith("0.1.0.dev")
    run([*git, "tag", "v0.2.0"], tmp_path)
    assert run(ask, tmp_path) == "0.2.0"
    run([*git, "commit", "--quiet", "--allow-empty", "-m", "two"], tmp_path)
    assert run(ask, tmp_path) == "0.2.1.dev1"
    for other in ("paper-2026", "iros2018", "nightly"):
        run([*git, "tag", other], tmp_path)
        assert run(ask, tmp_path) == "0.2.1.dev1"


def test_a_wheel_contains_everything_that_runs(
    wheel: Path, checks: ModuleType, tmp_path: Path
) -> None:
    checks.check_contents(wheel)
    checks.check_size(wheel)
    shutil.unpack_archive(wheel, tmp_path / "site", "zip")
    # Without the start-up files of this environment, which would find the checkout.
    paths = os.pathsep.join([str(tmp_path / "site"), sysconfig.get_path("platlib")])
    code = (
        "from haselab.rig.chip import board_names, source_folder\n"
        "from haselab.pipelines.examples.data_sets import find_data_set\n"
        "print(source_folder(), *board_names(), *find_data_set('bench').tables())\n"
        "from pathlib import Path\n"
        "from haselab.pipelines.examples.packages import PACKAGES, write_package\n"
        "print(*(len(write_package(name, Path(name))) for name in PACKAGES))"
    )
    found = run([sys.executable, "-S", "-c", code], tmp_path, PYTHONPATH=paths).split()
    kinds = "**/*.py", "**/*.c", "**/*.toml", "**/*.md"
    folders = [ROOT / "examples" / "plugins" / name for name in PACKAGES]
    counts = [sum(len(list(folder.glob(kind))) for kind in kinds) for folder in folders]
    assert found[-len(counts) :] == list(map(str, counts))
    assert found[: -len(counts)] == [
        str(tmp_path / "site" / "haselab" / "sources"), "atmega2560", "stm32g071", "bench.toml",
        "twin-hz.toml", "twin-rad.toml", "reference-study.toml",
    ]  # fmt: skip


def test_the_source_distribution_contains_all_sources(tmp_path: Path, installed: Installed) -> None:
    """The wheels are built from it; it lacked the tests of the example packages."""
    code = "import sys; from scikit_build_core.build import build_sdist; build_sdist(sys.argv[1])"
    run([sys.executable, "-c", code, tmp_path], ROOT)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as opened:
        found = {name.partition("/")[2] for name in opened.getnames()}
    folders = "src", "core", "native", "firmware", "rigs", "examples"
    listed = run([installed("git", "git"), "ls-files", *folders], ROOT).split("\n")
    assert sorted(name for name in listed if name not in found) == []


def test_a_missing_file_is_found(wheel: Path, checks: ModuleType, tmp_path: Path) -> None:
    lacking = tmp_path / wheel.name
    with zipfile.ZipFile(wheel) as whole, zipfile.ZipFile(lacking, "w") as part:
        for name in whole.namelist():
            if name != "haselab/sources/firmware/app/main.c":
                part.writestr(name, whole.read(name))
    with pytest.raises(checks.CheckError, match=r"such as haselab/sources/firmware/app/main\.c"):
        checks.check_contents(lacking)


def test_a_module_that_does_not_load_is_found(
    wheel: Path, checks: ModuleType, tmp_path: Path
) -> None:
    assert (
        checks.check_loads(Path(sys.executable), wheel, tmp_path / "whole")
        == f"{len(checks._MODULES)} modules"
    )
    source, broken = tmp_path / "a.c", tmp_path / wheel.name
    source.write_text("int absent(void); int present(void) { return absent(); }", encoding="ascii")
    run(["cc", "-shared", "-fPIC", source, "-o", tmp_path / "_a.so"])
    with zipfile.ZipFile(broken, "w") as part:
        part.write(tmp_path / "_a.so", "haselab/_a.so")
    with pytest.raises(checks.CheckError, match="undefined symbol: absent"):
        checks.check_loads(Path(sys.executable), broken, tmp_path / "broken")


def test_a_release_is_not_cited_as_another_version(checks: ModuleType) -> None:
    cited = re.search(r"(?m)^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited is not None
    assert checks.check_citation(Path(f"haselab-{cited[1]}.tar.gz")) == cited[1]
    assert checks.check_citation(Path("haselab-9.0.0.dev3.tar.gz")) == "not a release"
    with pytest.raises(checks.CheckError, match=r"but the package's is 9\.0\.0"):
        checks.check_citation(Path("haselab-9.0.0.tar.gz"))


def described(folder: Path, version: str, description: str) -> Path:
    """A source distribution that contains only its metadata."""
    sdist = folder / f"haselab-{version}.tar.gz"
    text = f"Metadata-Version: 2.4\nName: haselab\n\n{description}".encode()
    with tarfile.open(sdist, "w:gz") as opened:
        entry = tarfile.TarInfo(f"haselab-{version}/PKG-INFO")
        entry.size = len(text)
        opened.addfile(entry, io.BytesIO(text))
    return sdist


@pytest.mark.parametrize(
    "description",
    ["see [safety](docs/bench/safety.md)", "![panel](docs/pictures/panel.gif)",
     "[a][1]\n\n[1]: docs/faq.md", '<img alt="a" src="docs/pictures/bench.svg">'],
)  # fmt: skip
def test_a_release_whose_description_has_a_relative_link_is_found(
    checks: ModuleType, tmp_path: Path, description: str
) -> None:
    with pytest.raises(checks.CheckError, match="1 relative links or pictures, such as docs/"):
        checks.check_description(described(tmp_path, "9.0.0", description))
    assert (
        checks.check_description(described(tmp_path, "9.0.0.dev3", description)) == "not a release"
    )


def test_a_description_may_have_absolute_links_anchors_and_code(
    checks: ModuleType, tmp_path: Path
) -> None:
    text = "[a](https://example.org/a) [b](#cite) `[c](d)`\n\n```\n[e](f)\n```\n"
    sdist = described(tmp_path, "9.0.0", text)
    assert checks.check_description(sdist) == "2 links, none relative"


def made_up_site(folder: Path, checks: ModuleType) -> Path:
    """The files that a site has at least, with their titles."""
    names = "index.html", "searchindex.js", "_static/site.css", *checks._start_pages()
    for name in (*names, ".buildinfo"):
        path = folder / "site" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("<title>A page &#8212; haselab 9.0.0</title>", encoding="utf-8")
    return folder / "site"


def test_the_documentation_is_one_archive(checks: ModuleType, tmp_path: Path) -> None:
    site = made_up_site(tmp_path, checks)
    archive = module("site_archive").pack_site(site, "9.0.0", tmp_path / "dist")
    assert archive.name == "haselab-9.0.0-docs.zip"
    with zipfile.ZipFile(archive) as opened:
        names = set(opened.namelist())
    assert {"haselab-9.0.0-docs/index.html", "haselab-9.0.0-docs/docs/start/index.html"} <= names
    assert "haselab-9.0.0-docs/.buildinfo" not in names
    pages = len(checks._start_pages()) + 1
    assert pages > 8
    assert checks.check_docs(archive) == f"{pages} pages, 0.0 MB"


@pytest.mark.parametrize("name", ["index.html", "searchindex.js", "docs/how-to/index.html"])
def test_a_page_that_the_documentation_lacks_is_found(
    checks: ModuleType, tmp_path: Path, name: str
) -> None:
    site = made_up_site(tmp_path, checks)
    (site / name).unlink()
    archive = module("site_archive").pack_site(site, "9.0.0", tmp_path)
    with pytest.raises(checks.CheckError, match=f"1 faults, such as: {name} is missing"):
        checks.check_docs(archive)


@pytest.mark.parametrize(
    "name",
    ["doctrees/docs/faq.doctree", "notebooks/global.db", "reference/report.html",
     "docs/environment.pickle", "twin-actuator.toml"],
)  # fmt: skip
def test_a_file_of_out_that_is_not_the_site_is_found(
    checks: ModuleType, tmp_path: Path, name: str
) -> None:
    site = made_up_site(tmp_path, checks)
    (site / name).parent.mkdir(parents=True, exist_ok=True)
    (site / name).write_text("not a page", encoding="utf-8")
    archive = module("site_archive").pack_site(site, "9.0.0", tmp_path)
    with pytest.raises(checks.CheckError, match=f"1 faults, such as: {name} is not of the site"):
        checks.check_docs(archive)


def test_documentation_of_another_version_is_found(checks: ModuleType, tmp_path: Path) -> None:
    archive = module("site_archive").pack_site(made_up_site(tmp_path, checks), "9.0.1", tmp_path)
    with pytest.raises(checks.CheckError, match=r"does not name haselab 9\.0\.1"):
        checks.check_docs(archive)


OLD_PROCESSOR = """
import numpy as np
from haselab import _camera, _core, _identify, _loops, _models, _motion, _sense, _track, _twin
from haselab.sensing import Lockin, LockinConfig
phase = 2.0 * np.pi * 2000.0 / 200e3 * np.arange(2000)
carrier = np.round(3000.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1))
noise = np.random.default_rng(1).integers(-40, 40, (4, 2000, 2))
config = LockinConfig(
    rate_hz=200e3, block_samples=2000, carrier_hz=2000.0, skew_s=2.5e-6, ohm_per_ratio=2.5e6
)
found = Lockin(config).sense((carrier + noise).astype(np.int16))
print(_loops.widest(), *(float(value) for value in found.capacitance_f))
"""


def test_haselab_runs_on_a_processor_without_avx(installed: Installed) -> None:
    emulator = installed("qemu-x86_64", "qemu-user")
    python = [sys.executable, "-W", "ignore", "-c", OLD_PROCESSOR]
    _, *wanted = map(float, run(python).split())
    widest, *found = map(float, run([emulator, "-cpu", "Nehalem", *python]).split())
    assert widest == 0
    # haselab's own sums are equal. numpy's sine, of which the plan is made, is off by up to 4 units
    # of the last place on other processors: 2**-50 of each of a few factors.
    assert found == pytest.approx(wanted, rel=2.0**-46)
