"""Tables of every kind tell the same numbers; bad ones are refused in one line."""

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from haselab.base import InputError
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import read_table

U = np.array([0.0, 1.5, -2.25e-9, 3.0])
Y = np.array([1.0, 2.0, 3.0, 4.5])


def as_csv(path):
    rows = "\n".join(f"{u!r},{y!r}" for u, y in zip(U.tolist(), Y.tolist(), strict=True))
    path.write_text(f"# rate_hz = 400\nu,y\n{rows}\n", encoding="utf-8")


def as_mat5(path):
    savemat(path, {"u": U, "y": Y[:, None], "rate_hz": 400.0})


def as_mat73(path):
    with h5py.File(path, "w", userblock_size=512) as file:
        file["u"], file["y"], file["rate_hz"] = U[None, :], Y[None, :], [[400.0]]


def as_npz(path):
    np.savez(path, u=U, y=Y, rate_hz=400.0)


def as_h5(path):
    with h5py.File(path, "w") as file:
        file["run/u"], file["run/y"] = U, Y
        file["run/u"].attrs["rate_hz"] = 400.0


def as_tdms(path):
    nptdms = pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("bench", name, data, {"wf_increment": 1.0 / 400.0})
             for name, data in (("u", U), ("y", Y))]
        )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "write"),
    [("a.csv", as_csv), ("five.mat", as_mat5), ("seven.mat", as_mat73), ("a.npz", as_npz),
     ("a.h5", as_h5), ("a.tdms", as_tdms)],
)  # fmt: skip
def test_every_kind_of_file_gives_the_same_columns_and_rate(tmp_path, name, write):
    write(tmp_path / name)
    table = read_table(tmp_path / name, ["u", "y"])
    assert table["u"].tolist() == U.tolist()
    assert table["y"].tolist() == Y.tolist()
    assert table.rate_hz == pytest.approx(400.0)
    with pytest.raises(InputError, match=r"lacks volts; it has .*u.*y"):
        read_table(tmp_path / name, ["u", "volts"])


def test_the_rate_of_a_csv_comes_from_even_times_only(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("time_s;y\n0.0;1\n0.01;2\n0.02;3\n", encoding="utf-8-sig")
    assert read_table(file, ["y"]).rate_hz == pytest.approx(100.0)
    file.write_text("time_s\ty\n0.0\t1\n0.01\t2\n0.05\t3\n")
    assert read_table(file, ["y"]).rate_hz is None


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "The file is empty. Export a header"),
        ("u,y\n", "Column u is empty"),
        ("u,y\n1,2\n1,nan\n", r"Column y has nan in row 2 \(1 such rows\)"),
        ("u,y\n1,2\n1,bad\n", "Column y has 'bad' in line 3"),
        ("u,y\n1,2\n1\n", "Column y has no value in line 3"),
        ("u,y\n1,2\n1,\n", "Column y has no value in line 3"),
        ("1.0,2.0\n3.0,4.0\n", "no header row"),
    ],
)
def test_a_bad_csv_is_refused_with_the_place(tmp_path, text, match):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=match) as caught:
        read_table(file, ["u", "y"])
    assert str(caught.value).endswith(str(file))
    assert "\n" not in str(caught.value)


def test_other_bad_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_table(tmp_path / "none.csv", ["u"])
    (tmp_path / "a.xls").write_text("u")
    with pytest.raises(InputError, match=r"'.xls' are not supported. Export the data as CSV"):
        read_table(tmp_path / "a.xls", ["u"])
    np.savez(tmp_path / "a.npz", u=U, y=Y[:2], z=np.ones((2, 2)), c=np.array([1j]))
    with pytest.raises(InputError, match=r"unequal lengths \(u 4, y 2\)"):
        read_table(tmp_path / "a.npz", ["u", "y"])
    with pytest.raises(InputError, match=r"shape \(2, 2\)"):
        read_table(tmp_path / "a.npz", ["z"])
    with pytest.raises(InputError, match="does not contain real numbers"):
        read_table(tmp_path / "a.npz", ["c"])
    (tmp_path / "b.npz").write_bytes(b"not a zip")
    with pytest.raises(InputError, match="cannot be read"):
        read_table(tmp_path / "b.npz", ["u"])


def test_a_name_that_is_there_twice_needs_its_group(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one/u"], file["two/u"] = U, Y
    with pytest.raises(InputError, match=r"has 2 columns u \(one/u, two/u\)"):
        read_table(tmp_path / "a.h5", ["u"])
    assert read_table(tmp_path / "a.h5", ["two/u"])["two/u"].tolist() == Y.tolist()


def test_the_times_of_other_groups_are_not_those_of_a_group_without(tmp_path):
    """As in an exported session: the samples have a rate, the tables beside them have times."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/u"], file["run/rate_hz"] = U, 400.0
        file["run-blocks/time_s"], file["run-strain/time_s"] = [0.0, 1.0], [0.0, 2.0, 4.0]
    table = read_table(tmp_path / "a.h5", ["run/u"])
    assert (table["run/u"].tolist(), table.rate_hz) == (U.tolist(), 400.0)


def test_a_structure_of_an_old_mat_file_is_opened(tmp_path):
    savemat(tmp_path / "a.mat", {"run": {"u": U, "fs": 400.0}})
    table = read_table(tmp_path / "a.mat", ["u"])
    assert (table["u"].tolist(), table.rate_hz) == (U.tolist(), 400.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("time_s,u,y\n0,1,2\n0.100000,1,0.000284,0.001784\n0.2,1,2\n", r"Line 3 has 4 cells"),
        ("time_s,u,y\n0,1,2\n0.01,1,0e-2,7\n0.02,1,2\n", r"decimal comma"),
        ("# rate_hz = 50\ntime_s,u,y\n0,1,2\n0.01,2,2\n0.02,3,2\n0.03,4,1\n", r"50 Hz.*100 rows"),
        ("u (mV),y\nV,V\n1,2\n2,3\n", r"unit mV in its header, but V in the row of units"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(tmp_path, text, words):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words):
        read_table(path, ["u", "y"])


@pytest.mark.parametrize("end", ["", ",", ",,", " , "])
def test_empty_cells_at_the_end_of_a_row_are_no_surplus(tmp_path, end):
    path = tmp_path / "a.csv"
    path.write_text(f"u,y\n1,2\n2,3{end}\n4,5\n")
    assert read_table(path, ["y"])["y"].tolist() == [2.0, 3.0, 5.0]


def test_a_unit_for_a_column_that_is_not_there_is_refused(tmp_path):
    as_csv(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"--unit nope=V names no column of the file, .* u, y"):
        read_table(tmp_path / "a.csv", ["u"], ColumnOptions(units={"nope": "V"}))


def test_the_times_of_another_table_do_not_contradict_the_rate(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, u=np.arange(40.0), rate_hz=400.0, time_s=np.arange(5) / 100.0)
    assert read_table(path, ["u"]).rate_hz == 400.0
    np.savez(path, u=np.arange(40.0), rate_hz=400.0, time_s=np.arange(40) / 100.0)
    with pytest.raises(InputError, match=r"rate of 400 Hz, but column time_s has 100 rows"):
        read_table(path, ["u"])


def test_a_cell_of_very_many_digits_is_examined_without_delay(tmp_path):
    """Such a cell in a damaged file took 3 s; the time grew with the square of its length."""
    file = tmp_path / "digits.csv"
    file.write_text(f"u,y\n1,2\n{'1' * 300_000}.0.1,3\n4,5\n")
    with pytest.raises(InputError, match=r"^Column u has .* in line 3"):
        read_table(file, ["u", "y"])


def test_names_may_follow_a_preamble_of_numbers(tmp_path):
    rows = "".join(f"{k};{k % 7};{k % 5}\n" for k in range(40))
    path = tmp_path / "a.csv"
    for above in ("1;2;3\n", "2024;11;28\n7;8;9\n", "1;2;3\nlog of a bench\n"):
        path.write_text(f"{above}t [ms];U [V];x [mm]\n{rows}")
        found = read_table(path, ["U", "x"])
        assert found["x"].size == 40 and found.rate_hz == pytest.approx(1000.0)
    # A gap that a program fills with the same word is no header.
    path.write_text("t;U;x\n0;1;2\ngap;gap;gap\n" + "".join(f"{k};1;2\n" for k in range(1, 40)))
    with pytest.raises(InputError, match=r"'gap' in line 3"):
        read_table(path, ["U", "x"])


def test_times_with_thousands_separators_are_named_as_the_reason(tmp_path):
    path = tmp_path / "a.csv"
    rows = "".join(f"{k:,};{k % 7};x{k % 5}\n" for k in range(960, 1010)).replace("x", "0.")
    path.write_text(f"t [ms];U;x\n{rows}")
    with pytest.raises(InputError, match=r"'1,000' in line 42|thousands separators"):
        read_table(path, ["U", "x"])
