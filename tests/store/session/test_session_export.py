"""Exports hold every number of a session; what comes back is what went out."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import loadmat

from haselab.base import InputError
from haselab.store.columns.reader import open_columns
from haselab.store.export.import_session import ImportPlan, import_session
from haselab.store.export.session import FOLDERS, FORMS, export_session
from haselab.store.manifest import read_manifest
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

SAMPLES, BLOCKS, VOLT, RATE_HZ = 200, 23, 3.0517578125e-4, 200e3
HEADER = {"rig": {"rate_hz": RATE_HZ, "volt_per_code": VOLT}, "seed": 4}
PLANS = [ExperimentPlan("pi-1", "PI step", 2, {"kp": 0.5}), ExperimentPlan("none", "chirp", 2, {})]
LIBRARY = {"parquet": "pyarrow", "nwb": "pynwb", "tdms": "nptdms"}


def codes_of() -> np.ndarray:
    rng = np.random.default_rng(3)
    codes = rng.integers(-32768, 32768, (BLOCKS, SAMPLES, 2), dtype=np.int16)
    codes[0, :2] = [[-32768, 32767], [32767, -32768]]
    return codes


@pytest.fixture
def session(tmp_path: Path) -> Path:
    path = tmp_path / "session.h5"
    with SessionWriter(path, PLANS, SAMPLES, HEADER) as writer:
        writer.event(0.25, 'start "pi-1", with a comma')
        for k, block in enumerate(codes_of()):
            writer.append_block("pi-1", block, 2.0 + 0.001 * k, 0.1 * k, float("nan"))
        tracks = np.zeros((3, 2), SessionWriter.track_dtype())
        tracks["x_px"], tracks["valid"] = [[1 / 3, 2.0], [3.0, 4.0], [5.0, np.nan]], True
        tracks["valid"][2, 1] = False
        writer.append_frames("pi-1", 2.0 + np.arange(3) / 100, tracks, 0.25)
    return path


def read(form: str, folder: Path) -> dict[str, np.ndarray]:
    """Both monitors in V, by the other tool's own reader."""
    if form == "csv":
        with (folder / "pi-1.csv").open() as file:
            rows = list(csv.DictReader(file))
        return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    if form == "mat":
        return loadmat(folder / "s.mat", simplify_cells=True)["pi_1"]
    if form == "tdms":
        import nptdms

        group = nptdms.TdmsFile.read(folder / "s.tdms")["pi-1"]
        return {channel.name: channel[:] for channel in group.channels()}
    if form == "parquet":
        import pyarrow.parquet

        table = pyarrow.parquet.read_table(folder / "pi-1.parquet")
        return {name: table[name].to_numpy() for name in table.column_names}
    with h5py.File(folder / "s.nwb", "r") as file:
        found = {}
        for name in ("v_monitor", "i_monitor"):
            data = file[f"acquisition/pi-1_{name}/data"]
            found[f"{name}_v"] = data[:] * data.attrs["conversion"]
        return found


@pytest.mark.parametrize("form", sorted(FORMS))
def test_every_code_comes_back_from_every_form(session, tmp_path, form):
    if form in LIBRARY:
        pytest.importorskip(LIBRARY[form])
    out = tmp_path / "out"
    done = export_session(session, form, out if form in ("csv", "parquet") else out / f"s.{form}")
    assert done.doubt == "" and done.files and all(path.is_file() for path in done.files)
    found = read(form, out)
    for k, name in enumerate(("v_monitor_v", "i_monitor_v")):
        back = np.rint(np.asarray(found[name], float) / VOLT).astype(np.int16)
        np.testing.assert_array_equal(back, codes_of()[:, :, k].ravel())
    if "time_s" in found:
        expected = (2.0 + 0.001 * np.arange(BLOCKS))[:, None] + np.arange(SAMPLES) / RATE_HZ
        np.testing.assert_array_equal(found["time_s"], expected.ravel())


def test_tables_of_events_blocks_and_tracks_come_back_to_the_last_bit(session, tmp_path):
    export_session(session.parent, "csv", tmp_path / "out")
    with (tmp_path / "out" / "events.csv").open() as file:
        assert list(csv.reader(file))[1:] == [["0.25", 'start "pi-1", with a comma']]
    with (tmp_path / "out" / "pi-1-tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["x_px"]) for row in rows[:2]] == [1 / 3, 2.0]
    assert rows[-1]["x_px"] == "nan" and [row["valid"] for row in rows][-2:] == ["1", "0"]
    assert json.loads((tmp_path / "out" / "header.json").read_text()) == HEADER


def test_a_matlab_file_holds_settings_and_tracks(session, tmp_path):
    export_session(session, "mat", tmp_path / "s.mat")
    data = loadmat(tmp_path / "s.mat", simplify_cells=True)
    assert json.loads(data["pi_1"]["settings"]) == {"kp": 0.5}
    assert data["pi_1"]["x_px"][0, 0] == 1 / 3
    assert json.loads(data["session"]["header"]) == HEADER


@pytest.mark.parametrize("form", ["csv", "mat", "tdms"])
def test_an_export_comes_back_as_a_session_bit_for_bit(session, tmp_path, form):
    if form in LIBRARY:
        pytest.importorskip(LIBRARY[form])
    out = tmp_path / "out"
    export_session(session, form, out if form == "csv" else out / f"s.{form}")
    file = {"csv": "pi-1.csv"}.get(form, f"s.{form}")
    group = {"csv": "", "mat": "pi_1/", "tdms": "pi-1/"}[form]
    columns = (f"{group}v_monitor_v", f"{group}i_monitor_v")
    with open_columns(out / file, columns) as stream:
        assert stream.rate_hz in (None, pytest.approx(RATE_HZ))
    plan = ImportPlan("back", columns, SAMPLES, RATE_HZ, VOLT)
    # The code -32768 has no counterpart: a converter's lowest reading is as good as clipped.
    if form == "tdms":
        plan = ImportPlan("back", columns, SAMPLES, None, VOLT)
    with pytest.raises(InputError, match=r"Row 1 has \[-10.*Raise --volt-per-code.*"):
        import_session(out / file, tmp_path / "refused", plan)
    finer = ImportPlan("back", columns, SAMPLES, plan.rate_hz, 1.5 * VOLT)
    made = import_session(out / file, tmp_path / "again", finer)
    assert (made.blocks, made.samples_left) == (BLOCKS, 0)
    assert made.rate_hz == pytest.approx(RATE_HZ)
    assert made.largest_rounding_v <= 0.5 * 1.5 * VOLT * (1 + 1e-6)
    with SessionReader(tmp_path / "again" / "session.h5") as reader:
        record = reader.experiment("back")
    np.testing.assert_array_equal(record.codes, np.rint(codes_of() * VOLT / (1.5 * VOLT)))
    assert read_manifest(tmp_path / "again")["state"] == "SEALED"


def test_columns_that_cannot_be_a_session_are_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("v_monitor_v,i_monitor_v\n" + "0.5,0.25\n" * 50)
    with pytest.raises(InputError, match=r"states no sampling rate\. Add --rate-hz.*a\.csv$"):
        import_session(path, tmp_path / "x", ImportPlan())
    with pytest.raises(InputError, match=r"50 samples, but a block has 2000.*a\.csv$"):
        import_session(path, tmp_path / "x", ImportPlan(rate_hz=1e3))
    np.savez(tmp_path / "c.npz", v=np.zeros(50, np.int16), i=np.zeros(50, np.int16), rate_hz=1e3)
    with pytest.raises(InputError, match=r"contain integers.*Add --volt-per-code\. .*c\.npz$"):
        import_session(tmp_path / "c.npz", tmp_path / "y", ImportPlan(columns=("v", "i")))


def test_a_session_without_scale_and_an_unknown_form_are_refused(session, tmp_path):
    with pytest.raises(InputError, match=r"Unknown format 'xls'\. Use one of csv, mat"):
        export_session(session, "xls", tmp_path / "x")
    SessionWriter(tmp_path / "bare.h5", PLANS, SAMPLES, {}).close()
    with pytest.raises(InputError, match=r"lacks rig\.volt_per_code.*bare\.h5$"):
        export_session(tmp_path / "bare.h5", "csv", tmp_path / "x")


@pytest.mark.parametrize("form", sorted(LIBRARY))
def test_a_missing_library_is_one_line(session, tmp_path, monkeypatch, form):
    import importlib

    def absent(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(InputError, match=r"pip install 'haselab\[formats\]', or use --to"):
        export_session(session, form, tmp_path / f"s.{form}")


# ---- names of experiments that are names of something else in the other tool ---------------------

TAKEN = [
    "session", "events", "EVENTS", "header", "a", "A", "a-blocks", "step-1", "step 1", "step_1",
    "end", "2nd", "\u00e9", "\u00e8", "v_monitor_v", "x" * 70 + "1", "x" * 70 + "2",
]  # fmt: skip


@pytest.fixture
def named(tmp_path: Path) -> Path:
    """A session in which every experiment holds its own number as code."""
    path = tmp_path / "session.h5"
    plans = [ExperimentPlan(name, "test", 1, {"name": name}) for name in TAKEN]
    with SessionWriter(path, plans, SAMPLES, HEADER) as writer:
        writer.event(0.5, "the only event")
        for number, name in enumerate(TAKEN, 1):
            writer.append_block(name, np.full((SAMPLES, 2), number, np.int16), 0.0, 1.0, 2.0)
    return path


def code_in(form: str, folder: Path, name: str) -> int:
    """The code in the first sample of the voltage monitor, by the other tool's reader."""
    if form == "csv":
        with (folder / f"{name}.csv").open() as file:
            volt = float(next(csv.DictReader(file))["v_monitor_v"])
    elif form == "parquet":
        import pyarrow.parquet

        volt = pyarrow.parquet.read_table(folder / f"{name}.parquet")["v_monitor_v"][0].as_py()
    elif form == "mat":
        volt = loadmat(folder / "s.mat", simplify_cells=True)[name]["v_monitor_v"][0]
    elif form == "tdms":
        import nptdms

        volt = nptdms.TdmsFile.read(folder / "s.tdms")[name]["v_monitor_v"][0]
    else:
        with h5py.File(folder / "s.nwb", "r") as file:
            data = file[f"acquisition/{name}_v_monitor/data"]
            volt = data[0] * data.attrs["conversion"]
    return round(volt / VOLT)


@pytest.mark.parametrize("form", sorted(FORMS))
def test_no_experiment_is_lost_to_the_name_of_another(named, tmp_path, form):
    if form in LIBRARY:
        pytest.importorskip(LIBRARY[form])
    out = tmp_path / "out"
    place = out if form in FOLDERS else out / f"s.{form}"
    done = export_session(named, form, place)
    assert sorted(done.experiments) == sorted(TAKEN)
    for number, name in enumerate(TAKEN, 1):
        assert code_in(form, out, done.experiments[name]) == number, name
    files = [path.name.casefold() for path in out.iterdir()]
    assert len(files) == len(set(files)) == len(done.files)  # also where A is a
    assert all(len(each) <= 63 for each in done.experiments.values()) or form != "mat"
    if form == "mat":
        structs = loadmat(place, simplify_cells=True)
        assert {structs[new]["name"]: new for new in done.experiments.values()} == done.experiments
        assert structs["session"]["event"] == "the only event"
    if form == "csv":
        header = json.loads((out / "header.json").read_text())
        changed = {name: new for name, new in done.experiments.items() if name != new}
        assert header == HEADER | {"exported_as": changed}
        assert (out / "events.csv").read_text() == 'time_s,what\n0.5,"the only event"\n'


@pytest.mark.parametrize("form", sorted(FORMS))
def test_an_export_that_fails_leaves_no_file(session, tmp_path, monkeypatch, form):
    if form in LIBRARY:
        pytest.importorskip(LIBRARY[form])
    out = tmp_path / "out"

    def full(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        export_session(session, form, out if form in FOLDERS else out / f"s.{form}")
    assert list(out.iterdir()) == []
