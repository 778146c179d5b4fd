"""A misspelled key of an actuator file is found; keys of one's own are left alone."""

from __future__ import annotations

import tomllib

import pytest

from haselab.models.actuator.spelling import misspelled_keys


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[drive]\nhihg_v = 2.0", "[drive] hihg_v has no effect; did you mean high_v?"),
        ("[contoller]\nkind = 'pid'", "[contoller] has no effect; did you mean [controller]?"),
        ("[actuator]\nmas_kg = 0.2", "[actuator] mas_kg has no effect; did you mean mass_kg?"),
        ("[actuator.geometry]\ngap_mm = 1.0",
         "[actuator.geometry] gap_mm has no effect; did you mean gap_m?"),
        ("[sensing.strain_map]\nslope_per_f = 1.0\nofset = 0.0",
         "[sensing.strain_map] ofset has no effect; did you mean offset?"),
        ("[sensing]\nofsets_v = [0.0, 0.0]",
         "[sensing] ofsets_v has no effect; did you mean offsets_v?"),
        ("[model]\nnatural_frequency_rads = 3.0",
         "[model] natural_frequency_rads has no effect; did you mean natural_frequency_rad_s?"),
        ("[controller]\nkind='pid'\n[controller.parameters]\nderivative_filter = 1.0",
         "[controller.parameters] derivative_filter has no effect; did you mean "
         "derivative_filter_s?"),
        ("[[controller.alternatives]]\nkind='pi'\nlimit = {low = 0.0, high = 1.0}",
         "[controller] limit has no effect; did you mean limits?"),
    ],
)  # fmt: skip
def test_a_key_close_to_a_known_one_of_its_section_is_named(text: str, said: str) -> None:
    assert [str(found) for found in misspelled_keys(tomllib.loads(text))] == [said]


def test_keys_of_ones_own_and_all_that_commands_write_are_left_alone() -> None:
    text = """
    [mine]
    colour = "red"
    [actuator]
    name = "leg"
    serial = "A7"
    [sensing]
    stray_s = [0.0, 0.0]
    scale_std_s = 0.0
    [model]
    fit_percent = 90.0
    linear_models = []
    covariance = {names = [], valuess = []}
    [controller]
    kind = "mine"
    parameters = {kpp = 1.0}
    predicted = {rise = 1.0}
    [provenance.model]
    comand = "x"
    """
    assert misspelled_keys(tomllib.loads(text)) == []


def test_a_known_key_beside_it_is_not_meant() -> None:
    """low_v is there already: low_v2 is one of the user's own."""
    assert misspelled_keys({"drive": {"low_v": 0.0, "low_v2": 1.0, "high_v": 1.0}}) == []
