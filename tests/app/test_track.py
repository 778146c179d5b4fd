"""`haselab track` as a user calls it: tables, summary, errors."""

import csv
import json
from fractions import Fraction

import av
import numpy as np
import pytest

from haselab.app.main import main

COLUMNS = ["frame", "time_s", "point", "x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid"]
ROWS = np.array([[x, y] for y in (40.0, 200.0) for x in (50.0, 110.0, 170.0)])
STRAINS = [0.0, 0.0, 0.0, 0.01, 0.02, 0.03]


def draw(dots, sigma, image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    for cx, cy in dots:
        image -= 90 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """An FFV1 clip of two clamps with three dots each and a sheet of particles between them."""
    path = tmp_path_factory.mktemp("clip") / "clip.mkv"
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.linspace(40, 180, 6), np.linspace(70, 170, 5))
    particles = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-2, 2, (30, 2))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=Fraction(400))
        stream.width, stream.height, stream.pix_fmt = 220, 240, "gray"
        for strain in STRAINS:
            image = np.full((240, 220), 160.0)
            for dots, sigma in ((ROWS, 5.0), (particles, 2.0)):
                moved = dots * [1.0, 1.0 + strain] - [0.0, 40.0 * strain]
                draw(moved, sigma, image)
            noisy = np.rint(rng.normal(image, 1.5)).clip(0, 255).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noisy, format="gray")))
        container.mux(stream.encode())
    return path


def call(*arguments):
    with pytest.raises(SystemExit) as stop:
        main(["track", *map(str, arguments)])
    return stop.value.code


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_points_of_a_table_give_the_columns_of_the_contract(clip, tmp_path, capsys):
    points = tmp_path / "p.csv"
    points.write_text("point,x_px,y_px\nupper,110,40\nlower,110,200\n")
    out = tmp_path / "new" / "tracks.csv"
    assert call(clip, "--points", points, "--rest-frames", 3, "--out", out, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    rows = read(out)
    assert list(rows[0]) == [*COLUMNS, "reason"]
    assert [row["point"] for row in rows] == ["upper", "lower"] * 6
    assert [float(row["time_s"]) for row in rows[::2]] == pytest.approx(
        np.arange(6) / 400, abs=1e-9
    )
    for row, strain in zip(rows[1::2], STRAINS, strict=True):
        # five deviations, plus the last digit of the table
        assert float(row["y_px"]) == pytest.approx(
            200 + 160 * strain, abs=5 * float(row["std_y_px"]) + 1e-5
        )
        assert row["valid"] == "1"
    assert (summary["frames"], summary["rate_hz"], summary["lossy"]) == (6, 400.0, False)
    assert summary["noise"]["floor"] + 140 * summary["noise"]["slope"] == pytest.approx(
        1.5**2 + 1 / 12, rel=0.1
    )


def test_clamp_dots_are_found_and_give_the_strain(clip, tmp_path, capsys):
    out, picture = tmp_path / "t.csv", tmp_path / "t.png"
    assert (
        call(clip, "--auto", "--rest-frames", 3, "--out", out, "--overlay", picture, "--json") == 0
    )
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert captured.err == ""
    assert summary["model"] == "neighbours"
    assert summary["valid_fraction"] == 1.0
    assert {f"{row}{k}" for row in ("upper", "lower") for k in (1, 2, 3)} < {
        row["point"] for row in read(out)
    }
    rows = read(tmp_path / "t-strain.csv")
    for row, strain in zip(rows, STRAINS, strict=True):
        assert float(row["strain"]) == pytest.approx(strain, abs=5 * float(row["strain_std"]))
    assert float(rows[0]["strain_std"]) < 3e-4  # 0.03 px over 160 px
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_scale_adds_displacements_in_metres(clip, tmp_path):
    points = tmp_path / "p.csv"
    points.write_text("point,x_px,y_px\na,110,200\n")
    out = tmp_path / "t.csv"
    assert call(clip, "--points", points, "--scale-mm-per-px", "0.1", "--out", out) == 0
    rows = read(out)
    assert list(rows[0]) == [*COLUMNS, "displacement_x_m", "displacement_y_m", "reason"]
    assert float(rows[-1]["displacement_y_m"]) == pytest.approx(
        1e-4 * (float(rows[-1]["y_px"]) - 200.0), abs=1e-9
    )


def test_linking_real_colloids_warns_that_the_file_is_lossy(shared_data, tmp_path, capsys):
    out = tmp_path / "t.csv"
    video = shared_data / "video/bulk-water.mov"
    assert call(video, "--link", "--out", out, "--json") == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert "compressed with loss" in captured.err
    assert summary["frames"] == 480
    assert summary["particles_a_frame"] > 400
    with out.open() as file:
        assert file.readline().strip().split(",") == [*COLUMNS, "reason"]


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ("x_px,y_px\n1,2\n", "needed are point, x_px, y_px"),
        ("point,x_px,y_px\na,1,two\n", "not a number"),
        ("point,x_px,y_px\na,50,50\na,60,60\n", "same name"),
        ("point,x_px,y_px\na,2,50\n", "too close to the edge"),
    ],
)
def test_tables_of_points_that_cannot_be_used_end_with_one_line(
    clip, tmp_path, capsys, table, match
):
    points = tmp_path / "p.csv"
    points.write_text(table)
    assert call(clip, "--points", points, "--out", tmp_path / "t.csv") == 2
    error = capsys.readouterr().err
    assert match in error
    assert error.count("\n") == 1


def test_wrong_usage_and_missing_files_end_with_code_2(clip, tmp_path, capsys):
    out = tmp_path / "t.csv"
    assert call(clip) == 2
    assert call(tmp_path / "no.avi", "--out", out) == 2
    assert call(clip, "--auto", "--points", "p.csv", "--out", out) == 2
    assert call(clip, "--rest-frames", 99, "--out", out) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [
        part in line
        for part, line in zip(
            ("--out OUT.csv is needed", "no such video", "excludes --auto", "has 6 frames"),
            lines,
            strict=True,
        )
    ] == [True] * 4
    assert not out.exists()
