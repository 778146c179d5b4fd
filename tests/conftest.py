"""What all tests share: the measured data, where a checkout has it."""

from pathlib import Path

import pytest

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
