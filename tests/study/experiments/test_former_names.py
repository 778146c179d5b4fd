"""Keys of a study that were renamed: a file is refused with the new name, a recording is read."""

from __future__ import annotations

from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.store.toml import toml_text
from haselab.study.definition import builtin_study, checked_study, load_study, recorded_study
from haselab.study.tables import StaticLoad, Steps, Triangle

FORMER = [
    (table, former, name)
    for table, kind in (("triangle", Triangle), ("static_load", StaticLoad), ("steps", Steps))
    for former, name in kind.former_names.items()
]


def test_every_new_name_is_a_key() -> None:
    assert len(FORMER) == 5
    kinds = {"triangle": Triangle, "static_load": StaticLoad, "steps": Steps}
    for table, former, name in FORMER:
        assert name in kinds[table].model_fields and former not in kinds[table].model_fields


@pytest.mark.parametrize(("table", "former", "name"), FORMER)
def test_a_file_with_a_former_key_is_refused_with_the_new_name(
    tmp_path: Path, table: str, former: str, name: str
) -> None:
    tables = builtin_study().model_dump(mode="json")
    tables[table][former] = tables[table].pop(name) or 2
    path = tmp_path / "study.toml"
    path.write_text(toml_text(tables))
    said = rf"{table}\.{former}: no such key; it is now called {name}"
    with pytest.raises(InputError, match=said):
        load_study(path)


def test_a_recording_with_former_keys_is_read() -> None:
    study = builtin_study()
    tables = study.model_dump(mode="json")
    for table, former, name in FORMER:
        tables[table][former] = tables[table].pop(name)
    with pytest.raises(InputError, match="now called"):
        checked_study(tables, "header")
    assert checked_study(recorded_study(tables), "header") == study
