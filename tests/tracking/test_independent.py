"""Dots that do not move together: `--model auto` follows each by itself and loses none."""

from importlib import import_module

import pytest

NAMES = [
    "Brownian dots, 0.2 px",
    "halves that slide apart by 0.2 px a frame",
    "shear band",
    "wave of 126 px",
]


@pytest.mark.long
@pytest.mark.parametrize("name", NAMES)
def test_dots_that_move_independently_are_neither_lost_nor_wrong(benchmarks, name):
    clips, difficult = (
        import_module("benchmarks.tracking.difficult_clips"),
        import_module("benchmarks.tracking.difficult"),
    )
    case = next(case for case in clips.cases() if case.name.startswith(name))
    score = difficult.compare(case, libraries=False)["haselab"]
    assert score.wrong == 0.0
    assert score.lost <= 0.02
    assert score.rms < 0.03


@pytest.mark.long
def test_dots_that_pass_each_other_keep_their_names(benchmarks):
    clips, difficult = (
        import_module("benchmarks.tracking.difficult_clips"),
        import_module("benchmarks.tracking.difficult"),
    )
    case = next(case for case in clips.cases() if case.name.startswith("layers"))
    score = difficult.compare(case, libraries=False)["haselab"]
    assert score.wrong == 0.0
    assert 0.8 < score.ratio < 1.25
