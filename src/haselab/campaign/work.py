"""What a worker does: compute cases. An exception becomes a failed case."""

from __future__ import annotations

import re
import time
import traceback
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from haselab.base import DeviceError, Estimate, Json, described, shown
from haselab.base.exits import no_exit
from haselab.campaign.definition import with_values
from haselab.campaign.kinds.case_kind import CASE_KINDS, Inputs
from haselab.campaign.plan import Job, Problem, code_of
from haselab.store.campaign.shards import KEYS, CaseRow

__all__ = ["compute_case", "compute_cases"]

_ADDRESS = re.compile(r"0x[0-9a-f]{6,}")  # differs between processes
_MOST_CHARACTERS = 500


def compute_cases(problem: Problem, jobs: Iterable[Job]) -> list[CaseRow]:
    """Compute some cases, one after the other.

    Args:
        problem: what they share.
        jobs: of them.
    Returns:
        Their rows.
    Raises:
        DeviceError: the code of this worker is not that of the program that sent the cases.
    """
    own = code_of(problem.kind)
    if own != problem.code:
        raise DeviceError(
            f"A worker has haselab {own}, but the campaign was started by {problem.code}. Install "
            "the same version on all computers, and do not change its source while it runs."
        )
    return [compute_case(problem, job) for job in jobs]


def compute_case(problem: Problem, job: Job) -> CaseRow:
    """Compute one case.

    Args:
        problem: what all cases share.
        job: the case.
    Returns:
        Its row; with the error if it failed.
    """
    start = time.perf_counter()
    error, trace, results = "", "", dict[str, Json]()
    try:
        with no_exit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results = _computed(problem, job)
    except Exception as failure:  # a case of another package may raise anything
        error = _storable(_ADDRESS.sub("0x...", described(failure)))[:_MOST_CHARACTERS]
        trace = _storable(traceback.format_exc())
    spent_s = time.perf_counter() - start
    return CaseRow(
        job.case, job.index, dict(job.values), results, error, trace, job.attempt, spent_s
    )


def _storable(text: str) -> str:
    """The text with escapes for what UTF-8 does not have, such as a byte of a file's name."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _computed(problem: Problem, job: Job) -> dict[str, Json]:
    kind = CASE_KINDS.find(problem.kind)
    inputs = Inputs(with_values(problem.tables, job.values))
    seed = np.random.SeedSequence(problem.seed, spawn_key=job.key)
    found = kind.compute(inputs, np.random.default_rng(seed))
    if not isinstance(found, Mapping):
        raise TypeError(f"the case returned {type(found).__name__!r}, not results by name")
    columns: dict[str, Json] = {}
    for name, value in found.items():
        for column, number in _columns(str(name), value).items():
            if not column or column in {*KEYS, *job.values, *columns}:
                raise ValueError(f"the table cannot have the result {column!r}, because it has a "
                                 "column of this name. Rename the result" if column else
                                 "a result has no name")  # fmt: skip
            column.encode()  # may raise: Parquet has names in UTF-8
            columns[column] = number
    return columns


def _columns(name: str, value: Any) -> dict[str, Json]:
    """Columns of the table for one result."""
    if isinstance(value, Estimate):
        low, high = value.ci95
        return {
            name: float(value.value), f"{name}.std": float(value.std),
            f"{name}.low": float(low), f"{name}.high": float(high),
        }  # fmt: skip
    if isinstance(value, (str, bytes)):  # float("7") is a number
        raise TypeError(f"the result {name!r} is the text {shown(value)}, not a number")
    return {name: float(value)}
