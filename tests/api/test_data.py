"""Files, pandas, xarray and dictionaries give the same tables and records."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from scipy.io import savemat

import haselab as hl
from haselab.base import InputError
from haselab.store.session.writer import ExperimentPlan, SessionWriter

TIME_S = np.arange(200) / 50.0
U = np.repeat(np.random.default_rng(1).normal(size=20), 10)
Y = np.cumsum(U)


def csv(folder: Path) -> Path:
    path = folder / "record.csv"
    rows = np.column_stack([TIME_S, U, Y, np.arange(200) != 7])
    np.savetxt(path, rows, "%.17g", ",", header="time_s,u,y,valid", comments="")
    return path


SOURCES = {
    "dictionary": {"time_s": TIME_S, "u": U, "y": Y},
    "frame with a column of times": pd.DataFrame({"time_s": TIME_S, "u": U, "y": Y, "word": "a"}),
    "frame with an index of times": pd.DataFrame(
        {"u": U, "y": Y}, index=pd.Index(TIME_S, name="time_s")
    ),
    "frame with an index of clock times": pd.DataFrame(
        {"u": U, "y": Y}, index=pd.Timestamp("2026-01-01") + pd.to_timedelta(TIME_S, unit="s")
    ),
    "frame with an index in a time zone": pd.DataFrame(
        {"u": U, "y": Y},
        index=pd.Timestamp("2026-03-29", tz="Europe/Zurich") + pd.to_timedelta(TIME_S, unit="s"),
    ),
    "frame of nullable numbers": pd.DataFrame({"time_s": TIME_S, "u": U, "y": Y}, dtype="Float64"),
    "milliseconds by name": {"time_ms": 1e3 * TIME_S, "u": U, "y": Y},
    "milliseconds in brackets": pd.DataFrame({"Zeit [ms]": 1e3 * TIME_S, "u": U, "y": Y}),
    "frame with an index in milliseconds": pd.DataFrame(
        {"u": U, "y": Y}, index=pd.Index(1e3 * TIME_S, name="t [ms]")
    ),
    "frame with durations": pd.DataFrame(
        {"time_ms": pd.to_timedelta(TIME_S, unit="s"), "u": U, "y": Y}
    ),
    "data set in milliseconds": xr.Dataset(
        {"u": ("time", U), "y": ("time", Y)}, {"time": ("time", 1e3 * TIME_S, {"units": "ms"})}
    ),
    "data set": xr.Dataset({"u": ("time_s", U), "y": ("time_s", Y)}, {"time_s": TIME_S}),
    "table": hl.table({"time_s": TIME_S, "u": U, "y": Y}),
}


@pytest.mark.parametrize("data", SOURCES.values(), ids=SOURCES.keys())
def test_every_source_gives_the_same_record(data):
    (record,) = hl.records(data)
    assert np.array_equal(record.u, U) and np.array_equal(record.y, Y)
    assert record.input_rate_hz == pytest.approx(50.0, rel=1e-9)
    assert record.input_before is None


def test_a_rate_comes_from_the_argument_or_the_attribute():
    frame = pd.DataFrame({"drive": U, "out": Y})
    with pytest.raises(InputError, match="no sampling rate"):
        hl.records(frame, "drive", "out")
    assert hl.records(frame, "drive", "out", rate_hz=20.0)[0].input_rate_hz == 20.0
    frame.attrs["rate_hz"] = 30.0
    assert hl.records(frame, "drive", "out")[0].input_rate_hz == 30.0


def test_times_in_a_unit_come_out_in_seconds():
    found = hl.table({"t / min": TIME_S / 60.0, "u": U})
    assert (found.time_name, sorted(found)) == ("time_s", ["time_s", "u"])
    np.testing.assert_allclose(found.time_s, TIME_S, rtol=1e-12, atol=1e-12)
    volts = hl.table({"t [mV]": TIME_S, "u": U})  # no times
    assert (volts.time_name, volts.rate_hz) == (None, None)
    with pytest.raises(InputError, match=r"^Column 't \[ticks\]' states the unit 'ticks', which"):
        hl.records({"t [ticks]": TIME_S, "u": U, "y": Y})


@pytest.mark.parametrize(
    ("name", "factor"),
    [("clock", 1.0), ("clock [ms]", 1e3), ("t [ms]", 1e3), ("frame_min", 1 / 60)],
)
def test_times_of_any_name(name, factor, tmp_path):
    path = tmp_path / "a.csv"
    rows = np.c_[factor * TIME_S, U, Y]
    np.savetxt(path, rows, "%.17g", ",", header=f"{name},u,y", comments="")
    columns = {name: factor * TIME_S, "u": U, "y": Y}
    for data in (columns, pd.DataFrame(columns), path, hl.load(path)):
        (found,) = hl.records(data, time=name)
        assert found.input_rate_hz == pytest.approx(50.0)


def test_the_named_times_are_used_and_must_be_times():
    both = {"time_s": TIME_S, "late_s": 2.0 * TIME_S, "u": U, "y": Y}
    assert hl.records(both, time="late_s")[0].input_rate_hz == pytest.approx(25.0)
    with pytest.raises(InputError, match=r"^Column 'u \[V\]' is in V, not in s\. Name"):
        hl.records({"u [V]": TIME_S, "u": U, "y": Y}, time="u [V]")
    with pytest.raises(InputError, match=r"^There is no column 'clok'; the data have time_s, "):
        hl.records(both, time="clok")


def test_what_print_shows_of_a_table():
    found = hl.table({"time_s": TIME_S, "u": U})
    assert str(found) == repr(found) == "Table of 200 rows at 50 Hz: time_s, u"


def test_a_loaded_table_shows_the_units_of_its_values(tmp_path):
    path = tmp_path / "a.csv"
    np.savetxt(path, np.c_[1e3 * TIME_S, U], "%.17g", ",", header="t [ms],u [mV]", comments="")
    assert str(hl.load(path)) == "Table of 200 rows at 50 Hz: t (s), u (V)"


@pytest.mark.parametrize("name", ["time [V]", "t (V)", "time_s [V]"])
def test_times_in_another_unit_are_named(name, tmp_path):
    path = tmp_path / "a.csv"
    rows = np.c_[TIME_S, U, Y]
    np.savetxt(path, rows, "%.9g", ",", header=f"{name},u,y", comments="")
    said = rf"no sampling rate\. Column {re.escape(name)} states a unit that is not a time\. Give"
    for data in (path, {name: TIME_S, "u": U, "y": Y}):
        with pytest.raises(InputError, match=said):
            hl.records(data)


@pytest.mark.parametrize("name", ["t", "time_ms"])
def test_times_that_do_not_rise_are_named(name):
    twice = np.r_[TIME_S[:20], TIME_S[19:-1]]
    for times in (TIME_S[::-1], twice):
        with pytest.raises(InputError, match=rf"no sampling rate. Column {name} does not rise ev"):
            hl.records({name: times, "u": U, "y": Y})


def test_a_gap_in_the_times_begins_a_new_record():
    frame = pd.DataFrame({"time_s": TIME_S, "u": U, "y": Y}).drop(index=range(90, 105))
    first, second = hl.records(frame)
    assert (first.y.size, second.y.size) == (90, 95)
    assert np.array_equal(second.y, Y[105:])


def test_wrong_data_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(InputError, match="no column 'drive'; the data have time_s, u, y"):
        hl.records(SOURCES["dictionary"], "drive")
    with pytest.raises(InputError, match="columns of one length"):
        hl.table({"u": U, "y": Y[1:]})
    with pytest.raises(InputError, match="no column of numbers"):
        (tmp_path / "words.csv").write_text("a,b\nx,y\nz,w\n")
        hl.load(tmp_path / "words.csv")


def test_a_file_is_loaded_without_its_invalid_rows_and_goes_out_again(tmp_path):
    table = hl.load(csv(tmp_path))
    assert isinstance(table, hl.Table)
    assert list(table) == ["time_s", "u", "y"] and table.left_out == 1
    kept = np.arange(200) != 7
    assert np.array_equal(table["y"], Y[kept])
    frame = table.to_pandas()
    assert list(frame.columns) == ["time_s", "u", "y"] and len(frame) == 199
    dataset = table.to_xarray()
    assert np.array_equal(dataset.u.values, U[kept])
    assert np.array_equal(dataset.time_s.values, TIME_S[kept])
    assert dataset.time_s.attrs["units"] == "s"
    assert "<th>u</th>" in table._repr_html_()


def test_records_pass_through():
    records = hl.records(SOURCES["dictionary"])
    assert hl.records(records) == records
    assert hl.records(records[0]) == records


def test_one_row_with_a_time_is_too_short():
    with pytest.raises(InputError, match="time_s has 1 times"):
        hl.records({"time_s": [0.0], "u": [1.0], "y": [2.0]})


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_a_rate_that_contradicts_the_times_is_refused(name):
    (kept,) = hl.records(SOURCES[name], rate_hz=50.0)
    assert kept.input_rate_hz == 50.0
    with pytest.raises(InputError, match=r"rate_hz is 25, but the data have 50 rows per second"):
        hl.records(SOURCES[name], rate_hz=25.0)


def at_a_path(folder: Path, name: str) -> object:
    return csv(folder) if name == "file" else SOURCES[name]


@pytest.mark.parametrize("name", ["file", *sorted(SOURCES)])
def test_a_table_has_the_rate_that_is_stated_or_refuses_it(tmp_path, name):
    data = at_a_path(tmp_path, name)
    assert hl.table(data, rate_hz=50.0).rate_hz == 50.0
    for read in (hl.table, hl.records):
        with pytest.raises(InputError, match=r"rate_hz is 25, but the data have 50 rows per sec"):
            read(data, rate_hz=25.0)


def test_a_stated_rate_must_not_contradict_the_attribute_or_the_attribute_the_times():
    frame = pd.DataFrame({"u": U, "y": Y})
    frame.attrs["rate_hz"] = 30.0
    with pytest.raises(InputError, match=r"rate_hz is 50, but the data have 30 rows per second"):
        hl.table(frame, rate_hz=50.0)
    frame.index = pd.Index(TIME_S, name="time_s")
    with pytest.raises(InputError, match=r"rate_hz is 30, but the data have 50 rows per second"):
        hl.table(frame)


def test_a_stated_rate_does_not_close_a_gap_in_the_times(tmp_path):
    frame = pd.DataFrame({"time_s": TIME_S, "u": U, "y": Y}).drop(index=range(90, 105))
    frame.to_csv(tmp_path / "gap.csv", index=False)
    for data in (frame, tmp_path / "gap.csv"):
        assert [record.y.size for record in hl.records(data, rate_hz=50.0)] == [90, 95]


def test_a_column_that_is_only_called_like_times_is_none():
    table = hl.table({"t": Y, "u": U, "y": Y}, rate_hz=50.0)
    assert table.time_s is None and hl.records(table)[0].input_rate_hz == 50.0


def test_other_columns_of_a_file_may_hold_anything(tmp_path):
    frame = pd.DataFrame({"time_s": TIME_S, "u": U, "y": Y, "spare": np.nan, "note": "a"})
    frame.to_csv(tmp_path / "spare.csv", index=False)
    (record,) = hl.records(tmp_path / "spare.csv")
    assert np.array_equal(record.u, U)


@pytest.mark.parametrize("read", [hl.table, hl.records])
def test_a_session_is_no_table(tmp_path, read):
    with SessionWriter(tmp_path / "session.h5", [ExperimentPlan("x", "test", 6, {})], 100, {}):
        pass
    with pytest.raises(InputError, match=r"holds one table for each experiment\. Use hl\.load"):
        read(tmp_path)


def test_a_session_of_several_experiments_asks_for_one(tmp_path):
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("chirp", "steps")]
    with SessionWriter(tmp_path / "session.h5", plans, 100, {"rig": {"rate_hz": 1e4}}) as session:
        for name in ("chirp", "steps"):
            session.append_block(name, np.zeros((100, 2), np.int16), 0.0, 0.0, np.nan)
    found = hl.load(tmp_path)
    for convert in (found.to_pandas, found.to_xarray):
        with pytest.raises(InputError, match=r"^The session has 2 experiments\. Name one of"):
            convert()


def _runs(path, **root):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.normal(size=40), 10)
    y = np.cumsum(u)
    runs = {
        "first": {"u": u, "y": y, "time_s": np.arange(400) / 100.0},
        "second": {"u": u[:300], "y": -y[:300], "time_s": np.arange(300) / 50.0},
    }
    savemat(path, runs | root)
    return u, y


def test_structures_of_a_matlab_file_bring_their_own_times(tmp_path):
    _, y = _runs(tmp_path / "runs.mat")
    for source in (tmp_path / "runs.mat", str(tmp_path / "runs.mat")):
        (first,) = hl.records(source, "first/u", "first/y")
        (second,) = hl.records(source, "second/u", "second/y")
        assert (first.input_rate_hz, second.input_rate_hz) == (100.0, 50.0)
        assert np.array_equal(second.y, -y[:300])


def test_a_loaded_file_knows_the_full_names_and_keeps_those_that_repeat(tmp_path):
    u, y = _runs(tmp_path / "runs.mat")
    loaded = hl.load(tmp_path / "runs.mat")  # the longest columns
    assert list(loaded) == ["first/u", "first/y", "first/time_s"]
    (record,) = hl.records(loaded, "first/u", "first/y")
    assert np.array_equal(record.y, y)
    savemat(tmp_path / "one.mat", {"run": {"u": u, "y": y, "time_s": np.arange(400) / 100.0}})
    one = hl.load(tmp_path / "one.mat")
    assert list(one) == ["u", "y", "time_s"]
    assert np.array_equal(one["run/u"], one["u"])
    assert "run/u" in one and "run/z" not in one
    (named,) = hl.records(one, "run/u", "run/y")
    (plain,) = hl.records(one, "u", "y")
    assert np.array_equal(named.y, plain.y)
