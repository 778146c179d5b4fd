"""The twins of a campaign are those that its cases have."""

from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.campaign import load_twins
from haselab.rig.twin.config import twin_of_reading

DRAWN = """
name = "a"
kind = "geometry"
seed = 3
[base]
twin = "hz"
[parameters]
twin.load.mass_kg = [0.2, 0.25]
twin.shell.thickness_m = { normal = [1.2e-3, 0.05e-3] }
[design]
kind = "random"
samples = 200
repeats = 2
"""


def test_each_point_has_one_twin_with_its_drawn_values(tmp_path: Path) -> None:
    """200 draws: mean and deviation within four standard errors; nothing else differs."""
    path = tmp_path / "drawn.toml"
    path.write_text(DRAWN)
    twins = load_twins(path)
    assert [one.load.mass_kg for one in twins] == [0.2] * 200 + [0.25] * 200
    thick = np.array([one.shell.thickness_m for one in twins]).reshape(2, 200)
    np.testing.assert_array_equal(thick[0], thick[1])
    assert abs(thick[0].mean() - 1.2e-3) < 4.0 * 0.05e-3 / np.sqrt(200)
    assert abs(thick[0].std() / 0.05e-3 - 1.0) < 4.0 / np.sqrt(400)
    public = twin_of_reading("hz").model_dump(exclude={"origin"})
    other = twins[7].model_dump(exclude={"origin"})
    other["load"]["mass_kg"] = public["load"]["mass_kg"]
    other["shell"]["thickness_m"] = public["shell"]["thickness_m"]
    assert other == public


def test_a_kind_without_a_twin_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "linear.toml"
    path.write_text('name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = [0.5]\n')
    with pytest.raises(InputError, match="'transfer', which has no twin"):
        load_twins(path)
