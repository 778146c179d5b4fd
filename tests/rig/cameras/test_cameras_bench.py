"""Section `camera` of RIG.toml, through the bench, the ladder and the doctor."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from haselab.base import DeviceError, InputError
from haselab.cli.main import main
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.aravis import library as aravis_library
from haselab.rig.cameras.aravis.library import AravisLibrary
from haselab.rig.cameras.source import ExposureLine
from haselab.rig.real_bench import RealBench, identify
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.safety.gate import Gate
from haselab.store.video.writer import write_png

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")


@pytest.fixture(scope="module")
def served() -> Iterator[ServedTwin]:
    """In lock-step: a camera that keeps its own time is asked who it is, and films elsewhere."""
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as twin:
        yield twin


@pytest.fixture
def pictures(tmp_path: Path) -> tuple[Path, np.ndarray]:
    frames = np.random.default_rng(1).integers(0, 256, (30, 8, 12), dtype=np.uint8)
    folder = tmp_path / "pictures"
    folder.mkdir()
    for k, frame in enumerate(frames):
        write_png(folder / f"{k:02d}.png", frame)
    return folder, frames


def with_camera(served: ServedTwin, camera: dict[str, Any] | None) -> BenchConfig:
    data = tomllib.loads(served.rig_file(ahead_blocks=1))
    data["daq"]["server_patience_s"] = 30.0  # a busy machine is no fault
    del data["camera"]
    return BenchConfig.model_validate(data | ({"camera": camera} if camera else {}))


def written(config: BenchConfig, path: Path) -> Path:
    """As TOML: sections of numbers, texts and truths."""
    lines: list[str] = []
    sections = config.model_dump(exclude_none=True)
    for key, value in sections.items():
        if not isinstance(value, dict):
            lines.append(f"{key} = {json.dumps(value)}")
    for key, value in sections.items():
        if isinstance(value, dict):
            lines += [f"[{key}]", *(f"{k} = {json.dumps(v)}" for k, v in value.items())]
    path.write_text("\n".join(lines) + "\n")
    return path


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(stop.value.code or 0), out, err


def test_a_folder_films_on_the_clock_of_the_board(served, pictures):
    folder, frames = pictures
    with RealBench(with_camera(served, {"kind": "folder", "path": str(folder)}), Gate()) as bench:
        rig = bench.rig
        rig.camera.start(100.0)
        start_s, taken = rig.acquisition.time_s, []
        for _ in range(20):
            rig.acquisition.read()
            found = rig.camera.take()
            if found is not None:
                assert found.time_s[-1] <= rig.acquisition.time_s
                taken.append(found)
        rig.camera.stop()
        time_s = np.concatenate([found.time_s for found in taken])
        images = np.concatenate([found.images for found in taken])
    # One frame a block of 10 ms, from the start on; a rounding of the clock may move one frame.
    assert abs(len(images) - 21) <= 1
    # The first pictures may belong to blocks that the start of the output took: over USB those of
    # its three queued values, and the one in which it began.
    first = next(k for k, frame in enumerate(frames) if np.array_equal(frame, images[0]))
    assert first <= 4  # blocks
    np.testing.assert_array_equal(images, frames[first : first + len(images)])
    np.testing.assert_allclose(time_s, start_s + 0.01 * np.arange(len(images)), rtol=0, atol=1e-9)


def test_a_bench_without_a_camera_films_nothing(served):
    with RealBench(with_camera(served, None), Gate()) as bench:
        bench.rig.camera.start(100.0)
        bench.rig.acquisition.read()
        assert bench.rig.camera.take() is None
        assert [found.name for found in bench.instruments] == ["daq", "generator", "supply"]


def test_the_camera_is_among_those_that_are_asked_who_they_are(served, pictures):
    config = with_camera(served, {"kind": "folder", "path": str(pictures[0])})
    assert ("camera", "pictures, 12 x 8 px") in identify(config)
    with RealBench(config, Gate()) as bench:
        assert bench.instruments[-1].identity == "pictures, 12 x 8 px"


def test_a_genicam_camera_is_named_by_its_serial_number(served):
    try:
        AravisLibrary()
    except DeviceError as missing:
        pytest.skip(str(missing))
    camera = {"kind": "aravis", "name": "Fake_1", "serial_number": "1"}
    reported = dict(identify(with_camera(served, camera)))
    assert reported["camera"] == "Aravis Fake, serial number 1"
    reported = dict(identify(with_camera(served, camera | {"serial_number": "2"})))
    assert "but the rig file names 2" in str(reported["camera"])


def test_a_camera_that_is_missing_leaves_the_bench_closed_and_at_0_v(served):
    config = with_camera(served, {"kind": "v4l2", "device": "/dev/video-none"})
    with pytest.raises(DeviceError, match="The camera does not exist"), RealBench(config, Gate()):
        pass
    assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)
    with RealBench(with_camera(served, None), Gate()) as bench:  # nothing holds the instruments
        bench.rig.acquisition.read()


@pytest.mark.parametrize(
    ("camera", "reported"),
    [
        ({"kind": "film"}, r"camera"),
        ({"kind": "folder"}, r"\[camera\] has no key path \(folder of images"),
        (
            {"kind": "folder", "path": "x", "address": "y"},
            r"camera\.address: no such key; the keys are kind, path, repeat",
        ),
        ({"kind": "aravis", "exposure_s": -1.0}, r"camera\.exposure_s"),
        ({"kind": "v4l2", "width_px": 640}, r"set both width_px and height_px"),
        ({"kind": "twin"}, r"\[camera\] has no key address \(host:port of the twin"),
    ],
)
def test_a_fault_in_the_section_is_reported_with_its_place(served, tmp_path, camera, reported):
    path = written(with_camera(served, None), tmp_path / "rig.toml")
    text = "\n".join(f"{key} = {json.dumps(value)}" for key, value in camera.items())
    path.write_text(path.read_text() + f"[camera]\n{text}\n")
    with pytest.raises(InputError, match=reported):
        load_rig(path)


def test_the_check_names_the_camera_and_counts_its_frames(served, pictures, tmp_path, capsys):
    camera = {"kind": "folder", "path": str(pictures[0]), "repeat": True}
    path = written(with_camera(served, camera), tmp_path / "rig.toml")
    code, out, err = call(capsys, "rig", "check", path, "--json")
    assert code == 0, err
    checks = {(r["step"], r["what"]): r["found"] for r in json.loads(out)["checks"]}
    assert checks["dry", "camera"] == "pictures, 12 x 8 px"
    found = {f"{n} at 100 Hz, 100 Hz found, 0 lost, times to 0 us" for n in (50, 51)}
    assert checks["dry", "frames"] in found


def test_the_doctor_reports_a_missing_driver_and_a_missing_camera(
    served, tmp_path, capsys, monkeypatch
):
    names = {key: ("libnone.so", *rest) for key, (_, *rest) in aravis_library._NAMES.items()}
    monkeypatch.setattr(aravis_library, "_NAMES", names)
    path = written(with_camera(served, {"kind": "aravis"}), tmp_path / "rig.toml")
    code, out, _ = call(capsys, "doctor", "--rig", path, "--json")
    found = {(f["kind"], f["name"]): f for f in json.loads(out)["findings"]}
    assert code == 0
    assert not found["optional", "Aravis"]["found"]
    assert found["optional", "Aravis"]["advice"].startswith("For GenICam cameras: ")
    assert not found["instrument", "camera"]["found"]
    code, _, err = call(capsys, "rig", "check", path)
    assert code == 4 and err.count("\n") == 1 and "which is not installed. Run: " in err


LINE = {"input": "PFI0"}
ARAVIS = {"kind": "aravis", "name": "Fake_1"}


def exposed(served: ServedTwin, camera: dict[str, Any], line: dict[str, Any]) -> BenchConfig:
    data = tomllib.loads(served.rig_file(ahead_blocks=1))
    return BenchConfig.model_validate(data | {"camera": camera, "exposure": LINE | line})


def test_the_exposure_of_the_camera_is_the_one_of_its_line(served):
    file = exposed(served, ARAVIS | {"exposure_s": 3e-3}, {"line": "Line2", "inverted": True})
    assert file.exposure is not None and file.exposure.duration_s == 3e-3
    assert file.exposure_line == ExposureLine(3e-3, "Line2", True)
    same = exposed(served, ARAVIS | {"exposure_s": 3e-3}, {"duration_s": 3.01e-3})
    assert same.exposure_line == ExposureLine(3.01e-3)


@pytest.mark.parametrize(
    ("camera", "line", "reported"),
    [
        (ARAVIS | {"exposure_s": 3e-3}, {"duration_s": 2e-3}, "Remove exposure.duration_s"),
        (ARAVIS, {}, "duration_s is unknown. Set camera.exposure_s"),
        (ARAVIS, {"duration_s": 2e-3, "inverted": True}, "exposure.inverted needs exposure.line"),
        ({"kind": "v4l2"}, {"duration_s": 2e-3, "line": "Line1"}, "need a camera of kind 'aravis'"),
        (
            {"kind": "twin", "address": "x:1"},
            {"duration_s": 2e-3},
            "cannot have a section exposure",
        ),
    ],
)
def test_an_exposure_section_that_does_not_fit_the_camera_is_refused(
    served, camera, line, reported
):
    with pytest.raises(ValidationError, match=reported):
        exposed(served, camera, line)
