"""A minus before the name of a column takes it with the other sign, in files of every kind."""

import numpy as np
import pytest
from scipy.io import savemat

from haselab.base import InputError
from haselab.store.columns.reader import check_times, open_columns
from haselab.store.columns.selection import ColumnOptions
from haselab.store.columns.table import read_table

U = np.array([-32768, -3, 0, 5, 32767], np.int16)
Y = np.array([1.0, 2.0, 4.0, 8.0, 16.0])


def _csv(path):
    lines = [
        "t [s];U [mV];Weg mm",
        *(f"{k};{u};{y}" for k, (u, y) in enumerate(zip(U, Y, strict=True))),
    ]
    path.write_text("\n".join(lines) + "\n")


def _h5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["rig/U [mV]"], file["rig/Weg mm"] = U, Y


WRITERS = {
    "a.csv": _csv,
    "a.npz": lambda path: np.savez(path, **{"U [mV]": U, "Weg mm": Y}),
    "a.mat": lambda path: savemat(path, {"U_mv": U.astype(float), "Weg_mm": Y}),
    "a.h5": _h5,
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_other_sign_of_a_column_in_every_kind_of_file(tmp_path, name):
    WRITERS[name](tmp_path / name)
    plain = read_table(tmp_path / name, ["U", "Weg"])
    table = read_table(tmp_path / name, ["-U", "-Weg"])
    assert np.array_equal(table["-U"], -1e-3 * U.astype(float))  # -32768 has no int16 of its own
    assert np.array_equal(table["-Weg"], -plain["Weg"])
    assert table.units["-Weg"].symbol == "mm"
    one = read_table(tmp_path / name, ["U", "-Weg"], ColumnOptions(units={"Weg": "µm"}))
    assert np.array_equal(one["-Weg"], -1e-6 * Y)


def test_columns_by_number_and_without_names(tmp_path):
    _csv(tmp_path / "a.csv")
    assert np.array_equal(read_table(tmp_path / "a.csv", ["-3"])["-3"], -1e-3 * Y)
    np.save(tmp_path / "a.npy", np.stack([U, U], axis=1))
    with open_columns(tmp_path / "a.npy", ["v", "-i"], use_times=False) as stream:
        ((v, i),) = stream.chunks(100)
    assert np.array_equal(v, U) and np.array_equal(i, -U.astype(float))


def test_a_column_whose_name_begins_with_a_minus_is_that_column(tmp_path):
    np.savez(tmp_path / "a.npz", **{"-y": Y, "y": 3.0 * Y})
    for name, values in (("-y", Y), ("--y", -Y), ("y", 3.0 * Y)):
        assert np.array_equal(read_table(tmp_path / "a.npz", [name])[name], values)


def test_what_cannot_have_another_sign_is_refused(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t [s];C [pF]\n0;1\n1;2\n2;3\n")
    with pytest.raises(InputError, match=r"Column -C .* capacitance cannot be negative"):
        read_table(path, ["-C"])
    with pytest.raises(InputError, match=r"--time -t asks for times with the other sign"):
        read_table(path, ["C"], ColumnOptions(time="-t"))
    with pytest.raises(InputError, match=r"named for two quantities"):
        read_table(path, ["t", "-t"])
    with pytest.raises(InputError, match=r"The file lacks -Weg; it has t \[s\], C \[pF\]"):
        read_table(path, ["-Weg"])


def test_a_stated_rate_is_compared_with_times_beside_such_columns(tmp_path):
    np.savez(tmp_path / "a.npz", **{"U [mV]": U, "t [s]": 0.1 * np.arange(5)})
    with pytest.raises(InputError, match="has 10 rows per second"):
        check_times(tmp_path / "a.npz", 20.0, ColumnOptions(), ["-U"])
