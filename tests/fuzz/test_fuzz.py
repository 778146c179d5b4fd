"""What the fuzzer once found stays mended, and a fixed slice of it finds nothing new."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, and reads /proc")
HERE = Path(__file__).parent
GUARD_S = 1500.0  # against a fuzzer that hangs, on a busy machine
SLICES, CASES = 2, 450  # together about a minute of computing


def fuzzed(*arguments: str) -> None:
    command = [sys.executable, str(HERE / "fuzz.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=GUARD_S, check=False)
    assert done.returncode == 0, done.stdout[-8000:] + done.stderr[-4000:]


def test_no_case_that_was_once_found_is_a_defect_again() -> None:
    fuzzed("--replay", *map(str, sorted((HERE / "corpus").rglob("*.json"))))


@pytest.mark.parametrize("part", range(SLICES))
def test_a_fixed_slice_of_the_fuzzer_finds_no_defect(part: int) -> None:
    fuzzed("--seed", f"{1000 + part}", "--cases", str(CASES), "--seconds", "inf")
