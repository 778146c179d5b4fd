"""Conformance tests for instrument drivers, as pytest classes to derive from.

Derive a class from the one for your instrument, and give it a fixture `rig_file`: the path of a rig
file with your section.

THE TESTS PUT OUT VOLTAGES. Run them on an emulator. On a real instrument, disconnect the actuator
and the amplifier first, and keep clear.

Example:
    >>> import pytest
    >>> class TestMySupply(SupplyConformance):
    ...     @pytest.fixture
    ...     def rig_file(self, tmp_path):
    ...         path = tmp_path / "rig.toml"
    ...         path.write_text(RIG)
    ...         return path
"""

from haselab.testing.conformance.bench import BenchConformance
from haselab.testing.conformance.instruments import (
    BlockTimer,
    CameraConformance,
    GeneratorConformance,
    InstrumentConformance,
    SupplyConformance,
)

__all__ = [
    "BenchConformance",
    "BlockTimer",
    "CameraConformance",
    "GeneratorConformance",
    "InstrumentConformance",
    "SupplyConformance",
]
