"""Units of headers: usual spellings are known, and what is unknown is refused with a list."""

import h5py
import numpy as np
import pytest

from haselab.base import InputError
from haselab.store.columns.table import read_table
from haselab.store.columns.units import is_unit, parse_unit, split_header


@pytest.mark.parametrize(
    ("header", "name", "si", "factor"),
    [
        ("u [V^2]", "u", "V²", 1.0),
        ("u [kV²]", "u", "V²", 1e6),
        ("t [h]", "t", "s", 3600.0),
        ("t (hours)", "t", "s", 3600.0),
        ("t [min]", "t", "s", 60.0),
        ("t (min.)", "t", "s", 60.0),
        ("t (milliseconds)", "t", "s", 1e-3),
        ("I [uA]", "I", "A", 1e-6),
        ("I [μA]", "I", "A", 1e-6),  # GREEK SMALL LETTER MU
        ("C (nF)", "C", "F", 1e-9),
        ("C (picofarads)", "C", "F", 1e-12),
        ("R [kohm]", "R", "Ω", 1e3),
        ("R [MOhm]", "R", "Ω", 1e6),
        ("e [‰]", "e", "1", 1e-3),
        ("e [um/m]", "e", "1", 1e-6),
        ("e (per cent)", "e", "1", 1e-2),
        ("x [microns]", "x", "m", 1e-6),
        ("a [m/s^2]", "a", "m/s²", 1.0),
        ("A [mm^2]", "A", "m²", 1e-6),
        ("M [N·m]", "M", "Nm", 1.0),
        ("L [H]", "L", "H", 1.0),  # henry, not hours
        ("p [psi]", "p", "Pa", 6894.757293168),
        ("time_hours", "time", "s", 3600.0),
        ("force_kn", "force", "N", 1e3),
        ("F [gf]", "F", "N", 9.80665e-3),  # the standard acceleration, by definition
        ("F (kgf)", "F", "N", 9.80665),
        ("F [N]", "F", "N", 1.0),
        ("u [KV]", "u", "V", 1e3),
        ("u [kv]", "u", "V", 1e3),
        ("E [MV/m]", "E", "V/m", 1e6),
        ("p [MPa]", "p", "Pa", 1e6),
        ("Disp {mm}", "Disp", "m", 1e-3),
        ("Weg mm", "Weg", "m", 1e-3),
        ("Strain %", "Strain", "1", 1e-2),
    ],
)
def test_usual_spellings_are_known(header, name, si, factor):
    found, text = split_header(header)
    unit = parse_unit(text, header)
    assert (found, unit.si, unit.factor) == (name, si, pytest.approx(factor))


@pytest.mark.parametrize("header", ["x [dB]", "u [A^3]", "u (V^3)", "stress_mpa", "p [mpa]"])
def test_unknown_and_ambiguous_ones_are_refused_with_those_that_are_known(header):
    _, text = split_header(header)
    with pytest.raises(InputError, match=r"unknown or ambiguous. Use V, A, .* mV, µA or uA, pF"):
        parse_unit(text, header)


@pytest.mark.parametrize(
    "header",
    ["F [GF]", "x [gm]", "x [Gm]", "x [Mm]", "x [MM]", "x / Mm", "x_Mm", "t [gs]", "t [MS]",
     "I [fa]", "I [MA]", "C [MF]", "E [mV/m]", "E (mV/m)", "p (MBAR)", "G [S]", "G (µS)", "G / mS",
     "G [uS]", "u [gv]"],
)  # fmt: skip
def test_a_unit_in_the_wrong_case_never_changes_its_prefix_or_quantity(header):
    _, text = split_header(header)
    with pytest.raises(InputError, match=r"unknown or ambiguous"):
        parse_unit(text, header)


@pytest.mark.parametrize("header", ["Channel A", "Strain min", "Sensor 1", "U {raw}", "mm"])
def test_a_last_word_that_may_be_part_of_the_name_states_no_unit(header):
    assert split_header(header) == (header, "")


def test_every_unit_that_the_refusal_names_is_known():
    with pytest.raises(InputError, match=r"unknown") as refused:
        parse_unit("furlong", "here")
    listed = str(refused.value).split("Use ")[1].removesuffix(" for a pure number.")
    for word in ("and ", "g with a prefix from f to k (such as", ")", "or "):
        listed = listed.replace(word, ",")
    names = [name.strip() for name in listed.split(",") if name.strip()]
    assert len(names) > 30
    assert [name for name in names if not is_unit(name)] == []


def test_an_unknown_unit_of_an_attribute_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["u"] = np.arange(4.0)
        file["u"].attrs["units"] = "furlong"
    with pytest.raises(InputError, match=r"^Column 'u' states the unit 'furlong'"):
        read_table(tmp_path / "a.h5", ["u"])


def test_an_unknown_unit_of_a_labview_channel_is_refused(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        channels = [
            nptdms.ChannelObject("g", "u", np.arange(4.0), {"unit_string": "furlong"}),
            nptdms.ChannelObject("g", "y", np.arange(4.0), {"unit_string": "mV"}),
        ]
        writer.write_segment(channels)
    assert read_table(tmp_path / "a.tdms", ["y"])["y"].tolist() == [0.0, 1e-3, 2e-3, 3e-3]
    with pytest.raises(InputError, match=r"^Column 'g/u' states the unit 'furlong'"):
        read_table(tmp_path / "a.tdms", ["u"])


def test_the_unit_of_a_very_long_header_is_found_without_delay():
    """The time of a pattern that tries each place of a run of spaces grows with its third power."""
    name = "x" + " " * 100_000 + "y"
    assert split_header(name) == (name, "")
    assert split_header(f"{name} [mV]") == (name, "mV")
