"""The documentation site, built once for all tests, and a browser."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[3]
_GUARD_S = 1800.0


def _build(folder: Path) -> None:
    """Build the site cold; the log of a build with a warning is kept.

    The notebooks are not executed here: `tests/docs/notebooks` does that.
    """
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-n", "-c", "docs",
               "-D", "nb_execution_mode=off", "-d", str(folder / "doctrees"), ".",
               str(folder / "site")]  # fmt: skip
    done = subprocess.run(
        command, cwd=_ROOT, capture_output=True, text=True, check=False, timeout=_GUARD_S
    )
    folder.mkdir(exist_ok=True)
    log = "" if done.returncode == 0 else f"{done.stdout}{done.stderr}" or "failed"
    (folder / "log").write_text(log, encoding="utf-8")


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a build, the same for all processes of the tests: `site` and `log`."""
    for needed in ("sphinx", "myst_nb", "pydata_sphinx_theme", "latex2mathml", "ipykernel"):
        pytest.importorskip(needed, reason="the site's packages; make docs installs them")
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "documentation"
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "log").exists():
            _build(folder)
    return folder


@pytest.fixture(scope="session")
def site(built: Path) -> Path:
    """The root of the site."""
    return built / "site"
