"""Arming on the page: the dialog, errors at their fields, focus, two pages, a computing twin."""

import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect

from tests.panel.running import WAIT_S, RunningPanel, ended, started

WAIT_MS = 1e3 * WAIT_S


@pytest.fixture
def with_loop(actuator_file: Path) -> Iterator[RunningPanel]:
    found = started("--actuator", str(actuator_file))
    try:
        yield found
    finally:
        ended(found)


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    with browser.new_context() as found:
        yield found


@pytest.fixture
def page(context: BrowserContext, with_loop: RunningPanel) -> Page:
    return opened(context, with_loop)


def opened(context: BrowserContext, panel: RunningPanel) -> Page:
    """A page of a panel that shows live data."""
    page = context.new_page()
    page.set_default_timeout(WAIT_MS)
    page.goto(panel.address)
    expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
    expect(page.locator("#emergency-state")).to_have_text("STOP: ready", timeout=WAIT_MS)
    return page


def limit_of(page: Page) -> Locator:
    return page.get_by_label("Highest drive of this run")


def request(page: Page) -> None:
    page.get_by_role("button", name="Arm the bench …").click()
    expect(limit_of(page)).to_be_focused(timeout=WAIT_MS)
    expect(page.locator("header")).to_contain_text("arming, waiting", timeout=WAIT_MS)


def arm(page: Page, limit_v: str = "1.5") -> None:
    request(page)
    limit_of(page).fill(limit_v)
    page.keyboard.press("Enter")
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)


def test_the_dialog_is_short_and_its_number_must_be_typed(page: Page) -> None:
    request(page)
    form = page.locator("form")
    assert len(form.inner_text().split()) < 40
    expect(limit_of(page)).to_have_value("")
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("This field is empty")
    expect(form).to_contain_text("smallest limit that you need, at most 2.000 V (10.00 kV).")
    form.get_by_text("All limits of this run").click()
    expect(form.get_by_text("up to 10 kV at the amplifier's output")).to_be_visible()
    limit_of(page).fill("1e-9")  # would be shown as 0.000 V
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("1e-9 is too low. Type at least 0.001.")


def test_stop_closes_the_dialog(page: Page) -> None:
    request(page)
    limit_of(page).fill("1")
    page.keyboard.press("Escape")
    expect(limit_of(page)).to_have_count(0, timeout=WAIT_MS)
    expect(page.get_by_role("button", name="Arm the bench …")).to_be_focused(timeout=WAIT_MS)
    page.keyboard.press("Enter")
    expect(limit_of(page)).to_have_value("", timeout=WAIT_MS)
    expect(page.get_by_text("no longer valid")).to_have_count(0)
    page.get_by_label("The cause has been removed.").check()
    limit_of(page).fill("1")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)


def test_what_was_refused_is_said_at_its_field_and_ends_with_the_next_command(page: Page) -> None:
    arm(page)
    alert = page.get_by_role("alert")
    drive, strain = page.get_by_label("Drive, typed"), page.get_by_label("strain, typed")
    drive.fill("1.9")
    drive.press("Enter")
    expect(alert).to_contain_text("armed for 0 to 1.5 V", timeout=WAIT_MS)
    assert drive.get_attribute("aria-describedby") == alert.get_attribute("id")
    strain.fill("40")
    strain.press("Enter")
    expect(alert).to_contain_text("The desired strain is 40 %", timeout=WAIT_MS)
    expect(alert).to_have_count(1)
    assert strain.get_attribute("aria-describedby") == alert.get_attribute("id")
    drive.fill("0,5")
    expect(alert).to_have_count(1)
    expect(alert).to_contain_text("0,5 is not a number")
    drive.fill("0.5")
    drive.press("Enter")
    expect(alert).to_have_count(0)


def test_the_strain_has_its_range_and_round_steps(page: Page) -> None:
    arm(page)
    slider = page.get_by_role("slider", name="Desired strain, in %, -4 to 10")
    assert slider.get_attribute("step") == "0.1"
    expect(page.get_by_label("Desired strain, typed, in %, -4 to 10")).to_be_visible()
    slider.focus()
    page.keyboard.press("ArrowRight")
    typed = page.get_by_label("strain, typed")
    expect(typed).to_have_value("0.1")
    page.evaluate(
        """async () => {
            const { stepsOf } = await import("/static/number.js");
            const ends = [[-3.217, 4.381], [0, 0.0123], [0, 2]];
            const found = JSON.stringify(ends.map(([low, high]) => stepsOf(low, high)));
            const wanted = JSON.stringify([{ step: 0.1, min: -3.2, max: 4.3 },
                { step: 0.0001, min: 0, max: 0.0123 }, { step: 0.1, min: 0, max: 2 }]);
            if (found !== wanted) throw new Error(found);
        }"""
    )


def test_the_focus_goes_to_the_next_control(page: Page) -> None:
    arm(page)
    drive = page.get_by_label("Drive, typed")
    expect(drive).to_be_focused(timeout=WAIT_MS)
    strain = page.get_by_label("strain, typed")
    strain.fill("0.1")
    strain.press("Enter")
    loop = page.get_by_role("button", name="Open the loop")
    loop.focus()
    page.keyboard.press("Enter")
    expect(loop).to_have_count(0, timeout=WAIT_MS)
    expect(drive).to_be_focused()
    page.get_by_role("button", name="Disarm").focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Arm the bench …")).to_be_focused(timeout=WAIT_MS)


def test_a_page_says_that_another_one_has_requested_or_armed(
    context: BrowserContext, page: Page, with_loop: RunningPanel
) -> None:
    other = opened(context, with_loop)
    request(page)
    said = other.get_by_text("Another page has requested to arm the bench.")
    expect(said).to_be_visible(timeout=WAIT_MS)
    request(other)
    expect(limit_of(page)).to_have_count(0, timeout=WAIT_MS)
    expect(page.get_by_text("Another page has requested to arm the bench.")).to_be_visible()
    expect(limit_of(other)).to_be_visible()
    page.route("**/ready", lambda asked: asked.abort())
    page.get_by_role("button", name="Arm the bench …").click()
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("STOP of this page does not answer", timeout=WAIT_MS)
    limit_of(other).fill("1")
    limit_of(other).press("Enter")
    expect(other.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)
    expect(page.get_by_text("Armed by another page")).to_be_visible(timeout=WAIT_MS)
    other.get_by_role("button", name="Disarm").click()
    expect(page.get_by_role("button", name="Arm the bench …")).to_be_visible(timeout=WAIT_MS)
    expect(alert).to_have_count(0)


def test_all_time_axes_are_aligned(page: Page) -> None:
    expect(page.get_by_text("Strain: sensed –")).to_be_visible()  # a plot without data
    page.wait_for_timeout(500)
    lefts = page.evaluate(
        """() => [...document.querySelectorAll(".charts .u-over")].map((one) => {
            const box = one.getBoundingClientRect();
            return [Math.round(box.left), Math.round(box.right)].join();
        })"""
    )
    assert len(lefts) == 5 and len(set(lefts)) == 1, lefts


def test_a_twin_that_computes_is_no_alarm_but_silence_is(
    context: BrowserContext, with_loop: RunningPanel
) -> None:
    page = context.new_page()
    page.route(  # the block is old, and the state is what the bench process sends
        "**/static/link.js",
        lambda route: route.fulfill(
            response=(answer := route.fetch()),
            body=answer.text().replace(
                "this.blockAge = about.age_s;",
                "if (window.pretend) { about.age_s = 5;"
                " about.state.computing = window.pretend.computing; } this.blockAge = about.age_s;",
            ),
        ),
    )
    page.set_default_timeout(WAIT_MS)
    page.goto(with_loop.address)
    age, header = page.locator("#age"), page.locator("header")
    expect(age).to_have_text("data live", timeout=WAIT_MS)
    page.evaluate("window.pretend = { computing: true }")
    expect(age).to_have_text(re.compile("^The simulated bench is computing: no new data for 5"))
    expect(header).not_to_contain_text("unknown")
    page.evaluate("window.pretend = { computing: false }")  # a thread that waits
    expect(age).to_have_text(re.compile("^NO NEW DATA"))
    expect(header).to_contain_text("Bench: unknown")
    page.evaluate("window.pretend = { computing: true }")
    expect(age).to_have_text(re.compile("^The simulated bench"))
    bench = with_loop.child("bench_process")
    os.kill(bench, signal.SIGSTOP)
    try:
        expect(age).to_have_text(re.compile("^NO NEW DATA"), timeout=WAIT_MS)
        expect(header).to_contain_text("Bench: unknown")
    finally:
        os.kill(bench, signal.SIGCONT)
