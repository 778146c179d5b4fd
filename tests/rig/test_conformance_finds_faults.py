"""The conformance suite refuses drivers with the faults that leave high voltage on."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "examples" / "plugins" / "haselab-mysupply"
# fault: what the driver has, what it has instead, and the test that has to fail
FAULTS = {
    "shut_down does nothing": (
        "            connection.switch_off_and_discharge()\n            connection.check",
        "            connection.check",
        "test_shut_down_from_outside_switches_off_an_output_in_use",
    ),
    "opening leaves the output on, as does closing": (
        "            self._connection.switch_off_and_discharge()\n        except",
        "            self.off = lambda: None\n        except",
        "test_opening_switches_off_what_was_left_on",
    ),
    "off leaves the set point": (
        "OUTP OFF;:VOLT 0;:OUTP?",
        "VOLT 0;:OUTP?",
        "test_opening_switches_off_what_was_left_on|test_off_is_off|test_shut_down",
    ),
    "is_off repeats what was requested": (
        'return self._connection.query("OUTP?") == "0"',
        "return True",
        "test_it_reports_that_it_is_on",
    ),
    "off raises": (
        "        with contextlib.suppress(DeviceError):\n            self._connection.switch_off()",
        "        self._connection.switch_off()",
        "test_off_does_not_raise_on_a_closed_connection",
    ),
    "the limit of the rig file is ignored": (
        "if not 0.0 <= voltage_v <= self._config.highest_v:",
        "if not 0.0 <= voltage_v <= 1e9:",
        "test_a_voltage_outside_the_limits_is_refused_and_the_old_one_stays",
    ),
    "another supply is accepted": (
        'if wanted is not None and wanted not in identity.split(","):',
        "if False:",
        "test_another_serial_number_is_refused",
    ),
    "a voltage is set and never put out": (
        ";:OUTP ON;:VOLT?",
        ";:VOLT?",
        "test_it_reports_that_it_is_on",
    ),
}


def conformance(folder: Path, *options: str, old: str = "", new: str = "") -> tuple[int, str]:
    """The package's own tests, with one text of its driver replaced."""
    shutil.copytree(PACKAGE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    driver = folder / "haselab_mysupply.py"
    text = driver.read_text()
    assert old in text
    driver.write_text(text.replace(old, new, 1))
    metadata = folder / "haselab_mysupply-0.1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: haselab-mysupply\nVersion: 0.1.0\n"
    )
    (metadata / "entry_points.txt").write_text(
        "[haselab.instruments]\nmysupply = haselab_mysupply:MySupply\n"
    )
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rf", "-p", "no:cacheprovider", "-p", "no:xdist",
         "--rootdir", str(folder), "-c", os.devnull, *options, "tests"],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)}, capture_output=True, text=True,
        check=False, timeout=300.0,
    )  # fmt: skip
    return done.returncode, done.stdout


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_of_a_driver_fails_the_test_for_it(fault: str, tmp_path: Path) -> None:
    old, new, test = FAULTS[fault]
    only = ("-k", test.replace("|", " or "))
    code, output = conformance(tmp_path / "package", *only, old=old, new=new)
    assert code == 1, output
    assert re.search(rf"^FAILED .*::TestMySupply::({test})", output, re.MULTILINE), output


def test_without_a_fault_all_pass(tmp_path: Path) -> None:
    code, output = conformance(tmp_path / "package")
    assert code == 0, output
    assert "20 passed" in output


def test_the_suite_without_pytest_names_what_to_install():
    code = "import sys; sys.modules['pytest'] = None; import haselab.testing.conformance"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert "pytest, which is not installed" in found.stderr.splitlines()[-1]
