"""The page Studies: what it says before the check, its durations, and what it asks for."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from haselab.panel.files import PanelFiles
from haselab.panel.pages.study_job import available, check
from tests.panel.pages.test_arming_page import arm, limit_of, opened
from tests.panel.running import TRIANGLE, WAIT_S, RunningPanel, ended, started

WAIT_MS = 1e3 * WAIT_S


@pytest.fixture
def panel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningPanel]:
    monkeypatch.chdir(tmp_path)
    Path("triangle.toml").write_text(TRIANGLE)
    cut = tmp_path / "out" / "cut"
    cut.mkdir(parents=True)
    (cut / "session.h5").touch()
    (cut / "manifest.json").write_text(
        '{"format": "haselab manifest 1", "state": "SEALED", "ended": "SafetyError: Smoke."}'
    )
    found = started()
    try:
        yield found
    finally:
        ended(found)


@pytest.fixture
def page(browser: Browser, panel: RunningPanel) -> Iterator[Page]:
    with browser.new_context() as context:
        yield opened(context, panel)


def test_the_planned_time_is_that_of_the_check(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    files = PanelFiles(path, None, tmp_path / "out")
    (reference, *_) = available(files)["studies"]
    for k, quick in enumerate((False, True)):
        planned = sum(one["seconds"][k] for one in reference["experiments"])
        chosen = {"study": "reference study", "quick": quick}
        assert planned == pytest.approx(check(files, chosen)["seconds"])
    path.write_text("kind = 1\n")  # the page still lists the studies
    assert available(files)["studies"][0]["experiments"][0]["seconds"] == [None, None]


def test_durations_and_choices_are_there_before_the_check(page: Page) -> None:
    page.get_by_role("button", name="Studies").click()
    expect(page.get_by_label("Static load (static_load): 20 min")).to_be_checked(timeout=WAIT_MS)
    expect(page.get_by_text("Planned duration of all: 57 min.")).to_be_visible()
    page.get_by_role("button", name="None").click()
    expect(page.get_by_role("checkbox", checked=True)).to_have_count(0)
    expect(page.get_by_role("button", name="Check, then play")).to_be_disabled()
    page.get_by_label("Maps (triangle)").check()
    expect(page.get_by_text("Planned duration of all: 20 s.")).to_be_visible()
    page.get_by_role("button", name="All", exact=True).click()
    page.get_by_label("Short version").check()
    expect(page.get_by_label("Static load (static_load): 13 min")).to_be_checked()
    expect(page.get_by_text("as fast as this computer can")).to_be_visible()


def test_an_armed_bench_is_disarmed_before_the_check(page: Page) -> None:
    arm(page)
    page.get_by_role("button", name="Studies").click()
    said = page.get_by_text("This page has armed the bench. Disarm it before you play a study.")
    expect(said).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_role("combobox", name="Study")).to_be_disabled()
    page.locator(".tab").get_by_role("button", name="Disarm").click()
    expect(said).to_have_count(0, timeout=WAIT_MS)
    expect(page.get_by_role("button", name="Check, then play")).to_be_focused()
    page.get_by_role("button", name="Pick").click()
    expect(page.get_by_label("Video")).to_be_enabled(timeout=WAIT_MS)


def test_a_limit_below_the_study_can_be_corrected_at_once(page: Page) -> None:
    page.get_by_role("button", name="Studies").click()
    page.get_by_role("combobox", name="Study").select_option("triangle.toml", timeout=WAIT_MS)
    page.get_by_role("button", name="Check, then play").click()
    page.get_by_role("button", name="Arm the bench and play").click()
    tab = page.locator(".tab")
    expect(tab.get_by_text("This study needs at least 1.800 V (9.00 kV)")).to_be_visible()
    limit = limit_of(tab)
    limit.fill("1.5")
    limit.press("Enter")
    alert = tab.get_by_role("alert")
    expect(alert).to_contain_text("The study needs 1.8 V", timeout=WAIT_MS)
    expect(limit).to_be_focused()
    limit.fill("1.8")
    expect(alert).to_have_count(0)
    limit.press("Enter")
    expect(tab.get_by_text("Playing a study")).to_be_visible(timeout=WAIT_MS)
    expect(tab.get_by_text("Playing a study")).to_be_focused()
    expect(tab.get_by_text("The study has ended")).to_be_visible(timeout=4 * WAIT_MS)


def test_what_the_list_of_recordings_says(page: Page, tmp_path: Path) -> None:
    page.get_by_role("button", name="Studies").click()
    row = page.get_by_role("row", name=re.compile("cut"))
    expect(row).to_contain_text(
        "only if all of its recorded experiments are complete", timeout=WAIT_MS
    )
    page.get_by_label("Search").fill("nothing like that")
    expect(page.get_by_text("No recording contains “nothing like that”")).to_be_visible()
    page.get_by_label("Search").fill("")
    (tmp_path / "out" / "cut" / "report.html").write_text(
        "<h1>Results</h1><a href='#end'>to the end</a>"
        "<p style='height: 300vh'></p><p id='end'>The end</p>"
    )
    button = page.get_by_role("button", name="Report", exact=True)
    button.click(timeout=WAIT_MS)
    report = page.frame_locator("iframe")
    expect(report.get_by_role("heading", name="Results")).to_be_visible(timeout=WAIT_MS)
    page.wait_for_timeout(300)
    before = page.evaluate("scrollY")
    report.get_by_role("link").click()
    expect(report.locator("#end")).to_be_in_viewport()
    assert page.evaluate("scrollY") == before
    page.get_by_role("button", name="Close the report").click()
    expect(button).to_be_focused()
