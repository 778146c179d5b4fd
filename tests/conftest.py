"""What all tests share: the measured data, where a checkout has it."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest

from haselab.safety.gate import Gate

# Interlocks of benches under test, apart from those of this computer's own benches.
os.environ["HASELAB_INTERLOCKS"] = tempfile.mkdtemp(prefix="haselab-interlocks-")
atexit.register(shutil.rmtree, os.environ["HASELAB_INTERLOCKS"], ignore_errors=True)

_SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


class PermittedGate(Gate):
    """For tests of drivers below the safety chain: they may energise what they have claimed."""

    def claim(self, key: str, call_s: float) -> bool:
        vanished = super().claim(key, call_s)
        self.permit(self.interlock.revision)
        return vanished


@pytest.fixture(scope="session")
def permitted() -> type[PermittedGate]:
    """Makes gates with a permission."""
    return PermittedGate


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured data; tests that need it are skipped, with the source, elsewhere."""
    if not _SHARED.is_dir():
        pytest.skip(
            "measured data not present; public sources: LucMarechal/Soft-Robotics-Materials-"
            "Database, SLICOT-Reference, DIC Challenge sample 14, soft-matter/trackpy, pyMRAW, pims"
        )
    return _SHARED
