"""What all tests share: tiers, measured data, external programs, and the list of skipped tests."""

import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import hypothesis
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# Interlocks of benches under test, apart from those of this computer's own benches.
os.environ["HASELAB_INTERLOCKS"] = tempfile.mkdtemp(prefix="haselab-interlocks-")


def pytest_unconfigure() -> None:
    """A worker process ends without its exit handlers, so the folder is removed here."""
    shutil.rmtree(os.environ["HASELAB_INTERLOCKS"], ignore_errors=True)


# The tests run in one process per core, and their matrices are small: threads of the linear algebra
# would triple the time. Set before numpy loads, and inherited by every process that a test starts.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

_BROWSER_MS = 300e3  # how long a test may hang; a busy machine must not fail it
_TESTS = Path(__file__).resolve().parent
_SHARED = _TESTS.parents[1] / "shared" / "data"

# Folders of unit tests: they call functions, and start no process, server or chip.
_UNIT = {
    "base", "control", "controllers", "identify", "models", "sensing", "signals", "store",
    "tracking",
}  # fmt: skip

# A busy machine must not fail a test: no example has a deadline, and slow examples are no fault.
hypothesis.settings.register_profile(
    "haselab", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow]
)
hypothesis.settings.load_profile("haselab")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the unit tests, which are those of `make check`, and put what takes longest first.

    Left for the end, it would run alone. The tests that use a study stay side by side, hence on
    one worker, which plays it once.
    """
    for item in items:
        folder = item.path.relative_to(_TESTS).parts[0]
        excluded = any(item.get_closest_marker(name) for name in ("long", "slow"))
        if folder in {*_UNIT, "test_house.py", "test_lint.py"} and not excluded:
            item.add_marker("unit")
    items.sort(key=_place)


# Files beside whole studies with a test or a fixture of more than 7 s of CPU, the longest first.
_LONGEST = (
    "test_notebooks.py",
    "test_kinds.py", "test_own_controller.py", "test_your_actuator_page.py", "test_fuzz.py",
    "test_add_an_experiment_page.py", "test_one_experiment_page.py", "test_transfer_choice.py",
    "test_add_an_instrument_page.py", "test_add_a_controller_page.py",
    "test_add_an_actuator_page.py", "test_twin_of_your_actuator.py",
    "test_identification_page.py", "test_run_from_actuator.py", "test_chip_rig.py",
    "test_study_run.py", "test_which_model_page.py", "test_session_kill.py",
)  # fmt: skip


def _place(item: pytest.Item) -> int:
    if item.path.name == "test_lint.py":
        return 0
    if "studies" in getattr(item, "fixturenames", ()):
        return 1
    return 2 + (_LONGEST.index(item.path.name) if item.path.name in _LONGEST else len(_LONGEST))


_SIGNALS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
# What starts the tests may ignore a signal (nohup, a script's background job). Each process that
# they start would inherit that and not end by it. A function in its place is not inherited.
for _number in _SIGNALS:
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, lambda *_: None)
_HANDLERS = {number: signal.getsignal(number) for number in _SIGNALS}


@pytest.fixture(autouse=True)
def _signals_of_the_process() -> None:
    """A command run in this process leaves its signal handlers; the next test has the former."""
    for number, handler in _HANDLERS.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def permitted() -> type:
    """Makes gates for tests of drivers below the safety chain, with a permission."""
    from haselab.safety.gate import Gate

    class PermittedGate(Gate):
        def claim(self, key: str, call_s: float, shared: Collection[str] = ()) -> bool:
            vanished = super().claim(key, call_s, shared)
            self.permit(self.interlock.revision)
            return vanished

    return PermittedGate


@pytest.fixture(scope="session")
def benchmarks() -> Iterator[Path]:
    """The folder of the benchmarks, whose scenes some tests share; `benchmarks` can be imported."""
    checkout = _TESTS.parent
    sys.path.insert(0, str(checkout))
    yield checkout / "benchmarks"
    sys.path.remove(str(checkout))


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
            pytest.skip(f"{program} is not installed. Run:  sudo apt-get install -y {package}")
        return path

    return find


@pytest.fixture(scope="module")
def browser(installed: Callable[[str, str], str]) -> "Iterator[Browser]":
    """The distribution's Chromium."""
    path = installed("chromium", "chromium")
    playwright = pytest.importorskip("playwright.sync_api")
    playwright.expect.set_options(timeout=_BROWSER_MS)
    flags = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
    with playwright.sync_playwright() as running:
        found = running.chromium.launch(executable_path=path, args=flags)
        try:
            yield found
        finally:
            found.close()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List what was skipped by reason, which says how to get what is missing."""
    if terminalreporter.config.option.collectonly:
        return
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
