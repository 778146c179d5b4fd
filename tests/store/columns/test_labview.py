"""LabVIEW measurement files state units and rate in their headers, per channel.

The layouts follow NI's specification of the .lvm format; values of a channel stand in its column.
"""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import read_table

T, U, Y = np.arange(40) / 100.0, np.sin(np.arange(40.0)), np.cos(np.arange(40.0))


def text(columns, units="mV\tV", dimension="Time\tTime", labels="", rows=None):
    names = {"One": "X_Value\tu\ty", "Multi": "X_Value\tu\tX_Value\ty", "No": "X_Value\tu\ty"}
    written = {
        "One": [f"{t}\t{1e3 * u}\t{y}" for t, u, y in zip(T, U, Y, strict=True)],
        "Multi": [f"{t}\t{1e3 * u}\t{t}\t{y}" for t, u, y in zip(T, U, Y, strict=True)],
        "No": [f"\t{1e3 * u}\t{y}" for u, y in zip(U, Y, strict=True)],
    }
    between = "\t\t" if columns == "Multi" else "\t"
    units, dimension = (each.replace("\t", between) for each in (units, dimension))
    return (
        "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
        f"Multi_Headings\tYes\nX_Columns\t{columns}\n***End_of_Header***\t\n\t\n"
        f"Channels\t2\nSamples\t40{between}40\nY_Unit_Label\t{units}\n"
        f"X_Dimension\t{dimension}\n{labels}X0\t0{between}0\nDelta_X\t0.01{between}0.01\n"
        f"***End_of_Header***\t\n{names[columns]}\tComment\n" + "\n".join(written[columns]) + "\n"
    )


def read(folder, content, options=None):
    (folder / "a.lvm").write_text(content)
    return read_table(folder / "a.lvm", ["u", "y"], options or ColumnOptions())


@pytest.mark.parametrize("columns", ["One", "Multi", "No"])
def test_each_channel_is_converted_from_its_own_unit(tmp_path, columns):
    table = read(tmp_path, text(columns))
    np.testing.assert_allclose(table["u"], U, rtol=1e-12)
    np.testing.assert_array_equal(table["y"], Y)
    assert {name: unit.symbol for name, unit in table.units.items()} == {"u": "mV", "y": "V"}
    assert table.rate_hz == pytest.approx(100.0)
    assert not table.assumed_seconds  # the specification says s


def test_a_decimal_comma_in_the_increment_is_read(tmp_path):
    assert read(tmp_path, text("No").replace(".", ",")).rate_hz == pytest.approx(100.0)


def test_an_x_axis_that_is_no_time_gives_no_rate(tmp_path):
    for columns in ("One", "No"):
        frequency = text(columns, dimension="Frequency\tFrequency")
        assert read(tmp_path, frequency).rate_hz is None
    milliseconds = text("One", labels="X_Unit_Label\tms\tms\n")
    assert read(tmp_path, milliseconds).rate_hz == pytest.approx(1e5)


@pytest.mark.parametrize(
    ("old", "new"),
    [("Delta_X\t0.01\t\t0.01", "Delta_X\t0.01\t\t0.02"), ("X0\t0\t\t0", "X0\t0\t\t3")],
)
def test_channels_with_times_of_their_own_need_the_column_of_times(tmp_path, old, new):
    own = text("Multi").replace(old, new)
    assert read(tmp_path, own).rate_hz is None
    assert read(tmp_path, own, ColumnOptions("1")).rate_hz == pytest.approx(100.0)
    assert read(tmp_path, text("Multi"), ColumnOptions("3")).rate_hz == pytest.approx(100.0)


def test_an_unknown_unit_of_a_channel_is_refused_and_can_be_stated(tmp_path):
    strange = text("One", units="furlong\tV")
    with pytest.raises(InputError, match=r"^Column 'u' states the unit 'furlong', which is unk"):
        read(tmp_path, strange)
    stated = read(tmp_path, strange, ColumnOptions(units={"u": "mV"}))
    np.testing.assert_allclose(stated["u"], U, rtol=1e-12)


def test_a_second_segment_is_refused(tmp_path):
    whole = text("One")
    second = whole[whole.index("Channels") :]
    line = whole.count("\n") + 2  # after an empty one
    with pytest.raises(InputError, match=rf"^Line {line} begins another segment of a LabVIEW file"):
        read(tmp_path, f"{whole}\n{second}")
