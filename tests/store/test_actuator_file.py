"""actuator.toml as a file: what a section's writer changes, and what it leaves alone."""

import subprocess
import sys
import threading
import time
import tomllib
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.models.actuator import ActuatorTables
from haselab.store import actuator_file
from haselab.store.actuator_file import Provenance, hashed, read_run, write_section
from haselab.store.manifest import sha256_of
from haselab.store.toml import validated

TYPED = """\
# my actuator, do not lend

[mine]  # nobody else's
colour = "blue"

[model]
gain = 1.0  # measured on a Friday
note = "keep me"
damping_ratio = 0.1

[model.covariance]
names = ["gain"]
"""


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(TYPED)
    return file


def provenance(*inputs):
    return Provenance("haselab test", hashed(inputs), datetime(2026, 2, 3, 4, 5, tzinfo=UTC), "9.9")


def test_comments_order_and_unknown_keys_survive(path):
    write_section(path, "model", {"gain": 2.5}, None, ["gain", "damping_ratio", "covariance"])
    text = path.read_text()
    assert text.startswith("# my actuator, do not lend\n\n[mine]  # nobody else's\n")
    assert "gain = 2.5  # measured on a Friday\n" in text
    assert tomllib.loads(text) == {
        "mine": {"colour": "blue"}, "model": {"gain": 2.5, "note": "keep me"},
    }  # fmt: skip


def test_a_section_says_where_its_numbers_come_from(path, tmp_path):
    record = tmp_path / "record.csv"
    record.write_bytes(b"abc")
    write_section(path, "sensing.strain_map", {"offset": -0.3}, provenance(record))
    data = tomllib.loads(path.read_text())
    assert data["sensing"]["strain_map"] == {"offset": -0.3}
    assert data["provenance"]["sensing"]["strain_map"] == {
        "command": "haselab test",
        "input": ["record.csv"],
        "sha256": ["ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"],  # FIPS 180
        "date": "2026-02-03T04:05:00+00:00",
        "version": "9.9",
        "status": "ok",
    }


def test_files_of_one_name_are_all_among_the_sources(tmp_path):
    """Two runs both have a session.h5; `compare` must recognise each."""
    files = [tmp_path / run / "session.h5" for run in ("first", "second")]
    for file in files:
        file.parent.mkdir()
        file.write_text(file.parent.name)
    found = hashed([*files, tmp_path / "absent"])
    assert list(found) == [file.as_posix() for file in files]
    assert len(set(found.values())) == 2
    assert list(hashed(files[:1])) == ["session.h5"]


def test_values_written_after_a_subsection_stay_in_their_section(path):
    write_section(path, "sensing.strain_map", {"offset": -0.3}, provenance())
    write_section(path, "sensing", {"carrier_hz": 2e3, "reference": [{"a": 1.0}, {"a": 2.0}]}, None)
    assert tomllib.loads(path.read_text())["sensing"] == {
        "strain_map": {"offset": -0.3}, "carrier_hz": 2e3, "reference": [{"a": 1.0}, {"a": 2.0}],
    }  # fmt: skip


numbers = st.floats(allow_nan=False, allow_infinity=False)
values = st.dictionaries(
    st.sampled_from("abcd"),
    numbers | st.text("xyz[]\"\\#=\n'", max_size=6) | st.lists(st.lists(numbers), max_size=3)
    | st.dictionaries(st.sampled_from("pq"), numbers, min_size=1),
    max_size=4,
)  # fmt: skip


@given(first=values, second=values)
def test_what_was_written_is_what_is_read(tmp_path_factory, first, second):
    file = tmp_path_factory.mktemp("any") / "a.toml"
    file.write_text(TYPED)
    write_section(file, "other", first, provenance(), "abcd")
    write_section(file, "other", second, provenance(), "abcd")
    data = tomllib.loads(file.read_text())
    assert data["other"] == second
    assert data["model"] == tomllib.loads(TYPED)["model"]


def test_a_value_in_the_place_of_a_section_is_refused_and_the_file_stays(path):
    path.write_text("model = 3\n")
    with pytest.raises(InputError, match=r"\[model\] cannot be written: model is not a table"):
        write_section(path, "model", {"gain": 1.0}, provenance())
    assert path.read_text() == "model = 3\n"


def test_the_target_of_a_link_is_written_and_the_link_stays(path, tmp_path):
    (tmp_path / "lab").mkdir()
    link = tmp_path / "lab" / "link.toml"
    link.symlink_to("../a.toml")
    write_section(link, "model", {"gain": 2.5}, provenance())
    assert link.is_symlink() and tomllib.loads(path.read_text())["model"]["gain"] == 2.5
    assert [each.name for each in link.parent.iterdir()] == ["link.toml"]


def test_a_read_only_file_and_one_in_a_read_only_folder_are_refused(path, tmp_path):
    path.chmod(0o444)
    with pytest.raises(InputError, match=r"^The file is read-only\. Make it writable .*a\.toml$"):
        write_section(path, "model", {"gain": 2.5}, None)
    path.chmod(0o644)
    tmp_path.chmod(0o555)
    try:
        with pytest.raises(InputError, match=r"^The folder of this file is read-only"):
            write_section(path, "model", {"gain": 2.5}, None)
    finally:
        tmp_path.chmod(0o755)
    assert path.read_text() == TYPED


def test_a_missing_file_is_named_with_the_command_that_makes_one(tmp_path):
    with pytest.raises(InputError, match=r"haselab init NAME --out no\.toml"):
        write_section(tmp_path / "no.toml", "model", {}, None)


def test_an_older_run_reads_as_an_actuator_file(tmp_path):
    (tmp_path / "model.json").write_text(
        '{"plant": {"gain": 0.5}, "rate_hz": 100.0, "zero_strain_length_m": 0.05,'
        ' "strain_map": {"slope_per_f": 1.0}, "voltage_map": {"a1_v": 2.0}}'
    )
    (tmp_path / "controller.toml").write_text(
        "[pi]\nkp = 1.0\nphase_margin_deg = 60.0\n[pid]\nkp = 2.0\n"
        "[saturation]\nlow = -0.1\nhigh = 0.1\n"
    )
    found = read_run(tmp_path)
    assert found["model"] == {"gain": 0.5, "rate_hz": 100.0}
    assert found["controller"]["parameters"] == {"kp": 2.0}
    assert found["controller"]["alternatives"][0]["parameters"] == {"kp": 1.0}
    assert found["controller"]["alternatives"][0]["limits"] == {"low": -0.1, "high": 0.1}
    assert found["actuator"]["geometry"]["zero_length_m"] == 0.05


@pytest.mark.parametrize("rows", ["[[1.0, 0.0], [0.0]]", "[]", "[[1.0], 2.0, [3.0], [4.0]]"])
def test_a_covariance_that_is_no_matrix_of_four_rows_is_refused(path, rows):
    table = f"slope_per_f = 1e9\noffset = 0\ncovariance = {rows}\n"
    path.write_text(f"[sensing.strain_map]\n{table}")
    with pytest.raises(InputError, match=r"covariance"):
        validated(ActuatorTables, read_run(path), path).strain_map()


def test_only_one_of_two_simultaneous_writers_is_told_that_it_has_written(path, monkeypatch):
    sha256, written, refused = sha256_of(path), [], []
    replace = actuator_file.write_text

    def slow(*given):
        time.sleep(0.2)  # the other thread checks the file meanwhile
        replace(*given)

    monkeypatch.setattr(actuator_file, "write_text", slow)

    def write(gain):
        try:
            write_section(path, "model", {"gain": gain}, None, sha256=sha256)
            written.append(gain)
        except InputError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=write, args=(gain,)) for gain in (2.0, 3.0)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert len(written) == 1 and len(refused) == 1
    assert "has changed since [model] was computed from it" in refused[0]
    assert tomllib.loads(path.read_text())["model"]["gain"] == written[0]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot replace a file that is open")
def test_a_writer_waits_for_one_in_another_program(path, monkeypatch):
    code = (
        "import sys, pathlib\nfrom haselab.store.actuator_file import _sole_writer\n"
        "with _sole_writer(pathlib.Path(sys.argv[1])):\n    print('has it', flush=True)\n"
        "    sys.stdin.readline()\n"
    )
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "has it\n"
        monkeypatch.setattr(actuator_file, "_WAIT_S", 0.05)
        with pytest.raises(InputError, match="another program has locked this file"):
            write_section(path, "model", {"gain": 2.0}, None)
        assert path.read_text() == TYPED
        monkeypatch.setattr(actuator_file, "_WAIT_S", 60.0)
        threading.Timer(0.1, other.stdin.close).start()
        write_section(path, "model", {"gain": 2.0}, None)
    assert tomllib.loads(path.read_text())["model"]["gain"] == 2.0
