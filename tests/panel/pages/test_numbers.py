"""Number fields in Chromium: a decimal comma is refused beside the field, and nothing is sent."""

import json
import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.panel.pages.test_design import CONTROLLER, MODEL
from tests.panel.pages.test_pick import WAIT_MS, clip
from tests.panel.running import RunningPanel, ended, started

COMMA = "0,2 is not a number. Write a decimal point: 0.2."
READ = ("arm", "drive", "loop", "design-loop", "pick-scale", "pick-region", "pick-save")
ACCEPTED = {
    "0.2": 0.2, " 0.2 ": 0.2, "1e-3": 1e-3, "-0.5": -0.5, "+.5": 0.5, "2.": 2.0, "1E+2": 100.0,
}  # fmt: skip
REFUSED = {
    "0,2": COMMA, "-,5": "-,5 is not a number. Write a decimal point: -0.5.", "": "empty",
    "  ": "empty", "1 2": "without a unit", "0.2 V": "without a unit", "1,000.5": "without a unit",
    "0x10": "without a unit", "Infinity": "without a unit", "1e999": "too large",
    "1e": "without a unit", "--1": "without a unit", "1.2.3": "without a unit",
}  # fmt: skip


class Watched:
    """A page, and the names of the commands that it has sent."""

    def __init__(self, page: Page) -> None:
        self.page, self.sent = page, list[str]()
        page.set_default_timeout(WAIT_MS)
        page.on("websocket", lambda socket: socket.on("framesent", self._frame))
        page.on("request", lambda request: self._note(request.url.rpartition("/")[2]))

    def _frame(self, text: str | bytes) -> None:
        self._note(json.loads(text).get("do", ""))

    def _note(self, name: str) -> None:
        if name in READ:
            self.sent.append(name)

    def refuses(self, box: Locator, press: str = "") -> None:
        """Type a decimal comma; the field stays as typed, and nothing is sent."""
        before = list(self.sent)
        box.click()
        self.page.keyboard.press("Control+a")
        self.page.keyboard.type("0,2")
        said = self.page.get_by_text(COMMA)
        expect(said).to_be_visible()
        self.page.keyboard.press("Enter")
        if press:
            self.page.get_by_role("button", name=press, exact=True).click()
        self.page.wait_for_timeout(600)  # more than any delay of the pages
        expect(said).to_have_count(1)
        expect(box).to_have_value("0,2")
        expect(box).to_have_attribute("aria-invalid", "true")
        described = self.page.locator(f"#{box.get_attribute('aria-describedby')}")
        expect(described).to_have_text(COMMA)
        assert self.sent == before

    def types(self, box: Locator, text: str, sends: str) -> None:
        """Type a number and press Enter; it is sent."""
        before = self.sent.count(sends)
        box.click()
        self.page.keyboard.press("Control+a")
        self.page.keyboard.type(text)
        self.page.keyboard.press("Enter")
        expect(self.page.locator(".number")).to_have_count(0)
        self.expect_sent(sends, before)

    def expect_sent(self, name: str, before: int = 0) -> None:
        """Wait until a command was sent once more."""
        for _ in range(100):
            if self.sent.count(name) > before:
                return
            self.page.wait_for_timeout(100)
        pytest.fail(f"{name} was not sent")


def test_the_limit_the_drive_and_the_strain(browser: Browser, actuator_file: Path) -> None:
    panel = started("--actuator", str(actuator_file))
    try:
        with browser.new_context(locale="en-US") as context:
            watched = Watched(context.new_page())
            page = watched.page
            page.goto(panel.address)
            page.get_by_role("button", name="Arm the bench").click()
            limit = page.get_by_label("Highest drive of this run")
            expect(page.locator("header")).to_contain_text(
                "Bench: arming, waiting for the typed limit", timeout=WAIT_MS
            )
            watched.refuses(limit, press="Arm")
            for text, problem in (("", "empty"), ("9", "too high"), ("-1", "too low")):
                limit.fill(text)
                limit.press("Enter")
                expect(page.locator(".number")).to_contain_text(problem)
            assert watched.sent == []
            limit.fill("0.5")
            limit.press("ArrowUp")
            expect(limit).to_have_value("1.5")
            watched.types(limit, "0.2", "arm")
            expect(page.get_by_text("Armed by this page up to 0.200 V")).to_be_visible()
            drive, strain = page.get_by_label("Drive, typed"), page.get_by_label("strain, typed")
            watched.refuses(drive)
            page.keyboard.press("Tab")  # away from the field, which then shows the present drive
            expect(drive).to_have_value("0")
            expect(page.locator(".number")).to_have_count(0)
            drive.press("ArrowUp")
            expect(drive).to_have_value("0.2")  # ends at the limit, and is not sent without Enter
            assert watched.sent == ["arm"]
            watched.types(drive, "0.1", "drive")
            expect(page.locator("header")).to_contain_text("0.100 V", timeout=WAIT_MS)
            watched.refuses(strain)
            watched.types(strain, "0.2", "loop")  # more than 0.2 V reaches
            expect(page.get_by_text("The desired strain was limited to")).to_be_visible()
            expect(strain).to_have_value(re.compile(r"^-\d\.\d+$"))
            assert watched.sent == ["arm", "drive", "loop"]
    finally:
        ended(panel)


def test_the_gains(browser: Browser, tmp_path: Path) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(MODEL + CONTROLLER)
    panel = started("--actuator", str(path))
    try:
        with browser.new_context(locale="en-US") as context:
            watched = Watched(context.new_page())
            page = watched.page
            page.goto(panel.address)
            page.get_by_role("button", name="Design").click()
            for name in ("kp", "ki", "kd", "filter"):
                box = page.get_by_role("textbox", name=name)
                expect(page.get_by_text("plausible plants")).to_be_visible(timeout=WAIT_MS)
                watched.refuses(box)
                page.keyboard.press("Tab")
                expect(page.get_by_text(COMMA)).to_be_visible()  # as long as it is in the field
                watched.types(box, "0.2", "design-loop")
                expect(box).to_have_value("0.2")
            box.press("ArrowUp")
            expect(box).to_have_value("1.2")
            box.press("ArrowDown")
            box.press("ArrowDown")
            expect(box).to_have_value("0")
    finally:
        ended(panel)


def test_the_numbers_of_a_picture(browser: Browser, tmp_path: Path) -> None:
    video = clip(tmp_path / "run 1" / "clip.mkv")
    panel = started("--runs", str(tmp_path))
    try:
        with browser.new_context(locale="en-US") as context:
            watched = Watched(context.new_page())
            page = watched.page
            page.goto(panel.address)
            page.get_by_role("button", name="Pick").click()
            page.get_by_label("Video").select_option("run 1/clip.mkv")
            picture, marks = page.get_by_role("application"), page.locator(".marks button")
            page.get_by_label("Snap to dots").uncheck()
            for count, kind in enumerate(("Region", "Region", "Scale", "Scale", "Points")):
                page.get_by_role("button", name=kind, exact=True).click()
                picture.click(position={"x": 60 + 40 * count, "y": 60 + 30 * count})
                expect(marks).to_have_count(count + 1, timeout=WAIT_MS)
            for axis in "xy":
                box = page.get_by_label(f"{axis}, in px")
                before = marks.all_inner_texts()
                watched.refuses(box)
                assert marks.all_inner_texts() == before
                box.fill("40.25")
                box.press("Enter")
                box.press("ArrowUp")
                expect(box).to_have_value("40.35")
            expect(marks.last).to_contain_text(re.compile(r"40\.\d, 40\.\d"))
            distance = page.get_by_label("Distance, in mm")
            watched.refuses(distance, press="Save 1 points")
            said = page.get_by_text("Not saved, because the distance in Scale is not valid.")
            expect(said).to_have_count(1)
            watched.types(distance, "0.2", "pick-scale")
            expect(said).to_have_count(0)  # an error ends with the next change
            expect(page.get_by_text("mm per px")).to_be_visible(timeout=WAIT_MS)
            most = page.get_by_label("At most this many")
            watched.refuses(most, press="Find the dots in the region")
            for text in ("0.2", "0", "5001", ""):
                most.fill(text)
                page.get_by_role("button", name="Find the dots").click()
                expect(page.locator(".number")).to_be_visible()
            assert "pick-region" not in watched.sent
            assert not list(video.parent.glob("*-points.csv"))
            most.fill("5001")
            most.blur()  # also before anything is pressed
            expect(page.locator(".number")).to_contain_text("Type at most 5000.")
            most.fill("20")
            name = page.get_by_label("File name of the table")
            name.fill(" ")
            page.get_by_role("button", name="Save 1 points").click()
            expect(page.locator(".number")).to_contain_text("Type a file name")
            expect(name).to_be_focused()
            assert "pick-save" not in watched.sent
            name.fill("points.csv")
            expect(page.locator(".number")).to_have_count(0)
            page.get_by_role("button", name="Find the dots").click()
            watched.expect_sent("pick-region")
    finally:
        ended(panel)


def test_one_parser(browser: Browser, shared_panel: RunningPanel) -> None:
    address = shared_panel.address
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(address)
        parse = "text => import('/static/number.js').then(found => found.numberOf(text))"
        for text, value in ACCEPTED.items():
            assert page.evaluate(parse, text) == {"value": value, "problem": ""}, text
        for text, problem in REFUSED.items():
            found = page.evaluate(parse, text)
            assert found["value"] is None and problem in found["problem"], (text, found)


def test_no_field_leaves_numbers_to_the_browser() -> None:
    static = Path(__file__).parents[3] / "src" / "haselab" / "panel" / "static"
    sources = [path.read_text() for path in static.glob("*.js")]
    assert len(sources) > 5
    assert not any(re.search(r"<input[^>]*type=\"?number", text) for text in sources)
