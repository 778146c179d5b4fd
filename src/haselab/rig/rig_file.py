"""Read RIG.toml and open its rig."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, Field

from haselab.base import DeviceError, InputError
from haselab.rig import Gate, Rig
from haselab.rig.bench_config import (
    BenchConfig,
    BenchOutputs,
    DaqField,
    GeneratorField,
    InstrumentOfFile,
    SupplyField,
)
from haselab.rig.chip import ChipFile, opened_chip
from haselab.rig.instruments.registry import instrument_of
from haselab.rig.operator import WeightHandler
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.rig.twin.twin_file import identified_twin, is_actuator_file, load_twin
from haselab.store.toml import PrintableSection, read_toml, validated

__all__ = [
    "MAX_SEED",
    "ReplayFile",
    "RigFile",
    "TwinFile",
    "load_rig",
    "load_rig_to_shut_down",
    "opened_rig",
]

MAX_SEED = 2**63 - 1
_FORMER_CHIP = "mega"  # kind of a microcontroller in rig files of earlier versions


class TwinFile(PrintableSection):
    """`kind = "twin"`, `twin = "TWIN.toml"` or `reading = "hz"`, `seed = 1`.

    `twin` may also be an actuator file with `[model.physical]`: then `bench` is the TWIN.toml with
    the instruments, and `draw` the seed with which its parameters are drawn.
    """

    kind: Literal["twin"]
    twin: str | None = None
    reading: Literal["rad", "hz"] | None = None
    seed: int = Field(1, ge=0, le=MAX_SEED)
    bench: str | None = None
    draw: int | None = Field(None, ge=0, le=MAX_SEED)

    def configuration(self, path: Path) -> TwinConfig:
        """Load the twin's configuration.

        Args:
            path: of the rig file, relative to which the twin's file is found.
        Raises:
            InputError: The twin's file is not valid, or a key has no effect beside another.
        """
        file = None if self.twin is None else path.parent / self.twin
        if file is not None and is_actuator_file(file):
            bench = TwinFile(kind="twin", twin=self.bench, reading=self.reading)
            return identified_twin(file, bench.configuration(path), self.draw)
        for key, value in (("bench", self.bench), ("draw", self.draw)):
            if value is not None:
                raise InputError(
                    f"{key} = {value!r} needs an identified actuator. Set twin to an actuator file "
                    f"with [model.physical], or remove {key}. {path}"
                )
        if file is None:
            return twin_of_reading(self.reading or "hz")
        if self.reading is not None:
            raise InputError(f"Set either twin or reading; the twin's file has a reading. {path}")
        return load_twin(file)


class ReplayFile(PrintableSection):
    """`kind = "replay"`, `session = "DIR/session.h5"`, with its videos beside it."""

    kind: Literal["replay"]
    session: str = Field(
        min_length=1, description="recording to play back", examples=["out/run/session.h5"]
    )
    experiments: tuple[str, ...] = Field((), description="names; empty: all")


class _Kind(BaseModel):
    """The key that determines the other contents of the file."""

    kind: Literal["twin", "bench", "chip", "replay"]


class _DaqSection(BaseModel):
    """Section `daq` of a bench, whatever else its file holds."""

    daq: DaqField


class _GeneratorSection(BaseModel):
    """The same of section `generator`."""

    generator: GeneratorField


class _SupplySection(BaseModel):
    """The same of section `supply`, which a bench may lack."""

    supply: SupplyField = None


_OUTPUTS: dict[str, type[BaseModel]] = {
    "daq": _DaqSection,
    "generator": _GeneratorSection,
    "supply": _SupplySection,
}
RigFile = TwinFile | BenchConfig | ChipFile | ReplayFile
_KINDS: dict[str, type[TwinFile] | type[BenchConfig] | type[ChipFile] | type[ReplayFile]] = {
    "twin": TwinFile,
    "bench": BenchConfig,
    "chip": ChipFile,
    "replay": ReplayFile,
}


def load_rig(path: Path) -> RigFile:
    """Read RIG.toml; all faults are reported at once, with its path in the file.

    Args:
        path: of the TOML file.
    Returns:
        The checked configuration of one kind.
    Raises:
        InputError: The file is missing or not TOML, or has an unknown kind or key or a value out of
            range.
    """
    data = read_toml(path, "rig file")
    if data.get("kind") == _FORMER_CHIP:
        raise InputError(
            f"The rig file has kind = {_FORMER_CHIP!r}, which is now called 'chip'. Write kind = "
            f'"chip" instead. {path}'
        )
    return validated(_KINDS[validated(_Kind, data, path).kind], data, path)


def load_rig_to_shut_down(path: Path) -> tuple[RigFile | BenchOutputs, list[tuple[str, str]]]:
    """Read RIG.toml to shut its bench down, each output section by itself.

    A broken package, or a fault elsewhere in the file, must not prevent the other outputs from
    being shut down.

    Args:
        path: of the TOML file.
    Returns:
        The rig, or for a bench the instruments whose sections can be used; and each other section
        with its fault.
    Raises:
        InputError: As for `load_rig`; or no section of a bench can be used.
        DeviceError: No section can be used, because of the drivers.
    """
    data = read_toml(path, "rig file")
    if data.get("kind") == _FORMER_CHIP:  # an older file must shut its bench down as well
        data["kind"] = "chip"
    kind = validated(_Kind, data, path).kind
    if kind != "bench":
        return validated(_KINDS[kind], data, path), []
    found: list[InstrumentOfFile] = []
    faults: list[tuple[str, InputError | DeviceError]] = []
    for section, model in _OUTPUTS.items():
        try:
            config = getattr(validated(model, data, path), section)
            if config is not None:
                found.append(InstrumentOfFile(section, instrument_of(section, config), config))
        except (InputError, DeviceError) as error:
            faults.append((section, error))
    if not found:
        kinds = [type(error) for _, error in faults]
        raised = DeviceError if DeviceError in kinds else InputError
        raise raised(" ".join(f"{section}: {error}" for section, error in faults))
    return BenchOutputs(tuple(found)), [(section, str(error)) for section, error in faults]


@contextlib.contextmanager
def opened_rig(
    file: RigFile, path: Path, gate: Gate, operator: WeightHandler | None = None
) -> Iterator[Rig]:
    """Open the rig of a file; the context ends at 0 V and closes all connections.

    Args:
        file: from `load_rig`.
        path: of the rig file.
        gate: wraps its drivers.
        operator: hangs the masses of a real bench; None: a person at the terminal.
    Raises:
        DeviceError: An instrument or its driver is missing.
        InputError: An instrument is not the one that the file names, or the session is missing.
    """
    if isinstance(file, TwinFile):
        rig = replace(make_twin(file.configuration(path), file.seed), gate=gate)
        try:
            yield rig
        finally:
            rig.safe()
    elif isinstance(file, BenchConfig):
        with RealBench(file, gate, operator) as bench:
            yield bench.rig
    elif isinstance(file, ChipFile):
        with opened_chip(file, path, gate) as chip:
            yield chip.rig
    else:
        from haselab.rig.replay import ReplayBench  # readers of videos, which others do not need

        with ReplayBench(path.parent / file.session, file.experiments) as replay:
            yield replace(replay.rig, gate=gate)
