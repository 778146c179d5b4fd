"""The folder of a campaign: what it is, and the final table."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, Json, JsonObject
from haselab.campaign.definition import Campaign
from haselab.campaign.plan import Plan
from haselab.store.campaign.shards import CaseRow, Shards
from haselab.store.claim import is_occupied, not_written
from haselab.store.folder import drafted, json_text, read_json, write_new, write_text
from haselab.store.optional import library

__all__ = [
    "CAMPAIGN", "FAILED", "TABLE", "changes_of", "described_in", "doubts_about", "finished_rows",
    "open_folder", "plan_of", "read_results", "table_checksum", "write_table",
]  # fmt: skip

CAMPAIGN, DESIGN, SUMMARY = "campaign.json", "design.npy", "summary.json"
TABLE, FAILED = "results.parquet", "failed.txt"
_MOST_SHOWN = 3
_ROWS_IN_GROUP = 50_000


def plan_of(campaign: Campaign, folder: Path) -> Plan:
    """The cases of a campaign; the points that a folder has for it are not drawn again.

    Args:
        campaign: checked.
        folder: new, or of this or another campaign.
    Returns:
        The plan.
    Raises:
        InputError: a drawn value is outside the limits of its key; a library is missing.
    """
    drawn = None
    with contextlib.suppress(InputError, OSError, ValueError, EOFError):
        if read_json(folder / CAMPAIGN) == campaign.described():
            drawn = np.load(folder / DESIGN)
    shape = (campaign.points, len(campaign.distributions))
    return Plan(campaign, drawn if drawn is not None and drawn.shape == shape else None)


def open_folder(plan: Plan, folder: Path) -> None:
    """Begin or continue a folder.

    Args:
        plan: of the campaign.
        folder: new, empty, or of the same campaign.
    Raises:
        InputError: it holds something else, or pyarrow is not installed.
        DeviceError: the disk refuses.
    """
    library("pyarrow", "campaign")  # before anything is written
    described = plan.campaign.described()
    if not (folder / CAMPAIGN).exists():
        others = is_occupied(folder) and any(
            not each.name.startswith(".") for each in folder.iterdir()
        )
        if others and not (folder / CAMPAIGN).exists():  # another program may begin it now
            raise InputError(
                "--out names a folder that is not empty and has no campaign; it was not changed. "
                f"Name a new folder, or add --force to move this one aside. {folder}"
            )
        with contextlib.suppress(InputError):  # another program has just begun it
            write_new(folder / CAMPAIGN, json_text(described))
        _save_design(plan, folder / DESIGN)
    found = read_json(folder / CAMPAIGN)
    changes = changes_of(found, described)
    if changes:
        shown = "; ".join(changes[:_MOST_SHOWN])
        more = f"; and {len(changes) - _MOST_SHOWN} more" if len(changes) > _MOST_SHOWN else ""
        raise InputError(
            f"--out holds another campaign, which was not changed: {shown}{more}. Name a new "
            f"folder, or add --force to move this one aside. {folder}"
        )


def _save_design(plan: Plan, path: Path) -> None:
    """Keep the drawn points: to draw them takes longer than all else at the next start."""
    try:
        with drafted(path) as draft:
            np.save(draft, plan.drawn)
    except OSError as error:
        raise not_written(path, error) from None


def changes_of(old: Json, new: Json, path: str = "") -> list[str]:
    """Say in which values two tables differ.

    Args:
        old: table that the texts call "there".
        new: table that the texts call "here".
        path: prefix of the names in the texts.
    Returns:
        One text for each value that differs.
    """
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        names = dict.fromkeys([*new, *old])
        inner = [(f"{path}.{name}" if path else name, name) for name in names]
        return [
            change for where, name in inner
            for change in changes_of(old.get(name), new.get(name), where)
        ]  # fmt: skip
    if old == new:
        return []
    name = path.removeprefix("tables.")  # as in the campaign file
    return [f"{name} is {_short(old)} there and {_short(new)} here"]


def _short(value: Json) -> str:
    text = "missing" if value is None else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def finished_rows(plan: Plan, folder: Path) -> list[CaseRow]:
    """Rows of the finished cases in the order of their indices, with parameters and results.

    Args:
        plan: of the campaign.
        folder: with the shards.
    Returns:
        The rows.
    Raises:
        InputError: a shard is damaged.
    """
    return Shards(folder, "").rows(plan.hashes(), plan.paths)


def write_table(plan: Plan, rows: Sequence[CaseRow], folder: Path) -> None:
    """Write the final table and the list of failed cases.

    The bytes of both depend on the campaign alone: not on the order in which the cases were
    computed, nor on where.

    Args:
        plan: of the campaign.
        rows: of all its cases.
        folder: of the campaign.
    Raises:
        DeviceError: the disk refuses.
    """
    arrow: Any = library("pyarrow", "campaign")
    parquet: Any = library("pyarrow.parquet", "campaign")
    columns: dict[str, list[Json]] = {
        "case": [row.case for row in rows],
        "index": [row.index for row in rows],
        **{path: [row.values[path] for row in rows] for path in plan.paths},
        "status": [row.status for row in rows],
        "error": [row.error for row in rows],
    }
    for name in sorted({name for row in rows for name in row.results}):
        columns[name] = [row.results.get(name) for row in rows]
    try:
        with drafted(folder / TABLE) as draft:
            parquet.write_table(
                arrow.table(columns), draft, compression="zstd", row_group_size=_ROWS_IN_GROUP,
                write_page_checksum=True,
            )  # fmt: skip
    except OSError as error:
        raise not_written(folder / TABLE, error) from None
    write_text(folder / FAILED, "\n".join(_failures(rows)))


def read_results(folder: Path) -> dict[str, NDArray[np.float64]]:
    """Read the numbers of a finished campaign.

    Args:
        folder: of the campaign.
    Returns:
        Results of all its cases by name; NaN where a case has none.
    Raises:
        InputError: the folder has no table of results, or a damaged one.
    """
    path = folder / TABLE
    if not path.is_file():
        raise InputError(
            f"This folder has no {TABLE}, so there is no finished campaign to compare with. Name "
            f"the folder of one. {folder}"
        )
    arrow: Any = library("pyarrow", "campaign")
    parquet: Any = library("pyarrow.parquet", "campaign")
    try:
        table = parquet.read_table(path, page_checksum_verification=True)
        table.validate(full=True)
    except (arrow.ArrowException, OSError, ValueError) as error:
        text = " ".join(str(error).split())[:200]
        raise InputError(f"Not a table of a campaign ({text}). {path}") from None
    about = _summary_of(folder)
    if "table_crc32" in about and about["table_crc32"] != table_checksum(folder):
        raise InputError(
            f"{TABLE} is not the table of summary.json in this folder: one of them is damaged or "
            f"older. Start the command of that campaign again, and then this one. {path}"
        )
    return {
        name: table.column(name).to_numpy(zero_copy_only=False).astype(np.float64)
        for name in table.column_names if table.schema.field(name).type == arrow.float64()
    }  # fmt: skip


def table_checksum(folder: Path) -> str:
    """CRC-32 of the final table, in hexadecimal digits, for `summary.json`.

    The checksums of Parquet leave out the names of the columns.

    Args:
        folder: of a finished campaign.
    """
    return f"{zlib.crc32((folder / TABLE).read_bytes()):08x}"


def _summary_of(folder: Path) -> Mapping[str, Json]:
    """The summary in a folder; an empty one if there is none that can be read."""
    with contextlib.suppress(InputError, OSError):
        if isinstance(found := read_json(folder / SUMMARY), dict):
            return found
    return {}


def doubts_about(folder: Path, code: str) -> list[str]:
    """Why the results in a folder may not be those that its campaign would give now.

    Args:
        folder: of a campaign that was finished once.
        code: version of the code here, see `Plan.code`.
    Returns:
        One text for each reason: another version of the code, no summary, or finished cases that
        are not in the table.
    Raises:
        InputError: a shard is damaged.
    """
    there = _summary_of(folder).get("code")
    found = list[str]()
    if there is None:
        found.append("its summary.json is missing or unreadable, so the version of its code is "
                     "unknown")  # fmt: skip
    elif there != code:
        found.append(f"it was computed by haselab {there}, and this one by haselab {code}")
    if count := _not_in_table(folder):
        found.append(
            f"its table lacks {count:,} cases that were finished later: start its command again"
        )
    return found


def _not_in_table(folder: Path) -> int:
    """Number of results in shards that are newer than the table and not in it."""
    table_s = (folder / TABLE).stat().st_mtime
    if all(path.stat().st_mtime <= table_s for path in (folder / "shards").glob("*.parquet")):
        return 0  # a copied folder may have other times, so that its table has to be read
    parquet: Any = library("pyarrow.parquet", "campaign")
    table = parquet.read_table(folder / TABLE).to_pydict()
    listed = dict(zip(table.get("case", ()), table.get("status", ()), strict=False))
    return sum(
        case not in listed or (listed[case] != "ok" and not state.failed)
        for case, state in Shards(folder, "").states().items()
    )


def described_in(folder: Path) -> JsonObject:
    """What determines the results of a campaign.

    Args:
        folder: of the campaign.
    Returns:
        Its `Campaign.described`.
    Raises:
        InputError: the folder has no campaign, or a damaged one.
    """
    found = read_json(folder / CAMPAIGN)
    if not isinstance(found, dict) or not {"design", "parameters"} <= set(found):
        raise InputError(f"Not the file of a campaign. Name another folder. {folder / CAMPAIGN}")
    return found


def _failures(rows: Sequence[CaseRow]) -> list[str]:
    lines = []
    for row in rows:
        if row.error:
            values = ", ".join(f"{path} = {value!r}" for path, value in row.values.items())
            lines += [f"case {row.index} ({row.case}): {values}", row.traceback.rstrip(), ""]
    return lines
