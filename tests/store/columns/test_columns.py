"""Columns come chunk by chunk, the same from every kind of file, in little memory."""

import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from haselab.base import InputError
from haselab.store.columns.reader import open_columns, pairs_of, rate_of_times

ROWS = 1003  # prime to the chunks below
RNG = np.random.default_rng(11)
V = RNG.standard_normal(ROWS)
I = RNG.standard_normal(ROWS).astype(np.float32)  # noqa: E741
K = RNG.integers(-32768, 32767, ROWS).astype(np.int16)
COLUMNS = {"v": V, "i": I, "k": K}


def as_csv(path):
    head = "# rate_hz = 400\nv;i;k\n"
    cells = zip(V.tolist(), I.tolist(), K.tolist(), strict=True)
    rows = "".join(f"{v!r};{i!r};{k}\n" for v, i, k in cells)
    path.write_text(head + rows, encoding="utf-8-sig")


def as_npz(path):
    np.savez(path, rate_hz=400.0, **COLUMNS)


def as_npz_deflated(path):
    np.savez_compressed(path, rate_hz=400.0, **COLUMNS)


def as_mat(path):
    savemat(path, {"rate_hz": 400.0, **COLUMNS})


def as_mat_deflated(path):
    savemat(path, {"rate_hz": 400.0, **{k: v[:, None] for k, v in COLUMNS.items()}},
            do_compression=True)  # fmt: skip


def as_mat_structure(path):
    savemat(path, {"run": {"fs": 400.0, "label": "a text", "sub": {"x": [1.0, 2.0]}, **COLUMNS}},
            do_compression=True)  # fmt: skip


def as_mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file.create_dataset(name, data=values[None, :], chunks=(1, 64), compression="gzip")
        file["rate_hz"] = [[400.0]]
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def as_h5(path):
    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file[f"run/{name}"] = values
        file["run"]["v"].attrs["fs"] = 400.0


def as_h5_chunked(path):
    with h5py.File(path, "w") as file:
        for name, values in COLUMNS.items():
            file.create_dataset(name, data=values, chunks=(64,), shuffle=True, compression="gzip")
        file.attrs["rate_hz"] = 400.0


def as_tdms(path):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(path) as writer:
        for part in (slice(0, 400), slice(400, ROWS)):
            writer.write_segment(
                [nptdms.ChannelObject("bench", name, data[part], {"wf_increment": 1.0 / 400.0})
                 for name, data in COLUMNS.items()]
            )  # fmt: skip


KINDS = {
    "a.csv": as_csv, "stored.npz": as_npz, "deflated.npz": as_npz_deflated, "a.mat": as_mat,
    "deflated.mat": as_mat_deflated, "structure.mat": as_mat_structure, "seven.mat": as_mat73,
    "contiguous.h5": as_h5, "chunked.hdf5": as_h5_chunked, "a.tdms": as_tdms,
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("columns")
    for name, write in KINDS.items():
        write(path / name)
    return path


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("rows", [1, 7, 64, 500, ROWS, 5000])
def test_pieces_of_any_length_make_the_column_in_its_own_type(folder, name, rows):
    if rows == 1 and name == "a.tdms":
        rows = 3  # its reader takes a millisecond a chunk
    with open_columns(folder / name, ["i", "k", "v"]) as stream:
        assert stream.rate_hz == pytest.approx(400.0)
        assert stream.rows == (None if name.endswith("csv") else ROWS)
        chunks = list(stream.chunks(rows))
    assert [len(chunk[0]) for chunk in chunks[:-1]] == [rows] * (len(chunks) - 1)
    for k, wanted in enumerate((I, K, V)):
        column = np.concatenate([chunk[k] for chunk in chunks])
        np.testing.assert_array_equal(column, wanted)
        assert column.dtype == (np.float64 if name.endswith("csv") else wanted.dtype)
        assert column.dtype.isnative


@pytest.mark.parametrize("name", KINDS)
def test_a_second_pass_begins_at_the_first_row(folder, name):
    with open_columns(folder / name, ["v"]) as stream:
        first = next(iter(stream.chunks(10)))[0]
        again = next(iter(stream.chunks(10)))[0]
        assert 0.0 < stream.share_read() <= 1.0
    np.testing.assert_array_equal(first, V[:10])
    np.testing.assert_array_equal(again, V[:10])


@pytest.mark.parametrize("name", KINDS)
def test_a_missing_column_is_one_line_with_those_that_are_there(folder, name):
    with pytest.raises(InputError, match=r"lacks amps; it has .*v.*i") as caught:
        open_columns(folder / name, ["v", "amps"])
    assert str(caught.value).endswith(name)


@settings(max_examples=40, deadline=None)
@given(sizes=st.lists(st.integers(1, 300), min_size=1, max_size=12), chunk=st.integers(1, 200))
def test_whole_chunks_are_read_whatever_is_requested(tmp_path_factory, sizes, chunk):
    path = tmp_path_factory.getbasetemp() / "property.h5"
    values = np.arange(sum(sizes), dtype=np.int32)
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=values, chunks=(min(chunk, values.size),), compression="lzf")
    with open_columns(path, ["x"]) as stream:
        take = stream._archive.start(["x"])
        got = [take(size)[0] for size in sizes]
    assert [len(chunk) for chunk in got] == sizes
    np.testing.assert_array_equal(np.concatenate(got), values)
    assert got[0].dtype == np.float64


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["i2", "f4", "f8", ">f8"])
@pytest.mark.parametrize("turned", [False, True])
def test_both_columns_of_an_array_without_names_are_taken_by_position(
    tmp_path, order, dtype, turned
):
    table = np.stack([K, K // 2], axis=0 if turned else 1).astype(dtype)
    np.save(tmp_path / "a.npy", np.asarray(table, order=order))
    with open_columns(tmp_path / "a.npy", ["volts", "amps"]) as stream:
        assert (stream.rows, stream.rate_hz) == (ROWS, None)
        chunks = list(stream.chunks(400))
    np.testing.assert_array_equal(np.concatenate([p[0] for p in chunks]), K)
    np.testing.assert_array_equal(np.concatenate([p[1] for p in chunks]), K // 2)
    for volts, amps in chunks:
        assert volts.dtype == np.dtype(dtype).newbyteorder("=")
        contiguous = volts.flags.c_contiguous and amps.flags.c_contiguous
        assert contiguous or pairs_of(volts, amps).shape == (volts.size, 2)


def test_fields_of_a_structured_array_are_columns(tmp_path):
    table = np.zeros(ROWS, [("t", "f8"), ("v", ">f4"), ("i", "i2")])
    table["v"], table["i"] = I, K
    np.save(tmp_path / "a.npy", table)
    with open_columns(tmp_path / "a.npy", ["i", "v"]) as stream:
        chunks = list(stream.chunks(999))
    np.testing.assert_array_equal(np.concatenate([p[0] for p in chunks]), K)
    np.testing.assert_array_equal(np.concatenate([p[1] for p in chunks]), I)
    with pytest.raises(InputError, match="lacks x; it has t, v, i"):
        open_columns(tmp_path / "a.npy", ["x"])


def test_whole_numbers_that_matlab_stores_small_are_doubles_again(tmp_path):
    savemat(tmp_path / "a.mat", {"v": np.arange(5.0), "i": np.array([1.0, 2.0, 300.0, 4.0, 5.0])})
    raw = bytearray((tmp_path / "a.mat").read_bytes())
    place = raw.index(np.arange(5.0).tobytes()) - 8
    # The same variable as MATLAB writes it: type uint8, five bytes, padded to eight.
    small = np.array([2, 5], "<u4").tobytes() + bytes([0, 1, 2, 3, 4, 0, 0, 0])
    size = int(np.frombuffer(raw[132:136], "<u4")[0]) - 40 + 8
    raw[132:136] = np.array([size], "<u4").tobytes()
    raw[place : place + 48] = small
    (tmp_path / "a.mat").write_bytes(raw)
    with open_columns(tmp_path / "a.mat", ["v", "i"]) as stream:
        ((v, i),) = stream.chunks(10)
    assert (v.tolist(), i.tolist()) == ([0, 1, 2, 3, 4], [1, 2, 300, 4, 5])
    assert v.dtype == np.float64


def test_what_is_not_finite_passes(tmp_path):
    (tmp_path / "a.csv").write_text("v,i\n1,nan\ninf,2\n")
    with open_columns(tmp_path / "a.csv", ["v", "i"]) as stream:
        ((v, i),) = stream.chunks(10)
    np.testing.assert_array_equal(v, [1.0, np.inf])
    np.testing.assert_array_equal(i, [np.nan, 2.0])


def test_a_cell_that_is_not_a_number_is_reported_with_its_line(tmp_path):
    rows = "1.5,2\n" * 900_000  # more than one chunk of text
    (tmp_path / "a.csv").write_text(f"v,i\n{rows}3,oops\n")
    with (
        open_columns(tmp_path / "a.csv", ["v", "i"]) as stream,
        pytest.raises(InputError, match="Column i has 'oops' in line 900002"),
    ):
        for _ in stream.chunks(10_000):
            pass


def test_comments_blank_lines_and_a_last_line_without_an_end_are_read(tmp_path):
    (tmp_path / "a.csv").write_text("# made by hand\n\nv,i\n# a note\n1,2\n\n3,4\r\n5,6")
    with open_columns(tmp_path / "a.csv", ["i"]) as stream:
        ((i,),) = stream.chunks(10)
    assert i.tolist() == [2.0, 4.0, 6.0]


@pytest.mark.parametrize("name", [name for name in KINDS if name != "a.csv"])
def test_a_file_that_was_cut_off_is_one_line(folder, tmp_path, name):
    data = (folder / name).read_bytes()
    cut = tmp_path / name
    cut.write_bytes(data[: len(data) * 2 // 3])
    with (
        pytest.raises(InputError, match=r"cannot be read|unequal lengths|lacks") as caught,
        open_columns(cut, ["v", "i", "k"]) as stream,
    ):
        for _ in stream.chunks(100):
            pass
    assert "\n" not in str(caught.value)


def test_a_rate_from_times_is_checked_to_the_end(tmp_path):
    time_s = np.arange(10_000) / 200.0
    np.savez(tmp_path / "even.npz", time_s=time_s, v=time_s)
    with open_columns(tmp_path / "even.npz", ["v"]) as stream:
        assert stream.rate_hz == pytest.approx(200.0)
        assert [len(chunk) for chunk in stream.chunks(10_000)] == [1]
    time_s[7000:] += 1.0
    np.savez(tmp_path / "gap.npz", time_s=time_s, v=time_s)
    for rows in (1000, 7000, 20_000):
        with (
            open_columns(tmp_path / "gap.npz", ["v"]) as stream,
            pytest.raises(
                InputError, match=r"time_s has a step of 1.005 s before row 7001, but 0.005"
            ),
        ):
            list(stream.chunks(rows))
    with open_columns(tmp_path / "gap.npz", ["v"], use_times=False) as stream:
        assert stream.rate_hz is None
        assert sum(len(v) for (v,) in stream.chunks(1000)) == 10_000


def test_uneven_times_state_no_rate():
    assert rate_of_times(np.array([0.0, 1.0, 2.5])) is None
    assert rate_of_times(np.array([0.0, np.nan, 2.0])) is None
    assert rate_of_times(np.array([2.0, 1.0, 0.0])) is None
    assert rate_of_times(np.array([1.0])) is None


@pytest.mark.parametrize("name", ["a.npz", "b.npz", "a.mat", "b.mat", "a.h5", "b.h5", "a.npy"])
def test_memory_holds_pieces_and_not_the_file(tmp_path, name):
    rows, chunk = 2_000_000, 20_000
    v = np.tile(RNG.standard_normal(1000), rows // 1000)
    kind, packed = Path(name).suffix, name.startswith("b")
    path = tmp_path / name
    if kind == ".npz":
        (np.savez_compressed if packed else np.savez)(path, v=v, i=v)
    elif kind == ".mat":
        savemat(path, {"v": v, "i": v}, do_compression=packed)
    elif kind == ".npy":
        np.save(path, np.stack([v, v], axis=1))
    else:
        with h5py.File(path, "w") as file:
            for column in ("v", "i"):
                options = {"chunks": (50_000,), "compression": "gzip"} if packed else {}
                file.create_dataset(column, data=v, **options)
    with open_columns(path, ["v", "i"]) as stream:
        next(iter(stream.chunks(rows)))  # what modules and caches take is taken
        tracemalloc.start()
        for _ in stream.chunks(chunk):
            pass
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    # Two chunks of each column, and twice the largest unit that is read ahead: 1 MB of chunks.
    assert peak < 4 * 8 * chunk + 2 * 2 * (1 << 20) + 1_000_000
    assert peak < 0.2 * 2 * v.nbytes


@pytest.mark.parametrize("dtype", ["i2", ">i2", "f4", "f8", "i4"])
@pytest.mark.parametrize(
    "filters",
    [
        {"compression": "gzip"},
        {"compression": "gzip", "shuffle": True},
        {"compression": "gzip", "shuffle": True, "fletcher32": True},
        {"compression": "lzf", "shuffle": True},
        {"shuffle": True},
    ],
)
def test_packed_chunks_are_what_hdf5_itself_reads(tmp_path, dtype, filters):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, shape, chunks in (
            ("line", (ROWS,), (64,)), ("row", (1, ROWS), (1, 50)), ("column", (ROWS, 1), (50, 1)),
        ):  # fmt: skip
            data = file.create_dataset(name, shape, dtype, chunks=chunks, fillvalue=7, **filters)
            values = K.reshape(shape)
            # Rows 300 to 600 are never written: their chunks are not in the file.
            if name == "column":
                data[:300], data[600:] = values[:300], values[600:]
            else:
                data[..., :300], data[..., 600:] = values[..., :300], values[..., 600:]
        wanted = {name: file[name][()].reshape(-1).astype("f8") for name in file}
    with open_columns(tmp_path / "a.h5", list(wanted)) as stream:
        chunks = list(stream.chunks(130))
    for k, name in enumerate(wanted):
        np.testing.assert_array_equal(np.concatenate([p[k] for p in chunks]), wanted[name])


def test_a_packed_chunk_that_is_damaged_is_one_line(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("v", data=V, chunks=(100,), compression="gzip")
        place = data.id.get_chunk_info(4).byte_offset
    with path.open("r+b") as file:
        file.seek(place + 20)
        file.write(bytes(60))
    with (
        open_columns(path, ["v"]) as stream,
        pytest.raises(InputError, match="cannot be read"),
    ):
        list(stream.chunks(100))


@pytest.mark.parametrize("names", [["v", "v"], ["v", "1"], ["v", "v [mV]"]])
def test_one_column_for_two_quantities_is_refused(tmp_path, names):
    path = tmp_path / "a.csv"
    path.write_text("v [mV],i\n1,2\n3,4\n5,6\n")
    with pytest.raises(InputError, match=r"^Column v \[mV\] is named for two quantities\. Name"):
        open_columns(path, names)
