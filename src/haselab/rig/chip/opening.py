"""RIG.toml with `kind = "chip"`: a microcontroller on a serial port, or simulated with the twin."""

from __future__ import annotations

import contextlib
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from haselab.base import LimitError
from haselab.firmware import MOTION_RISE_V_PER_S, ChipSettings, FrontEnd
from haselab.models.maps import VoltageMap
from haselab.rig import Camera, Frames, Gate, Rig
from haselab.rig.bench_config import CameraField, SpecimenConfig
from haselab.rig.cameras.opening import open_camera
from haselab.rig.chip.calibrate import calibrated_firmware
from haselab.rig.chip.chip_bench import ChipBench, describe_chip
from haselab.rig.chip.design import ModuleLimits, read_design, strains_within
from haselab.rig.chip.link import ChipLink
from haselab.rig.chip.serial_link import SerialChip
from haselab.rig.chip.simulator import SLOT_S, SLOTS, CoSim
from haselab.rig.chip.supplied import SuppliedCoSim, SupplyModel
from haselab.rig.operator import BenchStand, OperatorWeights, WeightHandler
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench
from haselab.rig.twin.twin_file import load_twin
from haselab.store.toml import PrintableSection

__all__ = [
    "ChipFile",
    "ConnectedChip",
    "FrontEndConfig",
    "SimulatorConfig",
    "key_of_port",
    "opened_chip",
]

_MAX_SEED = 2**63 - 1
_CALL_S = 5.0  # longest call: arming, and the ramp to 0 V
_START_S = 0.02  # longer than from power-up to the first update


class FrontEndConfig(PrintableSection):
    """Monitors and analogue stages, see `haselab.firmware.FrontEnd`."""

    gain: float = Field(5000.0, ge=10, le=1e5)
    volt_per_monitor_volt: float = Field(5000.0, ge=10, le=1e5)
    ampere_per_monitor_volt: float = Field(2e-3, ge=1e-6, le=1)
    v_stage: float = Field(50.0, ge=0.1, le=1e3)
    i_stage: float = Field(0.8, ge=1e-3, le=1e3)
    carrier_high_v: float = Field(240.0, ge=1, le=1e4)
    correction: tuple[float, float] = Field(
        (1.0, 0.0), description="real and imaginary part, from a reference capacitor"
    )

    @model_validator(mode="after")
    def _near_one(self) -> Self:
        found = complex(*self.correction)
        if not (0.1 <= abs(found) <= 10.0 and found.real >= abs(found.imag)):
            raise ValueError(
                "correction (measured over expected) must have a magnitude of 0.1 to 10 and a "
                "phase of -45 to 45 degrees"
            )
        return self

    def front_end(self) -> FrontEnd:
        """The front end for the firmware."""
        return FrontEnd(**self.model_dump() | {"correction": complex(*self.correction)})


class SimulatorConfig(PrintableSection):
    """The twin with which the microcontroller is simulated."""

    twin: str | None = Field(None, description="TWIN.toml; omit: that of the reading")
    reading: Literal["rad", "hz"] | None = None
    seed: int = Field(1, ge=0, le=_MAX_SEED)
    precondition_v: float = Field(
        0.0, ge=0, le=2, description="highest earlier drive of the sheet; 0: a new sheet"
    )
    supply: SupplyModel | None = Field(
        None, description="a serial high-voltage supply in place of the analogue module"
    )

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if self.twin is not None and self.reading is not None:
            raise ValueError("set either twin or reading; the twin's file has a reading")
        return self

    def configuration(self, path: Path) -> TwinConfig:
        """Load the twin's configuration.

        Args:
            path: of the rig file, relative to which the twin's file is found.
        """
        if self.twin is None:
            return twin_of_reading(self.reading or "hz")
        return load_twin(path.parent / self.twin)


class ChipFile(PrintableSection):
    """`kind = "chip"`, `run = "DIR"`, and `port` or a table `simulator`."""

    kind: Literal["chip"]
    name: str = "chip"
    run: str = Field(
        min_length=1,
        description="folder of the study whose controller it runs",
        examples=["out/reference"],
    )
    structure: str | None = Field(
        None,
        min_length=1,
        max_length=64,
        description="kind or name of the controller; omit: [controller] itself",
    )
    controller_source: str | None = Field(
        None, min_length=1, description="C file of your own controller"
    )
    port: str | None = Field(None, min_length=1, description="/dev/ttyACM0, COM3, ...")
    simulator: SimulatorConfig | None = None
    front_end: FrontEndConfig = FrontEndConfig()
    drive_high_v: float | None = Field(
        None, gt=0, lt=2.048, description="highest drive, if the module reaches less"
    )
    rise_v_per_s: float | None = Field(
        None,
        gt=0,
        le=MOTION_RISE_V_PER_S,
        description="fastest change of the drive, if the module is slower",
    )
    bandgap_v: float | None = Field(
        None,
        ge=1.0,
        le=1.2,
        description="measured reference voltage; see docs/control/firmware.md",
    )
    specimen: SpecimenConfig | None = Field(None, description="of a real bench")
    camera: CameraField = Field(None, description="of a real bench")
    scale_m_per_px: float = Field(1e-4, gt=0)
    safety: dict[str, object] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.port is None) == (self.simulator is None):
            raise ValueError("set either port or a table simulator")
        if self.port is not None and (self.specimen is None or self.camera is None):
            raise ValueError("a microcontroller on a port needs the tables specimen and camera")
        if self.simulator is not None and (self.specimen or self.camera):
            raise ValueError("remove specimen and camera: with a table simulator the twin has them")
        return self

    @property
    def module(self) -> ModuleLimits:
        """Limits of this bench's high-voltage module."""
        return ModuleLimits(self.drive_high_v, self.rise_v_per_s)

    def limited(self, settings: ChipSettings) -> ChipSettings:
        """Apply the limits of this bench's high-voltage module to settings.

        Returns:
            The settings; the controller's output is limited to the strains that are reached.
        Raises:
            InputError: The voltage map turns within what the module reaches.
        """
        high, rise = self.drive_high_v, self.rise_v_per_s
        high = settings.drive_high_v if high is None else high
        limits = (settings.strain_low, settings.strain_high)
        low, top = strains_within(limits, VoltageMap(*settings.voltage_map), high)
        return replace(
            settings,
            strain_low=low,
            strain_high=top,
            drive_high_v=high,
            rise_v_per_s=settings.rise_v_per_s if rise is None else rise,
        )


@dataclass(frozen=True)
class ConnectedChip:
    """An opened microcontroller.

    Args:
        rig: its bench.
        settings: settings of its firmware.
        zero_length_m: length of the sheet at zero strain, from the study that made the settings.
        identity: its own identification.
    """

    rig: Rig
    settings: ChipSettings
    zero_length_m: float
    identity: str


def key_of_port(port: str) -> str:
    """Interlock key of the microcontroller on a serial port of this computer."""
    return f"chip {Path(port).resolve()}"


@contextlib.contextmanager
def opened_chip(file: ChipFile, path: Path, gate: Gate) -> Iterator[ConnectedChip]:
    """Open the microcontroller of a rig file; the context ends at 0 V and closes the link.

    In co-simulation the firmware is built, calibrated with a reference capacitor, and built again.

    Args:
        file: the rig file.
        path: of it.
        gate: wraps its driver.
    Returns:
        A context with the microcontroller.
    Raises:
        DeviceError: The port does not exist, there is no reply, or another program uses it.
        InputError: The firmware is not the file's, or a compiler or libsimavr is missing.
    """
    source = None if file.controller_source is None else path.parent / file.controller_source
    front_end = file.front_end.front_end()
    design = read_design(path.parent / file.run, file.structure, front_end, source, file.module)
    settings, zero_m = file.limited(design.settings), design.zero_length_m
    with contextlib.ExitStack() as opened:
        if file.simulator is not None:
            config = file.simulator.configuration(path)
            link, settings, sheet = _simulated(opened, config, file.simulator, settings)
            bench = _bench(opened, link, settings, gate, file.bandgap_v)
            rig = _rig_of_sheet(bench, settings, link, sheet, config, file.name)
        else:
            assert file.port is not None
            gate.claim(key_of_port(file.port), _CALL_S)
            opened.callback(gate.release)
            bench = _bench(opened, SerialChip(file.port), settings, gate, file.bandgap_v)
            rig = _on_port(opened, bench, file, settings)
        rig.gate = gate
        opened.callback(rig.safe)
        yield ConnectedChip(rig, settings, zero_m, bench.identity)


def _bench(
    opened: contextlib.ExitStack,
    link: ChipLink,
    settings: ChipSettings,
    gate: Gate,
    bandgap_v: float | None,
) -> ChipBench:
    try:
        bench = gate.instrument(ChipBench(link, settings, bandgap_v))
    except BaseException:
        link.close()
        raise
    opened.callback(bench.close)
    return bench


def _on_port(
    opened: contextlib.ExitStack, bench: ChipBench, file: ChipFile, settings: ChipSettings
) -> Rig:
    assert file.specimen is not None
    assert file.camera is not None
    camera = open_camera(file.camera, lambda: (bench.time_s, time.monotonic()))
    opened.callback(camera.close)
    specimen = file.specimen
    description = describe_chip(
        settings,
        name=file.name,
        shell_area_m2=specimen.shell_width_m * specimen.shell_thickness_m,
        lateral_stretch=specimen.lateral_stretch,
        scale_m_per_px=file.scale_m_per_px,
        mass_kg=specimen.mass_kg,
    )
    stand = BenchStand(OperatorWeights(), bench)
    return Rig(description, bench, bench, bench, camera.camera, stand, controller=bench)


class _Sheet(TwinBench):
    """The twin's camera filming a sheet that the co-simulation moves."""

    _passed: int | None = None  # slots; None: before the mass is hung

    @property
    def time_s(self) -> float:
        """Time on the clock of the microcontroller's bench, in s."""
        return super().time_s if self._passed is None else self._passed * SLOT_S

    def since(self, slots: int) -> None:
        """Let the co-simulation move the sheet from now on; its clock shows this many slots."""
        self._passed = slots

    def moved(self, lengths_m: list[float]) -> None:
        """Add lengths of the sheet, one per slot."""
        self._passed = (self._passed or 0) + len(lengths_m)
        self._remember(np.array(lengths_m))


class _SheetCamera:
    """Implements `Camera`."""

    def __init__(self, chip: CoSim, sheet: _Sheet) -> None:
        self._chip, self._sheet = chip, sheet

    def _follow(self) -> None:
        tracks, self._chip.tracks = self._chip.tracks, []
        self._chip.outputs = self._chip.outputs[-1:]
        if tracks:
            self._sheet.moved([track.length_m for track in tracks])

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`."""
        self._follow()
        self._sheet.start(rate_hz)

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`."""
        self._follow()
        return self._sheet.take()

    def stop(self) -> None:
        """See `haselab.rig.Camera`."""
        self._sheet.stop()


class _SheetWeights:
    """Implements `WeightHandler`: takes the twin's mass off and on."""

    def __init__(self, chip: CoSim, mass_kg: float) -> None:
        self._chip, self._mass_kg = chip, mass_kg

    def _load(self, mass_kg: float) -> None:
        self._chip.command(f"load {mass_kg * GRAVITY_M_S2!r}")

    def hang(self, mass_kg: float) -> None:
        """See `WeightHandler`."""
        if mass_kg != self._mass_kg:
            raise LimitError(
                f"The mass is {mass_kg:g} kg, but the simulated microcontroller has only a mass of "
                f"{self._mass_kg:g} kg. Use that mass, or the twin's rig."
            )
        self._load(mass_kg)

    def lift(self) -> None:
        """See `WeightHandler`."""
        self._load(0.0)

    def drop(self) -> None:
        """See `WeightHandler`."""
        self._load(self._mass_kg)


def _simulated(
    opened: contextlib.ExitStack,
    config: TwinConfig,
    simulator: SimulatorConfig,
    settings: ChipSettings,
) -> tuple[CoSim, ChipSettings, _Sheet]:
    """Start a simulated microcontroller; return it, its calibrated settings and its sheet."""
    folder, seed = Path(opened.enter_context(tempfile.TemporaryDirectory())), simulator.seed
    made = calibrated_firmware(settings, config, seed, folder)
    daq = config.acquisition.model_copy(update={"rate_hz": 20.0 / SLOT_S})
    sheet = _Sheet(config.model_copy(update={"acquisition": daq}), seed)
    precondition(sheet, simulator.precondition_v)
    program, elf = made.program, made.firmware.elf
    if simulator.supply is None:
        chip = CoSim(program, elf, sheet)
    else:
        gain = made.settings.front_end.gain
        chip = SuppliedCoSim(program, elf, sheet, simulator.supply, gain, seed)
    opened.callback(chip.close)
    chip.command("track 1")
    chip.run(_START_S)
    return chip, made.settings, sheet


def _rig_of_sheet(
    bench: ChipBench,
    settings: ChipSettings,
    chip: CoSim,
    sheet: _Sheet,
    config: TwinConfig,
    name: str,
) -> Rig:
    sheet.since(len(chip.tracks) - SLOTS * bench.origin)
    chip.tracks.clear()
    law = config.law
    description = describe_chip(
        settings,
        name=name,
        shell_area_m2=law.area_m2,
        lateral_stretch=law.lateral_stretch,
        scale_m_per_px=config.camera.scale_m_per_px,
        mass_kg=config.load.mass_kg,
    )
    weights: WeightHandler = _SheetWeights(chip, config.load.mass_kg)
    camera: Camera = _SheetCamera(chip, sheet)
    return Rig(
        description, bench, bench, bench, camera, BenchStand(weights, bench), controller=bench
    )
