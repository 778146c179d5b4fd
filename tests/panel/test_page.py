"""The panel's page in Chromium: STOP, stale data, keyboard, zoom, size and accessibility."""

import gzip
import json
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, BrowserContext, Page, expect

from tests.panel.running import TRIANGLE, WAIT_S, RunningPanel, ended, started

STATIC = Path(__file__).parents[2] / "src" / "haselab" / "panel" / "static"
RIGS = Path(__file__).parents[2] / "rigs"
WAIT_MS = 1e3 * WAIT_S
PAGES = {  # a text of each, once it is there
    "Studies": "Keep no camera frames", "Doctor": "checks", "Design": "All demands are met",
}  # fmt: skip


@pytest.fixture
def page(browser: Browser, panel: RunningPanel) -> Iterator[Page]:
    """The page of a fresh panel, once it shows live data; it has asked nobody else for anything."""
    with browser.new_context(viewport={"width": 1400, "height": 1000}) as context:
        found, problems = context.new_page(), []
        found.set_default_timeout(WAIT_MS)
        found.on("pageerror", lambda error: problems.append(str(error)))
        found.on("request", lambda sent: asked.append(sent.url))
        asked: list[str] = []
        found.goto(panel.address)
        expect(found.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
        expect(found.locator("#emergency-state")).to_have_text("STOP: ready", timeout=WAIT_MS)
        yield found
        assert not problems
        assert all(re.match(r"(http|ws)://127\.0\.0\.1:|data:|blob:", url) for url in asked)


def arm(page: Page, limit_v: str = "1.5") -> None:
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill(limit_v)
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)


def test_stop_acts_when_the_pointer_goes_down(page: Page) -> None:
    arm(page)
    page.get_by_label("Drive, typed").fill("1")
    page.keyboard.press("Enter")
    expect(page.locator("header")).to_contain_text(
        re.compile(r"running, 1\.000 V"), timeout=WAIT_MS
    )
    expect(page.locator(".seen .mark circle")).to_have_count(6)  # in the camera picture
    box = page.locator("#emergency").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 20, box["y"] + 20)
    page.mouse.down()  # and not up
    expect(page.locator("#emergency-state")).to_contain_text(
        re.compile(r"STOP: 0 V commanded at \d\d:\d\d:\d\d$"), timeout=WAIT_MS
    )
    expect(page.locator("header")).to_contain_text("Bench: tripped", timeout=WAIT_MS)
    page.mouse.up()
    # Recovery is a procedure on the page.
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill("1")
    expect(page.get_by_role("button", name="Arm", exact=True)).to_be_disabled()
    page.get_by_label("The cause has been removed.").check()
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)


def test_stop_needs_nothing_but_its_page_and_acts_on_a_click_without_a_pointer(
    browser: Browser, panel: RunningPanel
) -> None:
    """The web server hangs after sending the page; voice control and screen readers click."""
    with browser.new_context() as context:
        found = context.new_page()
        found.route("**/about", lambda route: None)  # never answered
        found.goto(panel.address)
        state = found.locator("#emergency-state")
        expect(state).to_have_text("STOP: ready", timeout=WAIT_MS)
        found.locator("#emergency").evaluate("button => button.click()")
        expect(state).to_contain_text("STOP: 0 V commanded at ", timeout=WAIT_MS)
        expect(found.locator("header")).to_contain_text("Bench: tripped", timeout=WAIT_MS)


def test_a_typed_drive_needs_enter_and_a_refused_one_is_not_shown(page: Page) -> None:
    """A press on Disarm takes the focus from the field; it must not put out what was typed."""
    arm(page)
    box = page.get_by_label("Drive, typed")
    box.fill("1")
    page.keyboard.press("Tab")
    expect(box).to_have_value("0")
    box.fill("1.9")
    box.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("armed for 0 to 1.5 V", timeout=WAIT_MS)
    expect(box).to_have_value("0")
    box.fill("0.5")
    box.press("Enter")
    expect(page.locator("header")).to_contain_text(
        re.compile(r"running, 0\.500 V"), timeout=WAIT_MS
    )
    box.fill("1.9")
    box.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("armed for 0 to 1.5 V", timeout=WAIT_MS)
    page.keyboard.press("Escape")  # STOP, whose reason is then shown alone
    expect(page.get_by_text("Last message of the bench: STOP")).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_an_old_picture_has_no_reason_that_is_not_true(page: Page) -> None:
    old = {"x-age-s": "5", "x-fiducials": '{"size": [1, 1], "points": []}'}
    page.route("**/camera", lambda route: route.fulfill(status=200, headers=old, body=b""))
    arm(page)
    text = page.get_by_text("OLD PICTURE.")
    expect(text).to_have_text("OLD PICTURE. No new picture has arrived.", timeout=WAIT_MS)
    page.get_by_role("button", name="Disarm").click()
    expect(text).to_contain_text("only films while the bench is armed", timeout=WAIT_MS)


def test_recordings_have_the_local_time_of_their_folders(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "session.h5").touch()
    manifest = {"format": "haselab manifest 1", "state": "SEALED", "ended": "complete"}
    manifest["opened"] = "2026-01-31T20:30:00.5+00:00"
    (tmp_path / "a" / "manifest.json").write_text(json.dumps(manifest))
    found = started("--runs", str(tmp_path))
    try:
        with browser.new_context(timezone_id="Asia/Tokyo") as context:
            page = context.new_page()
            page.goto(found.address)
            page.get_by_role("button", name="Studies").click(timeout=WAIT_MS)
            expect(page.get_by_text("2026-02-01 05:30:00")).to_be_visible(timeout=WAIT_MS)
    finally:
        ended(found)


def test_a_bipolar_bench_shows_limits_of_both_signs(browser: Browser, tmp_path: Path) -> None:
    text = (RIGS / "twin-hz.toml").read_text()
    (tmp_path / "twin.toml").write_text(text.replace("drive_low_v = 0.0", "drive_low_v = -2.0"))
    (tmp_path / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    found = started("--rig", str(tmp_path / "rig.toml"))
    try:
        with browser.new_context() as context:
            page = context.new_page()
            page.set_default_timeout(WAIT_MS)
            page.goto(found.address)
            page.get_by_role("button", name="Arm the bench").click()
            expect(page.get_by_text("at most ±2.000 V (±10.00 kV)")).to_be_visible(timeout=WAIT_MS)
            page.get_by_label("Highest drive of this run").fill("0.2")
            page.keyboard.press("Enter")
            expect(page.get_by_text("up to ±0.200 V (±1.00 kV)")).to_be_visible(timeout=WAIT_MS)
            expect(page.get_by_text("The sensing signal is on")).to_be_visible()
            expect(page.get_by_text("haselab example actuator")).to_be_visible()
    finally:
        ended(found)


def test_every_task_is_possible_by_keyboard(page: Page) -> None:
    def tab_to(name: str) -> None:
        for _ in range(60):
            page.keyboard.press("Tab")
            label = page.evaluate(
                "(document.activeElement.labels?.[0] ?? document.activeElement).textContent"
            )
            if label.strip().startswith(name):
                return
        pytest.fail(f"no way to {name!r} by Tab")

    tab_to("Arm the bench")
    page.keyboard.press("Enter")
    expect(page.get_by_label("Highest drive of this run")).to_be_visible(timeout=WAIT_MS)
    tab_to("Highest drive")
    page.keyboard.type("1.5")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)
    tab_to("Drive, in V")
    page.keyboard.press("End")
    expect(page.locator("header")).to_contain_text(
        re.compile(r"running, 1\.500 V"), timeout=WAIT_MS
    )
    page.keyboard.press("Escape")
    expect(page.locator("header")).to_contain_text("Bench: tripped", timeout=WAIT_MS)


def test_a_page_whose_stop_does_not_answer_cannot_arm(page: Page) -> None:
    """As behind a tunnel or a firewall that lets only the port of the page through."""
    page.route("**/ready", lambda asked: asked.abort())
    page.get_by_role("button", name="Arm the bench").click()
    said = page.get_by_text(
        re.compile(r"STOP of this page does not answer at http://127\.0\.0\.1:\d+")
    )
    expect(said).to_be_visible(timeout=WAIT_MS)
    assert page.get_by_label("Highest drive of this run").count() == 0
    page.unroute("**/ready")
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill("1.5")
    page.route("**/ready", lambda asked: asked.abort())  # between the two steps
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(said).to_be_visible(timeout=WAIT_MS)
    assert page.get_by_text("Armed by this page").count() == 0
    page.unroute("**/ready")
    arm(page)


def test_frozen_data_look_frozen_and_come_back(page: Page, panel: RunningPanel) -> None:
    before = page.evaluate("document.querySelector('.values').textContent")
    assert before
    os.kill(panel.process.pid, signal.SIGSTOP)
    try:
        expect(page.locator("#age")).to_have_text(re.compile("NO NEW DATA"), timeout=WAIT_MS)
        assert page.evaluate("document.body.classList.contains('stale')")
    finally:
        os.kill(panel.process.pid, signal.SIGCONT)
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
    assert not page.evaluate("document.body.classList.contains('stale')")


@pytest.mark.slow
def test_a_page_connects_again_after_a_long_outage(page: Page, panel: RunningPanel) -> None:
    """Chromium delays new connections of a page after about 30 failed ones."""
    os.kill(panel.process.pid, signal.SIGSTOP)
    try:
        time.sleep(40.0)
    finally:
        os.kill(panel.process.pid, signal.SIGCONT)
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)


def test_a_frozen_bench_looks_frozen_too(page: Page, panel: RunningPanel) -> None:
    bench = panel.child("bench_process")
    os.kill(bench, signal.SIGSTOP)
    try:
        expect(page.locator("#age")).to_have_text(re.compile("NO NEW DATA"), timeout=WAIT_MS)
    finally:
        os.kill(bench, signal.SIGCONT)
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)


def test_a_drag_zooms_into_the_recorded_samples(page: Page) -> None:
    time.sleep(2.0)  # of data
    plot = page.locator(".u-over").first
    box = plot.bounding_box()
    assert box is not None
    middle = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.90 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.95 * box["width"], middle, steps=5)
    page.mouse.up()
    shown = page.get_by_text("s shown.")
    expect(shown).to_have_text(re.compile(r"^0\.[45]\d* s shown"), timeout=WAIT_MS)
    expect(page.locator("#age")).to_contain_text("VIEW PAUSED at", timeout=WAIT_MS)
    page.get_by_role("button", name="Resume").click()
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing(browser: Browser, shared_panel: RunningPanel, scheme: str) -> None:
    with browser.new_context(color_scheme=scheme) as context:  # type: ignore[arg-type]
        page, problems = context.new_page(), []
        page.on(
            "console", lambda said: problems.append(said.text) if said.type == "error" else None
        )
        page.set_default_timeout(WAIT_MS)
        page.goto(shared_panel.address)
        expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
        for end in ("Cancel", ""):
            page.get_by_role("button", name="Arm the bench").click()
            expect(page.get_by_label("Highest drive of this run")).to_be_visible(timeout=WAIT_MS)
            if end:
                page.get_by_role("button", name=end).click()
        # On a busy computer, axe keeps the page silent for so long that the dialog may close.
        found = Axe().run(page)
        assert found.violations_count == 0, found.generate_report()
        for name, content in PAGES.items():
            page.get_by_role("button", name=name, exact=True).click()
            expect(page.get_by_text(content).first).to_be_visible(timeout=WAIT_MS)
            found = Axe().run(page)
            assert found.violations_count == 0, f"{name}: {found.generate_report()}"
    assert not problems


def test_a_study_is_checked_armed_played_and_reported_by_keyboard_alone(
    browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("triangle.toml").write_text(TRIANGLE)
    panel = started()
    try:
        with browser.new_context() as context:
            page = context.new_page()
            page.set_default_timeout(WAIT_MS)
            page.goto(panel.address)
            press(page, "Studies")
            study = page.get_by_role("combobox", name="Study")
            study.focus()
            page.keyboard.press("ArrowDown")  # the second of the list
            expect(study).to_have_value("triangle.toml", timeout=WAIT_MS)
            press(page, "Check")
            expect(page.get_by_text("The bench can play this study")).to_be_visible(timeout=WAIT_MS)
            press(page, "Arm the bench and play")
            page.locator(".tab").get_by_label("Highest drive of this run").focus()
            page.keyboard.type("1.8")
            page.keyboard.press("Enter")
            expect(page.locator(".tab").get_by_text("Playing a study")).to_be_visible(
                timeout=WAIT_MS
            )
            check_another_page(context, panel)
            ending = page.locator(".tab").get_by_text("The study has ended")
            expect(ending).to_be_visible(timeout=4 * WAIT_MS)
            expect(page.get_by_role("button", name="Report")).to_be_visible(timeout=4 * WAIT_MS)
            press(page, "Report")
            report = page.frame_locator("iframe")
            expect(report.get_by_text("SIMULATED").first).to_be_visible(timeout=WAIT_MS)
            press(page, "Close the report")
            page.get_by_label("Note about").focus()
            page.keyboard.type("first one")
            page.keyboard.press("Tab")
            note = next(tmp_path.glob("out/*/session.h5")).with_name("notes.txt")
            end_s = time.monotonic() + WAIT_S
            while not note.exists() and time.monotonic() < end_s:
                page.wait_for_timeout(100)
            assert note.read_text() == "first one"
    finally:
        ended(panel)


def check_another_page(context: BrowserContext, panel: RunningPanel) -> None:
    """Another page says that a study is played, and does not analyse what is being recorded."""
    page, bench = context.new_page(), panel.child("bench_process")
    page.goto(panel.address)
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
    os.kill(bench, signal.SIGSTOP)  # so that the study does not end meanwhile
    try:
        expect(page.get_by_text("It plays a study")).to_be_visible(timeout=WAIT_MS)
        press(page, "Studies")
        said = page.get_by_text("Another page plays a study, up to 1.800 V")
        expect(said).to_be_visible(timeout=WAIT_MS)
        expect(page.get_by_role("cell", name="being recorded")).to_be_visible(timeout=WAIT_MS)
        expect(page.get_by_role("button", name="Analyse")).to_be_disabled(timeout=WAIT_MS)
    finally:
        os.kill(bench, signal.SIGCONT)
        page.close()


def press(page: Page, name: str) -> None:
    """Press a button by keyboard alone."""
    page.get_by_role("button", name=name).first.focus()
    page.keyboard.press("Enter")


def test_a_page_without_the_token_says_what_to_do(
    browser: Browser, shared_panel: RunningPanel
) -> None:
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"http://{shared_panel.host}/")
        said = page.get_by_role("alert")
        expect(said).to_contain_text("Open the address that haselab panel printed", timeout=WAIT_MS)


def test_the_page_is_small() -> None:
    files = [path for path in STATIC.rglob("*") if path.suffix in (".html", ".js", ".css")]
    assert len(files) > 5
    assert sum(len(gzip.compress(path.read_bytes())) for path in files) < 150_000
