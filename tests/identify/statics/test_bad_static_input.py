"""Static fits refuse what cannot be, in one line with what to do, and leave the caller's arrays."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import HaselabError, InputError
from haselab.identify import (
    ArxOrders,
    Record,
    find_regions,
    fit_arx,
    fit_capacitance_map,
    fit_hyperelastic,
    fit_map,
    fit_voltage_map,
)
from haselab.identify.statics.columns import note_on_voltage
from haselab.models import Gent, LinearMap, VoltageMap

STRETCH = np.linspace(1.0, 3.0, 40)
STRESS_PA = Gent(15e3, 60.0).nominal_stress_pa(STRETCH)
STRAIN = 0.05 - 0.09 * np.cos(np.linspace(0.0, 12.0, 300))
VOLTS = VoltageMap(1.324, 3.124, -0.2805, -26.92).voltage_v(STRAIN)
CAPACITANCE = LinearMap(4.923e6, -0.276).relative_capacitance(STRAIN)
DRIVE = np.random.default_rng(1).normal(size=300)

Fit = Callable[..., object]
# The fit, its two columns, and what they are called.
FITS: dict[str, tuple[Fit, np.ndarray, np.ndarray, str, str]] = {
    "hyperelastic": (
        lambda x, y: fit_hyperelastic(x, y, "gent"), STRETCH, STRESS_PA, "stretch",
        "nominal_stress_pa",
    ),
    "regions": (find_regions, STRETCH, STRESS_PA / 1e4, "stretch", "load_n"),
    "voltage-map": (fit_voltage_map, STRAIN, VOLTS, "strain", "voltage_v"),
    "capacitance-map": (
        fit_capacitance_map, CAPACITANCE, STRAIN, "relative_capacitance", "strain",
    ),
    "map": (fit_map, STRAIN, VOLTS, "x", "y"),
    "arx": (
        lambda u, y: fit_arx(Record.sampled(u, y, 10.0), ArxOrders(1, 1, 1)),
        DRIVE, np.cumsum(DRIVE), "u", "y",
    ),
}  # fmt: skip
ALL = pytest.mark.parametrize("name", list(FITS))


def refusal(fit: Fit, *columns: object) -> str:
    """The line with which columns are refused."""
    with pytest.raises(InputError, match=r"must|needed") as error:
        fit(*columns)
    line = str(error.value)
    assert "\n" not in line
    # What to do is the last sentence.
    assert line.rstrip().endswith((".", "?")), line
    return line


@ALL
def test_a_column_without_change_is_refused(name: str) -> None:
    fit, x, y, first, second = FITS[name]
    flat_x, flat_y = refusal(fit, np.full(x.size, 1.5), y), refusal(fit, x, np.full(y.size, 2.0))
    assert "1.5 throughout" in flat_x and "2 throughout" in flat_y
    if name != "arx":
        assert flat_x.startswith(first) and flat_y.startswith(second)


@ALL
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_no_number_is_refused_with_its_row(name: str, bad: float) -> None:
    fit, x, y, first, second = FITS[name]
    for column, label in ((0, first), (1, second)):
        columns = [x.copy(), y.copy()]
        columns[column][7] = bad
        assert refusal(fit, *columns).startswith(f"{label} is {bad} at index 7")


@ALL
def test_too_few_samples_and_unequal_lengths_are_refused(name: str) -> None:
    fit, x, y, *_ = FITS[name]
    assert "at least" in refusal(fit, x[:3], y[:3])
    assert "must be equally long" in refusal(fit, x, y[:-1])
    refusal(fit, x[:, None], y)
    refusal(fit, np.array([]), np.array([]))


@pytest.mark.long
@pytest.mark.parametrize("name", ["hyperelastic", "regions", "voltage-map", "capacitance-map"])
def test_swapped_columns_are_noticed(name: str) -> None:
    fit, x, y, *_ = FITS[name]
    if name == "voltage-map":
        # Drive volts can be strains; volts of an amplifier cannot.
        fit(y, x)
        y = 2000.0 * y
    assert "swapped" in refusal(fit, y, x)


def test_stretch_in_other_units_is_refused() -> None:
    for fit, y in ((fit_hyperelastic, STRESS_PA), (find_regions, 3.0 * STRESS_PA / 1e4)):
        assert "Give stretch, not strain" in refusal(fit, STRETCH - 1.0, y)
        assert "per cent" in refusal(fit, 100.0 * (STRETCH - 1.0), y)
        assert "per cent" in refusal(fit, 100.0 * STRETCH, y)
        assert "load or a stress" in refusal(fit, 1e4 * STRETCH, y * 1e3)
    # A strain that never is zero passes for a stretch, but not with a tensile stress.
    strain = np.linspace(0.05, 2.0, 40)
    stress_pa = Gent(15e3, 60.0).nominal_stress_pa(1.0 + strain)
    assert "Give stretch, not strain" in refusal(fit_hyperelastic, strain, stress_pa)


@pytest.mark.parametrize("factor", [1e-6, 1e-3])
def test_stress_in_kpa_or_mpa_is_reported(factor: float) -> None:
    fit = fit_hyperelastic(STRETCH, factor * STRESS_PA, "gent")
    assert any("in kPa or MPa?" in note for note in fit.notes)
    assert not any("kPa" in note for note in fit_hyperelastic(STRETCH, STRESS_PA, "gent").notes)


def test_a_strain_above_one_is_noted() -> None:
    doubt = "per cent, divide it by 100."
    large = fit_voltage_map(10.0 * STRAIN, 1000.0 * VOLTS)
    assert large.notes[-1] == f"The strain reaches 1.4 times the length. If it is in {doubt}"
    assert fit_capacitance_map(CAPACITANCE, 10.0 * STRAIN).notes[-1].endswith(doubt)
    assert not any(doubt in note for note in fit_voltage_map(STRAIN, 1000.0 * VOLTS).notes)


def test_strain_in_other_units_is_refused() -> None:
    assert "strain reaches 13.9998;" in refusal(fit_voltage_map, 100.0 * STRAIN, 1000.0 * VOLTS)
    assert "divide it by 100" in refusal(fit_voltage_map, 40.0 + STRAIN, 1000.0 * VOLTS)
    assert "divide it by 100" in refusal(fit_capacitance_map, 1e9 * CAPACITANCE, 100.0 * STRAIN)


@pytest.mark.long
def test_voltage_that_cannot_be_is_refused_and_what_may_be_kilovolts_is_reported() -> None:
    assert "at most 100000 V" in refusal(fit_voltage_map, STRAIN, 1e6 * VOLTS)
    (note,) = note_on_voltage("U", VOLTS)
    assert f"reaches {VOLTS.max():.3g} only" in note and "--unit 'U=kV'" in note
    assert not note_on_voltage("U", 2000.0 * VOLTS)


@pytest.mark.long
@ALL
@settings(max_examples=15, deadline=None)
@given(st.data())
def test_the_callers_arrays_are_never_changed(name: str, data: st.DataObject) -> None:
    fit, x, y, *_ = FITS[name]
    seed = data.draw(st.integers(0, 2**16))
    size = data.draw(st.integers(3, 40))
    scale = data.draw(st.sampled_from([0.0, 1e-3, 1.0]))
    rows = np.random.default_rng(seed).permutation(x.size)[:size]
    columns = [x[rows], y[rows] * (1.0 + scale * np.random.default_rng(seed).normal(size=size))]
    kept = [column.copy() for column in columns]
    for column in columns:
        column.flags.writeable = False
    try:
        fit(*columns)
    except HaselabError as error:
        assert "\n" not in str(error)
    for column, copy in zip(columns, kept, strict=True):
        np.testing.assert_array_equal(column, copy)
