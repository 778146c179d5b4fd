"""A session in pandas, xarray, MATLAB and CSV, with the series that follow from it."""

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import haselab as hl
from haselab.base import InputError
from haselab.cli.main import main
from haselab.pipelines.sensing.series import derived_series
from haselab.store.columns.table import read_table
from haselab.store.export.frames import session_dataset, session_tables
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

RATE_HZ, CARRIER_HZ, VOLT, SAMPLES, BLOCKS = 50e3, 2000.0, 1e-4, 500, 12
CAPACITANCE_F, RESISTANCE_OHM, SCALE = 1.2e-9, 8e3, 2e-4
HEADER = {
    "rig": {"rate_hz": RATE_HZ, "volt_per_code": VOLT, "v_monitor_v_per_v": 1 / 5000.0,
            "i_monitor_v_per_a": 500.0, "skew_s": 0.0, "switch_sample": 0,
            "block_samples": SAMPLES, "scale_m_per_px": SCALE},
    "study": {"sensing": {"carrier_hz": CARRIER_HZ}},
}  # fmt: skip


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series R-C whose monitors are known, and six points, the lower three of which move."""
    path = tmp_path_factory.mktemp("run") / "session.h5"
    turn = np.exp(2j * np.pi * CARRIER_HZ * np.arange(BLOCKS * SAMPLES) / RATE_HZ)
    z_ohm = RESISTANCE_OHM + 1.0 / (2j * np.pi * CARRIER_HZ * CAPACITANCE_F)
    volts = np.stack([0.05 * turn, 0.05 * 5000.0 / 2e-3 / z_ohm * turn], axis=1).real
    volts += 1e-4 * np.random.default_rng(7).standard_normal(volts.shape)
    codes = np.rint(volts / VOLT).astype(np.int16).reshape(BLOCKS, SAMPLES, 2)
    plans = [ExperimentPlan("step-1", "step", 6, {"kp": 0.5}), ExperimentPlan("bare", "x", 6, {})]
    with SessionWriter(path, plans, SAMPLES, HEADER) as writer:
        writer.event(0.0, "start")
        for k, block in enumerate(codes):
            writer.append_block("step-1", block, 3.0 + 0.01 * k, 0.1 * k, float("nan"))
            writer.append_block("bare", block, 4.0 + 0.01 * k, 0.0, float("nan"))
        tracks = np.zeros((5, 6), SessionWriter.track_dtype())
        tracks["y_px"][:, :3], tracks["valid"] = 10.0, True
        tracks["y_px"][:, 3:] = 110.0 + 2.0 * np.arange(5)[:, None]
        tracks["valid"][4, 5] = False
        writer.append_frames("step-1", 3.0 + 0.01 * np.arange(5), tracks, 0.0)
    return path


STRAIN = [0.0, 0.02, 0.04, 0.06, np.nan]


def check_capacitance(columns: object, ending: str = "") -> None:
    values = np.asarray(columns["capacitance_f"])  # type: ignore[index]
    assert values.shape == (BLOCKS,)
    np.testing.assert_allclose(values, CAPACITANCE_F, rtol=3e-3)


def test_a_session_as_pandas_tables(session):
    tables = session_tables(session, "step-1", derived=derived_series)
    assert set(tables) == {"monitors", "blocks", "tracks", "events", "capacitance", "strain"}
    assert len(tables["monitors"]) == BLOCKS * SAMPLES
    assert tables["monitors"]["time_s"].iloc[SAMPLES] == pytest.approx(3.01)
    np.testing.assert_allclose(tables["blocks"]["drive_v"], 0.1 * np.arange(BLOCKS))
    assert len(tables["tracks"]) == 30
    check_capacitance(tables["capacitance"])
    np.testing.assert_allclose(tables["strain"]["strain_from_start"], STRAIN, atol=1e-12)
    np.testing.assert_allclose(tables["strain"]["length_m"][0], 100.0 * SCALE)
    assert set(session_tables(session, "bare")) == {"monitors", "blocks", "tracks", "events"}


@pytest.fixture
def beside(session, tmp_path):
    """The session with the actuator file of its run; its length is 100 px at the start."""
    shutil.copy(session, tmp_path)
    (tmp_path / "actuator.toml").write_text("[actuator.geometry]\nzero_length_m = 0.025\n")
    return tmp_path / "session.h5"


def test_the_strain_of_a_run_is_relative_to_its_own_zero_length(beside, session, tmp_path):
    expected = 100.0 * SCALE / 0.025 * (1.0 + np.array(STRAIN)) - 1.0
    one = hl.load(beside)
    np.testing.assert_allclose(one.to_pandas("step-1")["strain"]["strain"], expected)
    data = one.to_xarray("step-1")
    np.testing.assert_allclose(data["strain"], expected)
    assert hl.Actuator.load(beside.parent).zero_length_m == 0.025
    given = one.to_pandas("step-1", zero_length_m=0.02)["strain"]
    np.testing.assert_allclose(given["strain"], STRAIN, atol=1e-12)
    for form, name in (("csv", "csv"), ("mat", "s.mat")):
        out = tmp_path / name
        assert code_of("session", "export", beside, "--to", form, "--out", out) == 0
    exported = np.genfromtxt(tmp_path / "csv" / "step-1-strain.csv", delimiter=",", names=True)
    np.testing.assert_allclose(exported["strain"][:4], expected[:4], rtol=1e-6)
    matlab = loadmat(tmp_path / "s.mat", simplify_cells=True)["step_1"]["strain"]
    np.testing.assert_allclose(matlab["strain"], expected)
    assert "strain" not in hl.load(session).to_pandas("step-1")["strain"], "no zero length is known"


def test_a_zero_length_that_is_none_is_refused(beside):
    for wrong in (0.0, -1.0, float("nan"), "words", True):
        with pytest.raises(InputError, match=r"zero_length_m is .*must be a number above 0 m"):
            hl.load(beside).to_pandas("step-1", zero_length_m=wrong)
    file = beside.parent / "actuator.toml"
    file.write_text("[actuator.geometry]\nzero_length_m = -0.1\n")
    with pytest.raises(InputError, match=r"zero_length_m in \[actuator.geometry\] is -0.1, but"):
        hl.load(beside).to_xarray("step-1")


def test_a_session_as_an_xarray_data_set(session):
    data = session_dataset(session.parent, "step-1", derived=derived_series)
    assert dict(data.sizes) == {"block": BLOCKS, "sample": SAMPLES, "frame": 5, "point": 6,
                                "capacitance": BLOCKS, "strain": 5}  # fmt: skip
    assert data["v_monitor_v"].attrs["units"] == "V"
    assert data["capacitance_f"].attrs["units"] == "F"
    assert json.loads(data.attrs["settings"]) == {"kp": 0.5}
    check_capacitance(data)
    row = data["v_monitor_v"].isel(block=0)
    assert float(abs(row).max()) == pytest.approx(0.05, abs=6e-4)  # noise of 0.1 mV
    assert float(data["start_s"][1]) == pytest.approx(3.01)


@pytest.mark.parametrize(("function", "library"), [(session_tables, "pandas"),
                                                   (session_dataset, "xarray")])  # fmt: skip
def test_a_missing_library_names_the_extra(session, monkeypatch, function, library):
    def absent(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(InputError, match=rf"needs {library}, .* pip install .haselab\[frames\]"):
        function(session, "step-1")


def test_an_unknown_experiment_is_refused(session):
    for function in (session_tables, session_dataset):
        with pytest.raises(InputError, match="No experiment 'never'"):
            function(session, "never")


def code_of(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def test_one_experiment_is_exported_with_its_series(session, tmp_path, capsys):
    out = tmp_path / "csv"
    assert code_of("session", "export", session, "--to", "csv", "--experiment", "step-1", "--out",
                   out, "--json") == 0  # fmt: skip
    assert json.loads(capsys.readouterr().out)["experiments"] == {"step-1": "step-1"}
    assert {path.stem for path in out.iterdir()} == {
        "header", "events", "step-1", "step-1-blocks", "step-1-tracks", "step-1-capacitance",
        "step-1-strain",
    }  # fmt: skip
    check_capacitance(read_table(out / "step-1-capacitance.csv", ["capacitance_f"]))


def test_strains_have_a_common_zero_and_the_mean_drive_until_the_next_frame(session, tmp_path):
    out = tmp_path / "csv"
    assert code_of("session", "export", session, "--to", "csv", "--zero-length-m", "0.02", "--out",
                   out) == 0  # fmt: skip
    found = np.genfromtxt(out / "step-1-strain.csv", delimiter=",", names=True)
    np.testing.assert_allclose(found["strain"], found["length_m"] / 0.02 - 1.0)
    np.testing.assert_allclose(found["strain"][:2], [0.0, 0.02], atol=1e-12)
    np.testing.assert_allclose(found["voltage_v"], [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-12)


def test_a_late_output_is_averaged_between_frames(session):
    with SessionReader(session) as reader:
        reader.header["rig"] = {**reader.header["rig"], "switch_sample": 125}  # 2.5 of 10 ms
        voltage_v = derived_series(reader, "step-1")["strain"]["voltage_v"]
    np.testing.assert_allclose(voltage_v, [0.0, 0.075, 0.175, 0.275, 0.375], atol=1e-12)


def test_a_table_without_rows_is_named_and_not_written(session, tmp_path, capsys):
    out = tmp_path / "csv"
    assert code_of("session", "export", session, "--to", "csv", "--out", out, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["empty"] == ["bare-tracks"]
    assert "nothing was recorded for them: bare-tracks" in printed.err
    assert not (out / "bare-tracks.csv").exists() and (out / "bare.csv").exists()


def test_matlab_gets_series_as_structs_and_the_names_of_experiments(session, tmp_path):
    out = tmp_path / "s.mat"
    assert code_of("session", "export", session, "--to", "mat", "--out", out) == 0
    data = loadmat(out, simplify_cells=True)
    assert data["step_1"]["name"] == "step-1"
    check_capacitance(data["step_1"]["capacitance"])
    np.testing.assert_allclose(data["step_1"]["strain"]["strain_from_start"], STRAIN, atol=1e-12)
    assert code_of("session", "export", session, "--to", "mat", "--recorded-only", "--out",
                   tmp_path / "r.mat") == 0  # fmt: skip
    assert "capacitance" not in loadmat(tmp_path / "r.mat", simplify_cells=True)["step_1"]


def test_labview_gets_series_as_channels(session, tmp_path):
    nptdms = pytest.importorskip("nptdms")
    out = tmp_path / "s.tdms"
    assert code_of("session", "export", session, "--to", "tdms", "--out", out) == 0
    group = nptdms.TdmsFile.read(out)["step-1"]
    check_capacitance({"capacitance_f": group["capacitance_f"][:]})
    assert {"capacitance_time_s", "strain_time_s", "strain_from_start"} <= {
        channel.name for channel in group.channels()
    }


def test_an_experiment_that_is_not_there_is_refused_and_nothing_stays(session, tmp_path, capsys):
    out = tmp_path / "csv"
    assert code_of("session", "export", session, "--to", "csv", "--experiment", "never", "--out",
                   out) == 2  # fmt: skip
    assert "The session has no experiment 'never', only bare" in capsys.readouterr().err
    assert not out.exists()
