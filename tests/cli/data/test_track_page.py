"""Every command on the page about tracking runs as it stands."""

import csv
import re
import shlex
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
import tifffile

from haselab.cli.data.track import command
from haselab.cli.main import cli
from haselab.store.session.writer import ExperimentPlan, SessionWriter
from haselab.tracking import LossReason

PAGE = Path(__file__).resolve().parents[3] / "docs" / "measure" / "tracking.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = [
    line
    for block in re.findall(r"^```\n(.*?)^```$", TEXT, flags=re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
]
WIDTH, HEIGHT, REST, FRAMES = 320, 240, 10, 14
CLAMPS = np.array([[x, y] for y in (30.0, 210.0) for x in (80.0, 160.0, 240.0)])
FRAME_DOTS = np.array([[20.0, 60.0], [300.0, 120.0], [20.0, 180.0]])


def drawn(dots, sigma, image):
    for cx, cy in dots:
        left, top = int(cx) - 20, int(cy) - 20
        cut = np.s_[max(top, 0) : top + 41, max(left, 0) : left + 41]
        y, x = np.indices(image.shape)[(slice(None), *cut)]
        image[cut] -= 90 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))


def noisy(image, rng):
    return np.rint(rng.normal(image, 1.0)).clip(0, 255).astype(np.uint8)


def sheet_frames(rng):
    """Clamps, a sheet of particles that stretches between them, and dots that stand still."""
    x, y = np.meshgrid(np.linspace(60, 260, 8), np.linspace(60, 180, 6))
    particles = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-3, 3, (48, 2))
    for k in range(FRAMES):
        strain = 0.01 * max(k - REST + 1, 0)
        image = np.full((HEIGHT, WIDTH), 160.0)
        for dots, sigma in ((CLAMPS, 5.0), (particles, 2.0)):
            drawn(dots * [1.0, 1.0 + strain] - [0.0, 30.0 * strain], sigma, image)
        drawn(FRAME_DOTS, 3.0, image)
        yield noisy(image, rng)


def particle_frames(rng):
    place = rng.uniform(20, 220, (30, 2))
    for _ in range(8):
        place = place + rng.normal(0, 0.7, place.shape)
        image = np.full((HEIGHT, WIDTH), 160.0)
        drawn(place, 2.0, image)
        yield noisy(image, rng)


def board(turn, distance):
    """A checkerboard of 9 x 6 inner corners, tilted, each pixel the mean of 9 samples."""
    rise, swing = turn
    first = np.array([np.cos(swing), 0.0, np.sin(swing)])
    second = np.array([0.0, np.cos(rise), np.sin(rise)])
    total = np.zeros((HEIGHT, WIDTH))
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    for dy in (-1 / 3, 0, 1 / 3):
        for dx in (-1 / 3, 0, 1 / 3):
            rays = np.stack([(x + dx - 160) / 400, (y + dy - 120) / 400, np.ones_like(x)])
            columns = [np.broadcast_to(v, (HEIGHT, WIDTH, 3)) for v in (first, second)]
            matrix = np.stack([*columns, -np.moveaxis(rays, 0, 2)], axis=-1)
            place = np.linalg.solve(matrix, np.array([[0.0], [0.0], [-distance]]))
            u, v = place[..., 0, 0] + 5.0, place[..., 1, 0] + 3.5
            off = (u < 0) | (v < 0) | (u >= 10) | (v >= 7)
            total += np.where(off | ((np.floor(u) + np.floor(v)) % 2 == 0), 220, 40)
    return np.rint(total / 9).astype(np.uint8)


def write_video(path, frames, codec, form):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(400))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, form
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
        container.mux(stream.encode())


def write_points(path, names, places):
    rows = [f"{name},{x:g},{y:g}" for name, (x, y) in zip(names, places, strict=True)]
    path.write_text("\n".join(["point,x_px,y_px", *rows]) + "\n")


def write_tiff(path, image):
    tifffile.imwrite(path, image, photometric="minisblack")


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The files that the page speaks of."""
    folder, rng = tmp_path_factory.mktemp("records"), np.random.default_rng(4)
    frames = list(sheet_frames(rng))
    write_video(folder / "clip.mkv", frames, "ffv1", "gray")
    write_video(folder / "colloids.mov", particle_frames(rng), "png", "gray")
    names = [f"{row}{k}" for row in ("upper", "lower") for k in (1, 2, 3)]
    write_points(folder / "points.csv", names, CLAMPS)
    write_points(folder / "frame.csv", ["frame1", "frame2", "frame3"], FRAME_DOTS)
    ticks = np.tile(128 + 60 * np.cos(2 * np.pi * np.arange(float(WIDTH)) / 10.0), (HEIGHT, 1))
    write_tiff(folder / "ruler.tif", np.rint(ticks).astype(np.uint8))
    write_tiff(folder / "board.tif", board((0.1, 0.05), 18.0))
    for name in ("boards", "images"):
        (folder / name).mkdir()
    tilts = [(-0.3, 0.2), (0.3, 0.3), (0.2, -0.3), (-0.3, -0.2), (0.4, 0.0), (0.0, 0.3)]
    for k, turn in enumerate(tilts):  # as near as the corners of the board allow
        write_tiff(folder / f"boards/{k}.tif", board(turn, 12.5))
    for k, frame in enumerate(frames):
        write_tiff(folder / f"images/{k:03}.tif", frame)
    time_s = np.arange(FRAMES) / 400.0
    table = "".join(f"{k},{t:.6f}\n" for k, t in enumerate(time_s))
    (folder / "times.csv").write_text("frame,time_s\n" + table)
    plans = [ExperimentPlan("triangle", "play", 1, {})]
    with SessionWriter(folder / "session.h5", plans, 2000, {}) as writer:
        tracks = np.zeros((FRAMES, 1), SessionWriter.track_dtype())
        writer.append_frames("triangle", time_s, tracks, np.nan)
    return folder


def remove_results(records, arguments):
    """Remove what an earlier command left under the names that this one writes."""
    for option in ("--out", "--overlay", "--report"):
        if option in arguments:
            path = records / arguments[arguments.index(option) + 1]
            for old in (path, path.with_name(f"{path.stem}-strain.csv")):
                old.unlink(missing_ok=True)


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_of_the_page_runs(records, monkeypatch, line):
    if "board" in line:
        pytest.importorskip("cv2")
    monkeypatch.chdir(records)
    program, *arguments = shlex.split(line)
    assert program == "haselab"
    if "tracks-lens.json" in line and not (records / "tracks-lens.json").is_file():
        pytest.importorskip("cv2")  # the command before makes it; it may run in another process
        before = shlex.split(COMMANDS[COMMANDS.index(line) - 1])[1:]
        remove_results(records, before)
        cli.main(before, standalone_mode=False)
    remove_results(records, arguments)
    cli.main(arguments, standalone_mode=False)
    for option in ("--out", "--overlay", "--report"):
        if option in arguments:
            assert (records / arguments[arguments.index(option) + 1]).stat().st_size > 0


def test_the_page_names_every_option_and_every_reason():
    options = {name for param in command.params for name in param.opts}
    common = {"--json", "--debug", "--help", "-h", "video"}
    assert options - common - set(re.findall(r"--[a-z-]+", TEXT)) == set()
    assert {r.name for r in LossReason if f"`{str(r.name).lower()}`" not in TEXT} == set()


def test_the_header_of_the_table_is_that_of_the_page(records, monkeypatch):
    monkeypatch.chdir(records)
    asked = ["track", "clip.mkv", "--points", "points.csv", "--out", "h.csv"]
    cli.main(asked, standalone_mode=False)
    with Path("h.csv").open(newline="") as file:
        assert "`" + ", ".join(next(csv.reader(file))) + "`" in TEXT
