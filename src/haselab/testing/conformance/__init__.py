"""Conformance tests for instrument drivers: base classes for your pytest classes.

Derive a class from the one for your kind of instrument. Give it a fixture `rig_file` that returns
the path of a rig file with the section of your instrument.

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

from haselab.store.optional import library

library("pytest", "test")  # in one clear line, before the modules that import it

from haselab.testing.conformance.bench import BenchConformance, DaqConformance  # noqa: E402
from haselab.testing.conformance.instruments import (  # noqa: E402
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
    "DaqConformance",
    "GeneratorConformance",
    "InstrumentConformance",
    "SupplyConformance",
]
