"""Noise-free reference runs: the twin with ideal instruments.

The reference value of a result comes from the same experiment and the same fit on the same twin
with all noise off. For a nonlinear bench this is the best approximation that the fit can reach. An
analysis of recorded data never reads it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import JsonObject
from haselab.rig import Rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.lockin import lockin_of, printed_chain_of
from haselab.runtime.observer import Seen
from haselab.sensing import Lockin
from haselab.study.definition import Study
from haselab.study.fits.observe import TRIANGLE, Observation
from haselab.study.fits.paper_chain import Chain, read_chain

__all__ = ["NoiseFreeBench"]

_BLOCKS = 200
_DITHER = 0.5  # of a converter's step


class _Recording:
    """Recording of one experiment in memory: sensed blocks and true lengths."""

    def __init__(self) -> None:
        self.blocks: list[tuple[float, float, float]] = []
        self.codes: list[NDArray[np.int16]] = []
        self.sensed: list[NDArray[np.float64]] = []
        self.printed: list[NDArray[np.float64]] = []
        self.frames: list[NDArray[np.float64]] = []
        self.drop_s = float("nan")


class NoiseFreeBench:
    """A noise-free twin with a perfect camera: recorder, observer and rig in one.

    The converters round. With no noise at all, an error of up to 0.4 pF would repeat in all blocks
    of equal codes; a dither of half a step makes it random.

    Args:
        config: of the twin.
        study: whose sensing settings are used.
    """

    def __init__(self, config: TwinConfig, study: Study) -> None:
        step_v = 2.0 * config.acquisition.range_v / 2**config.acquisition.bits
        dither = {"v_noise_v": _DITHER * step_v, "i_noise_v": _DITHER * step_v}
        acquisition = config.acquisition.model_copy(update=dither)
        config = config.model_copy(update={"acquisition": acquisition})
        self._bench = TwinBench(config, 0)
        self.rig: Rig = rig_of(self._bench, config)
        self._sensing = study.sensing
        lockin = lockin_of(self.rig.description, study.sensing.carrier_hz)
        self._lockin = Lockin(lockin.config, models=False)  # rounding is not noise
        self._chain = printed_chain_of(self.rig.description, study.sensing.carrier_hz)
        self._recordings: dict[str, _Recording] = {}
        self._name = ""
        self._mass_kg = 0.0
        self._settings: dict[str, dict[str, Any]] = {}

    # Recorder
    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        """See `haselab.runtime.runner.Recorder`."""
        recording = self._recordings.setdefault(name, _Recording())
        recording.blocks.append((start_s, drive_v, reference))
        recording.codes.append(codes)
        if len(recording.codes) == _BLOCKS:
            self.flush(name)

    def flush(self, name: str) -> None:
        """See `haselab.runtime.runner.Recorder`."""
        recording = self._recordings[name]
        if not recording.codes:
            return
        codes = np.stack(recording.codes)
        sensed = self._lockin.sense(codes)
        recording.codes = []
        volt = self.rig.description.volt_per_code
        read = read_chain(sensed, self._sensing, volt)
        recording.sensed.append(read.rows())
        if name == TRIANGLE:
            chain = self._chain.sense(codes)
            recording.printed.append(read_chain(chain, self._sensing, volt).rows())

    def event(self, time_s: float, what: str) -> None:
        """See `haselab.runtime.runner.Recorder`."""
        verb, _, name = what.partition(" ")
        if verb == "drop":
            self._recordings.setdefault(name, _Recording()).drop_s = time_s

    def condition(
        self, time_s: float, drive_v: float, carrier_v: float, pull_n: float, mass_kg: float
    ) -> None:
        """See `haselab.runtime.runner.Recorder`; nothing here needs it."""

    def complete_settings(self, name: str, settings: JsonObject) -> None:
        """Store the settings that were really used."""
        self._settings[name] = settings

    # Observer
    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """See `haselab.runtime.observer.Observer`."""
        del part, particles
        self._name, self._mass_kg = name, mass_kg
        self._bench.start(rate_hz)

    def look(self) -> Seen | None:
        """See `haselab.runtime.observer.Observer`."""
        exposed = self._bench.exposures()
        if exposed is None:
            return None
        time_s, lengths = exposed
        rows = np.stack([time_s, lengths.mean(axis=1), np.full(time_s.size, self._mass_kg)], axis=1)
        self._recordings.setdefault(self._name, _Recording()).frames.append(rows)
        scale_m_per_px = self.rig.description.scale_m_per_px
        return Seen(float(time_s[-1]), float(lengths[-1].mean()) / scale_m_per_px)

    def finish(self) -> None:
        """See `haselab.runtime.observer.Observer`."""
        self.look()
        self._bench.stop()

    # Source
    def observation(self, name: str) -> Observation:
        """See `haselab.study.fits.observe.Source`."""
        recording = self._recordings[name]
        frame_time_s, length_m, mass_kg = np.concatenate(recording.frames).T
        block_start_s, drive_v, reference = np.array(recording.blocks).reshape(-1, 3).T
        lockin, printed = (
            Chain.of(np.concatenate(rows)) if rows else None
            for rows in (recording.sensed, recording.printed)
        )
        none = np.empty(0)
        return Observation(
            name=name,
            settings=self._settings.get(name, {}),
            block_start_s=block_start_s,
            drive_v=drive_v,
            reference=reference,
            sensed_s=block_start_s + self._lockin.middle_s,
            capacitance_f=none if lockin is None else lockin.capacitance_f,
            relative_capacitance=none if lockin is None else lockin.relative_capacitance,
            frame_time_s=frame_time_s,
            length_m=length_m,
            spread_m=np.zeros(length_m.size),
            mass_kg=mass_kg,
            drop_s=recording.drop_s,
            latency_s=np.empty(0),
            lockin=lockin,
            printed=printed,
        )
