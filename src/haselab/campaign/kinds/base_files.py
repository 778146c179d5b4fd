"""The files that cases start from, as tables with all their keys."""

from __future__ import annotations

from pathlib import Path

from haselab.base import JsonObject
from haselab.campaign.kinds.case_kind import BaseFile, Inputs
from haselab.rig.twin.config import READINGS, TwinConfig, twin_of_reading
from haselab.rig.twin.twin_file import load_twin
from haselab.store.toml import validated

__all__ = ["LABELS", "TWIN", "twin_of"]

#: Keys of a twin without effect; `reading` chooses values when the file is read, before a case.
LABELS = ("twin.name", "twin.reading", "twin.amplifier.name")


def _twin(source: str, folder: Path) -> JsonObject:
    twin = twin_of_reading(source) if source in READINGS else load_twin(folder / source)
    return twin.model_dump(mode="json", exclude={"origin"})


TWIN = BaseFile("twin", "hz", _twin)


def twin_of(inputs: Inputs) -> TwinConfig:
    """The twin of a case.

    Args:
        inputs: of the case.
    Returns:
        Its checked configuration.
    Raises:
        InputError: an unknown key, or a value out of range.
    """
    return validated(TwinConfig, inputs.tables["twin"], "", "twin")
