"""The actuator file of a run that started from another file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, cast

import numpy as np

from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.models.posterior import PlantPosterior
from haselab.study.definition import builtin_study
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.maps import Maps
from haselab.study.folder import write_design

OLDER = """\
[model]
numerator = [1.0]
denominator = [1.0, 2.0]
poles = [[-1.0, 0.0]]
fitted_to = [1, 2]
fit_percent = 99.0
colour = "red"  # a key of the user
"""
MAP = (1.324, 3.124, -0.2805, -26.92)


def test_the_model_of_a_run_replaces_all_of_an_older_one(tmp_path: Path) -> None:
    """A numerator left behind would be read in place of the new model."""
    (tmp_path / "actuator.toml").write_text(OLDER)
    plant = Plant(0.8, 28.0, 0.15)
    names = ("natural_frequency_rad_s", "damping_ratio", "gain")
    posterior = PlantPosterior(
        names, (True, True, False), np.array([28.0, 0.15, 0.8]), 1e-4 * np.eye(3)
    )
    dynamics = Dynamics(plant, cast(Any, None), {}, {}, posterior, 1e-4)
    maps = Maps(0.05, VoltageMap(*MAP), StrainMap(8.09e8, -0.38), {}, {}, {})
    write_design(tmp_path, maps, dynamics, None, builtin_study())
    model = tomllib.loads((tmp_path / "actuator.toml").read_text())["model"]
    assert Plant.from_dict(model) == plant and model["colour"] == "red"
    assert model["through_voltage_map"] == list(MAP)
    assert not {"numerator", "denominator", "poles", "fitted_to", "fit_percent"} & set(model)
