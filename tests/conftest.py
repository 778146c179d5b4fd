"""What all tests share: the measured data, external programs, and the list of skipped tests."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

# The tests run in one process per core, and their matrices are small: threads of the linear algebra
# would triple the time. Set before numpy loads, and inherited by every process that a test starts.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured data; tests that need it are skipped, with the source, elsewhere."""
    if not _SHARED.is_dir():
        pytest.skip(
            "measured data not present; public sources: LucMarechal/Soft-Robotics-Materials-"
            "Database, SLICOT-Reference, DIC Challenge sample 14, soft-matter/trackpy, pyMRAW, pims"
        )
    return _SHARED


@pytest.fixture(scope="session")
def installed() -> Callable[[str, str], str]:
    """Find a program, by its name and its Debian package; a test without it is skipped."""

    def find(program: str, package: str) -> str:
        path = shutil.which(program)
        if path is None:
            pytest.skip(f"{program} is not installed. Type:  sudo apt-get install -y {package}")
        return path

    return find


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List what was skipped by reason, which says how to get what is missing."""
    reasons: dict[str, list[str]] = {}
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2].removeprefix("Skipped: ")
        reasons.setdefault(reason, []).append(report.nodeid.partition("::")[0])
    count = sum(map(len, reasons.values()))
    terminalreporter.section(f"{count or 'nothing'} skipped", sep="-")
    for reason, files in sorted(reasons.items(), key=lambda item: -len(item[1])):
        terminalreporter.line(f"{len(files)} skipped: {reason}")
        terminalreporter.line(f"    in {', '.join(sorted(set(files)))}")
    if any("apt-get" in reason for reason in reasons):
        terminalreporter.line("To install what apt provides:  make tools")
    if left_out := terminalreporter.config.option.markexpr:
        terminalreporter.line(f"Not selected: tests outside '-m {left_out}' (see CONTRIBUTING.md)")
