"""The actuator file that comes with the package is what a quick study of the same twin finds."""

import tomllib
from pathlib import Path

import numpy as np

from haselab.study.definition import reference_actuator

SHIPPED = tomllib.loads(reference_actuator())


def test_its_model_is_that_of_another_seed_within_both_uncertainties(played):
    fresh = tomllib.loads((played("hz").folder / "actuator.toml").read_text())
    assert fresh["provenance"]["model"]["command"] != SHIPPED["provenance"]["model"]["command"]
    first, second = (one["model"]["covariance"] for one in (SHIPPED, fresh))
    assert first["names"] == second["names"] and first["logarithmic"] == second["logarithmic"]
    values = np.array([first["values"], second["values"]])
    difference = np.where(first["logarithmic"], np.log(np.abs(values[0] / values[1])),
                          values[0] - values[1])  # fmt: skip
    total = np.array(first["matrix"]) + np.array(second["matrix"])
    assert np.all(np.abs(difference) < 4.0 * np.sqrt(np.diag(total)))


def test_its_maps_are_those_of_another_seed(played):
    fresh = tomllib.loads((played("hz").folder / "actuator.toml").read_text())
    low_f, high_f = SHIPPED["sensing"]["strain_map"]["range_f"]
    farads = np.linspace(low_f, high_f, 50)
    powers = ["offset", "slope_per_f", "curvature_per_f2", "cubic_per_f3"]
    # Each study has a zero of its own for the strain, so that the lengths are compared.
    lengths_m = [
        one["actuator"]["geometry"]["zero_length_m"]
        * (1.0 + sum(one["sensing"]["strain_map"][name] * farads**k
                     for k, name in enumerate(powers)))
        for one in (SHIPPED, fresh)
    ]  # fmt: skip
    # The band states where 95 % of single strains are: the maps themselves differ by less.
    low, high = SHIPPED["sensing"]["strain_map"]["band"]
    zero_m = SHIPPED["actuator"]["geometry"]["zero_length_m"]
    assert np.max(np.abs(lengths_m[0] - lengths_m[1])) < 0.5 * (high - low) * zero_m
    drives = []
    for one in (SHIPPED, fresh):
        curve = one["drive"]["voltage_map"]
        at_m = zero_m * (1.0 + np.linspace(-0.035, 0.15, 50))  # 0.1 V to 2 V
        strain = at_m / one["actuator"]["geometry"]["zero_length_m"] - 1.0
        drives.append(curve["a1_v"] * np.exp(curve["b1"] * strain)
                      + curve["a2_v"] * np.exp(curve["b2"] * strain))  # fmt: skip
    assert np.min(drives) > 0.0 and np.max(drives) < 2.1
    # The noise moves such a fit by some 0.1 mV; 5 mV are a quarter of a per cent of the range.
    assert np.max(np.abs(drives[0] - drives[1])) < 0.005


def test_it_names_no_place_of_the_machine_that_wrote_it():
    for one in (SHIPPED["provenance"]["model"], SHIPPED["provenance"]["controller"]):
        assert one["command"].startswith("haselab reproduce --quick --no-physical-model --out ")
        assert not Path(one["command"].split()[-1]).is_absolute()
        assert one["simulated"] is True
