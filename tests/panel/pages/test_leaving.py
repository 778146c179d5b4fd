"""What ends a run or loses work: a change of colours, a reload, another version of the panel."""

import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.panel.running import WAIT_S, RunningPanel

WAIT_MS = 1e3 * WAIT_S
FIRST_DARK = [0x6F, 0xB1, 0xFF]  # --first of panel.css
PIXELS = """(colour) => [...document.querySelectorAll("canvas")].filter((one) => one.clientWidth)
    .map((one) => {
        const data = one.getContext("2d").getImageData(0, 0, one.width, one.height).data;
        let found = 0;
        for (let k = 0; k < data.length; k += 4) {
            found += colour.every((value, n) => data[k + n] === value);
        }
        return found;
    })"""


@pytest.fixture
def page(browser: Browser, with_file: RunningPanel) -> Iterator[Page]:
    with browser.new_context(color_scheme="light") as context:
        found, problems = context.new_page(), []
        found.set_default_timeout(WAIT_MS)
        found.on("pageerror", lambda error: problems.append(str(error)))
        found.goto(with_file.address)
        expect(found.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
        yield found
        assert not problems


def wait_for_pixels(page: Page, colour: list[int], least: int) -> None:
    """Wait until so many plots have lines of a colour."""
    page.wait_for_function(
        f"([colour, least]) => ({PIXELS})(colour).filter((n) => n > 20).length >= least",
        arg=[colour, least],
    )


def test_a_change_of_colours_ends_no_run_and_reaches_all_plots(page: Page) -> None:
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill("1.5")
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text("Armed by this page")).to_be_visible()
    page.evaluate("window.sameDocument = true")
    assert not any(page.evaluate(PIXELS, FIRST_DARK))
    page.emulate_media(color_scheme="dark")
    wait_for_pixels(page, FIRST_DARK, 3)  # voltage, current, drive: also without a desired strain
    expect(page.get_by_text("Armed by this page")).to_be_visible()
    page.get_by_role("button", name="Design").click()
    wait_for_pixels(page, FIRST_DARK, 4)
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"() => !({PIXELS})([{FIRST_DARK}][0]).some((n) => n > 0)")
    assert page.evaluate("window.sameDocument")
    page.get_by_role("button", name="Live").click()
    expect(page.get_by_text("Armed by this page")).to_be_visible()


def test_gains_that_are_not_written_are_marked_and_not_lost_without_a_question(
    page: Page, path: Path
) -> None:
    asked: list[str] = []
    page.on("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
    page.get_by_role("button", name="Design").click()
    mark = page.get_by_text("Changed, not written")
    typed = page.get_by_role("textbox", name="ki")
    before = typed.input_value()
    expect(mark).to_have_count(0)
    typed.fill("6.25")
    typed.press("Enter")
    expect(mark).to_be_visible()
    typed.fill(before)  # as in the file: nothing would be lost
    typed.press("Enter")
    expect(mark).to_have_count(0)
    typed.fill("6.25")
    typed.press("Enter")
    expect(mark).to_be_visible()
    page.get_by_role("button", name="Doctor").click()  # also while another page is shown
    page.evaluate("() => { setTimeout(() => location.reload()); }")
    page.wait_for_timeout(500)
    assert asked == ["beforeunload"]
    page.get_by_role("button", name="Design").click()
    expect(typed).to_have_value("6.25")
    page.get_by_role("button", name="Write to the actuator file").click()
    expect(page.get_by_text("Written to")).to_be_visible()
    expect(mark).to_have_count(0)
    assert tomllib.loads(path.read_text())["controller"]["parameters"]["ki"] == 6.25
    page.reload()
    assert asked == ["beforeunload"]
    page.get_by_role("button", name="Design").click()
    expect(typed).to_have_value("6.25")


def test_a_frame_of_another_version_does_not_reload_the_page(
    browser: Browser, with_file: RunningPanel
) -> None:
    with browser.new_context() as context:
        page = context.new_page()
        page.route(
            "**/static/link.js",
            lambda route: route.fulfill(
                response=(answer := route.fetch()),
                body=answer.text().replace("const SCHEMA = 1;", "const SCHEMA = 2;"),
            ),
        )
        page.goto(with_file.address)
        page.evaluate("window.sameDocument = true")
        expect(page.get_by_role("alert")).to_contain_text(
            "another version. Reload this page.", timeout=WAIT_MS
        )
        page.wait_for_timeout(500)
        assert page.evaluate("window.sameDocument")
