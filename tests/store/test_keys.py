"""A missing key is explained: which table, what it means, its unit and range, an example."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args

import pytest
from pydantic import BaseModel, Field

from haselab.base import InputError
from haselab.models.actuator.model_tables import PlantTable, PolesTable
from haselab.models.actuator.sections import ActuatorTables
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile
from haselab.rig.instruments.registry import INSTRUMENTS
from haselab.rig.instruments.sections import InstrumentConfig
from haselab.rig.rig_file import ReplayFile, TwinFile
from haselab.rig.twin.config import TwinConfig
from haselab.safety.rig_limits import RatingSection, SafetySection
from haselab.store.keys import describe_key
from haselab.store.toml import Section, validated


class _Inner(Section):
    """Where the beam is clamped."""

    hold_s: float = Field(gt=0, le=10, description="length of the hold", examples=[2.5])
    count: int = Field(ge=1, le=9, description="number of holds", examples=[3])
    form: Literal["sine", "square"]
    plain_m: float


class _File(Section):
    clamp: _Inner


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("hold_s", r"hold_s \(length of the hold, in s, above 0 and at most 10, for example "
         r"hold_s = 2\.5\)\. x\.toml$"),
        ("count", r"count \(number of holds, a whole number, 1 to 9, for example count = 3\)\. x"),
        ("form", r'form \("sine" or "square", for example form = "sine"\)\. x'),
        ("plain_m", r"plain_m \(in m\)\. x"),
    ],
)  # fmt: skip
def test_a_missing_key_is_explained(key: str, message: str) -> None:
    whole = {"hold_s": 1.0, "count": 1, "form": "sine", "plain_m": 1.0}
    del whole[key]
    with pytest.raises(InputError, match=rf"^1 error: \[clamp\] has no key {message}"):
        validated(_File, {"clamp": whole}, "x.toml")


def test_a_missing_table_is_explained_with_the_keys_that_it_needs() -> None:
    words = r"the file has no table \[clamp\] \(Where the beam is clamped; it needs the keys hold"
    with pytest.raises(InputError, match=words):
        validated(_File, {}, "x.toml")


def test_a_wrong_value_beside_a_missing_key_is_to_be_changed() -> None:
    given = {"clamp": {"hold_s": -1.0, "count": 1, "form": "sine"}}
    with pytest.raises(InputError, match=r"hold_s: .*has no key plain_m \(.*Change these values"):
        validated(_File, given, "x.toml")


def required(model: type[BaseModel]) -> Iterator[tuple[str, Any]]:
    """Every key without a default, of a table and of the tables in it."""
    for name, field in model.model_fields.items():
        kinds = [
            kind
            for kind in (field.annotation, *get_args(field.annotation))
            if isinstance(kind, type) and issubclass(kind, BaseModel)
        ]
        for kind in kinds:
            if kind is not model and not issubclass(kind, InstrumentConfig):  # see `every_table`
                yield from required(kind)
        if field.is_required() and not kinds:
            yield f"{model.__name__}.{name}", field


FILES = (BenchConfig, ReplayFile, TwinFile, ChipFile, TwinConfig, RatingSection, SafetySection,
         ActuatorTables, PolesTable, PlantTable)  # fmt: skip


def every_table() -> list[type[BaseModel]]:
    """Tables of rig, twin and actuator files; study files: tests/docs/study."""
    drivers = [INSTRUMENTS.find(kind).config for kind in INSTRUMENTS.packages()]
    return [*FILES, *drivers]


@pytest.mark.parametrize("model", every_table(), ids=lambda model: model.__name__)
def test_each_required_key_states_its_meaning_and_an_example(model: type[BaseModel]) -> None:
    for name, field in required(model):
        key = describe_key(name.partition(".")[2], field)
        assert key.example, name
        assert key.meaning or key.values, name
