"""The rig files that come with the project are the twin that the program builds."""

from pathlib import Path

import pytest

from haselab.rig.twin.config import load_twin, twin_of_reading

_RIGS = Path(__file__).resolve().parents[2] / "rigs"


@pytest.mark.parametrize("reading", ["rad", "hz"])
def test_the_file_of_a_reading_is_the_default_twin(reading):
    assert load_twin(_RIGS / f"twin-{reading}.toml") == twin_of_reading(reading)
