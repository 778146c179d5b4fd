"""The list of recordings in Chromium: notes that change meanwhile, and thousands of recordings."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.panel.running import WAIT_S, ended, started

WAIT_MS = 1e3 * WAIT_S
MANY = 250


def record(runs: Path, name: str, second: int = 0) -> Path:
    folder = runs / name
    folder.mkdir(parents=True)
    (folder / "session.h5").touch()
    opened = f"2026-01-31T20:{second // 60:02}:{second % 60:02}+00:00"
    (folder / "manifest.json").write_text(
        f'{{"format": "haselab manifest 1", "state": "SEALED", "opened": "{opened}"}}'
    )
    return folder


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Iterator[Page]:
    """The page Studies of a panel with a recording "a"."""
    record(tmp_path, "a")
    panel = started("--runs", str(tmp_path))
    try:
        with browser.new_context() as context:
            found = context.new_page()
            found.set_default_timeout(WAIT_MS)
            found.goto(panel.address)
            found.get_by_role("button", name="Studies").click()
            expect(found.get_by_label("Note about a")).to_be_visible(timeout=WAIT_MS)
            yield found
    finally:
        ended(panel)


def test_a_note_that_nobody_typed_is_not_saved(page: Page, tmp_path: Path) -> None:
    path, note = tmp_path / "a" / "notes.txt", page.get_by_label("Note about a")
    note.fill("old")
    note.blur()
    page.wait_for_function("() => document.querySelector('textarea').value === 'old'")
    end = page.get_by_label("Search")
    for _ in range(100):
        if path.exists():
            break
        page.wait_for_timeout(100)
    assert path.read_text() == "old"
    path.write_text("of an editor")
    expect(note).to_have_value("of an editor", timeout=WAIT_MS)
    note.click()
    end.click()
    page.wait_for_timeout(500)
    assert path.read_text() == "of an editor"


def test_two_notes_at_once_are_both_kept_until_somebody_chooses(page: Page, tmp_path: Path) -> None:
    path, note = tmp_path / "a" / "notes.txt", page.get_by_label("Note about a")
    note.fill("mine")
    path.write_text("of an editor")
    note.blur()  # the page does not know yet
    said = page.get_by_text("meanwhile, the note was changed to “of an editor”")
    expect(said).to_be_visible(timeout=WAIT_MS)
    expect(note).to_have_value("mine")
    assert path.read_text() == "of an editor"
    for name in ("Doctor", "Studies"):  # a visit to another page keeps it
        page.get_by_role("button", name=name).click()
    expect(said).to_be_visible(timeout=WAIT_MS)
    expect(note).to_have_value("mine")
    page.get_by_role("button", name="Save what I typed instead").click()
    expect(said).to_be_hidden(timeout=WAIT_MS)
    assert path.read_text() == "mine"
    note.fill("mine again")
    path.write_text("of an editor")
    expect(said).to_be_visible(timeout=WAIT_MS)
    page.get_by_role("button", name="Discard what I typed").click()
    expect(note).to_have_value("of an editor", timeout=WAIT_MS)
    assert path.read_text() == "of an editor"


def test_a_hundred_recordings_are_drawn_at_once_and_only_when_they_change(
    page: Page, tmp_path: Path
) -> None:
    for k in range(MANY):
        record(tmp_path, f"r{k:03}", k)
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(100, timeout=WAIT_MS)
    expect(rows.first).to_contain_text(f"r{MANY - 1:03}")
    expect(page.get_by_text(f"The newest 100 of {MANY + 1} are shown.")).to_be_visible()
    draws = page.evaluate(  # the time of each row is parsed once a draw
        """() => new Promise((resolve) => {
          const parse = Date.parse;
          let rows = 0;
          Date.parse = (text) => { rows += 1; return parse(text); };
          setTimeout(() => { Date.parse = parse; resolve(rows / 100); }, 2500);
        })"""
    )
    assert draws <= 4  # the list is read once in 3 s; with each frame there would be about 40
    page.get_by_role("button", name="Show more").click()
    expect(rows).to_have_count(200, timeout=WAIT_MS)
    page.get_by_label("Search").fill("r000")
    expect(rows).to_have_count(1, timeout=WAIT_MS)


def test_a_note_has_a_button_until_it_is_saved(page: Page, tmp_path: Path) -> None:
    sent = []
    page.on("request", lambda request: sent.append(request.url.rpartition("/")[2]))
    page.get_by_label("Note about a").fill("mine")
    save = page.get_by_role("button", name="Save", exact=True)
    save.click()
    expect(page.get_by_text("Saved.")).to_be_visible(timeout=WAIT_MS)
    expect(save).to_have_count(0, timeout=WAIT_MS)
    assert sent.count("note") == 1  # the field saves, too, when the button takes the focus
    page.reload()
    expect(page.get_by_label("Note about a")).to_have_value("mine", timeout=WAIT_MS)
    assert (tmp_path / "a" / "notes.txt").read_text() == "mine"


def test_a_report_is_shown_in_the_page_with_stop_and_runs_no_script(
    page: Page, tmp_path: Path
) -> None:
    (tmp_path / "a" / "report.html").write_text(
        "<script>parent.wrong = 1</script><h1 onclick='parent.wrong = 1'>Results of a</h1>"
        "<a href='#end'>to the end</a><p id='end'>The end</p>"
    )
    page.get_by_role("button", name="Report", exact=True).click()
    heading = page.frame_locator("iframe").get_by_role("heading", name="Results of a")
    heading.click()
    page.frame_locator("iframe").get_by_role("link").click()
    expect(heading).to_be_visible()  # the link leads to a place in the report
    assert page.evaluate("window.wrong") is None
    state = page.locator("#emergency-state")
    expect(state).to_have_text("STOP: ready", timeout=WAIT_MS)
    page.keyboard.press("Escape")  # the focus is in the report
    expect(state).to_contain_text("STOP: 0 V commanded at", timeout=WAIT_MS)
    page.get_by_role("button", name="Close the report").click()
    expect(page.locator("iframe")).to_have_count(0)


def test_a_report_that_leads_elsewhere_gives_the_keys_back(page: Page, tmp_path: Path) -> None:
    (tmp_path / "a" / "report.html").write_text(
        "<h1>Results of a</h1><select><option>b</option></select><iframe srcdoc='c'></iframe>"
        "<a href='http://127.0.0.1:9/'>to another page</a>"
    )
    for _ in range(2):  # it can be opened again
        page.get_by_role("button", name="Report", exact=True).click()
        report = page.frame_locator("iframe")
        expect(report.get_by_role("heading", name="Results of a")).to_be_visible(timeout=WAIT_MS)
        expect(report.locator("iframe, select")).to_have_count(0)  # they would take the keys
        report.get_by_role("link").click()
        expect(page.get_by_text("A link in the report led elsewhere")).to_be_visible(
            timeout=WAIT_MS
        )
    page.keyboard.press("Escape")
    state = page.locator("#emergency-state")
    expect(state).to_contain_text("STOP: 0 V commanded at", timeout=WAIT_MS)


def test_a_report_that_would_keep_stop_waiting_is_not_shown(page: Page, tmp_path: Path) -> None:
    (tmp_path / "a" / "report.html").write_text("<p>" + 11_000_000 * "a")
    page.get_by_role("button", name="Report", exact=True).click()
    expect(page.get_by_text("at most 10 MB")).to_be_visible(timeout=WAIT_MS)
    expect(page.locator("iframe")).to_have_count(0)


def test_back_forward_and_reload_stay_on_the_page_that_was_open(page: Page) -> None:
    def shown(name: str) -> None:
        button = page.locator("nav [aria-current=page]")
        expect(button).to_have_text(name, timeout=WAIT_MS)

    page.get_by_role("button", name="Doctor").click()
    shown("Doctor")
    page.go_back()
    shown("Studies")
    expect(page.get_by_label("Note about a")).to_be_visible(timeout=WAIT_MS)
    page.go_forward()
    shown("Doctor")
    page.reload()
    shown("Doctor")
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
    page.evaluate("location.hash = 'constructor'")  # no such page
    shown("Live")
