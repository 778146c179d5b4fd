"""docs/identify/published-records.md: each figure of haselab in it, and the differences."""

from __future__ import annotations

import re

import pytest

from haselab.base import LimitError
from tests.docs.page import Page

PAGE = Page("identify/published-records.md")
ROW = re.compile(
    r"\| (A|B) \| (\d+) V, ([\d.]+) N \| ([\d.]+) \| ([\d.]+) \| ([^|]*) \| ([^|]*) \|\n"
)


@pytest.fixture(scope="module")
def names() -> dict[str, object]:
    return PAGE.execute(PAGE.python[0])


def test_the_code_prints_what_the_page_shows(capsys: pytest.CaptureFixture[str]) -> None:
    PAGE.execute(PAGE.python[0])
    (shown,) = re.findall(r"```text\n(.*?)```", PAGE.text, re.DOTALL)
    assert capsys.readouterr().out == shown


def test_every_stroke_of_the_table_is_that_of_the_law(names) -> None:
    rows = ROW.findall(PAGE.text)
    assert len(rows) == 12
    for which, volt, load, published, ideal, own, difference in rows:
        law, voltage_v, load_n = names[which], float(volt), float(load)
        found_mm = 1e3 * names["ideal_stroke_m"](law, voltage_v, load_n)
        assert f"{found_mm:.2f}" == ideal
        if own.strip() == "outside the valid range":
            with pytest.raises(LimitError, match="no equilibrium"):
                names["law_stroke_m"](law, voltage_v, load_n)
            continue
        own_mm = 1e3 * names["law_stroke_m"](law, voltage_v, load_n)
        assert f"{own_mm:.2f}" == own
        assert f"{100.0 * (own_mm / float(published) - 1.0):+.0f} %" == difference


def test_the_angle_at_rest_and_the_blocked_forces_are_those_of_the_page(names) -> None:
    assert f"{names['B'].pouch.rest_angle_rad:.5f} rad" in PAGE.text
    for law in (names["A"], names["B"]):
        blocked_n = float(law.ideal_force_n(law.pouch.rest_angle_rad, 6e3))
        assert round(blocked_n) == 51
