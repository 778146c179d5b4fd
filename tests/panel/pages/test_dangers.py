"""What a page must not do: follow a swipe, depend on one way to STOP, show old data as new."""

import contextlib
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, CDPSession, Page, expect

from tests.panel.pages.test_design import CONTROLLER, MODEL
from tests.panel.running import WAIT_S, RunningPanel, ended, started

WAIT_MS = 1e3 * WAIT_S
PHONE = {"width": 390, "height": 844}


@contextlib.contextmanager
def opened(browser: Browser, address: str, **options: object) -> Iterator[Page]:
    with browser.new_context(**options) as context:  # type: ignore[arg-type]
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(address)
        expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
        expect(page.locator("#emergency-state")).to_have_text("STOP: ready", timeout=WAIT_MS)
        yield page


def arm(page: Page, limit_v: str = "1.5") -> None:
    page.get_by_role("button", name="Arm the bench").click()
    page.get_by_label("Highest drive of this run").fill(limit_v)
    page.get_by_role("button", name="Arm", exact=True).click()
    expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)


def drive(page: Page, value: str) -> None:
    page.get_by_label("Drive, typed").fill(value)
    page.keyboard.press("Enter")
    shown = re.compile(rf"Bench: running, {float(value):.3f} V")
    expect(page.locator("header")).to_contain_text(shown, timeout=WAIT_MS)


def swipe(touch: CDPSession, start: tuple[float, float], by: tuple[float, float]) -> None:
    for what, share in (("touchStart", 0.0), *(("touchMove", k / 8) for k in range(1, 9))):
        place = {"x": start[0] + share * by[0], "y": start[1] + share * by[1]}
        touch.send("Input.dispatchTouchEvent", {"type": what, "touchPoints": [place]})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_a_finger_moves_a_slider_only_by_its_handle(browser: Browser, panel: RunningPanel) -> None:
    with opened(browser, panel.address, viewport=PHONE, has_touch=True, is_mobile=True) as page:
        arm(page)
        touch = page.context.new_cdp_session(page)
        slider = page.get_by_role("slider", name=re.compile("^Drive"))

        def middle() -> tuple[float, float, float]:
            slider.scroll_into_view_if_needed()
            box = slider.bounding_box()
            assert box is not None
            return box["x"], box["y"] + 0.5 * box["height"], box["width"]

        for share, by in ((0.8, (0.0, -160.0)), (0.8, (60.0, 0.0)), (0.3, (0.0, 0.0))):
            left, height, width = middle()
            swipe(touch, (left + share * width, height), by)
            page.wait_for_timeout(300)
            assert slider.input_value() == "0"
        expect(page.get_by_label("Drive, typed")).to_have_value("0")
        left, height, width = middle()
        swipe(touch, (left + 8.0, height), (0.5 * width, 0.0))  # by the handle
        expect(page.locator("header")).to_contain_text(
            re.compile(r"running, 0\.[5-9]"), timeout=WAIT_MS
        )


def test_a_press_of_stop_works_while_its_process_hangs(
    browser: Browser, panel: RunningPanel
) -> None:
    with opened(browser, panel.address) as page:
        arm(page)
        drive(page, "1")
        state = page.locator("#emergency-state")
        process = panel.child("stop_process")
        os.kill(process, signal.SIGSTOP)
        try:
            page.locator("#emergency").click()
            expect(page.locator("header")).to_contain_text("Bench: tripped", timeout=WAIT_MS)
            expect(page.get_by_text("Last message of the bench: STOP was pressed")).to_be_visible()
            expect(state).to_contain_text("0 V commanded at ", timeout=WAIT_MS)
            expect(state).to_contain_text("STOP DOES NOT ANSWER", timeout=WAIT_MS)
        finally:
            with contextlib.suppress(ProcessLookupError):  # the panel has ended
                os.kill(process, signal.SIGCONT)


def test_an_alarm_about_stop_ends_when_stop_answers_again(
    browser: Browser, panel: RunningPanel
) -> None:
    with opened(browser, panel.address) as page:
        state = page.locator("#emergency-state")
        page.context.set_offline(True)
        page.locator("#emergency").click()
        expect(state).to_contain_text("STOP DOES NOT ANSWER", timeout=WAIT_MS)
        page.context.set_offline(False)
        expect(state).to_contain_text("THE LAST PRESS WAS NOT CONFIRMED", timeout=WAIT_MS)
        page.locator("#emergency").click()
        expect(state).to_contain_text("STOP: 0 V commanded at ", timeout=WAIT_MS)
        expect(state).to_have_text("STOP: ready", timeout=WAIT_MS)


def test_the_state_of_a_bench_without_new_data_is_called_unknown(
    browser: Browser, panel: RunningPanel
) -> None:
    with opened(browser, panel.address) as page:
        arm(page)
        drive(page, "1")
        os.kill(panel.process.pid, signal.SIGSTOP)
        try:
            expect(page.locator("header")).to_contain_text(
                "Bench: unknown (last: running, 1.000 V", timeout=WAIT_MS
            )
            for name in ("Disarm", "Ramp to 0 V"):
                expect(page.get_by_role("button", name=name)).to_be_disabled(timeout=WAIT_MS)
            expect(page.get_by_role("slider", name=re.compile("^Drive"))).to_be_disabled()
            expect(page.get_by_text("What is shown of the bench is old")).to_be_visible()
        finally:
            os.kill(panel.process.pid, signal.SIGCONT)
        expect(page.locator("header")).not_to_contain_text("unknown", timeout=WAIT_MS)


def test_a_typed_gain_is_written_by_one_click_and_a_wrong_one_prevents_it(
    browser: Browser, tmp_path: Path
) -> None:
    path = tmp_path / "actuator.toml"
    path.write_text(MODEL + CONTROLLER)
    panel = started("--actuator", str(path))
    try:
        with opened(browser, panel.address) as page:
            page.get_by_role("button", name="Design").click()
            field = page.get_by_role("textbox", name="ki")
            write = page.get_by_role("button", name="Write to the actuator file")
            field.fill("5.25")
            write.click()
            expect(page.get_by_text("Written to")).to_be_visible(timeout=WAIT_MS)
            assert "ki = 5.25" in path.read_text()
            before = path.read_bytes()
            field.fill("6,5")
            write.click()
            expect(page.get_by_text("Not written: a field")).to_be_visible(timeout=WAIT_MS)
            assert path.read_bytes() == before
    finally:
        ended(panel)


@pytest.mark.parametrize("seconds", [2.5, 0.25])
def test_times_of_the_axis_are_not_rounded(
    browser: Browser, shared_panel: RunningPanel, seconds: float
) -> None:
    """A tick at 2.5 s was labelled 3 s."""
    with opened(browser, shared_panel.address) as page:
        found = page.evaluate(
            """async (step) => (await import("/static/charts.js")).seconds(
                null, [4 * step, 5 * step], 0, 0, step)""", seconds,
        )  # fmt: skip
        assert [float(text.removesuffix(" s")) for text in found] == [4 * seconds, 5 * seconds]


def test_values_of_the_axis_have_no_rounded_or_negative_zeros(
    browser: Browser, shared_panel: RunningPanel
) -> None:
    """Rounding errors of a drive of 0 V filled the plot, with the labels 0, 0 and -0."""
    with opened(browser, shared_panel.address) as page:
        labels, small, large = page.evaluate(
            """async () => {
                const { heights, numbers } = await import("/static/charts.js");
                return [numbers(null, [-0.0005, -1e-19, 0.0005], 0, 0, 0.0005),
                        heights(0.001)(null, -1e-8, 1e-8), heights(0.001)(null, -5, 5)];
            }"""
        )
        assert labels == ["-0.0005", "0.0000", "0.0005"]
        assert small[0] <= -0.0005 and small[1] >= 0.0005
        assert large[0] <= -5.0 and large[1] >= 5.0


def test_the_terminal_says_at_the_end_that_0_v_was_commanded(capfd: pytest.CaptureFixture) -> None:
    panel = started()
    ended(panel)
    assert "The panel has ended, and 0 V was commanded." in capfd.readouterr().err


def test_state_and_old_data_stay_beside_stop_when_the_page_is_scrolled(
    browser: Browser, panel: RunningPanel
) -> None:
    with opened(browser, panel.address, viewport={"width": 1280, "height": 500}) as page:
        arm(page)
        drive(page, "1")
        corner = page.locator("#corner-state")
        page.get_by_role("heading", name="Camera").scroll_into_view_if_needed()
        expect(corner).to_contain_text("Bench: running, 1.000 V", timeout=WAIT_MS)
        expect(corner).to_be_in_viewport()
        page.context.set_offline(True)
        os.kill(panel.process.pid, signal.SIGSTOP)
        try:
            page.keyboard.press("Escape")
            expect(corner).to_contain_text("NO NEW DATA", timeout=WAIT_MS)
            said = page.locator("#emergency-state")
            expect(said).to_contain_text("Press the emergency stop", timeout=WAIT_MS)
            above, below = said.bounding_box(), corner.bounding_box()
            assert above is not None and below is not None
            assert above["y"] + above["height"] <= below["y"]  # it does not cover the instruction
        finally:
            os.kill(panel.process.pid, signal.SIGCONT)


def test_no_list_can_take_the_key_of_stop_while_the_bench_is_armed(
    browser: Browser, panel: RunningPanel
) -> None:
    with opened(browser, panel.address) as page:
        page.get_by_role("button", name="Studies").click()
        study = page.get_by_role("combobox", name="Study")
        expect(study).to_be_enabled(timeout=WAIT_MS)
        page.get_by_role("button", name="Live", exact=True).click()
        arm(page)
        for name, label in (("Studies", "Study"), ("Pick", "Video")):
            page.get_by_role("button", name=name).click()
            expect(page.get_by_role("combobox", name=label)).to_be_disabled(timeout=WAIT_MS)
