"""Columns of another tool's file as a session: codes, blocks, and where they came from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.store.columns.reader import ColumnStream, open_columns
from haselab.store.manifest import Manifest, sha256_of
from haselab.store.session.writer import ExperimentPlan, SessionWriter

__all__ = ["ImportPlan", "Imported", "import_session"]

_LARGEST = 32767
_PIECE_BLOCKS = 200


@dataclass(frozen=True)
class ImportPlan:
    """How columns become blocks.

    Args:
        experiment: name in the session.
        columns: of the voltage and the current monitor, in V.
        block_samples: samples per channel in one block.
        rate_hz: samples per second and channel; None: the file tells.
        volt_per_code: None: the finest at which all readings fit into 16 bits.
    """

    experiment: str = "imported"
    columns: tuple[str, str] = ("v_monitor_v", "i_monitor_v")
    block_samples: int = 2000
    rate_hz: float | None = None
    volt_per_code: float | None = None


@dataclass(frozen=True)
class Imported:
    """What became of a file.

    Args:
        blocks: recorded.
        samples_left: at the end, that fill no block.
        rate_hz: samples per second and channel.
        volt_per_code: of both channels.
        largest_rounding_v: what was lost by making codes of the readings, in V.
    """

    blocks: int
    samples_left: int
    rate_hz: float
    volt_per_code: float
    largest_rounding_v: float


def import_session(file: Path, folder: Path, plan: ImportPlan) -> Imported:
    """Make a session of two columns.

    Args:
        file: anything that `open_columns` reads.
        folder: for session.h5 and its manifest.
        plan: names, rate, scale.
    Returns:
        What was made.
    Raises:
        InputError: no rate, readings that do not fit the scale or are no numbers, less than a
            block.
    """
    with open_columns(file, plan.columns) as stream:
        rate_hz = plan.rate_hz or stream.rate_hz
    if not rate_hz:
        raise InputError(f"The file does not tell its rate. Give --rate-hz. {file}")
    volt = plan.volt_per_code or _peak(file, plan) / _LARGEST
    header: dict[str, Any] = {
        "rig": {"name": "imported", "rate_hz": rate_hz, "block_samples": plan.block_samples,
                "volt_per_code": volt},
        "source": {"file": file.name, "sha256": sha256_of(file)},
    }  # fmt: skip
    plans = [ExperimentPlan(plan.experiment, "imported", 1, {"columns": list(plan.columns)})]
    path = folder / "session.h5"
    with (
        Manifest(folder, header),
        SessionWriter(path, plans, plan.block_samples, header) as session,
        open_columns(file, plan.columns) as stream,
    ):
        blocks, left, worst_v = _copy(stream, session, plan, header, file)
    if blocks == 0:
        raise InputError(
            f"{left} samples are less than a block of {plan.block_samples}. Shorten --block-samples"
            f" or record for longer. {file}"
        )
    return Imported(blocks, left, rate_hz, volt, worst_v)


def _peak(file: Path, plan: ImportPlan) -> float:
    peak = 0.0
    with open_columns(file, plan.columns) as stream:
        for piece in stream.pieces(_PIECE_BLOCKS * plan.block_samples):
            for column in piece:
                if np.issubdtype(column.dtype, np.integer):
                    raise InputError(
                        f"The columns hold integers: codes of a converter. Give --volt-per-code. "
                        f"{file}"
                    )
                peak = max(peak, float(np.abs(column).max()))
    return peak if peak > 0.0 else 1.0


def _codes(
    piece: tuple[NDArray[Any], ...], volt: float, first: int, file: Path
) -> tuple[NDArray[np.int16], float]:
    values = np.stack(piece, axis=1)
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.int16), 0.0
    scaled = values.astype(float) / volt
    rounded = np.rint(scaled)
    fits = (np.abs(rounded) <= _LARGEST).all(axis=1)
    if not fits.all():
        row = int(np.argmin(fits))
        raise InputError(
            f"Row {first + row + 1} reads {values[row].tolist()} V; allowed are numbers up to "
            f"{_LARGEST * volt:g} V at {volt:g} V a code. Correct --volt-per-code. {file}"
        )
    return rounded.astype(np.int16), float(np.abs(rounded - scaled).max() * volt)


def _copy(
    stream: ColumnStream,
    session: SessionWriter,
    plan: ImportPlan,
    header: dict[str, Any],
    file: Path,
) -> tuple[int, int, float]:  # fmt: skip
    samples, count, worst_v = plan.block_samples, 0, 0.0
    rate_hz, volt = header["rig"]["rate_hz"], header["rig"]["volt_per_code"]
    rest = np.empty((0, 2), np.int16)
    for piece in stream.pieces(_PIECE_BLOCKS * samples):
        codes, lost_v = _codes(piece, volt, stream.rows_read - len(piece[0]), file)
        worst_v = max(worst_v, lost_v)
        codes = np.concatenate([rest, codes])
        whole = len(codes) // samples
        for block in codes[: whole * samples].reshape(whole, samples, 2):
            start_s = count * samples / rate_hz
            session.append_block(plan.experiment, block, start_s, float("nan"), float("nan"))
            count += 1
        rest = codes[whole * samples :]
    return count, len(rest), worst_v
