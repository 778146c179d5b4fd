"""Read analysis.json section by section, with an error for each missing or invalid value."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = ["Array", "LeftOutError", "Section"]

Array = NDArray[np.float64]


class LeftOutError(InputError):
    """A figure cannot be drawn from the folder; the page shows the message as a note."""


class Section:
    """One mapping of analysis.json.

    Args:
        name: its place in the file, such as `chirp.fits`.
        data: the parsed mapping.

    Example:
        >>> section = Section("triangle", {"time_s": [0.0, 1.0], "strain": [0.0, None]})
        >>> section.array("strain", like=section.array("time_s"))
        array([ 0., nan])
    """

    def __init__(self, name: str, data: Any) -> None:
        if not isinstance(data, Mapping):
            raise LeftOutError(f"'{name}' in analysis.json is not a mapping.")
        self.name = name
        self._data = data

    def __contains__(self, key: str) -> bool:
        return self._data.get(key) is not None

    def _item(self, key: str) -> Any:
        if key not in self:
            raise LeftOutError(f"'{self.name}' in analysis.json has no '{key}'.")
        return self._data[key]

    def array(self, key: str, *, like: Array | None = None) -> Array:
        """A list of numbers; null becomes NaN.

        Args:
            key: name in the section.
            like: another array whose length it must have.

        Returns:
            Shape `(N,)`.

        Raises:
            LeftOutError: missing, not numbers, none of them finite, or of another length.
        """
        item = self._item(key)
        try:
            values = np.asarray(item, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise LeftOutError(
                f"'{self.name}.{key}' in analysis.json contains something other than numbers."
            ) from error
        if values.ndim != 1 or values.size == 0:
            raise LeftOutError(f"'{self.name}.{key}' in analysis.json is not a list of numbers.")
        if not np.isfinite(values).any():
            raise LeftOutError(f"'{self.name}.{key}' in analysis.json has no finite number.")
        if like is not None and values.shape != like.shape:
            raise LeftOutError(
                f"'{self.name}.{key}' in analysis.json has {values.size} values for {like.size}."
            )
        return values

    def optional(self, key: str, *, like: Array | None = None) -> Array | None:
        """A list of numbers, or `None` if the file has no such key or no number in it."""
        values = self._data.get(key)
        if values is None or (isinstance(values, list) and all(v is None for v in values)):
            return None
        return self.array(key, like=like)

    def rows(self, key: str, *, length: int | None = None) -> Array:
        """A list of equally long lists of numbers, shape `(rows, columns)`."""
        item = self._item(key)
        try:
            values = np.asarray(item, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise LeftOutError(f"'{self.name}.{key}' in analysis.json is not a table.") from error
        if values.ndim != 2 or values.size == 0 or length not in (None, values.shape[1]):
            raise LeftOutError(f"'{self.name}.{key}' in analysis.json has shape {values.shape}.")
        return values

    def number(self, key: str) -> float:
        """One number."""
        value = self._item(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise LeftOutError(f"'{self.name}.{key}' = {value!r} in analysis.json is not a number.")
        return float(value)

    def text(self, key: str) -> str:
        """A text; empty if the file has none."""
        value = self._data.get(key)
        return value if isinstance(value, str) else ""

    def flag(self, key: str) -> bool:
        """Whether the file says true."""
        return self._data.get(key) is True

    def section(self, key: str) -> Section:
        """A mapping inside this one."""
        return Section(f"{self.name}.{key}", self._item(key))

    def sections(self, key: str) -> dict[str, Section]:
        """A mapping of mappings, or a list of them named by their place from 1; may be empty."""
        if key not in self:
            return {}
        items = self._data[key]
        if not isinstance(items, (Mapping, list)):
            raise LeftOutError(
                f"'{self.name}.{key}' in analysis.json is neither a mapping nor a list."
            )
        named = items.items() if isinstance(items, Mapping) else enumerate(items, start=1)
        return {str(name): Section(f"{self.name}.{key}.{name}", item) for name, item in named}
