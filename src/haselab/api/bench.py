"""Play drives and close loops from a notebook, and get back what was measured."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.api.design import Actuator
from haselab.base import (
    InputError,
    Progress,
    ResultError,
    SilentProgress,
    check_length,
    checked,
    real_array,
    shown,
)
from haselab.base.chart import Chart, Curve, Panel
from haselab.identify.record import Record
from haselab.models.maps import VoltageMap
from haselab.rig import Rig, RigDescription
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.rig.twin.twin_file import load_twin
from haselab.runtime import runner as runtime
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.lockin import lockin_of
from haselab.store.columns.table import Table
from haselab.study.fits.observe import gauge_length

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.figure import Figure

__all__ = ["Recording", "Runner", "twin"]

Floats = NDArray[np.float64]
_SEEDS = 2**64
_SETTLE_S = 4.0  # until the actuator is at rest: the first frames are the tracker's reference
_BASELINE_S = 4.0  # for which the length of zero strain is then measured
_NO_FOLDER = Path()  # no video is kept


@checked
def twin(
    file: str | Path | None = None, *, frequency_unit: Literal["rad", "hz"] = "hz", seed: int = 1
) -> Rig:
    """A simulated bench.

    Args:
        file: TWIN.toml, or an actuator file with an identified `[model.physical]`. None: the
            actuator of the reference study.
        frequency_unit: interpretation of that study's frequency axis, "hz" or "rad".
        seed: of its noise.
    Returns:
        The bench, for `Runner`.
    Raises:
        InputError: no such file, or a value out of range.
    """
    if not 0 <= seed < _SEEDS:
        raise InputError(f"seed is {shown(seed)}; it must be a whole number of 0 to {_SEEDS - 1}.")
    return make_twin(
        twin_of_reading(frequency_unit) if file is None else load_twin(Path(file)), seed
    )


@dataclass(frozen=True)
class Recording:
    """What was measured while a drive was played or a loop was closed.

    Args:
        rig: the bench.
        start_s: clock at each block's first sample, shape `(B,)`.
        drive_v: asked for in each block, in V. Shape `(B,)`.
        reference: desired strain, NaN in open loop. Shape `(B,)`.
        sensed_s: clock at the middle of what each capacitance was measured from. Shape `(B,)`.
        capacitance_f: by self-sensing, NaN where it failed, in F. Shape `(B,)`.
        frame_s: clock at the middle of each camera frame. Shape `(F,)`.
        length_m: between the rows of fiducials in each frame, in m. Shape `(F,)`.
        zero_length_m: length of zero strain, in m.
    """

    rig: RigDescription
    start_s: Floats
    drive_v: Floats
    reference: Floats
    sensed_s: Floats
    capacitance_f: Floats
    frame_s: Floats
    length_m: Floats
    zero_length_m: float

    @property
    def strain(self) -> Floats:
        """Strain in each camera frame. Shape `(F,)`."""
        return self.length_m / self.zero_length_m - 1.0

    @cached_property
    def table(self) -> Table:
        """A row for each block whose capacitance and strain were measured.

        `time_s` counts from the first block; `strain` is the camera's, between its frames;
        `reference` is there in a closed loop.
        """
        seen = (self.sensed_s >= self.frame_s[0]) & (self.sensed_s <= self.frame_s[-1])
        rows = seen & np.isfinite(self.capacitance_f)
        columns = {
            "time_s": self.sensed_s - self.start_s[0],
            "drive_v": self.drive_v,
            "capacitance_f": self.capacitance_f,
            "strain": np.interp(self.sensed_s, self.frame_s, self.strain),
        }
        if np.isfinite(self.reference).any():
            columns["reference"] = self.reference
        kept = {name: values[rows] for name, values in columns.items()}
        return Table(kept, None, int((~rows).sum()), time_name="time_s", time_s=kept["time_s"])

    def __getitem__(self, name: str) -> Floats:
        return self.table[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.table)

    def records(self, *, through: VoltageMap | None = None) -> list[Record]:
        """Drive and strain as the fits of `haselab.identify` take them.

        The strain is read at the frames' own times, the drive where it took effect.

        Args:
            through: map that turns the drive into strain. None: the drive stays in V.
        Returns:
            One record.
        Raises:
            LimitError: a drive outside the map.
        """
        u = self.drive_v if through is None else through.strain(self.drive_v)
        first_s = self.start_s[0] + self.rig.switch_sample / self.rig.rate_hz
        after = self.frame_s >= first_s
        return [
            Record(
                u, 1.0 / self.rig.block_s, self.strain[after], self.frame_s[after] - first_s, None
            )
        ]

    def to_pandas(self) -> pandas.DataFrame:
        """The table as a pandas DataFrame."""
        return self.table.to_pandas()

    def to_xarray(self) -> xarray.Dataset:
        """The table as an xarray Dataset over `time_s`."""
        return self.table.to_xarray()

    def chart(self) -> Chart:
        """Strain with its reference, drive and capacitance in time."""
        time_s, axis = self.start_s - self.start_s[0], "Time (s)"
        strain = [Curve(self.frame_s - self.start_s[0], self.strain, "camera", "points")]
        if np.isfinite(self.reference).any():
            strain.append(Curve(time_s, self.reference, "reference", "steps"))
        return Chart(self.rig.name, (
            Panel(axis, "Strain", strain),
            Panel(axis, "Drive (V)", (Curve(time_s, self.drive_v, "", "steps"),)),
            Panel(axis, "Capacitance (pF)", (Curve(time_s, 1e12 * self.capacitance_f),)),
        ))  # fmt: skip

    def plot(self) -> Figure:
        """Draw strain, drive and capacitance in time.

        Returns:
            A matplotlib figure: a notebook shows it, and `savefig` writes it.
        """
        return self.chart().plot()


class _Memory:
    """Keeps the blocks and frames of what plays now: recorder of runner and camera."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        self.codes: list[NDArray[np.int16]] = []
        self.blocks: list[tuple[float, float, float]] = []
        self.frames: list[tuple[Floats, NDArray[np.void]]] = []

    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        del name
        self.codes.append(codes.copy())
        self.blocks.append((start_s, drive_v, reference))

    def append_frames(
        self, name: str, time_s: Floats, tracks: NDArray[np.void], mass_kg: float
    ) -> None:
        del name, mass_kg
        self.frames.append((time_s, tracks.copy()))

    def flush(self, name: str) -> None:
        del name

    def event(self, time_s: float, what: str) -> None:
        del time_s, what

    def condition(
        self, time_s: float, drive_v: float, carrier_v: float, pull_n: float, mass_kg: float
    ) -> None:
        del time_s, drive_v, carrier_v, pull_n, mass_kg


class Runner:
    """Plays drives and closes loops on a bench. Use it in a `with` block, which ends at 0 V.

    Nothing is written to disk: record what you want to keep with `haselab run`.

    Args:
        rig: a simulated bench, or a real one that `hl.armed` has armed.
        baseline_v: drive of zero strain, in V; it is held for 8 s at first, of which the camera
            films the last 4 s. 0: zero strain is the length at 0 V.
        zero_length_m: length of zero strain, in m, such as that of an earlier recording. None: it
            is measured at the baseline.
        carrier_hz: frequency of the sensing signal, in Hz.
        carrier_v: its peak amplitude ahead of the amplifier, in V.
        frame_rate_hz: of the camera, in Hz.
        progress: what shows how far it is.
    Raises:
        InputError: a length of zero strain that is not above 0 and finite.
        ResultError: the camera sees no fiducials.
        SafetyError: a bench that is neither armed nor simulated; or at the end, an output that is
            not at 0 V, or not known to be.
    """

    @checked
    def __init__(
        self,
        rig: Rig,
        *,
        baseline_v: float = 0.0,
        zero_length_m: float | None = None,
        carrier_hz: float = 2000.0,
        carrier_v: float = 0.02,
        frame_rate_hz: float = 50.0,
        progress: Progress | None = None,
    ) -> None:
        check_length("zero_length_m", zero_length_m)
        self._memory = _Memory()
        self._camera = CameraRecorder(rig.camera, self._memory, _NO_FOLDER, "none")
        self._runner = runtime.Runner(
            rig, self._memory, self._camera, carrier_hz, carrier_v, progress or SilentProgress()
        )
        self._rig, self._baseline_v, self._frame_rate_hz = (
            rig.description,
            baseline_v,
            frame_rate_hz,
        )
        self._lockin = lockin_of(rig.description, carrier_hz)
        self._zero_m = math.nan if zero_length_m is None else zero_length_m
        self._played = 0

    @property
    def update_hz(self) -> float:
        """New outputs a second, in Hz: the rate of `drive_v` and `reference`."""
        return 1.0 / self._rig.block_s

    def __enter__(self) -> Self:
        self._runner.__enter__()
        try:
            self.hold(self._baseline_v, _SETTLE_S)
            held = self.play(np.full(round(_BASELINE_S * self.update_hz), self._baseline_v))
        except BaseException as error:
            self._runner.__exit__(type(error), error, error.__traceback__)
            raise
        if math.isnan(self._zero_m):
            self._zero_m = float(held.length_m[held.length_m.size // 2 :].mean())
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._runner.__exit__(kind, error, trace)

    @checked
    def play(self, drive_v: ArrayLike) -> Recording:
        """Put out a drive in open loop.

        Args:
            drive_v: one value for each update, in V. Shape `(B,)`.
        Returns:
            What was measured.
        Raises:
            LimitError: a value outside the limits of the bench; nothing is put out then.
            ResultError: the camera lost the fiducials in all frames.
            SafetyError: the bench protected itself.
            DeviceError: an instrument failed.
        """
        name = self._begin()
        self._runner.play(name, _vector(drive_v), self._frame_rate_hz, self._runner.mass_kg)
        return self._recording()

    @checked
    def close_loop(self, reference: ArrayLike, actuator: Actuator) -> Recording:
        """Follow a strain in closed loop, measured by self-sensing.

        Args:
            reference: desired strain for each update. Shape `(B,)`.
            actuator: its controller and both of its maps.
        Returns:
            What was measured.
        Raises:
            InputError: a part of the actuator that is missing.
            SafetyError: no strain could be measured, or the bench protected itself.
            DeviceError: an instrument failed.
        """
        desired, loop, name = _vector(reference), actuator.loop(), self._begin()
        self._runner.close_loop(name, desired, loop, self._frame_rate_hz, self._runner.mass_kg)
        return self._recording()

    @checked
    def hold(self, drive_v: float, duration_s: float) -> None:
        """Hold a drive with nothing recorded, so that creep fades before what comes.

        Args:
            drive_v: in V.
            duration_s: for how long, in s.
        Raises:
            LimitError: a value outside the limits of the bench.
        """
        self._runner.settle(drive_v, duration_s)

    def _begin(self) -> str:
        self._memory.clear()
        self._played += 1
        return f"play-{self._played}"

    def _recording(self) -> Recording:
        sensed = self._lockin.sense(np.stack(self._memory.codes))
        start_s, drive_v, reference = np.array(self._memory.blocks).T
        times, tracks = zip(*self._memory.frames, strict=True)
        length_m = gauge_length(np.concatenate(tracks), self._rig.scale_m_per_px)
        good = np.isfinite(length_m)
        if not good.any():
            raise ResultError(
                f"The camera did not find all six fiducials in any of {good.size} frames, so there "
                "is no strain. Check that they are visible, and that the actuator is at rest when "
                "the with block begins."
            )
        return Recording(
            rig=self._rig,
            start_s=start_s,
            drive_v=drive_v,
            reference=reference,
            sensed_s=start_s + sensed.time_s - self._rig.block_s * np.arange(start_s.size),
            capacitance_f=np.where(sensed.valid, sensed.capacitance_f, np.nan),
            frame_s=np.concatenate(times)[good],
            length_m=length_m[good],
            zero_length_m=self._zero_m,
        )


def _vector(values: ArrayLike) -> Floats:
    vector = real_array("values", values)
    if vector.ndim != 1 or vector.size == 0:
        raise InputError(
            f"The values have shape {vector.shape}. Give one value for each update of the output."
        )
    if not np.isfinite(vector).all():
        row = int(np.flatnonzero(~np.isfinite(vector))[0])
        raise InputError(f"The value at index {row} is {vector[row]}; it must be finite.")
    return vector
