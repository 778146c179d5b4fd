"""Panels on the twin, a browser, and an actuator file with a loop."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.panel.running import RunningPanel, ended, started


@pytest.fixture
def panel() -> Iterator[RunningPanel]:
    found = started()
    try:
        yield found
    finally:
        ended(found)


@pytest.fixture
def impatient_panel() -> Iterator[RunningPanel]:
    """A panel with the default lease."""
    found = started(lease_s=1.5)
    try:
        yield found
    finally:
        ended(found)


@pytest.fixture(scope="module")
def shared_panel() -> Iterator[RunningPanel]:
    """One panel for the tests that leave it as it was."""
    found = started()
    try:
        yield found
    finally:
        ended(found)


@pytest.fixture(scope="session")
def actuator_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Maps and controller of the reference study's actuator."""
    path = tmp_path_factory.mktemp("panel") / "actuator.toml"
    path.write_text(
        """[actuator]
kind = "planar-hasel"

[drive]
voltage_map = {a1_v = 1.588, b1 = 1.688, a2_v = -0.605, b2 = -22.05}

[sensing.strain_map]
slope_per_f = 1.053e9
offset = -0.4339
curvature_per_f2 = -6.163e17
cubic_per_f3 = 1.811e26
range_f = [4.96e-10, 9.01e-10]

[controller]
kind = "pid"
limits = {low = -0.04, high = 0.1}

[controller.parameters]
kp = 0.0
ki = 11.4
kd = 0.0
derivative_filter_s = 0.005
"""
    )
    return path
