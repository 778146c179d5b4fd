"""Every number of a session is verified by every reader; nothing outside the file is read."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from haselab.base import InputError
from haselab.store.columns.reader import open_columns
from haselab.store.columns.session import SessionColumns, session_experiments
from haselab.store.export.session import export_session
from haselab.store.session.checksums import static_digest
from haselab.store.session.opening import is_session, open_unsealed
from haselab.store.session.probe import verify
from haselab.store.session.recover import recover
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

SAMPLES = 200
HEADER = {"rig": {"rate_hz": 200e3, "volt_per_code": 3.05e-4}, "seed": 4}
PLANS = [ExperimentPlan("chirp", "chirp", 2, {"gain": 0.25})]
_KILLED = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_session_checks import fill
fill(Path(sys.argv[2]))
os.kill(os.getpid(), signal.SIGKILL)
"""
posix = pytest.mark.skipif(os.name == "nt", reason="SIGKILL is POSIX's")


def fill(path: Path) -> SessionWriter:
    """A session of 137 blocks and 9 frames, still open."""
    session = SessionWriter(path, PLANS, SAMPLES, HEADER)
    session.event(0.0, "start chirp")
    rng = np.random.default_rng(2)
    for k in range(137):
        codes = rng.integers(-9000, 9000, (SAMPLES, 2), dtype=np.int16)
        session.append_block("chirp", codes, 0.001 * k, 1.0, float("nan"))
    tracks = np.zeros((9, 2), SessionWriter.track_dtype())
    session.append_frames("chirp", np.arange(9) / 100, tracks, 0.25)
    session.event(1.0, "end chirp")
    return session


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    fill(tmp_path / "session.h5").close()
    return tmp_path / "session.h5"


@pytest.fixture
def killed(tmp_path: Path) -> Path:
    path = tmp_path / "session.h5"
    command = [sys.executable, "-c", _KILLED, str(Path(__file__).parent), str(path)]
    done = subprocess.run(command, check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    return path


def place_of(path: Path, dataset: str, row: int = 0) -> int:
    """Where a row of a dataset lies in the file."""
    with open_unsealed(path) as file:
        data = file[dataset]
        if data.chunks is None:
            return int(data.id.get_offset()) + row * data.dtype.itemsize
        return int(data.id.get_chunk_info(0).byte_offset) + row * data.dtype.itemsize


def flip(path: Path, place: int, bit: int = 6) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << bit
    path.write_bytes(data)


def test_one_bit_of_a_drive_is_refused_by_every_reader(sealed, tmp_path):
    # The reported fault: 1.0 V became 0.5 V, and the export ended with exit code 0.
    flip(sealed, place_of(sealed, "experiments/chirp/blocks", 3) + 6, 4)
    changed = r"SHA-256 does not match.*from a backup, or .*--unverified.*session\.h5"
    with pytest.raises(InputError, match=changed):
        SessionReader(sealed)
    with pytest.raises(InputError, match=changed):
        SessionColumns(sealed, "chirp")
    with pytest.raises(InputError, match=changed):
        session_experiments(sealed)
    with pytest.raises(InputError, match=changed):
        export_session(sealed, "mat", tmp_path / "s.mat")
    with pytest.raises(InputError, match=changed):
        recover(sealed)
    with pytest.raises(InputError, match="SHA-256 does not match"):
        open_columns(sealed, ["channel"])
    assert not (tmp_path / "s.mat").exists()


def test_a_damaged_session_is_read_on_request_and_marked(sealed, tmp_path):
    flip(sealed, place_of(sealed, "experiments/chirp/blocks", 3) + 6, 4)
    with SessionReader(sealed, unverified=True) as session:
        assert "SHA-256 does not match" in session.doubt
        assert session.experiment("chirp").drive_v.tolist().count(1.0) == 136
    doubt = export_session(sealed, "csv", tmp_path / "out", unverified=True).doubt
    assert doubt
    assert '"unverified": true' in (tmp_path / "out" / "header.json").read_text()


@posix
@pytest.mark.parametrize(
    ("dataset", "row", "what"),
    [
        ("experiments/chirp/blocks", 3, "block of 'chirp', 3"),
        ("experiments/chirp/frames", 2, "frame of 'chirp', 2"),
        ("experiments/chirp/tracks", 0, "frame of 'chirp', 0"),
        ("experiments/chirp/start_s", 5, "block of 'chirp', 5"),
        ("experiments/chirp/frame_s", 5, "time of a frame of 'chirp', 5"),
        ("experiments/chirp/sample_s", 7, "header, attributes or scales"),
        ("experiments/chirp/settings", 0, ""),
        ("experiments/chirp/codes", 0, ""),
        ("events", 1, "event 1"),
        ("tail", 20, "slot 20 of the tail"),
    ],
)
def test_one_bit_of_a_killed_session_is_refused(killed, dataset, row, what):
    flip(killed, place_of(killed, dataset, row) + 6, 4)
    with pytest.raises(InputError, match="The file is not a complete haselab session") as caught:
        SessionReader(killed)
    assert what.replace("block of 'chirp', 5", "start of 'chirp', 5") in str(caught.value)
    with pytest.raises(InputError, match="The file is not a complete haselab session"):
        recover(killed)


@posix
@pytest.mark.parametrize("kept", [8, 24, 400, 848])
def test_a_slot_that_was_cut_while_it_was_written_is_left_out(killed, kept):
    """The system writes page by page, so the number and the row may be there without the end."""
    with open_unsealed(killed) as file:
        slots = file["tail"][:]
        place = int(slots["sequence"].argmax())
    newest = slots[place]
    assert newest["row"] == 136
    newest["sequence"] += 1
    newest["row"] += 1
    start = place_of(killed, "tail", (place + 1) % len(slots))
    data = bytearray(killed.read_bytes())
    data[start : start + kept] = newest.tobytes()[:kept]
    killed.write_bytes(data)
    assert verify(killed) == ("", [])
    with SessionReader(killed) as session:
        assert len(session.experiment("chirp").codes) == 137
    assert recover(killed).blocks == {"chirp": 137}
    with SessionReader(killed) as session:
        assert len(session.experiment("chirp").codes) == 137


@posix
def test_a_killed_session_is_known_as_one_before_hdf5_sees_it(killed):
    assert is_session(killed)
    assert session_experiments(killed) == ["chirp"]


@posix
def test_a_changed_killed_session_is_read_on_request(killed):
    flip(killed, place_of(killed, "experiments/chirp/blocks", 3) + 6, 4)
    with SessionReader(killed, unverified=True) as session:
        assert session.doubt == "block of 'chirp', 3 does not match its checksum"
        assert len(session.experiment("chirp").codes) == 137


@posix
def test_reading_a_killed_session_does_not_change_it(killed):
    before = killed.read_bytes()
    with SessionReader(killed) as session:
        assert session.doubt == "" and len(session.experiment("chirp").codes) == 137
    assert killed.read_bytes() == before
    assert recover(killed).blocks == {"chirp": 137}
    assert verify(killed) == ("", [])  # the checksums inside agree with the seal


def test_checks_of_what_is_fixed_cover_header_attributes_and_scales(tmp_path):
    def digest(header: dict[str, object], settings: dict[str, object], kind: str) -> str:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.h5"
        SessionWriter(path, [ExperimentPlan("a", kind, 2, settings)], SAMPLES, header).close()
        with h5py.File(path, "r") as file:
            assert bytes(file.attrs["static_sha256"]).decode() == static_digest(file)
            return static_digest(file)

    same = digest(HEADER, {}, "x")
    assert digest(HEADER, {"gain": 2}, "x") == same  # settings have their own: they may change
    finer = {"rig": {"rate_hz": 200e3, "volt_per_code": 3.06e-4}, "seed": 4}
    assert len({same, digest(finer, {}, "x"), digest(HEADER, {}, "y")}) == 3


def test_a_seal_that_is_cut_or_written_over_is_noticed(sealed):
    data = sealed.read_bytes()
    for changed in (data[:-1], data[:-200], data[:-20] + b"x" * 20, data + b"\0", data[:-120]):
        sealed.write_bytes(changed)
        with pytest.raises(InputError, match="The file is not a complete haselab session"):
            SessionReader(sealed)


# ---- links, names -------------------------------------------------------------------------------


def _linked(path: Path, kind: str) -> None:
    """A file of columns or a session, with something that lies outside it."""
    with h5py.File(path.with_name("other.h5"), "w") as other:
        other["x"] = np.arange(100.0)
    with h5py.File(path, "a", libver=("v110", "v110")) as file:
        if kind == "external link":
            file["x"] = h5py.ExternalLink("other.h5", "x")
        elif kind == "virtual":
            layout = h5py.VirtualLayout((100,), "f8")
            layout[:] = h5py.VirtualSource("other.h5", "x", (100,))
            file.create_virtual_dataset("x", layout)
        elif kind == "external storage":
            file.create_dataset("x", (100,), "f8", external=[("other.h5", 0, 800)])
        else:
            file["x"] = h5py.SoftLink("/experiments")


@pytest.mark.parametrize("kind", ["external link", "virtual", "external storage", "soft link"])
def test_a_session_with_links_is_refused(sealed, kind):
    fill(sealed.with_name("s2.h5")).close()
    _linked(sealed.with_name("s2.h5"), kind)
    with pytest.raises(InputError, match=r"in another file|is a link, which is not followed"):
        SessionReader(sealed.with_name("s2.h5"))


@pytest.mark.parametrize("kind", ["external link", "virtual", "external storage"])
@pytest.mark.parametrize("name", ["a.h5", "a.mat"])
def test_columns_that_lie_in_another_file_are_refused(tmp_path, kind, name):
    _linked(tmp_path / name, kind)
    with pytest.raises(InputError, match=r"^The values of x are in another file.*\.(h5|mat)$"):
        open_columns(tmp_path / name, ["x"])


@pytest.mark.parametrize(
    "name", ["..", "a/b", "..\\x", "C:x", "", "NUL", "com1.txt", "a\n", "x" * 101, ".hidden", "a "]
)
def test_an_experiment_that_could_be_no_file_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="cannot be a file name"):
        SessionWriter(tmp_path / "s.h5", [ExperimentPlan(name, "x", 1, {})], SAMPLES, HEADER)


def test_an_old_session_is_read_and_called_unverified(tmp_path):
    path = tmp_path / "old.h5"
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.attrs["format"] = "haselab session 1"
        file.attrs["header"] = "{}"
        file["events"] = np.array([(0.5, b"x")], [("time_s", "f8"), ("what", "S96")])
        file.create_group("experiments")
    with SessionReader(path) as session:
        assert session.doubt == "haselab session 1 has no checksums"
        assert session.events() == [(0.5, "x")]
