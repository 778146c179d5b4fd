"""Results by name, and what is read from JSON and TOML files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from numpy.typing import NDArray

if TYPE_CHECKING:
    from haselab.base.estimate import Estimate

__all__ = ["Json", "JsonObject", "table_at"]

#: What `to_plain` turns into JSON: numbers, texts, estimates, arrays, and lists and tables of them.
Json: TypeAlias = (
    "bool | int | float | complex | str | Estimate | NDArray[Any] | Sequence[Json] | "
    "Mapping[str, Json] | None"
)
#: A table of these by name.
JsonObject: TypeAlias = "dict[str, Json]"


def table_at(data: Mapping[str, Json], *keys: str) -> Mapping[str, Json]:
    """A table within tables.

    Args:
        data: the outermost table.
        keys: names of the tables on the way.
    Returns:
        The table; an empty one where there is none.
    Example:
        >>> table_at({"rig": {"daq": {"rate_hz": 1.0}}}, "rig", "daq")
        {'rate_hz': 1.0}
        >>> table_at({"rig": None}, "rig", "daq")
        {}
    """
    for key in keys:
        found = data.get(key)
        data = found if isinstance(found, Mapping) else {}
    return data
