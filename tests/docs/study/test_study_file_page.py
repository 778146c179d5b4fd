"""The page on study files has every key of every table as the code checks it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from haselab.store.keys import describe_key
from haselab.store.toml import Section
from haselab.study.definition import load_study
from haselab.study.registry import EXPERIMENTS
from haselab.study.tables import OperatingPoint, Sensing, StepTrials

TEXT = (Path(__file__).resolve().parents[3] / "docs" / "study" / "study-file.md").read_text()
HEAD = "| key | unit | default | range | meaning |\n|---|---|---|---|---|\n"


def tables() -> dict[str, type[Section]]:
    """Every table that a study file of haselab's own experiments may have."""
    found: dict[str, type[Section]] = {"sensing": Sensing, "operating_point": OperatingPoint}
    for name in EXPERIMENTS.packages():
        found.setdefault(name, EXPERIMENTS.find(name).settings_type)
    return {**found, "step_trials": StepTrials}


def rows_of(model: type[Section]) -> str:
    """The table of the page for one table of the file."""
    keys = [describe_key(name, field) for name, field in model.model_fields.items()]
    return HEAD + "".join(
        f"| `{key.name}` | {key.unit} | {'required' if key.required else key.default or 'none'} "
        f"| {key.values} | {key.meaning} |\n"
        for key in keys
    )


def test_the_page_has_a_heading_for_every_table_and_no_others() -> None:
    assert re.findall(r"^### `\[(\w+)\]`", TEXT, re.MULTILINE) == list(tables())


@pytest.mark.parametrize("name", tables())
def test_each_key_is_on_the_page_as_the_code_checks_it(name: str) -> None:
    section = TEXT.split(f"### `[{name}]`")[1].split("\n#")[0]
    assert rows_of(tables()[name]) in section


@pytest.mark.parametrize("name", tables())
def test_each_key_states_its_meaning_and_each_required_one_an_example(name: str) -> None:
    for key_name, field in tables()[name].model_fields.items():
        key = describe_key(key_name, field)
        assert key.meaning, key_name
        assert key.example or not key.required, key_name
    required = {
        name: field.examples[0]
        for name, field in tables()[name].model_fields.items()
        if field.is_required() and field.examples
    }
    tables()[name].model_validate(required)  # the examples are valid together


def test_the_study_of_the_page_can_be_read(tmp_path: Path) -> None:
    (code,) = re.findall(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "study.toml").write_text(code)
    assert load_study(tmp_path / "study.toml", quick=True).triangle.cycles == 2
    assert load_study(tmp_path / "study.toml").triangle.cycles == 5
