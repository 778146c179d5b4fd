"""Every page fits a desktop, a tablet and a telephone, also after it was turned."""

import json
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from tests.panel.pages.test_design import CONTROLLER, MODEL
from tests.panel.pages.test_pick import WAIT_MS, clip
from tests.panel.running import ended, started

WIDTHS = (1280, 820, 390)
LONG = "2026-01-31_20-30-00_reference-study-of-the-second-sheet"
# What is wider than its place, or under STOP where STOP has a column of its own.
TOO_WIDE = """() => {
  const stop = document.getElementById("emergency").getBoundingClientRect();
  const root = document.documentElement, found = [];
  const column = stop.width < innerWidth / 2 ? stop.left : innerWidth;
  const about = (one) => `${one.tagName}.${one.className} "${one.textContent.slice(0, 30)}"`;
  const hidden = (one) => one.getBoundingClientRect().width === 0
    || one.closest("svg, .uplot *") || one.closest("thead")?.offsetWidth === 1;
  const own = "main, .tab, .card, .layout, section, table, fieldset";
  if (root.scrollWidth > root.clientWidth) found.push(`page: ${root.scrollWidth}`);
  for (const one of document.querySelectorAll("#panel *")) {
    const right = one.getBoundingClientRect().right;
    if (hidden(one)) continue;
    if (right > column + 0.5) found.push(`${about(one)}: ${right} > ${column}`);
    else if (one.matches(own) && one.scrollWidth > one.clientWidth + 1) {
      found.push(`${about(one)} scrolls: ${one.scrollWidth} > ${one.clientWidth}`);
    }
  }
  return found;
}"""


def expect_fit(page: Page, what: str) -> None:
    """Expect that all fits; the plots follow a new size a moment later."""
    found: list[str] = []
    for _ in range(50):
        found = page.evaluate(TOO_WIDE)
        if not found:
            return
        page.wait_for_timeout(100)
    pytest.fail(f"{what}: {found[:8]}")


def record(runs: Path, name: str, value: float) -> None:
    folder = runs / name
    folder.mkdir(parents=True)
    (folder / "session.h5").touch()
    manifest = {"format": "haselab manifest 1", "state": "SEALED", "ended": "complete"}
    manifest |= {"opened": "2026-01-31T20:30:00+00:00"}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    about = {"id": "voltage_map", "name": "Voltage map, first coefficient", "unit": "1/V^2"}
    measured = {"value": value, "std": 0.05, "ci95": [value - 0.1, value + 0.1]}
    results = {"quantities": [{**about, "measured": measured}]}
    (folder / "results.json").write_text(json.dumps(results))


@pytest.mark.parametrize("first", [1280])
def test_every_page_fits_also_after_it_was_turned(
    browser: Browser, tmp_path: Path, first: int
) -> None:
    actuator, runs = tmp_path / "actuator.toml", tmp_path / "runs"
    actuator.write_text(MODEL + CONTROLLER)
    clip(runs / f"{LONG}-0" / "a-video-with-a-long-name-of-the-second-camera.mkv")
    for number, value in ((1, -1.0), (2, -1.001)):
        record(runs, f"{LONG}-{number}", value)
    panel = started("--actuator", str(actuator), "--runs", str(runs))
    widths = sorted(WIDTHS, reverse=first == max(WIDTHS))
    try:
        with browser.new_context(viewport={"width": first, "height": 1000}) as context:
            page = context.new_page()
            page.set_default_timeout(WAIT_MS)

            def check(name: str) -> None:
                for width in widths:
                    page.set_viewport_size({"width": width, "height": 1000})
                    expect_fit(page, f"{name} at {width} px after {first} px")
                page.set_viewport_size({"width": first, "height": 1000})

            page.goto(panel.address)
            expect(page.locator("#age")).to_have_text("data live", timeout=WAIT_MS)
            check("Live")
            page.get_by_role("button", name="Arm the bench").click()
            page.get_by_label("Highest drive of this run").fill("0,2")
            check("Live while arming")
            page.get_by_label("Highest drive of this run").fill("1")
            page.get_by_role("button", name="Arm", exact=True).click()
            expect(page.get_by_text("Armed by this page")).to_be_visible(timeout=WAIT_MS)
            check("Live when armed")
            page.get_by_role("button", name="Disarm").click()
            page.get_by_role("button", name="Studies").click()
            expect(page.get_by_label(f"Mark {LONG}-1")).to_be_visible(timeout=WAIT_MS)
            page.get_by_role("button", name="Check, then play").click()
            expect(page.get_by_text("The bench can play this study")).to_be_visible(timeout=WAIT_MS)
            for number in (1, 2):
                page.get_by_label(f"Mark {LONG}-{number}").check()
            page.get_by_role("button", name="Compare the two").click()
            expect(page.get_by_role("heading", name="Comparison")).to_be_visible(timeout=WAIT_MS)
            expect(page.get_by_text(f"Difference: {LONG}-2 minus {LONG}-1")).to_be_visible()
            expect(page.get_by_role("cell", name="0.0", exact=True)).to_be_visible()  # not -0.0
            check("Studies")
            page.get_by_role("button", name="Pick").click()
            video = page.get_by_label("Video")
            expect(video.locator("option")).to_have_count(2, timeout=WAIT_MS)
            check("Pick without a picture")
            video.select_option(index=1)
            expect(page.get_by_role("application")).to_be_visible(timeout=WAIT_MS)
            page.get_by_role("application").click(position={"x": 50, "y": 50})
            expect(page.locator(".marks button")).to_have_count(1, timeout=WAIT_MS)
            check("Pick")
            page.get_by_role("button", name="Design").click()
            expect(page.get_by_text("plausible plants")).to_be_visible(timeout=WAIT_MS)
            check("Design")
            page.get_by_role("button", name="Doctor").click()
            expect(page.get_by_text("checks").first).to_be_visible(timeout=WAIT_MS)
            expect(page.get_by_role("button", name="Check again")).to_be_visible(timeout=WAIT_MS)
            check("Doctor")
    finally:
        ended(panel)
