"""Rates that a file states column by column, and columns that are only called like times."""

import h5py
import numpy as np
import pytest

from haselab.base import InputError
from haselab.store.columns.table import read_table

T, U, Y = np.arange(40) / 100.0, np.sin(np.arange(40.0)), np.cos(np.arange(40.0))


def rate_of_tdms(file, u, y):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(file) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("g", "u", U, u), nptdms.ChannelObject("g", "y", Y, y)]
        )
    return read_table(file, ["u", "y"]).rate_hz


def test_the_increment_of_a_waveform_is_in_the_unit_of_its_x_axis(tmp_path):
    in_ms = {"wf_increment": 10.0, "wf_xunit_string": "ms"}
    in_s = {"wf_increment": 0.01, "wf_xunit_string": ""}
    for u, y in ((in_ms, in_ms), (in_ms, in_s), (in_s, {})):
        assert rate_of_tdms(tmp_path / "a.tdms", u, y) == pytest.approx(100.0, rel=1e-12)
    for unit in ("Hz", "furlong"):  # a spectrum, and nobody knows
        no_time = {"wf_increment": 10.0, "wf_xunit_string": unit}
        assert rate_of_tdms(tmp_path / "b.tdms", no_time, no_time) is None


@pytest.mark.parametrize("other", [{"wf_increment": 0.001}, {"wf_start_offset": 3.0}])
def test_waveforms_with_times_of_their_own_have_no_common_rate(tmp_path, other):
    first = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    assert rate_of_tdms(tmp_path / "a.tdms", first, first | other) is None
    assert rate_of_tdms(tmp_path / "b.tdms", first | other, first) is None


@pytest.mark.parametrize(("rate_hz", "found"), [(200.0, None), (np.float32(100.0), 100.0)])
def test_datasets_with_other_rates_have_no_common_one(tmp_path, rate_hz, found):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["u"], file["y"] = U, Y
        file["u"].attrs["fs"], file["y"].attrs["fs"] = 100.0, rate_hz
    assert read_table(tmp_path / "a.h5", ["u", "y"]).rate_hz == found


def test_a_column_of_temperatures_does_not_hide_the_one_of_times(tmp_path):
    rows = [f"{t},{u},{y},20" for t, u, y in zip(T, U, Y, strict=True)]
    file = tmp_path / "a.csv"
    file.write_text("\n".join(["t,u,y,T [°C]", *rows]), encoding="utf-8")
    table = read_table(file, ["u", "y"])
    assert (table.time_name, table.rate_hz) == ("t", pytest.approx(100.0, rel=1e-9))


def test_stored_integers_are_scaled_as_their_attributes_say(tmp_path):
    path, y = tmp_path / "packed.h5", np.linspace(-1.0, 2.0, 100)
    with h5py.File(path, "w") as file:
        file["u"] = np.round(y / 1e-3).astype("i2")
        file["u"].attrs["scale_factor"] = 1e-3
        packed = np.round((y - 5.0) / 1e-3).astype("i2")
        file.create_dataset("y", data=packed, chunks=(10,), compression="gzip")
        file["y"].attrs.update({"scale_factor": np.array([1e-3]), "add_offset": 5.0})
    table = read_table(path, ["u", "y"])
    # Half a step of the stored numbers.
    assert np.abs(table["u"] - y).max() <= 0.501e-3
    assert np.abs(table["y"] - y).max() <= 0.501e-3


def test_the_fill_value_of_a_dataset_is_no_measurement(tmp_path):
    path, y = tmp_path / "filled.h5", np.linspace(0.0, 1.0, 100)
    y[40:50] = -9999.0
    with h5py.File(path, "w") as file:
        file["y"] = y
        file["y"].attrs["_FillValue"] = -9999.0
    with pytest.raises(InputError, match=r"nan in row 41 \(10 such rows\)"):
        read_table(path, ["y"])


@pytest.mark.parametrize("late", [0, 3])
def test_waveforms_that_begin_at_different_times_are_refused(tmp_path, late):
    tdms = pytest.importorskip("nptdms")
    path, begin = tmp_path / "late.tdms", np.datetime64("2026-01-01T00:00:00", "us")
    waveform = {"wf_increment": 0.01, "wf_start_offset": 0.0}
    channels = [
        tdms.ChannelObject(
            "g", name, np.arange(50.0),
            properties={**waveform, "wf_start_time": begin + np.timedelta64(seconds, "s")},
        )
        for name, seconds in (("u", 0), ("y", late))
    ]  # fmt: skip
    with tdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(channels)
    if late:
        with pytest.raises(InputError, match="g/y begins 3 s after channel g/u"):
            read_table(path, ["u", "y"])
    else:
        assert read_table(path, ["u", "y"]).rate_hz == pytest.approx(100.0)
