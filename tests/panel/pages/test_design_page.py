"""The Design page in Chromium: a dragged gain, the keyboard, writing, accessibility."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, Request, expect

from tests.panel.pages.test_design import GAINS, MODEL, ask
from tests.panel.running import WAIT_S, RunningPanel, ended, started

WAIT_MS = 1e3 * WAIT_S


@pytest.fixture
def page(browser: Browser, with_file: RunningPanel) -> Iterator[Page]:
    """The Design page once it shows margins; it has asked nobody else for anything."""
    with browser.new_context(viewport={"width": 1400, "height": 1200}) as context:
        found, problems = context.new_page(), []
        found.set_default_timeout(WAIT_MS)
        found.on("pageerror", lambda error: problems.append(str(error)))
        found.on("request", lambda sent: asked.append(sent.url))
        asked: list[str] = []
        found.goto(with_file.address)
        found.get_by_role("button", name="Design").click()
        expect(margins(found)).to_contain_text("stable", timeout=WAIT_MS)
        yield found
        assert not problems
        assert all(re.match(r"(http|ws)://127\.0\.0\.1:|data:|blob:", url) for url in asked)


def margins(page: Page) -> Page:
    """The table at the rate of the file."""
    return page.get_by_role("table", name="At 100 Hz with a delay of 10 ms")


def slider(page: Page, name: str) -> Page:
    return page.get_by_role("slider", name=name)


def typed(page: Page, name: str) -> Page:
    return page.get_by_role("textbox", name=name)


def shown_gains(page: Page) -> dict[str, float]:
    names = ("kp", "ki", "kd", "filter")
    return {
        gain: float(typed(page, name).input_value())
        for gain, name in zip(GAINS, names, strict=True)
    }


def expect_margins_of(page: Page, path: Path) -> None:
    """Expect the margins of the gains on the page, as the command states them."""
    found = ask(path, "design-loop", **shown_gains(page))["margins"]
    for name, unit in (("phase_margin_deg", "°"), ("gain_margin_db", "dB")):
        text = f"{float(f'{found[name]:.4g}'):g} {unit}"
        expect(margins(page)).to_contain_text(text, timeout=WAIT_MS)


def test_margins_and_plots_follow_while_a_gain_is_dragged(page: Page, path: Path) -> None:
    busy: list[int] = [0]  # requests that are under way, after each change

    def change(request: Request, by: int) -> None:
        if request.url.endswith("/request/design-loop"):
            busy.append(busy[-1] + by)

    expect_margins_of(page, path)
    page.on("request", lambda request: change(request, 1))
    page.on("requestfinished", lambda request: change(request, -1))
    before = margins(page).inner_text()
    plot = page.get_by_role("img", name="Magnitude")
    described = plot.get_attribute("aria-label")
    box = slider(page, "ki").bounding_box()
    assert box is not None
    gains = shown_gains(page)
    middle = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.6 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], middle, steps=40)
    expect(margins(page)).not_to_have_text(before, timeout=WAIT_MS)  # the button is still down
    expect(plot).not_to_have_attribute("aria-label", described or "", timeout=WAIT_MS)
    expect_margins_of(page, path)
    page.mouse.up()
    assert shown_gains(page)["ki"] > 1.5 * gains["ki"]
    assert shown_gains(page) | {"ki": 0} == gains | {"ki": 0}
    assert len(busy) > 1 and max(busy) == 1  # never two at a time
    expect(page.get_by_text("of 400 plausible plants")).to_be_visible(timeout=WAIT_MS)


def tab_to(page: Page, name: str, role: str) -> None:
    for _ in range(60):
        page.keyboard.press("Tab")
        if page.get_by_role(role, name=name).evaluate("e => e === document.activeElement"):
            return
    pytest.fail(f"no way to {name!r} by Tab")


def test_gains_are_changed_and_written_by_keyboard_alone(page: Page, path: Path) -> None:
    tab_to(page, "kp", "slider")
    before = shown_gains(page)["kp"]
    page.keyboard.press("ArrowRight")
    # One of 400 steps over four decades, on the grid of the slider.
    assert before < shown_gains(page)["kp"] < before * 10 ** (2 * 4 / 400)
    tab_to(page, "ki", "textbox")
    page.keyboard.press("Control+a")
    page.keyboard.type("6.25")
    page.keyboard.press("Enter")
    expect_margins_of(page, path)
    gains = shown_gains(page)
    write = page.get_by_role("button", name="Write to the actuator file")
    expect(write).to_be_enabled(timeout=WAIT_MS)
    tab_to(page, "Write to the actuator file", "button")
    page.keyboard.press("Enter")
    said = page.get_by_text("Press Arm the bench on the page Live to use it.")
    expect(said).to_be_visible(timeout=WAIT_MS)
    held = tomllib.loads(path.read_text())
    assert held["controller"]["parameters"] == gains and gains["ki"] == 6.25
    assert path.read_text().startswith(MODEL)


def test_an_unstable_loop_is_marked_and_not_written(page: Page, path: Path) -> None:
    before = path.read_bytes()
    typed(page, "ki").fill("120")
    typed(page, "ki").press("Enter")
    expect(margins(page)).to_contain_text("UNSTABLE", timeout=WAIT_MS)
    page.get_by_role("button", name="Write to the actuator file").click()
    said = page.get_by_text("Not written: with these gains the loop is unstable at 100 Hz")
    expect(said).to_be_visible(timeout=WAIT_MS)
    assert path.read_bytes() == before
    page.get_by_role("button", name="Compute gains").click()
    expect(margins(page)).to_contain_text("stable", timeout=WAIT_MS)
    expect(page.get_by_text("All demands are met.")).to_be_visible(timeout=WAIT_MS)


def test_a_file_that_changed_is_shown_before_it_is_written(page: Page, path: Path) -> None:
    path.write_text(path.read_text().replace("damping_ratio = 0.3", "damping_ratio = 0.2"))
    path.write_text(path.read_text().replace("32.0, 0.3,", "32.0, 0.2,"))
    page.get_by_role("button", name="Write to the actuator file").click()
    said = page.get_by_text("the actuator file has changed since")
    expect(said).to_be_visible(timeout=WAIT_MS)
    expect_margins_of(page, path)
    page.get_by_role("button", name="Read the file again").click()
    expect(page.get_by_text("The file has changed since this page")).to_have_count(0)
    page.get_by_role("button", name="Write to the actuator file").click()
    expect(page.get_by_text("Written to")).to_be_visible(timeout=WAIT_MS)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_on_a_tablet(
    browser: Browser, with_file: RunningPanel, scheme: str
) -> None:
    size = {"width": 800, "height": 1100}
    with browser.new_context(color_scheme=scheme, viewport=size) as context:  # type: ignore[arg-type]
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(with_file.address)
        page.get_by_role("button", name="Design").click()
        expect(page.get_by_text("of 400 plausible plants")).to_be_visible(timeout=WAIT_MS)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        found = Axe().run(page)
        assert found.violations_count == 0, found.generate_report()


def test_without_an_actuator_file_the_page_says_how_to_start(
    browser: Browser, tmp_path: Path
) -> None:
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    panel = started("--rig", str(tmp_path / "rig.toml"))
    try:
        with browser.new_context() as context:
            page = context.new_page()
            page.goto(panel.address)
            page.get_by_role("button", name="Design").click()
            said = page.get_by_text("Start it with --actuator ACTUATOR.toml").first
            expect(said).to_be_visible(timeout=WAIT_MS)
    finally:
        ended(panel)


def test_gains_that_another_program_wrote_are_not_reverted(page: Page, path: Path) -> None:
    path.write_text(path.read_text().replace("ki = 5.0", "ki = 0.1"))
    typed(page, "Derivative gain").fill("0.011")
    page.keyboard.press("Enter")
    said = page.get_by_text("The file has changed since this page read it.")
    expect(said).to_be_visible(timeout=WAIT_MS)
    page.get_by_role("button", name="Write to the actuator file").click()
    expect(page.get_by_text("Not written: the actuator file has changed")).to_be_visible(
        timeout=WAIT_MS
    )
    assert tomllib.loads(path.read_text())["controller"]["parameters"]["ki"] == 0.1
    page.get_by_role("button", name="Read the file again").click()
    expect(typed(page, "Integral gain")).to_have_value("0.1", timeout=WAIT_MS)
    page.get_by_role("button", name="Write to the actuator file").click()
    expect(page.get_by_text(re.compile("^Written to"))).to_be_visible(timeout=WAIT_MS)


def test_the_step_is_shown_until_a_slow_loop_settles(path: Path) -> None:
    for ki in (2.0, 0.3):  # before, 2 s and 10 s were shown, in which the output reached 0.6 of it
        step = ask(path, "design-loop", **{**GAINS, "kp": 0.0, "kd": 0.0, "ki": ki})["step"]
        late = abs(step["measured"][-1] - step["reference"][-1])
        assert late < 0.02 * abs(step["reference"][-1])
