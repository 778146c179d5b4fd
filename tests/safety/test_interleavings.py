"""Random interleavings of commands, faults and safe acts: energised implies a permission."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import run_state_machine_as_test


def _load() -> object:
    path = Path(__file__).with_name("interleavings.py")
    spec = importlib.util.spec_from_file_location("safety_interleavings", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["safety_interleavings"] = module
    spec.loader.exec_module(module)
    return module


interleavings = _load()
FEW = settings(
    deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), print_blob=False
)


def test_on_the_twin_nothing_is_energised_without_a_permission() -> None:
    run_state_machine_as_test(
        interleavings.Interleavings, settings=settings(FEW, max_examples=60, stateful_step_count=30)
    )
    counts = interleavings.COUNTS
    assert counts["checks while energised"] > 50, "the cases do reach high voltage"
    assert counts["made safe by others"] and counts["armed"] and counts["vanish"]


def test_over_the_wire_nothing_is_energised_without_a_permission() -> None:
    pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
    before = interleavings.COUNTS["checks while energised"]
    try:
        run_state_machine_as_test(
            interleavings.WireInterleavings,
            settings=settings(FEW, max_examples=8, stateful_step_count=25),
        )
    finally:
        interleavings.WireUnderTest.stop()
    assert interleavings.COUNTS["checks while energised"] > before
