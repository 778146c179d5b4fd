"""The answer of `haselab sense`, part by part: rows of a CSV file, JSON, and a summary."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from haselab.base import JsonObject, to_plain
from haselab.sensing import Sensed, reason_text, relative_capacitance

__all__ = [
    "COLUMNS",
    "BlockValidity",
    "CollectedColumns",
    "Columns",
    "CsvRows",
    "Summary",
    "columns_of",
    "json_parts",
]

Columns = dict[str, NDArray[np.float64]]

# The columns of the public contract, in its order; then further ones.
COLUMNS = (
    "time_s", "capacitance_f", "capacitance_std_f", "resistance_ohm", "relative_capacitance",
    "phase_rad", "v_pp_v", "i_pp_v", "valid", "resistance_std_ohm", "leakage_s", "leakage_std_s",
    "reason",
)  # fmt: skip
_SAMPLE = 1 << 17  # most valid blocks for the medians; at least half as many are used
_JSON_VALUES = 1 << 16
_NOTHING: Mapping[int, str] = MappingProxyType({})
_MOST_REASONS = 4  # in a warning
_MOST_CAUSES = 12  # models and causes in a summary
_SEEN_NUMBERS = re.compile(
    r" (at|of) [-\d.e]+ (ms|and [-\d.e]+ ms)| from [-\d.e]+ to [-\d.e]+ ms| of degree \d+|^by .*"
)


@dataclass(frozen=True)
class BlockValidity:
    """Validity of some blocks, and the reasons.

    Args:
        reason: 0 where a block is valid, else a sum of keys of `REASONS`. Shape `(blocks,)`.
        seen: as in `Sensed`.
    """

    reason: NDArray[np.uint8]
    seen: Mapping[int, str]

    def texts(self) -> list[tuple[bool, str]]:
        """Whether each block is valid, and why not, or the model other than the plain one."""
        words = {mask: (mask == 0, reason_text(mask)) for mask in set(self.reason.tolist())}
        rows = [words[mask] for mask in self.reason.tolist()]
        for block, text in self.seen.items():
            valid, known = rows[block]
            rows[block] = (valid, f"model: {text}" if valid else f"{known}: {text}")
        return rows


def columns_of(
    sensed: Sensed,
    *,
    time_s: NDArray[np.float64],
    volt_per_reading: float,
    frequency_hz: float,
    reactance_scale: float,
    capacitance_scale: float,
) -> Columns:
    """All columns but `valid` and `reason`; NaN for lost blocks."""
    relative = np.full(sensed.valid.shape, np.nan)
    shown = sensed.valid & np.isfinite(sensed.phase_rad)  # there is a phase only with a carrier
    relative[shown] = relative_capacitance(
        sensed.v_pp[shown],
        sensed.i_pp[shown],
        sensed.phase_rad[shown],
        frequency_hz=frequency_hz,
        reactance_scale=reactance_scale,
        capacitance_scale=capacitance_scale,
    )
    return {
        "time_s": time_s,
        "capacitance_f": sensed.capacitance_f,
        "capacitance_std_f": sensed.capacitance_std_f,
        "resistance_ohm": sensed.resistance_ohm,
        "relative_capacitance": relative,
        "phase_rad": sensed.phase_rad,
        "v_pp_v": sensed.v_pp * volt_per_reading,
        "i_pp_v": sensed.i_pp * volt_per_reading,
        "resistance_std_ohm": sensed.resistance_std_ohm,
        "leakage_s": sensed.leakage_s,
        "leakage_std_s": sensed.leakage_std_s,
    }


class CsvRows:
    """Writes rows as they come, with nine digits, far below the noise of any block.

    Args:
        file: a new text file.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._forms: dict[tuple[bool, str], str] = {}
        file.write(",".join(COLUMNS) + "\n")

    def write(
        self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str] = _NOTHING
    ) -> None:
        """Write the rows of some blocks."""
        rows = BlockValidity(reason, seen).texts()
        for row in set(rows) - set(self._forms):
            self._forms[row] = _row_form(*row)
        numbers = np.stack(list(columns.values()), axis=1)
        form = "".join([self._forms[row] for row in rows])
        self._file.write(form % tuple(numbers.ravel().tolist()))


def _row_form(valid: bool, words: str) -> str:
    """Format string of one row with these texts."""
    numbers = dict.fromkeys(COLUMNS, "%.9g")
    numbers |= {"time_s": "%.15g", "valid": str(int(valid)), "reason": _quoted(words)}
    return ",".join(numbers.values()) + "\n"


def _quoted(text: str) -> str:
    """Quote a text for CSV, and escape its % for a format string."""
    text = text.replace("%", "%%")
    return '"' + text.replace('"', '""') + '"' if "," in text or '"' in text else text


class CollectedColumns:
    """Keeps all columns in memory."""

    def __init__(self) -> None:
        self._columns: list[Columns] = []
        self._judged: list[BlockValidity] = []

    def write(
        self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str] = _NOTHING
    ) -> None:
        """Keep the columns of some blocks."""
        self._columns.append(columns)
        self._judged.append(BlockValidity(reason, seen))

    def column(self, name: str) -> NDArray[np.float64]:
        """Return one whole column; `valid` as 0 and 1."""
        if name == "valid":
            return np.concatenate([(each.reason == 0).astype(np.float64) for each in self._judged])
        return np.concatenate([columns[name] for columns in self._columns])

    def values(self, name: str) -> Iterator[list[Any]]:
        """Yield one column, some values at a time."""
        for columns, judged in zip(self._columns, self._judged, strict=True):
            words = judged.texts() if name == "reason" else []
            for k in range(0, judged.reason.size, _JSON_VALUES):
                part = slice(k, k + _JSON_VALUES)
                if name == "valid":
                    yield (judged.reason[part] == 0).astype(int).tolist()
                elif words:
                    yield [text for _, text in words[part]]
                else:
                    yield to_plain(columns[name][part])


def json_parts(answer: Mapping[str, Any], collected: CollectedColumns) -> Iterator[str]:
    """Yield one JSON document in parts: the answer, then every column as an array."""
    yield json.dumps(to_plain(answer), indent=2)[:-2]
    for name in COLUMNS:
        yield f',\n  "{name}": ['
        for k, values in enumerate(collected.values(name)):
            yield (", " if k else "") + json.dumps(values)[1:-1]
        yield "]"
    yield "\n}\n"


class _Median:
    """Median in bounded memory: of all values, or of every 2nd, 4th, ... of a long record."""

    def __init__(self) -> None:
        self._kept = np.empty(_SAMPLE)
        self._count, self._stride, self._seen = 0, 1, 0

    def add(self, values: NDArray[np.float64]) -> None:
        for k in range(0, values.size, _SAMPLE // 2):  # at most what fits after one thinning
            self._add(values[k : k + _SAMPLE // 2])

    def _add(self, values: NDArray[np.float64]) -> None:
        if self._count + values.size > _SAMPLE:
            kept = self._kept[: self._count : 2].copy()
            self._count, self._stride = kept.size, 2 * self._stride
            self._kept[: kept.size] = kept
        taken = values[-self._seen % self._stride :: self._stride]
        self._seen += values.size
        self._kept[self._count : self._count + taken.size] = taken
        self._count += taken.size

    def value(self) -> float:
        return float(np.median(self._kept[: self._count])) if self._count else float("nan")


class Summary:
    """Counts and medians over all blocks, in bounded memory."""

    def __init__(self) -> None:
        self.blocks = 0
        self.valid_blocks = 0
        self.largest_v = 0.0  # peak to peak
        self.masks: Counter[int] = Counter()
        self.seen: Counter[str] = Counter()
        self.models: Counter[str] = Counter()
        self._why: Counter[str] = Counter()
        self._capacitance_f, self._resistance_ohm = _Median(), _Median()

    def write(
        self, columns: Columns, reason: NDArray[np.uint8], seen: Mapping[int, str] = _NOTHING
    ) -> None:
        """Add some blocks."""
        valid = reason == 0
        self.blocks += valid.size
        v_pp = columns["v_pp_v"]
        self.largest_v = max(self.largest_v, float(np.max(v_pp, initial=0.0, where=v_pp > 0.0)))
        self.valid_blocks += int(valid.sum())
        counts = np.bincount(reason, minlength=256)
        self.masks.update({int(mask): int(counts[mask]) for mask in np.flatnonzero(counts) if mask})
        named = np.zeros(valid.size, dtype=bool)
        for block, text in seen.items():
            words = _SEEN_NUMBERS.sub("", text)
            if valid[block]:
                self.models[words] += 1
                continue
            named[block] = True
            known = reason_text(int(reason[block]))
            self.seen[words or known] += 1
            self._why[f"{known}: {words}" if words else known] += 1
        others = np.bincount(reason[~valid & ~named], minlength=256)
        self._why.update({reason_text(int(k)): int(others[k]) for k in np.flatnonzero(others)})
        self._capacitance_f.add(columns["capacitance_f"][valid])
        self._resistance_ohm.add(columns["resistance_ohm"][valid])

    def answer(self, method: str) -> JsonObject:
        """The results that describe the record as a whole."""
        others = sum(self.models.values())
        models = Counter({"plain": self.valid_blocks - others}) + self.models
        return {
            "method": method,
            "blocks": self.blocks,
            "valid_blocks": self.valid_blocks,
            "median_capacitance_f": self._capacitance_f.value(),
            "median_resistance_ohm": self._resistance_ohm.value(),
            "invalid": {reason_text(mask): count for mask, count in self.masks.most_common()},
            "seen": dict(self.seen.most_common(_MOST_CAUSES)),
            "models": dict(models.most_common(_MOST_CAUSES)),
        }

    def why_not(self) -> str:
        """Why blocks are not valid, the most frequent reasons first."""
        return "; ".join(f"{count} {text}" for text, count in self._why.most_common(_MOST_REASONS))
