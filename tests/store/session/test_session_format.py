"""Other programs open a session: stock HDF5 1.10, xarray, NeXus; old ones stay readable."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from haselab.store.session.superblock import superblock_checksum
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

SAMPLES, BLOCKS, VOLT = 400, 23, 3.05e-4
HEADER = {"rig": {"rate_hz": 200e3, "volt_per_code": VOLT}}
PLAN = ExperimentPlan("a", "triangle", 6, {"gain": 0.25})


def blocks_of(count: int) -> np.ndarray:
    return np.random.default_rng(1).integers(-9000, 9000, (count, SAMPLES, 2), dtype=np.int16)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "session.h5"
    with SessionWriter(path, [PLAN], SAMPLES, HEADER) as session:
        session.event(0.0, "start a")
        for k, block in enumerate(blocks_of(BLOCKS)):
            session.append_block("a", block, 0.002 * k, 0.5, float("nan"))
        tracks = np.zeros((3, 6), SessionWriter.track_dtype())
        session.append_frames("a", np.arange(3) / 100, tracks, 0.25)
    return path


def test_xarray_opens_an_experiment_in_volts_on_named_axes(path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_dataset(path, group="experiments/a", engine="h5netcdf") as data:
        assert data["codes"].dims == ("start_s", "sample_s", "channel")
        np.testing.assert_allclose(data["codes"], blocks_of(BLOCKS) * VOLT, rtol=1e-6)
        np.testing.assert_array_equal(data["start_s"], 0.002 * np.arange(BLOCKS))
        np.testing.assert_allclose(data["sample_s"], np.arange(SAMPLES) / 200e3)
        assert [bytes(x).decode() for x in data["channel"].values] == ["v_monitor", "i_monitor"]
        assert data["tracks"].dims == ("frame_s", "point")


def test_xarray_opens_the_tree(path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        assert tree["experiments/a/codes"].shape == (BLOCKS, SAMPLES, 2)


def test_nexus_attributes_lead_from_the_root_to_the_signal(path):
    with h5py.File(path, "r") as file:
        entry = file[file.attrs["default"]]
        data = entry[entry.attrs["default"]]
        assert [x.attrs["NX_class"] for x in (file, entry, data)] == ["NXroot", "NXentry", "NXdata"]
        signal, axes = data[data.attrs["signal"]], list(data.attrs["axes"])
        assert signal.shape == tuple(data[name].size for name in axes)


def test_stock_hdf5_prints_the_codes(path, installed):
    command = [
        installed("h5dump", "hdf5-tools"),
        "-d",
        "/experiments/a/codes",
        "-s",
        "22,0,0",
        "-c",
        "1,400,2",
        str(path),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    numbers = [
        int(number)
        for line in done.stdout.splitlines()
        if line.strip().startswith("(22,")
        for number in line.partition(":")[2].replace(",", " ").split()
    ]
    np.testing.assert_array_equal(np.reshape(numbers, (SAMPLES, 2)), blocks_of(BLOCKS)[22])


def test_a_chunk_holds_a_tenth_of_a_second_at_any_length_of_block(tmp_path):
    for samples, rows in ((2000, 10), (200, 100), (20000, 1), (400_000, 1)):
        path = tmp_path / f"{samples}.h5"
        SessionWriter(path, [PLAN], samples, HEADER).close()
        with h5py.File(path, "r") as file:
            assert file["experiments/a/codes"].chunks == (rows, samples, 2)


def test_the_checksum_is_that_of_hdf5_itself(path):
    head = path.read_bytes()[:48]
    assert superblock_checksum(head[:44]) == int.from_bytes(head[44:], "little")


def test_a_session_of_the_first_release_is_read(tmp_path):
    """As it was written then: packed tables, settings in a row of one, no tail, no attributes."""
    path = tmp_path / "old.h5"
    block = np.dtype([("drive_v", "f8"), ("reference", "f8"), ("start_s", "f8")])
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = "haselab session 1"
        file.attrs["header"] = json.dumps({"seed": 3})
        file["events"] = np.array([(0.5, b"x")], [("time_s", "f8"), ("what", "S96")])
        group = file.create_group("experiments/a")
        group.attrs["kind"] = "triangle"
        group["settings"] = np.array([b'{"gain": 0.25}'], "S65000")
        group["codes"] = blocks_of(4)
        group["blocks"] = np.array([(1.0, np.nan, 0.002 * k) for k in range(4)], block)
        group["frames"] = np.zeros(0, [("time_s", "f8"), ("mass_kg", "f8")])
        group["tracks"] = np.zeros((0, 6), SessionWriter.track_dtype())
    with SessionReader(path) as session:
        assert (session.names, session.events()) == (["a"], [(0.5, "x")])
        record = session.experiment("a")
        assert record.settings == {"gain": 0.25}
        np.testing.assert_array_equal(record.codes, blocks_of(4))
        assert len(session.follow("a", 3).codes) == 1
