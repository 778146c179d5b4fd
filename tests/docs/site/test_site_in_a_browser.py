"""The site in Chromium, opened as a file: search, accessibility, and no request to anywhere."""

from __future__ import annotations

from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, expect

WIDE, PHONE = {"width": 1400, "height": 900}, {"width": 390, "height": 844}
NO_PRELOAD = {"preload": False}  # axe would request the style sheets, which a file may not
SECTIONS = (
    "docs/index.html", "docs/start/your-own-csv.html", "docs/how-to/index.html",
    "docs/measure/sensing.html", "docs/concepts/what-an-interval-means.html",
    "docs/identify/which-model.html", "docs/reference/commands/sense.html",
    "docs/reference/api/haselab.sensing.html", "docs/reference/files.html", "docs/gallery.html",
    "ARCHITECTURE.html", "_modules/haselab/identify/creep/fit.html",
)  # fmt: skip


def _watched(page: Page) -> list[str]:
    """Errors of the console, and requests for anything but a file."""
    problems: list[str] = []
    page.on("console", lambda said: problems.append(said.text) if said.type == "error" else None)
    page.on("request", lambda sent: None if sent.url.startswith(("file:", "data:"))
            else problems.append(sent.url))  # fmt: skip
    return problems


def test_the_search_finds_a_word_without_a_server(browser: Browser, site: Path) -> None:
    page = browser.new_page()
    problems = _watched(page)
    page.goto((site / "index.html").as_uri())
    expect(page.locator("h1")).to_contain_text("haselab")  # the root leads to the first page
    page.keyboard.press("Control+k")
    page.locator("dialog input[type=search]").fill("capacitance")
    page.keyboard.press("Enter")
    # The results appear one by one.
    expect(page.locator("#search-results li a[href*='/measure/sensing.html']")).not_to_have_count(0)
    page.locator("#search-results li a").first.click()
    expect(page.locator("h1").first).to_be_visible()
    assert not problems


FIRST = {
    "install": "start/install",
    "CSV": "start/your-own-csv",
    "bode": "start/your-own-csv",
    "video": "start/your-own-video",
    "PID": "control/control",
    "firmware": "control/firmware",
    "hysteresis": "identify/hysteresis-and-creep",
    "National Instruments": "hardware",
    "quick start": "start/twin-in-five-minutes",
    "emergency stop": "bench/safety",
    "creep": "concepts/why-creep",
    "uncertainty": "concepts/what-an-interval-means",
    "ESP32": "hardware",
    "--count": "reference/commands/track",
    "delay-s": "reference/commands/design",
}


def test_the_search_shows_guides_before_the_api_and_the_history(
    browser: Browser, site: Path
) -> None:
    page = browser.new_page()
    for words, guide in FIRST.items():
        page.goto(f"{(site / 'search.html').as_uri()}?q={words}")
        expect(page.locator("#search-results h2")).to_have_text("Search Results")
        found = page.locator("#search-results li > a").evaluate_all("all => all.map(a => a.href)")
        assert any(f"docs/{guide}.html" in address for address in found[:3]), (words, found[:5])
    page.close()


@pytest.mark.parametrize(
    "size", [WIDE, pytest.param(PHONE, marks=pytest.mark.slow)], ids=["wide", "phone"]
)
def test_no_page_of_a_section_has_a_serious_barrier(
    browser: Browser, site: Path, size: dict[str, int]
) -> None:
    for scheme in ("light", "dark"):
        with browser.new_context(viewport=size, color_scheme=scheme) as context:  # type: ignore[arg-type]
            page = context.new_page()
            problems = _watched(page)
            for name in SECTIONS if scheme == "light" else SECTIONS[:4]:
                page.goto((site / name).as_uri())
                grave = [
                    f"{each['id']}: {each['nodes'][0]['html']}"
                    for each in Axe().run(page, options=NO_PRELOAD).response["violations"]
                    if each["impact"] in ("serious", "critical")
                ]
                assert not grave, f"{name}, {scheme}: {grave}"
                wide = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
                assert page.evaluate(wide) <= 0, f"{name} is wider than the window"
            assert not problems
