"""Record the pictures of the panel: panel.gif, panel.png, panel-pick.png and panel-design.png.

    python docs/pictures/record_panel.py

Needs Chromium, and `pip install haselab playwright`. The bench is the twin: all data are simulated.
"""

from __future__ import annotations

import io
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

from haselab.rig.twin.camera import TwinCamera, TwinCameraConfig
from haselab.store.video.writer import VideoWriter

FOLDER = Path(__file__).resolve().parent
HASELAB = [sys.executable, "-m", "haselab.cli"]
FLAGS = ["--no-sandbox", "--disable-gpu"]
SIZE = {"width": 1280, "height": 1080}
GIF_SCALE = 0.67
COLOURS = 48
FRAME_S = 0.15  # between two frames of the GIF, on a computer that is quick enough
SLOWEST_S, LAST_S = 0.8, 2.0
WAIT_MS = 120e3


class Film:
    """Screenshots with the times at which they were taken."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self._frames: list[Image.Image] = []
        self._times_s: list[float] = []

    def shoot(self, duration_s: float) -> None:
        """Take screenshots for some time."""
        end_s = time.monotonic() + duration_s
        while (now_s := time.monotonic()) < end_s:
            self._times_s.append(now_s)
            self._frames.append(Image.open(io.BytesIO(self._page.screenshot())).convert("RGB"))
            time.sleep(max(0.0, FRAME_S - (time.monotonic() - now_s)))

    def save(self, path: Path) -> None:
        """Write the GIF, in which each frame is shown for as long as it lasted."""
        # One palette for all frames: a colour that changes would be a change of the whole picture.
        samples = self._frames[:: max(1, len(self._frames) // 6)]
        width = self._frames[0].width
        wide = Image.new("RGB", (width, sum(each.height for each in samples)))
        for k, each in enumerate(samples):
            wide.paste(each, (0, k * each.height))
        palette = wide.quantize(COLOURS, method=Image.Quantize.MEDIANCUT)
        frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in self._frames]
        lasted_s = np.append(np.diff(self._times_s), LAST_S)
        frames[0].save(
            path, save_all=True, append_images=frames[1:], loop=0,
            duration=[int(1e3 * min(each, SLOWEST_S)) for each in lasted_s],
        )  # fmt: skip
        print(f"{path.name}: {len(frames)} frames, {path.stat().st_size / 1e6:.2f} MB")


def prepared(folder: Path) -> None:
    """Write a video below runs."""
    (folder / "runs" / "run1").mkdir(parents=True)
    camera = TwinCamera(TwinCameraConfig(), half_width_m=0.06, free_length_m=0.05, seed=4)
    strain = np.concatenate([np.zeros(5), np.linspace(0.0, 0.05, 11)])
    lengths_m = np.repeat(0.08 * (1.0 + strain)[:, None], camera.config.exposure_samples, axis=1)
    writer = VideoWriter(folder / "runs" / "run1" / "clip.mkv", 400.0)
    writer.append(camera.render(lengths_m, first_index=0), np.arange(strain.size) / 400.0)
    writer.close()


@contextmanager
def panel(folder: Path) -> Iterator[str]:
    """`haselab panel` on the twin; the address of its page."""
    command = [*HASELAB, "panel", "--no-browser", "--runs", "runs", "--lease-s", "10"]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        yield process.stdout.readline().strip()
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(60.0)


def typed(page: Page, label: str, text: str) -> None:
    """Type a value and press Enter."""
    page.get_by_label(label).fill(text)
    page.keyboard.press("Enter")


def arm(page: Page) -> None:
    """Arm the bench, for which the highest drive has been typed."""
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text("Armed by this page")).to_be_visible()


def live(page: Page) -> None:
    """The page Live in a closed loop; afterwards the bench is disarmed."""
    page.get_by_role("button", name="Live", exact=True).click()
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill("1.9")
    arm(page)
    for label, text, wait_s in (
        ("Drive, typed", "1", 2.0), ("Desired strain, typed", "0", 2.5),
        ("Desired strain, typed", "4", 2.5), ("Desired strain, typed", "-2", 1.5),
    ):  # fmt: skip
        typed(page, label, text)
        page.wait_for_timeout(1e3 * wait_s)
    keep(page, "panel.png")
    page.get_by_role("button", name="Disarm").click()
    expect(page.get_by_role("button", name="Arm the bench")).to_be_visible()


def film(page: Page) -> None:
    """Twin, arm, drive, close the loop, STOP."""
    shots = Film(page)
    shots.shoot(0.8)
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill("1.9")
    shots.shoot(1.0)
    arm(page)
    typed(page, "Drive, typed", "1")
    shots.shoot(2.2)
    typed(page, "Desired strain, typed", "0")
    shots.shoot(1.4)
    typed(page, "Desired strain, typed", "4")
    shots.shoot(1.8)
    typed(page, "Desired strain, typed", "-2")
    shots.shoot(1.6)
    page.locator("#emergency").dispatch_event("pointerdown")
    expect(page.locator("#emergency-state")).to_contain_text("STOP: 0 V commanded at ")
    shots.shoot(1.2)
    shots.save(FOLDER / "panel.gif")


def keep(page: Page, name: str, *, whole: bool = False) -> None:
    """Write a screenshot with few colours, which is a fifth of the size."""
    picture = Image.open(io.BytesIO(page.screenshot(full_page=whole))).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(FOLDER / name, optimize=True)
    print(f"{name}: {(FOLDER / name).stat().st_size / 1e3:.0f} kB")


def at(page: Page, x_px: float, y_px: float) -> tuple[float, float]:
    """Where a place of the whole picture is on the page."""
    box = page.get_by_role("application").bounding_box()
    assert box is not None
    size = TwinCameraConfig().width_px
    return box["x"] + (x_px + 0.5) * box["width"] / size, (
        box["y"] + (y_px + 0.5) * box["height"] / size
    )


def pick(page: Page) -> None:
    """Pick the dots of both clamps and of a region, and a scale along the lower clamp."""
    page.get_by_role("button", name="Pick", exact=True).click()
    page.get_by_label("Video").select_option("run1/clip.mkv")
    expect(page.get_by_role("application")).to_be_visible()
    marks = page.locator(".marks button")
    for y_px in (60.0, 288.6):
        for x_px in (155.5, 255.5, 355.5):
            count = marks.count()
            page.mouse.click(*at(page, x_px, y_px))
            expect(marks).to_have_count(count + 1)
    page.get_by_role("button", name="Region", exact=True).click()
    page.mouse.move(*at(page, 120, 95))
    page.mouse.down()
    page.mouse.move(*at(page, 390, 250), steps=5)
    page.mouse.up()
    page.get_by_label("At most this many").fill("40")
    page.get_by_role("button", name="Find the dots in the region").click()
    expect(marks.nth(12)).to_be_attached()
    page.get_by_role("button", name="Scale", exact=True).click()
    for x_px, y_px in ((155.5, 288.6), (355.5, 288.6)):
        page.mouse.click(*at(page, x_px, y_px))
    page.get_by_label("Distance, in mm").fill("70")
    expect(page.get_by_text("mm per px")).to_be_visible()
    keep(page, "panel-pick.png")


def design(page: Page) -> None:
    """The page Design, once the demands are checked."""
    page.get_by_role("button", name="Design", exact=True).click()
    expect(page.get_by_role("table", name="At 100 Hz")).to_contain_text("stable")
    expect(page.get_by_text("Checking the demands")).to_be_hidden()
    keep(page, "panel-design.png", whole=True)


def main() -> None:
    """Record all pictures."""
    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("chromium is not installed. Run:  sudo apt-get install -y chromium")
    expect.set_options(timeout=WAIT_MS)
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        folder = Path(name)
        prepared(folder)
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for scale, scenes in ((1.0, (design, pick, live)), (GIF_SCALE, (film,))):
            with panel(folder) as address:
                page = browser.new_page(viewport=SIZE, device_scale_factor=scale)
                page.set_default_timeout(WAIT_MS)
                page.goto(address)
                expect(page.locator("#age")).to_have_text("data live")
                for scene in scenes:
                    scene(page)
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
