"""Layout of a session file: datasets, their attributes, and how to read them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject
from haselab.store.names import check_name
from haselab.store.session.checksums import compare, frame_checks, read_settings, write_settings
from haselab.store.session.tail import TailReader, block_checks

__all__ = [
    "BLOCK",
    "BLOCK_ORDER",
    "CONDITION",
    "EVENT",
    "FORMAT",
    "FORMATS",
    "FRAME",
    "FRAME_ORDER",
    "HDF5_ERRORS",
    "TRACK",
    "BlockRows",
    "ExperimentPlan",
    "ExperimentRecord",
    "Sampling",
    "create_experiment",
    "create_root",
    "read_blocks",
    "read_conditions",
    "read_events",
    "read_experiment",
    "settings_of",
    "settings_text",
    "whole_rows",
]

FORMAT = "haselab session 2"
FORMATS = ("haselab session 1", FORMAT)  # 1 has no checksums
HDF5_ERRORS = (OSError, RuntimeError, ValueError, KeyError)
# `check`: see session_checks and session_tail.
EVENT = np.dtype([("time_s", "f8"), ("what", "S96"), ("check", "u4")])
# What acts on the actuator outside the blocks, from a time on; the pull changes in a straight line.
CONDITION = np.dtype(
    [
        ("time_s", "f8"), ("drive_v", "f8"), ("carrier_v", "f8"), ("pull_n", "f8"),
        ("mass_kg", "f8"), ("check", "u4"),
    ]
)  # fmt: skip
BLOCK = np.dtype([("drive_v", "f8"), ("reference", "f8"), ("start_s", "f8"), ("check", "u4")])
FRAME = np.dtype([("time_s", "f8"), ("mass_kg", "f8"), ("check", "u4")])
TRACK = np.dtype(
    [("x_px", "f8"), ("y_px", "f8"), ("std_x_px", "f4"), ("std_y_px", "f4"), ("valid", "?")]
)
# In the order of writing: rows in the last dataset are complete in all of them.
BLOCK_ORDER = ("codes", "blocks", "start_s")
FRAME_ORDER = ("tracks", "frames", "frame_s")
_SETTINGS_BYTES = 65000
_CHUNK_S = 0.1
_BLOCKS_PER_CHUNK = 10  # if the rate is unknown


@dataclass(frozen=True)
class ExperimentPlan:
    """The recording of one experiment; all datasets are created before the first block.

    Args:
        name: unique in the session.
        kind: of the study's step.
        points: tracked points per frame.
        settings: signals, loads, gains and others, as JSON types.
    """

    name: str
    kind: str
    points: int
    settings: JsonObject


@dataclass(frozen=True)
class ExperimentRecord:
    """The recorded data of one experiment: B blocks of N samples, F frames of P points.

    Args:
        name: of the experiment.
        kind: of the study's step.
        settings: as planned, and as completed in the run.
        codes: ADC codes, shape `(B, N, 2)`.
        drive_v: output requested in each block, shape `(B,)`.
        reference: desired strain in each block, NaN in open loop, shape `(B,)`.
        block_start_s: clock at each block's first sample, shape `(B,)`.
        frame_time_s: middle of the exposures, shape `(F,)`.
        tracks: fields `x_px y_px std_x_px std_y_px valid`, shape `(F, P)`.
        mass_kg: hung at each frame, shape `(F,)`.
    """

    name: str
    kind: str
    settings: JsonObject
    codes: NDArray[np.int16]
    drive_v: NDArray[np.float64]
    reference: NDArray[np.float64]
    block_start_s: NDArray[np.float64]
    frame_time_s: NDArray[np.float64]
    tracks: NDArray[np.void]
    mass_kg: NDArray[np.float64]


@dataclass(frozen=True)
class BlockRows:
    """Blocks of an experiment from some row on.

    Args:
        codes: ADC codes, shape `(B, N, 2)`.
        drive_v: requested output, shape `(B,)`.
        reference: desired strain, NaN in open loop, shape `(B,)`.
        start_s: clock at each block's first sample, shape `(B,)`.
    """

    codes: NDArray[np.int16]
    drive_v: NDArray[np.float64]
    reference: NDArray[np.float64]
    start_s: NDArray[np.float64]


@dataclass(frozen=True)
class Sampling:
    """Sampling of the blocks, as far as the session's header states it.

    Args:
        block_samples: samples per channel in one block.
        rate_hz: samples per second and channel; None: unknown.
        volt_per_code: None: unknown.
    """

    block_samples: int
    rate_hz: float | None
    volt_per_code: float | None

    @classmethod
    def of_header(cls, block_samples: int, header: Mapping[str, Any]) -> Sampling:
        """Read the sampling from `header["rig"]`, see `RigDescription`."""
        rig = header.get("rig")
        stated = [rig.get(key) if isinstance(rig, dict) else None for key in cls._KEYS]
        rate_hz, volt = (float(x) if isinstance(x, (int, float)) else None for x in stated)
        return cls(block_samples, rate_hz, volt)

    @property
    def chunk_blocks(self) -> int:
        """Blocks in 0.1 s."""
        if not self.rate_hz:
            return _BLOCKS_PER_CHUNK
        return max(1, round(_CHUNK_S * self.rate_hz / self.block_samples))

    _KEYS = ("rate_hz", "volt_per_code")


def create_root(file: h5py.File, plans: list[ExperimentPlan], header: Mapping[str, Any]) -> None:
    """Create the attributes of the file, the event table, and the group of experiments."""
    file.attrs["format"] = FORMAT
    file.attrs["header"] = json.dumps(header)
    file.attrs["NX_class"] = "NXroot"
    file.attrs["default"] = "experiments"
    events = file.create_dataset("events", (0,), EVENT, maxshape=(None,), chunks=(64,))
    events.make_scale("events")
    acted = file.create_dataset("conditions", (0,), CONDITION, maxshape=(None,), chunks=(256,))
    acted.make_scale("conditions")
    entry = file.create_group("experiments")
    entry.attrs["NX_class"] = "NXentry"
    if plans:
        entry.attrs["default"] = plans[0].name


def settings_text(name: str, settings: Mapping[str, Any]) -> bytes:
    """Settings as the file holds them.

    Raises:
        InputError: they are too long.
    """
    text = write_settings(settings)
    if len(text) > _SETTINGS_BYTES:
        raise InputError(
            f"Settings of {name!r} have {len(text)} bytes, but at most {_SETTINGS_BYTES} fit. "
            "Shorten them."
        )
    return text


def create_experiment(
    file: h5py.File, number: int, plan: ExperimentPlan, sampling: Sampling, text: bytes
) -> None:
    """Create all datasets of one experiment, with dimension scales and NeXus attributes.

    Only the codes are compressed: a table that grows row by row would be compressed repeatedly. A
    second axis without limit makes HDF5 index the chunks of the fast datasets with a tree of nodes
    of 2048 bytes: the parts of its array for one such axis exceed a page after 2051 chunks of codes
    (205 s), and a kill inside the write of one would make the session unreadable. In the other
    datasets this takes 8000 chunks of 1000 rows.

    Raises:
        InputError: the name cannot be a file name.
    """
    check_name(plan.name)
    group = file.create_group(f"experiments/{plan.name}")
    group.attrs.update(
        {
            "kind": plan.kind,
            "number": number,
            "NX_class": "NXdata",
            "signal": "codes",
            "axes": ["start_s", "sample_s", "channel"],
        }
    )
    group.create_dataset("settings", (), f"S{_SETTINGS_BYTES}", data=text)
    scales = _create_scales(group, plan, sampling)
    samples = sampling.block_samples
    codes = group.create_dataset(
        "codes", (0, samples, 2), np.int16, maxshape=(None, None, 2),
        chunks=(sampling.chunk_blocks, samples, 2),
        compression="gzip", compression_opts=1, shuffle=True,
    )  # fmt: skip
    if sampling.volt_per_code is None:
        codes.attrs["units"] = "code"
    else:
        codes.attrs.update(
            {"units": "V", "scale_factor": sampling.volt_per_code, "add_offset": 0.0}
        )
    codes.attrs["long_name"] = "voltage and current monitor"
    blocks = group.create_dataset("blocks", (0,), BLOCK, maxshape=(None,), chunks=(1000,))
    frames = group.create_dataset("frames", (0,), FRAME, maxshape=(None,), chunks=(1000,))
    shape = (0, plan.points)
    tracks = group.create_dataset("tracks", shape, TRACK, maxshape=(None, None),
                                  chunks=(100, plan.points))  # fmt: skip
    for dataset, names in (
        (codes, ("start_s", "sample_s", "channel")),
        (blocks, ("start_s",)),
        (frames, ("frame_s",)),
        (tracks, ("frame_s", "point")),
    ):
        for axis, name in enumerate(names):
            dataset.dims[axis].attach_scale(scales[name])


def _create_scales(
    group: h5py.Group, plan: ExperimentPlan, sampling: Sampling
) -> dict[str, h5py.Dataset]:
    for name in ("start_s", "frame_s"):
        group.create_dataset(name, (0,), np.float64, maxshape=(None,), chunks=(1000,))
    period_s = 1.0 / sampling.rate_hz if sampling.rate_hz else 1.0
    group["sample_s"] = period_s * np.arange(sampling.block_samples)
    group["channel"] = np.array([b"v_monitor", b"i_monitor"])
    group["point"] = np.arange(plan.points)
    names = ("start_s", "frame_s", "sample_s", "channel", "point")
    for name in names:
        group[name].make_scale(name)
    for name in ("start_s", "frame_s"):
        group[name].attrs["long_name"] = "clock of the acquisition in s"
    known = "s" if sampling.rate_hz else "samples"
    group["sample_s"].attrs["long_name"] = f"from the block's first sample, in {known}"
    return {name: group[name] for name in names}


def whole_rows(group: h5py.Group, order: tuple[str, ...]) -> int:
    """Number of complete rows: a dataset grows before its new rows are written."""
    return min(int(group[name].shape[0]) for name in order if name in group)


def read_blocks(
    group: h5py.Group,
    tail: TailReader,
    first: int,
    most: int | None = None,
    *,
    verify: bool = False,
) -> BlockRows:
    """Read blocks from a row on: those in the datasets, then those still in the tail.

    Args:
        group: of the experiment.
        tail: of its file.
        first: row.
        most: of the datasets' blocks.
        verify: also compare the blocks in the datasets with their checksums.
    Raises:
        ValueError: a checksum does not match.
    """
    count, late = _rows_and_tail(group, tail, first)
    until = count if most is None else min(count, first + most)
    rows = group["blocks"][first:until]
    stored = BlockRows(
        group["codes"][first:until], rows["drive_v"], rows["reference"], rows["start_s"]
    )
    if verify and "check" in (rows.dtype.names or ()):
        number = int(group.attrs["number"])
        found = block_checks(number, first, vars(stored))
        compare(rows["check"], found, first, f"block of {group.name!r},")
    if until < count or not late.size:
        return stored
    names = ("codes", "drive_v", "reference", "start_s")
    return BlockRows(*(np.concatenate([getattr(stored, n), late[n]]) for n in names))


def _rows_and_tail(group: h5py.Group, tail: TailReader, first: int) -> tuple[int, NDArray[np.void]]:
    """Number of rows in the datasets, and the blocks that follow them in the tail.

    Blocks that have left the tail in the meantime have reached the datasets.
    """
    count = whole_rows(group, BLOCK_ORDER)
    # A session of the first release has no tail.
    if "number" not in group.attrs:
        return count, np.empty(0, BLOCK)
    number = int(group.attrs["number"])
    while True:
        newest, start = tail.newest(number), max(first, count)
        late = tail.rows(number, start)
        if start + late.size > newest:
            return count, late
        for name in reversed(BLOCK_ORDER):
            group[name].id.refresh()
        before, count = count, whole_rows(group, BLOCK_ORDER)
        if count <= before:  # its writer was killed while it wrote a slot
            return count, late


def read_experiment(
    file: h5py.File, name: str, tail: TailReader, *, verify: bool = False
) -> ExperimentRecord:
    """Read all data of one experiment; with `verify` compare its checksums.

    Raises:
        ValueError: a checksum does not match.
    """
    group = file[f"experiments/{name}"]
    blocks = read_blocks(group, tail, 0, verify=verify)
    seen = whole_rows(group, FRAME_ORDER)
    frames, tracks = group["frames"][:seen], group["tracks"][:seen]
    if verify and "check" in (frames.dtype.names or ()):
        number = int(group.attrs["number"])
        found = frame_checks(number, 0, frames["time_s"], frames["mass_kg"], tracks)
        compare(frames["check"], found, 0, f"frame of {group.name!r},")
    return ExperimentRecord(
        name=name,
        kind=str(group.attrs["kind"]),
        settings=settings_of(group)[0],
        codes=blocks.codes,
        drive_v=blocks.drive_v,
        reference=blocks.reference,
        block_start_s=blocks.start_s,
        frame_time_s=frames["time_s"],
        tracks=tracks,
        mass_kg=frames["mass_kg"],
    )


def settings_of(group: h5py.Group) -> tuple[JsonObject, bool]:
    """Settings of an experiment, and whether they match their checksum."""
    return read_settings(bytes(np.ravel(group["settings"][()])[0]))


def read_conditions(file: h5py.File) -> NDArray[np.void]:
    """Rows of `CONDITION`; none in files that were written without them."""
    if "conditions" not in file:
        return np.zeros(0, CONDITION)
    rows = file["conditions"][:]
    torn = bool(len(rows) and not rows[-1].tobytes().strip(b"\0"))  # killed while writing
    return np.asarray(rows[: len(rows) - torn])


def read_events(file: h5py.File) -> list[tuple[float, str]]:
    """Time in s and text of each event; one that is not written yet has no text."""
    rows = file["events"][:]
    return [(float(r["time_s"]), r["what"].decode(errors="ignore")) for r in rows if r["what"]]
