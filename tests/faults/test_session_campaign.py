"""A slice of the damage campaign, with fixed seeds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(sys.platform != "linux", reason="forks with Linux's limits and locks")
def test_no_damage_to_a_session_hangs_a_command_or_passes_for_its_numbers() -> None:
    script = Path(__file__).with_name("session_campaign.py")
    command = [sys.executable, str(script), "--flips", "15", "--overwrites", "6", "--cuts", "6"]
    done = subprocess.run([*command, "--seed", "70001"], capture_output=True, text=True,
                          timeout=500, check=False)  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 rules broken" in done.stdout
    assert (
        sum(line.startswith(("flip", "overwrite", "cut")) for line in done.stdout.splitlines())
        == 36
    )
