"""One struct in a MATLAB file, there and back, and what is refused."""

import numpy as np
import pytest
from scipy.io import savemat

from haselab.base import InputError
from haselab.store.columns.mat_struct import read_mat_struct, write_mat_struct


def test_a_struct_comes_back_with_rows_numbers_and_text(tmp_path):
    path = tmp_path / "new" / "model.mat"
    write_mat_struct(path, "model", {"num": [1.0, 2.0], "Ts": 0.0, "InputName": "voltage"})
    fields = read_mat_struct(path, "model")
    assert np.array_equal(fields["num"], [1.0, 2.0])
    assert float(fields["Ts"]) == 0.0
    assert fields["InputName"] == "voltage"
    # Version 5 by its header, as `load` of every MATLAB reads it.
    assert path.read_bytes()[:10] == b"MATLAB 5.0"


def test_the_only_struct_counts_whatever_its_name(tmp_path):
    path = tmp_path / "sys.mat"
    savemat(path, {"sys": {"num": [3.0]}, "note": "text"})
    assert float(read_mat_struct(path, "model")["num"]) == 3.0


def test_files_without_a_struct_are_refused(tmp_path):
    path = tmp_path / "no.mat"
    savemat(path, {"u": np.ones(3)})
    with pytest.raises(InputError, match=r"has the variables u, but no struct 'model'"):
        read_mat_struct(path, "model")
    path.write_text("numerator = 1")
    with pytest.raises(InputError, match="not a MATLAB file of version 5"):
        read_mat_struct(path, "model")
    with pytest.raises(InputError, match=r"No such file.*none\.mat"):
        read_mat_struct(tmp_path / "none.mat", "model")
