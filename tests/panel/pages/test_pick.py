"""Pick points in a video: the page in Chromium, what is saved, and who may not use it."""

import csv
import http.client
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, Route, expect

from haselab.base import InputError
from haselab.panel.pages import pick as page_module
from haselab.panel.pages.pick import PICK_REQUESTS, Videos
from haselab.rig.twin.camera import TwinCamera, TwinCameraConfig
from haselab.store.video.writer import VideoWriter
from tests.panel.running import WAIT_S, RunningPanel, ended, started

WAIT_MS = 1e3 * WAIT_S
CAMERA = TwinCameraConfig()
REST, FRAMES = 5, 16
LENGTH_M = 0.080
MIDDLE_PX = (CAMERA.width_px - 1) / 2
UPPER = [(MIDDLE_PX + k * CAMERA.fiducial_spacing_px, CAMERA.top_px) for k in (-1, 0, 1)]
LOWER = [(x, y + LENGTH_M / CAMERA.scale_m_per_px) for x, y in UPPER]


def centre_std_px(
    sigma: float = CAMERA.fiducial_sigma_px,
    depth: float = CAMERA.fiducial_depth_grey,
    noise: float = (CAMERA.shot_gain_grey * 255.0 + CAMERA.read_noise_grey**2 + 1 / 12) ** 0.5,
) -> float:
    """Standard deviation of a dot's centre: `locate_particles` for white noise, at its scale.

    The response to a dot of depth A at its own scale has the curvature -A / (2 sigma²).
    """
    u = sigma**-2
    slope_std = noise * np.sqrt((2 - np.exp(-u) * (2 - 4 * u + u**2)) * u / (8 * np.pi))
    return float(slope_std / (depth / (2 * sigma**2)))


def clip(path: Path) -> Path:
    """Write a clip of the twin's camera."""
    strain = np.concatenate([np.zeros(REST), np.linspace(0.0, 0.05, FRAMES - REST)])
    lengths_m = np.repeat(LENGTH_M * (1 + strain)[:, None], CAMERA.exposure_samples, axis=1)
    frames = TwinCamera(CAMERA, 0.06, 0.05, seed=4).render(lengths_m, first_index=0)
    writer = VideoWriter(path, 400.0)
    writer.append(frames, np.arange(FRAMES) / 400.0)
    writer.close()
    return path


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clip in a folder of its own below a folder of recordings."""
    return clip(tmp_path_factory.mktemp("runs") / "run 1" / "clip.mkv")


@dataclass
class Picking:
    """`haselab track --pick` with its page."""

    process: subprocess.Popen[str]
    page: Page

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a place of the whole picture is on the screen."""
        box = self.page.get_by_role("application").bounding_box()
        assert box is not None
        return (
            box["x"] + (x + 0.5) * box["width"] / CAMERA.width_px,
            box["y"] + (y + 0.5) * box["height"] / CAMERA.height_px,
        )

    def click(self, x: float, y: float) -> None:
        """Click on a place, and wait for the mark."""
        marks = self.page.locator(".marks button")
        before = marks.count()
        self.page.mouse.click(*self.place(x, y))
        expect(marks).to_have_count(before + 1, timeout=WAIT_MS)

    def marks(self) -> list[str]:
        return self.page.locator(".marks button").all_inner_texts()

    def save(self) -> dict[str, Any]:
        """Press Save; what the command prints when it has ended by itself."""
        self.page.get_by_role("button", name=re.compile("Save")).click()
        expect(self.page.get_by_role("heading", name="Saved")).to_be_visible(timeout=WAIT_MS)
        assert self.process.stdout is not None
        rest = self.process.stdout.read()
        assert self.process.wait(WAIT_S) == 0
        return json.loads(rest)


def pick(*words: object) -> tuple[subprocess.Popen[str], str]:
    """Start `haselab track --pick`; the process, and the address that it printed."""
    command = [sys.executable, "-m", "haselab.cli", "track", "--pick", "--no-browser", "--json"]
    process = subprocess.Popen(
        [*command, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    assert process.stderr is not None
    return process, process.stderr.readline().strip()


@pytest.fixture
def picking(browser: Browser, video: Path, tmp_path: Path) -> Iterator[Picking]:
    """The page of a clip whose points go to `points.csv`; it asks nobody else for anything."""
    process, address = pick(video, "--out", tmp_path / "points.csv")
    try:
        with browser.new_context(viewport={"width": 1200, "height": 1000}) as context:
            page, problems = context.new_page(), []
            asked: list[str] = []
            page.set_default_timeout(WAIT_MS)
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.on("request", lambda sent: asked.append(sent.url))
            page.goto(address)
            expect(page.get_by_role("application")).to_be_visible(timeout=WAIT_MS)
            yield Picking(process, page)
            assert not problems
            assert all(re.match(r"http://127\.0\.0\.1:|data:|blob:", url) for url in asked)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def run(*words: object) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-m", "haselab.cli", *map(str, words)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_points_that_are_not_saved_are_not_lost_without_a_question(picking: Picking) -> None:
    asked: list[str] = []
    picking.page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
    picking.click(*UPPER[1])
    picking.page.evaluate("() => { setTimeout(() => location.reload()); }")
    picking.page.wait_for_timeout(500)
    assert asked == ["beforeunload"] and len(picking.marks()) == 1
    picking.page.get_by_role("button", name="Undo").click()  # nothing would be lost
    picking.page.reload()
    assert asked == ["beforeunload"]
    expect(picking.page.get_by_role("application")).to_be_visible(timeout=WAIT_MS)
    picking.click(*UPPER[1])
    picking.save()
    assert asked == ["beforeunload"]


def test_picked_points_are_those_that_track_finds_and_give_its_strain(
    picking: Picking, video: Path, tmp_path: Path
) -> None:
    picking.click(UPPER[1][0] - 5, UPPER[1][1] + 4)
    picking.click(LOWER[1][0] + 6, LOWER[1][1] + 3)
    picking.page.get_by_role("button", name="Scale", exact=True).click()
    picking.click(UPPER[0][0] + 4, UPPER[0][1] - 5)
    picking.click(UPPER[1][0] + 2, UPPER[1][1] + 2)  # where a point is; the third click begins anew
    picking.page.get_by_role("button", name="Undo").click()
    picking.click(UPPER[2][0] - 3, UPPER[2][1] - 6)
    span_mm = 1e3 * CAMERA.scale_m_per_px * 2 * CAMERA.fiducial_spacing_px
    picking.page.get_by_label("Distance, in mm").fill(f"{span_mm:g}")
    expect(picking.page.get_by_text("mm per px")).to_be_visible(timeout=WAIT_MS)
    shown = picking.page.get_by_text("mm per px").inner_text()
    found = picking.save()
    assert found["path"] == str(tmp_path / "points.csv") and found["points"] == 2

    automatic, auto = tmp_path / "auto.csv", ("--auto", "--rest-frames", REST)
    run("track", video, *auto, "--out", automatic, "--json")
    start = {row["point"]: row for row in table(automatic)[:20] if row["frame"] == "0"}
    points = table(tmp_path / "points.csv")
    assert [row["point"] for row in points] == ["upper2", "lower2"]
    rounded_px = 1e-3  # to 0.001 px on the page and in the table
    for row, truth in zip(points, (UPPER[1], LOWER[1]), strict=True):
        for axis, true_px in zip("xy", truth, strict=True):
            here = float(row[f"{axis}_px"])
            there = start[row["point"]]
            tracked_px = 5 * float(there[f"std_{axis}_px"]) + rounded_px
            assert here == pytest.approx(float(there[f"{axis}_px"]), abs=tracked_px)
            assert here == pytest.approx(true_px, abs=5 * centre_std_px() + rounded_px)

    words = shlex.split(found["command"])
    assert words[:2] == ["haselab", "track"]
    out = tmp_path / "picked.csv"
    words[words.index("--out") + 1] = str(out)
    tracked = run(*words[1:], "--rest-frames", REST, "--json")
    # both ends have the error of a dot's centre, and the command has them to 0.01 px
    scale_mm, std_px = span_mm / (2 * CAMERA.fiducial_spacing_px), np.sqrt(2) * centre_std_px()
    error = (5 * std_px + 0.01) / (2 * CAMERA.fiducial_spacing_px)
    assert tracked["scale_mm_per_px"]["value"] == pytest.approx(scale_mm, rel=error)
    value, _, std = shown.split()[:3]
    assert float(value) == pytest.approx(tracked["scale_mm_per_px"]["value"], rel=1e-5)
    assert float(std) == pytest.approx(tracked["scale_mm_per_px"]["std"], rel=0.05)
    pairs = zip(
        table(tmp_path / "picked-strain.csv"), table(tmp_path / "auto-strain.csv"), strict=True
    )
    for one, other in pairs:
        std = np.hypot(float(one["strain_std"]), float(other["strain_std"]))
        assert float(one["strain"]) == pytest.approx(float(other["strain"]), abs=5 * std)
    assert tracked["strain"]["largest"] > 0.04


def test_points_whose_dot_is_still_searched_for_are_saved_too(
    picking: Picking, tmp_path: Path
) -> None:
    held: list[Route] = []
    picking.page.route("**/request/pick-snap", lambda route: held.append(route))
    save = picking.page.get_by_role("button", name=re.compile("Save"))
    for x, y in UPPER:
        picking.page.mouse.click(*picking.place(x + 2, y + 1))
    picking.page.wait_for_function("document.body.innerText.includes('3 searches')")
    for number, route in enumerate(held):
        expect(save).to_be_disabled(timeout=WAIT_MS)
        route.continue_()
        expect(picking.page.locator(".marks button")).to_have_count(number + 1, timeout=WAIT_MS)
    assert len(held) == 3 and picking.save()["points"] == 3
    assert len(table(tmp_path / "points.csv")) == 3


def test_undo_redo_delete_and_arrow_keys(picking: Picking) -> None:
    page = picking.page
    picking.click(UPPER[0][0] + 3, UPPER[0][1] + 3)
    picking.click(60, 400)  # nothing is there
    expect(page.get_by_role("status").filter(has_text="no dot")).to_be_visible(timeout=WAIT_MS)
    assert [text.split()[0] for text in picking.marks()] == ["upper1", "p0"]
    where = [float(page.get_by_label(f"{axis}, in px").input_value()) for axis in "xy"]
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowUp")
    for axis, begun, step in zip("xy", where, (1.0, -0.1), strict=True):
        moved = float(page.get_by_label(f"{axis}, in px").input_value())
        assert moved - begun == pytest.approx(step, abs=1e-9)
    page.keyboard.press("Delete")
    assert len(picking.marks()) == 1
    page.keyboard.press("Control+z")
    assert len(picking.marks()) == 2
    for _ in range(4):
        page.get_by_role("button", name="Undo").click()
    assert picking.marks() == []
    expect(page.get_by_role("button", name="Undo")).to_be_disabled()
    expect(page.get_by_role("button", name=re.compile("Save"))).to_be_disabled()
    for _ in range(5):
        page.get_by_role("button", name="Redo").click()
    assert [text.split()[0] for text in picking.marks()] == ["upper1"]


def test_every_task_is_possible_by_keyboard(picking: Picking, tmp_path: Path) -> None:
    page = picking.page

    def tab_to(name: str) -> None:
        for _ in range(80):
            page.keyboard.press("Tab")
            label = page.evaluate(
                "document.activeElement.ariaLabel ||"
                "(document.activeElement.labels?.[0] ?? document.activeElement).textContent"
            )
            if label.strip().startswith(name):
                return
        pytest.fail(f"no way to {name!r} by Tab")

    def type_in(name: str, text: str) -> None:
        tab_to(name)
        page.keyboard.press("Control+a")
        page.keyboard.type(text)
        page.keyboard.press("Tab")

    def add(x: float, y: float) -> None:
        marks = page.locator(".marks button")
        before = marks.count()
        tab_to("Picture with marks")
        page.keyboard.press("Enter")
        expect(marks).to_have_count(before + 1, timeout=WAIT_MS)
        type_in("x, in px", f"{x:g}")
        type_in("y, in px", f"{y:g}")
        tab_to("Picture with marks")
        page.keyboard.press("s")

    add(UPPER[1][0] + 4, UPPER[1][1] - 4)
    expect(page.locator(".marks button")).to_contain_text(["255.5, 60.0"], timeout=WAIT_MS)
    type_in("Name", "top")
    tab_to("Scale")
    page.keyboard.press("Space")
    add(UPPER[0][0] + 2, UPPER[0][1] - 4)
    add(UPPER[2][0] + 2, UPPER[2][1] - 4)
    type_in("Distance, in mm", "70")
    expect(page.get_by_text("mm per px")).to_be_visible(timeout=WAIT_MS)
    tab_to("Save")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Saved")).to_be_visible(timeout=WAIT_MS)
    assert [row["point"] for row in table(tmp_path / "points.csv")] == ["top"]


def test_a_view_that_is_zoomed_and_moved_places_marks_where_they_are_seen(
    picking: Picking,
) -> None:
    page = picking.page
    page.get_by_label("Snap to dots").uncheck()
    where = picking.place(200, 150)
    page.mouse.move(*where)
    for _ in range(4):
        page.mouse.wheel(0, -400)
    page.mouse.click(*where)  # a zoom keeps the place under the pointer
    marks = page.locator(".marks button")
    expect(marks).to_have_count(1, timeout=WAIT_MS)
    pixel = CAMERA.width_px / page.get_by_role("application").bounding_box()["width"]  # type: ignore[index]
    for axis, truth in zip("xy", (200, 150), strict=True):
        there = float(page.get_by_label(f"{axis}, in px").input_value())
        assert there == pytest.approx(truth, abs=pixel)
    page.mouse.move(where[0] + 80, where[1])
    page.mouse.down()
    page.mouse.move(where[0] + 180, where[1], steps=5)  # moves the picture, not the mark
    page.mouse.up()
    expect(marks).to_have_count(1)
    page.get_by_role("button", name="Whole picture").click()
    page.mouse.move(*where)
    page.mouse.down()
    page.mouse.move(where[0] + 50, where[1], steps=5)  # drags the mark
    page.mouse.up()
    dragged = float(page.get_by_label("x, in px").input_value())
    assert dragged == pytest.approx(200 + 50 * pixel, abs=2 * pixel)
    page.get_by_role("button", name="Undo").click()
    assert float(page.get_by_label("x, in px").input_value()) == pytest.approx(200, abs=pixel)


def test_two_fingers_zoom_and_place_no_mark(browser: Browser, served: RunningPanel) -> None:
    with browser.new_context(viewport={"width": 820, "height": 1180}, has_touch=True) as context:
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(served.address)
        picture = page.get_by_role("application")
        expect(picture).to_be_visible(timeout=WAIT_MS)
        picking = Picking(served.process, page)
        x, y = picking.place(256, 256)
        touch = context.new_cdp_session(page)
        for kind, apart in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
            fingers = [{"x": x - apart, "y": y, "id": 1}, {"x": x + apart, "y": y, "id": 2}]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
        seen = page.locator(".frame svg").get_attribute("viewBox")
        assert seen is not None
        left, top, width, height = map(float, seen.split())
        assert width == height == pytest.approx(CAMERA.width_px / 2)  # 80 to 160 px apart
        assert left + width / 2 == pytest.approx(256, abs=CAMERA.width_px / 820)
        assert top + height / 2 == pytest.approx(256, abs=CAMERA.width_px / 820)
        assert picking.marks() == []


def test_dots_of_a_region_become_points(picking: Picking, tmp_path: Path) -> None:
    page = picking.page
    page.get_by_role("button", name="Region", exact=True).click()
    page.mouse.move(*picking.place(180, 110))
    page.mouse.down()
    page.mouse.move(*picking.place(330, 230), steps=5)
    page.mouse.up()
    page.get_by_label("At most this many").fill("20")
    page.get_by_role("button", name="Find the dots in the region").click()
    expect(page.locator(".marks button")).to_have_count(22, timeout=WAIT_MS)  # with two corners
    picking.save()
    rows = table(tmp_path / "points.csv")
    places = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows])
    assert len(places) == 20
    assert (places > [180, 110]).all() and (places < [330, 230]).all()


def test_points_belong_to_the_first_frame_and_a_ruler_to_any(picking: Picking) -> None:
    page = picking.page
    page.get_by_role("slider").fill("7")
    expect(page.get_by_text("Frame 7 of 0 to 15, 0.0175 s")).to_be_visible(timeout=WAIT_MS)
    page.mouse.click(*picking.place(200, 150))
    expect(page.get_by_role("alert")).to_contain_text("go to frame 0", timeout=WAIT_MS)
    assert picking.marks() == []
    page.get_by_role("button", name="Scale", exact=True).click()
    picking.click(200, 150)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_and_a_tablet_is_wide_enough(
    browser: Browser, video: Path, scheme: str
) -> None:
    panel = started("--runs", str(video.parents[1]))
    try:
        with browser.new_context(
            color_scheme=scheme, viewport={"width": 820, "height": 1180}, has_touch=True,  # type: ignore[arg-type]
        ) as context:  # fmt: skip
            page = context.new_page()
            page.set_default_timeout(WAIT_MS)
            page.goto(panel.address)
            page.get_by_role("button", name="Pick").click()
            page.get_by_label("Video").select_option("run 1/clip.mkv")
            picking = Picking(panel.process, page)
            expect(page.get_by_role("application")).to_be_visible(timeout=WAIT_MS)
            page.touchscreen.tap(*picking.place(UPPER[0][0] + 5, UPPER[0][1] + 5))
            expect(page.locator(".marks button")).to_contain_text(["upper1"], timeout=WAIT_MS)
            found = Axe().run(page)
            assert found.violations_count == 0, found.generate_report()
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            # What was picked is still there after another page.
            page.get_by_role("button", name="Live").click()
            page.get_by_role("button", name="Pick").click()
            expect(page.locator(".marks button")).to_contain_text(["upper1"], timeout=WAIT_MS)
            page.get_by_label("File name of the table").fill(f"{scheme}.csv")
            page.get_by_role("button", name=re.compile("Save")).click()
            expect(page.get_by_role("heading", name="Saved")).to_be_visible(timeout=WAIT_MS)
            assert len(table(video.with_name(f"{scheme}.csv"))) == 1
    finally:
        ended(panel)


def post(host: str, name: str, body: bytes, **headers: str) -> tuple[int, str]:
    """A request without a browser: status and answer."""
    connection = http.client.HTTPConnection(host, timeout=WAIT_S)
    try:
        given = {"Content-Type": "application/json"} | {
            key.replace("_", "-"): value for key, value in headers.items()
        }
        connection.request("POST", f"/request/{name}", body, given)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()
    finally:
        connection.close()


@pytest.fixture(scope="module")
def served(video: Path) -> Iterator[RunningPanel]:
    """`haselab track --pick`, for requests without a page."""
    process, address = pick(video)
    try:
        yield RunningPanel(process, address)
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=WAIT_S)


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        (b"{}", {"X_Panel_Token": ""}, 403),
        (b"{}", {"X_Panel_Token": "guess"}, 403),
        (b"{}", {"Origin": "http://evil.example"}, 403),
        (b"{}", {"Host": "evil.example:80"}, 403),
        (b"{", {}, 400),
        (b"[]", {}, 400),
        (b"[" * 100_000, {}, 400),
        (b"\xff", {}, 400),
        (b'{"a": "' + b"x" * (1 << 20) + b'"}', {}, 400),
        (b"{}", {"Content_Type": "text/plain"}, 400),
        (b"{}", {}, 422),
        (b'{"video": 3, "frame": 0}', {}, 422),
        (b'{"video": "clip.mkv", "frame": true}', {}, 422),
        (b'{"video": "/etc/passwd", "frame": 0}', {}, 422),
    ],
)
def test_a_page_alone_refuses_what_is_not_its_own(
    served: RunningPanel, body: bytes, headers: dict[str, str], status: int
) -> None:
    given = {"X_Panel_Token": served.token} | headers
    assert post(served.host, "pick-frame", body, **given)[0] == status
    assert post(served.host, "doctor", b"{}", X_Panel_Token=served.token)[0] == 404


def asked(videos: Videos, name: str, **values: object) -> Any:
    return PICK_REQUESTS[name](videos, dict(values))


@pytest.mark.parametrize(
    "name",
    ["../secret.mkv", "/etc/passwd", "run 1/../../secret.mkv", "link/secret.mkv", "a\0b", ""],
)
def test_no_video_outside_of_the_recordings_is_read(tmp_path: Path, name: str) -> None:
    runs = tmp_path / "runs"
    (runs / "run 1").mkdir(parents=True)
    (tmp_path / "secret.mkv").write_bytes(b"secret")
    (runs / "link").symlink_to(tmp_path)
    refused = "is not in the list of this page|contains no image"
    with pytest.raises(InputError, match=refused):
        asked(Videos(runs), "pick-frame", video=name, frame=0)
    assert asked(Videos(runs), "pick-videos")["videos"] == []


@pytest.mark.parametrize(
    "name", ["../x.csv", "/tmp/x.csv", "a/b.csv", "x.py", "a\\b.csv", "\n.csv"]
)
def test_no_table_outside_of_the_folder_of_the_video_is_written(video: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"Use a name that ends in \.csv"):
        asked(
            Videos(video.parents[1]), "pick-save", video="run 1/clip.mkv", table=name,
            points=[["a", 155.0, 60.0]],
        )  # fmt: skip


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"video": "none.mkv", "frame": 0}, "no such video file"),
        ({"video": "broken.mkv", "frame": 0}, "FFmpeg cannot open the video"),
        ({"video": "run 1/clip.mkv", "frame": 16}, "Frame 16 does not exist: the video has 16"),
        ({"video": "run 1/clip.mkv", "frame": -1}, "Frame -1 does not exist"),
    ],
)
def test_a_video_that_cannot_be_shown_is_refused_in_one_line(
    video: Path, values: dict[str, object], message: str
) -> None:
    (video.parents[1] / "broken.mkv").write_bytes(b"no video")
    with pytest.raises(InputError, match=message) as refused:
        asked(Videos(video.parents[1]), "pick-frame", **values)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("sigma", [3.0, 5.0, 7.0, 9.0])
def test_a_click_near_a_large_dot_among_particles_finds_its_centre(
    tmp_path: Path, sigma: float
) -> None:
    rng = np.random.default_rng(3)
    large = np.array([(60.3, 50.6), (200.2, 50.1), (60.7, 250.4), (200.4, 250.8)])
    small = rng.uniform([40, 100], [220, 200], (120, 2))
    y, x = np.mgrid[:300, :260]
    image = np.full(y.shape, 160.0)
    for dots, width, depth in ((large, sigma, 110.0), (small, 2.0, 70.0)):
        for cx, cy in dots:
            image -= depth * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
    path = tmp_path / "marks.tif"
    grey = np.rint(rng.normal(image, 2.0)).clip(0, 255).astype(np.uint8)
    tifffile.imwrite(path, grey[None], photometric="minisblack")
    videos = Videos(tmp_path)
    for truth in large:
        click = truth + rng.uniform(-6, 6, 2)
        found = asked(
            videos, "pick-snap", video="marks.tif", frame=0, place=click.tolist(), reach=12.0
        )
        # the scale of the detection is within an eighth of an octave of the dot's
        error = 5 * centre_std_px(sigma, 110.0, np.hypot(2.0, 12**-0.5)) * 2**0.25
        assert found["snapped"]
        np.testing.assert_allclose(found["place"], truth, atol=error)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([], "There is no point to save"),
        ([["a", 600.0, 60.0]], "1 of 1 points are outside the frame, the first is 'a'"),
        ([["a", 155.0, 60.0], ["a", 255.0, 60.0]], "Two points have the same name, 'a'"),
        ([["", 155.0, 60.0]], "Give it a name of printable characters"),
        ([["a\nb", 155.0, 60.0]], "Give it a name of printable characters"),
        ([["a", 2.0, 60.0]], "too close to the edge"),
        ([["a", "x", 60.0]], "must be 2 finite numbers"),
        ([["a", float("nan"), 60.0]], "must be 2 finite numbers"),
        ([["a", 155.0]], "must be 2 finite numbers"),
    ],
)
def test_points_that_cannot_be_tracked_are_not_saved(
    video: Path, tmp_path: Path, points: list[object], message: str
) -> None:
    out = tmp_path / "points.csv"
    with pytest.raises(InputError, match=message) as refused:
        asked(Videos(video.parent, video, out), "pick-save", video=str(video), points=points)
    assert "\n" not in str(refused.value) and not out.exists()


def test_points_on_noise_alone_are_saved_and_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:120, :160]
    dots = sum(100.0 * np.exp(-((x - c) ** 2 + (y - 60) ** 2) / 18.0) for c in (40, 120))
    frames = rng.normal(160.0 - dots, 2.0, (2, *y.shape)).round().astype(np.uint8)
    tifffile.imwrite(tmp_path / "two.tif", frames, photometric="minisblack")
    tifffile.imwrite(tmp_path / "one.tif", frames[:1], photometric="minisblack")
    points = [["dot", 40.0, 60.0], ["nothing", 80.0, 60.0], ["other dot", 120.0, 60.0]]
    for video, lost in (("two.tif", ["nothing"]), ("one.tif", [])):
        found = asked(Videos(tmp_path), "pick-save", video=video, points=points)
        assert found["lost"] == lost and found["points"] == 3


def test_an_existing_table_is_only_moved_when_that_is_requested(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "points.csv"
    out.write_text("mine")
    given: dict[str, Any] = {"video": str(video), "points": [['a, "b"', 155.5, 60.0]]}
    videos = Videos(video.parent, video, out)
    with pytest.raises(InputError, match=r"exists already.*tick 'Move an existing file") as refused:
        asked(videos, "pick-save", **given)
    assert "--force" not in str(refused.value)
    assert out.read_text() == "mine"
    with monkeypatch.context() as other:  # another page saves it after the check
        seen = iter((False, True))
        other.setattr(page_module, "is_occupied", lambda table: next(seen))
        with pytest.raises(InputError, match="Type another name, or tick") as refused:
            asked(videos, "pick-save", **given)
    assert "--force" not in str(refused.value) and out.read_text() == "mine"
    asked(videos, "pick-save", move=True, **given)
    assert (tmp_path / "points.csv.previous-1").read_text() == "mine"
    assert table(out) == [{"point": 'a, "b"', "x_px": "155.500", "y_px": "60.000"}]


def test_the_table_of_a_sealed_video_is_beside_its_folder(tmp_path: Path) -> None:
    (tmp_path / "run" / "video").mkdir(parents=True)
    videos = Videos(tmp_path)
    assert videos.table("run/video/a.mkv") == tmp_path / "run" / "video" / "a-points.csv"
    (tmp_path / "run" / "manifest.json").write_text("{}")
    assert videos.table("run/video/a.mkv") == tmp_path / "run" / "a-points.csv"


def test_ctrl_c_saves_nothing_and_puts_the_old_table_back(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "points.csv"
    out.write_text("mine")
    process, line = pick(video, "--out", out, "--force")
    assert line.startswith("haselab: moved") and process.stderr is not None
    assert process.stderr.readline().startswith("http://127.0.0.1:")
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=WAIT_S)
    assert process.returncode == 130 and "Interrupted." in said[1]
    assert out.read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["none.mkv"], "There is no such video file"),
        (["VIDEO", "--points", "p.csv"], "--pick excludes --points"),
        (["VIDEO", "--rest-frames", "3"], "--pick excludes --rest-frames"),
        (["VIDEO", "--out", "OLD"], "--out names an existing result"),
    ],
)
def test_what_cannot_be_picked_ends_before_a_page_is_served(
    video: Path, tmp_path: Path, words: list[str], message: str
) -> None:
    (tmp_path / "old.csv").write_text("mine")
    named = {"VIDEO": str(video), "OLD": str(tmp_path / "old.csv")}
    process, line = pick(*(named.get(word, word) for word in words))
    late = threading.Timer(WAIT_S, process.kill)
    late.start()
    process.communicate()
    late.cancel()
    assert message in line and process.returncode == 2


def test_the_port_of_the_page_is_chosen_and_refused_if_in_use(video: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        process, line = pick(str(video), "--page-port", str(port))
        process.communicate()
        assert f"{port}" in line and process.returncode == 4, line
    for _ in range(2):  # the second one at once after the first
        process, line = pick(str(video), "--page-port", str(port))
        assert line.startswith(f"http://127.0.0.1:{port}/?token=")
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
        page.request("GET", "/")
        page.getresponse().read()
        process.send_signal(signal.SIGINT)
        process.communicate()
        assert not page.sock.recv(1), "the server was the first to close"
        page.close()
