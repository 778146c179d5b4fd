"""A panel whose actuator file has a model and a controller, but no maps."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.panel.pages.test_design import CONTROLLER, MODEL
from tests.panel.running import RunningPanel, ended, started


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "actuator.toml"
    found.write_text(MODEL + CONTROLLER)
    return found


@pytest.fixture
def with_file(path: Path) -> Iterator[RunningPanel]:
    found = started("--actuator", str(path))
    try:
        yield found
    finally:
        ended(found)
