"""`haselab track` as a user calls it: tables, summary, errors."""

import csv
import json
import re
import shutil
from fractions import Fraction

import av
import numpy as np
import pytest
import tifffile

from haselab.cli.main import main
from haselab.pipelines.tracking.points import Points, name_gauge
from haselab.store.manifest import seal

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
        ("x_px,y_px\n1,2\n", "but must have point, x_px, y_px"),
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
            (
                "Missing option '--out'",
                "no such video",
                "excludes --auto",
                "has only 6 frames",
            ),
            lines,
            strict=True,
        )
    ] == [True] * 4
    assert not out.exists()


def table(path, rows):
    path.write_text("\n".join(["point,x_px,y_px", *rows]) + "\n")
    return path


SIX = [f"{row}{k},{x:g},{y:g}" for row, y in (("upper", 40), ("lower", 200))
       for k, x in ((1, 50), (2, 110), (3, 170))]  # fmt: skip


def write_clip(path, images, codec="ffv1", form="gray"):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(400))
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = form
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            container.mux(stream.encode(frame.reformat(format=form)))
        container.mux(stream.encode())
    return path


def sheet(moves, shape=(240, 220), noise=1.0, seed=3):
    """Two rows of clamp dots, each frame moved as `moves` says of all six points."""
    rng, images = np.random.default_rng(seed), []
    for move in moves:
        image = np.full(shape, 160.0)
        draw(move(ROWS), 5.0, image)
        images.append(np.rint(rng.normal(image, noise)).clip(0, 255).astype(np.uint8))
    return images


def summary_of(capsys):
    return json.loads(capsys.readouterr().out)


def test_the_motion_of_the_stand_is_taken_out_by_fixed_points(tmp_path, capsys):
    def shaken(shift, angle, stretch):
        def move(points):
            c, s = np.cos(angle), np.sin(angle)
            placed = points.copy()
            placed[3:, 1] += stretch
            middle = points.mean(axis=0)
            return (placed - middle) @ np.array([[c, -s], [s, c]]).T + middle + shift

        return move

    moves = [shaken([0, 0], 0, 0)] * 3 + [shaken([2 * k, -k], 0.004 * k, 1.5 * k) for k in (1, 2)]
    clip = write_clip(tmp_path / "c.mkv", sheet(moves))
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    fixed = "upper1,upper2,upper3"
    asked = ("--points", points, "--rest-frames", 3, "--fixed", fixed, "--subset-px", 31)
    assert call(clip, *asked, "--out", out, "--json") == 0
    assert summary_of(capsys)["fixed"] == fixed.split(",")
    for k, row in enumerate(read(out)):
        frame, point = divmod(k, 6)
        stretch = 1.5 * max(frame - 2, 0) * (point > 2)
        assert float(row["y_px"]) == pytest.approx(
            ROWS[point, 1] + stretch, abs=5 * float(row["std_y_px"])
        )
        assert float(row["x_px"]) == pytest.approx(ROWS[point, 0], abs=5 * float(row["std_x_px"]))


def test_where_no_fixed_point_is_found_the_others_are_lost_and_say_why(tmp_path, capsys):
    images = sheet([lambda p: p] * 6)
    images[4][:80] = 60  # over the upper row
    clip = write_clip(tmp_path / "c.mkv", images)
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    asked = ("--points", points, "--rest-frames", 3, "--fixed", "upper1,upper2,upper3")
    assert call(clip, *asked, "--out", out, "--json") == 0
    rows = [row for row in read(out) if row["frame"] == "4"]
    assert [row["valid"] for row in rows] == ["0"] * 6
    assert {row["x_px"] for row in rows} == {"nan"}
    assert [row["reason"] for row in rows[3:]] == ["untied"] * 3
    assert all(row["reason"] not in ("", "untied") for row in rows[:3])
    assert all(row["valid"] == "1" for row in read(out) if row["frame"] != "4")


def test_scales_of_points_and_of_a_ruler_agree_with_the_truth(clip, tmp_path, capsys):
    x = np.arange(220.0)
    ruler = np.tile(128 + 60 * np.cos(2 * np.pi * x / 10.0), (60, 1))
    picture = tmp_path / "ruler.tif"
    tifffile.imwrite(picture, np.rint(ruler).astype(np.uint8), photometric="minisblack")
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    asked = ("--points", points, "--out", out, "--json")
    assert call(clip, *asked, "--scale-points", "50,40,170,40,12") == 0
    scale = summary_of(capsys)["scale_mm_per_px"]
    assert (scale["value"], scale["unit"]) == (pytest.approx(0.1), "mm/px")
    assert scale["std"] == pytest.approx(0.1 * np.sqrt(2 / 12) / 120)
    wish = ("--scale-ruler", "5,30,210,30,1", "--scale-picture", picture)
    assert call(clip, *asked, *wish, "--force") == 0
    scale = summary_of(capsys)["scale_mm_per_px"]
    assert abs(scale["value"] - 0.1) < 5 * scale["std"]
    assert float(read(out)[-1]["displacement_y_m"]) == pytest.approx(
        scale["value"] * 1e-3 * 160 * STRAINS[-1], rel=0.03
    )


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (("--scale-mm-per-px", "0"), "--scale-mm-per-px is 0. Use a positive number"),
        (("--scale-mm-per-px", "nan"), "is not a finite number"),
        (("--scale-points", "1,2,3,4"), "not of the form X1,Y1,X2,Y2,MM"),
        (("--scale-points", "1,2,3,4,0"), "not a positive length"),
        (("--scale-points", "1,2,1,2,5"), "0 px apart"),
        (("--scale-points", "1,2,3,4,5", "--scale-mm-per-px", "1"), "exclude each other"),
        (("--scale-ruler", "10,10,900,10,1"), "is not inside the 220 x 240 px image"),
        (("--scale-board", "9,5"), "not of the form COLUMNSxROWS,MM"),
        (("--fixed", "left"), "No point has the name left"),
        (("--lens", "nothing.json"), "No such file"),
        (("--overlay", "a.gif"), "Use .mp4"),
        (("--times", "nothing.csv"), "has no times"),
        (("--rest-frames", "9"), "has only 6 frames"),
    ],
)
def test_scales_and_options_that_cannot_be_used_end_with_one_line(
    clip, tmp_path, capsys, options, match
):
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    assert call(clip, "--points", points, "--out", out, *options) == 2
    error = capsys.readouterr().err
    assert match in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_points_outside_the_picture_are_named(clip, tmp_path, capsys):
    points = table(tmp_path / "p.csv", ["a,50,40", "b,221,40", "c,10,-3"])
    assert call(clip, "--points", points, "--out", tmp_path / "t.csv") == 2
    error = capsys.readouterr().err
    assert "2 of 3 points are outside the frame, the first is 'b' at (221, 40) px" in error
    assert "x from 0 to 219" in error


def test_a_truncated_video_keeps_what_was_read_and_ends_with_code_2(tmp_path, capsys):
    images = sheet([lambda p: p] * 40, noise=3.0)
    whole = write_clip(tmp_path / "whole.mkv", images)
    short = tmp_path / "short.mkv"
    short.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    assert call(short, "--points", points, "--out", out, "--json") == 2
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    kept = summary["frames_read"]
    assert 10 < kept < 30
    assert len(read(out)) == 6 * kept
    assert len(read(tmp_path / "t-strain.csv")) == kept
    assert "Copy it again" in summary["incomplete"]
    assert f"Only {kept} frames were tracked; their rows are kept" in captured.err
    assert captured.err.count("\n") == 1


def test_a_size_that_changes_keeps_the_frames_before(tmp_path, capsys):
    folder = tmp_path / "frames"
    folder.mkdir()
    images = [*sheet([lambda p: p] * 3), *sheet([lambda p: p], shape=(240, 230))]
    for k, image in enumerate(images):
        tifffile.imwrite(folder / f"{k}.tif", image, photometric="minisblack")
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    assert call(folder, "--points", points, "--rate-hz", 100, "--out", out) == 2
    error = capsys.readouterr().err
    assert "Frame 3 has 230 x 240 px of 8 bit, frame 0 has 220 x 240 px" in error
    assert [float(row["time_s"]) for row in read(out)[::6]] == [0.0, 0.01, 0.02]


def test_files_that_are_no_video_end_with_one_line(tmp_path, capsys):
    points = table(tmp_path / "p.csv", SIX)
    letter, text_tiff = tmp_path / "letter.avi", tmp_path / "letter.tif"
    for path in (letter, text_tiff):
        path.write_text("a letter, not a video\n" * 40)
    (tmp_path / "empty.mkv").touch()
    (tmp_path / "folder").mkdir()
    for path in (letter, text_tiff, tmp_path / "empty.mkv", tmp_path / "folder"):
        assert call(path, "--points", points, "--out", tmp_path / "t.csv") == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert error.rstrip().endswith(str(path))
    assert not (tmp_path / "t.csv").exists()


def test_times_of_a_table_stand_as_they_are_and_must_reach_to_the_end(clip, tmp_path, capsys):
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    times = tmp_path / "times.csv"
    times.write_text("frame,time_s\n" + "".join(f"{k},{7 + 0.01 * k}\n" for k in range(6)))
    assert call(clip, "--points", points, "--times", times, "--out", out, "--json") == 0
    assert summary_of(capsys)["rate_hz"] == pytest.approx(100.0)
    found = [float(row["time_s"]) for row in read(out)[::6]]
    assert found == pytest.approx(7 + 0.01 * np.arange(6), abs=1e-9)
    times.write_text("frame,time_s\n0,7\n1,8\n")
    assert call(clip, "--points", points, "--times", times, "--out", out, "--force") == 2
    assert "The table of times has 2 frames, but the video has more" in capsys.readouterr().err


def test_a_lossy_file_is_named_as_such(tmp_path, capsys):
    clip = write_clip(tmp_path / "c.avi", sheet([lambda p: p] * 4), "mjpeg", "yuvj420p")
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    assert call(clip, "--points", points, "--out", out, "--json") == 0
    captured = capsys.readouterr()
    summary = json.loads(captured.out)
    assert (summary["lossy"], summary["codec"]) == (True, "mjpeg")
    assert "compressed with loss (mjpeg). The standard deviations are widened" in captured.err


def test_a_sheet_without_clamp_dots_gets_three_points_near_either_end(tmp_path, capsys):
    rng = np.random.default_rng(8)
    x, y = np.meshgrid(np.linspace(40, 260, 8), np.linspace(40, 360, 11))
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-3, 3, (88, 2))
    images = []
    for strain in (0, 0, 0, 0.01, 0.02):
        image = np.full((400, 300), 160.0)
        draw(dots * [1.0, 1.0 + strain] - [0.0, 40.0 * strain], 2.0, image)
        images.append(np.rint(rng.normal(image, 1.5)).clip(0, 255).astype(np.uint8))
    clip, out = write_clip(tmp_path / "c.mkv", images), tmp_path / "t.csv"
    assert call(clip, "--auto", "--rest-frames", 3, "--out", out, "--json") == 0
    summary = summary_of(capsys)
    assert any("no clamp dots: upper1-3 are the particles nearest" in w for w in summary["chosen"])
    places = {row["point"]: float(row["y_px"]) for row in read(out) if row["frame"] == "0"}
    assert all(places[f"lower{k}"] > 318 for k in (1, 2, 3))
    assert all(places[f"upper{k}"] < 82 for k in (1, 2, 3))
    last = read(tmp_path / "t-strain.csv")[-1]
    assert float(last["strain"]) == pytest.approx(0.02, abs=5 * float(last["strain_std"]))


def test_a_tilted_gauge_and_a_missing_one_are_named():
    x, y = np.meshgrid(np.linspace(0, 200, 9), np.linspace(0, 200, 9))
    grid = np.stack([x.ravel(), y.ravel()], axis=1)

    def named(place_px):
        return name_gauge(Points([f"p{k}" for k in range(len(place_px))], place_px, 21))

    assert "tilted" not in named(grid).gauge
    sheared = named(grid @ [[1.0, 0.0], [0.35, 1.0]])  # no particle is below another
    assert re.search(r"tilted by \d+\.\d deg, and the strain is along it", sheared.gauge)
    bare = named(grid[(y.ravel() > 30) | (x.ravel() < 40)])
    assert bare.gauge == "" and "no strain: fewer than three" in bare.chosen[-1]


def test_an_overlay_video_shows_every_frame(clip, tmp_path):
    points, out, shown = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv", tmp_path / "o.mp4"
    assert call(clip, "--points", points, "--out", out, "--overlay", shown) == 0
    with av.open(str(shown)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6
    x, y = ROWS[0].astype(int)
    red, green, blue = frames[0][y, x].astype(int)
    assert green > red + 40 and green > blue + 40


def test_strain_is_unknown_while_a_clamp_is_covered_and_known_otherwise(tmp_path, capsys):
    images = sheet([lambda p: p] * 8)
    rng = np.random.default_rng(9)
    for image in images[4:6]:
        image[170:230] = rng.integers(57, 63, (60, 220))
    clip = write_clip(tmp_path / "c.mkv", images)
    points, out = table(tmp_path / "p.csv", SIX), tmp_path / "t.csv"
    page = tmp_path / "page.html"
    asked = ("--points", points, "--rest-frames", 3, "--out", out, "--report", page, "--json")
    assert call(clip, *asked) == 0
    summary = summary_of(capsys)
    rows = read(tmp_path / "t-strain.csv")
    assert [row["strain"] == "nan" for row in rows] == [k in (4, 5) for k in range(8)]
    assert (summary["strain"]["frames"], summary["report"]) == (6, str(page))
    assert 'figure id="strain"' in page.read_text()


def test_times_skip_the_images_that_are_missing(tmp_path, capsys):
    folder = tmp_path / "images"
    folder.mkdir()
    image = np.full((60, 60), 160.0)
    draw([(30, 30)], 2.0, image)
    noise = np.random.default_rng(3)
    for number in (8, 9, 10, 12):
        noisy = np.rint(noise.normal(image, 1.5)).clip(0, 255).astype(np.uint8)
        tifffile.imwrite(folder / f"img_{number}.tif", noisy)
    points, out = tmp_path / "p.csv", tmp_path / "t.csv"
    points.write_text("point,x_px,y_px\na,30,30\n")
    arguments = (folder, "--points", points, "--rate-hz", 10, "--out", out, "--json")
    assert call(*arguments) == 0
    captured = capsys.readouterr()
    assert [float(row["time_s"]) for row in read(out)] == pytest.approx([0.0, 0.1, 0.2, 0.4])
    answer = json.loads(captured.out)
    assert answer["missing_frames"] == [3]
    assert [int(row["frame"]) for row in read(out)] == [0, 1, 2, 4]
    assert answer["expected_wrong_fraction"] == 1e-4
    linked = tmp_path / "l.csv"
    assert call(folder, "--link", "--rate-hz", 10, "--out", linked) == 0
    assert sorted({int(row["frame"]) for row in read(linked)}) == [0, 1, 2, 4]
    capsys.readouterr()
    assert "1 frames are missing" in captured.err
    times = tmp_path / "times.csv"
    times.write_text("frame,time_s\n0,0\n1,1\n2,2\n3,3\n4,4\n")
    assert call(*arguments, "--times", times, "--force") == 0
    assert [float(row["time_s"]) for row in read(out)] == pytest.approx([0.0, 1.0, 2.0, 4.0])


def test_a_recorded_video_that_changed_is_refused_or_marked(clip, tmp_path, capsys):
    run, points = tmp_path / "run", tmp_path / "p.csv"
    points.write_text("point,x_px,y_px\nupper,110,40\nlower,110,200\n")
    (run / "video").mkdir(parents=True)
    video = run / "video" / "chirp.avi"
    shutil.copy(clip, video)
    seal(run, "SEALED", {})
    out = tmp_path / "tracks.csv"
    arguments = (video, "--points", points, "--out", out, "--json")
    assert call(*arguments) == 0
    assert "unverified" not in json.loads(capsys.readouterr().out)
    data = bytearray(video.read_bytes())
    data[-20] ^= 1
    video.write_bytes(data)
    before = out.read_bytes()
    assert call(*arguments, "--force") == 2
    assert "not that in manifest.json" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert call(*arguments, "--force", "--unverified") in (0, 2)  # as far as it can be decoded
    printed = capsys.readouterr()
    assert json.loads(printed.out)["unverified"] is True
    assert "unverified numbers" in printed.err


def test_motion_in_the_rest_frames_is_reported_and_left_out(tmp_path, capsys):
    folder = tmp_path / "images"
    folder.mkdir()
    noise = np.random.default_rng(3)
    for number in range(12):
        image = np.full((60, 60), 160.0)
        draw([(30 + 0.5 * max(number - 5, 0), 30)], 2.0, image)
        noisy = np.rint(noise.normal(image, 1.5)).clip(0, 255).astype(np.uint8)
        tifffile.imwrite(folder / f"img_{number:02d}.tif", noisy)
    points, out, page = (tmp_path / name for name in ("p.csv", "t.csv", "t.html"))
    points.write_text("point,x_px,y_px\na,30,30\n")
    arguments = (folder, "--points", points, "--rest-frames", 10, "--report", page, "--json")
    assert call(*arguments, "--out", out) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["rest_frames"] == 6
    warning = "--rest-frames is 10, but the points move from frame 6 on"
    assert warning in captured.err and warning in page.read_text()
    for number, row in enumerate(read(out)):
        truth = 30 + 0.5 * max(number - 5, 0)
        assert float(row["x_px"]) == pytest.approx(truth, abs=5 * float(row["std_x_px"]))
