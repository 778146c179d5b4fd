"""Misbehaviours of a closed loop on the twin, each as a real fault would show."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import SafetyError, SilentProgress
from haselab.control import PidGains, Saturation
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Seen
from haselab.runtime.runner import Runner
from haselab.runtime.sensors import CapacitanceSensor
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.settings import FieldRating

BLOCK_S = 0.01
Codes = NDArray[np.int16]
# As the triangle test of the reference study finds them, reading by reading.
MAPS = {
    "hz": (
        VoltageMap(1.586405, 1.687190, -0.614446, -22.025777, -0.076973, 0.186364),
        StrainMap(809223848.0, -0.380167, -2.488615e17),
        Saturation(-0.0399, 0.1),
    ),
    "rad": (
        VoltageMap(14.731102, -1.834256, -14.068193, -2.638319, -0.098263, 0.248779),
        StrainMap(840707398.0, -0.366382, -2.597341e17),
        Saturation(-0.05, 0.1),
    ),
}
GAINS = {"hz": PidGains(0.4278, 0.7549), "rad": PidGains(0.6670, 1.1771)}  # of the study


class NoRecord:
    """Keeps nothing."""

    def append_block(self, *given: Any) -> None: ...
    def flush(self, name: str) -> None: ...
    def event(self, time_s: float, what: str) -> None: ...
    def condition(self, *given: Any) -> None: ...


@dataclass
class Scene:
    """A twin between two layers of faults: its blocks and what the sensor makes of them.

    Args:
        twin: the bench.
        codes: changes a block; given its number since the loop closed.
        strain: changes a strain.
        capacitance: changes a capacitance.
        written: changes an output before it goes out.
        frame: changes what the camera shows; None where no frame comes.
        strike: is called at the onset.
    """

    twin: TwinBench
    onset: int = 0
    codes: Callable[[int, Codes], Codes] | None = None
    strain: Callable[[int, float], float] | None = None
    capacitance: Callable[[int, float], float] | None = None
    written: Callable[[int, float], float] | None = None
    frame: Callable[[int, Seen], Seen | None] | None = None
    strike: Callable[[], None] = lambda: None
    block: int = -1_000_000  # since the loop closed
    past: list[Any] = field(default_factory=list)

    @property
    def since(self) -> int:
        """Blocks since the onset; negative before it."""
        return self.block - self.onset

    # VoltageSource
    def write(self, voltage_v: float) -> None:
        if self.written is not None and self.block >= 0:
            voltage_v = self.written(self.since, voltage_v)
        self.twin.write(voltage_v)

    def zero(self) -> None:
        self.twin.zero()

    # Acquisition
    def read(self) -> Codes:
        self.block += 1
        if self.since == 0:
            self.strike()
        codes = self.twin.read()
        if self.codes is not None and self.block >= 0:
            codes = self.codes(self.since, codes)
        return codes

    @property
    def time_s(self) -> float:
        return self.twin.time_s

    # Observer: a perfect camera with the noise of a tracked length
    def start(self, name: str, rate_hz: float, *given: Any, **named: Any) -> None:
        self.twin.start(rate_hz)
        self.noise = np.random.default_rng(7)

    def look(self) -> Seen | None:
        exposed = self.twin.exposures()
        if exposed is None:
            return None
        length_m = float(exposed[1][-1].mean()) + 2e-6 * self.noise.standard_normal()
        seen = Seen(float(exposed[0][-1]), length_m / 0.35e-3)
        return seen if self.frame is None else self.frame(self.since, seen)

    def finish(self) -> None:
        self.twin.stop()


@dataclass(frozen=True)
class Case:
    """One misbehaviour.

    Args:
        name: of it.
        reason: regular expression of the right one.
        inject: puts it into the scene.
        video: the camera gives the strain.
        reference: kind of reference.
        onset: block at which it begins; 0: wrong from the start.
        loop: changes the loop's settings.
        config: changes the twin.
        rated: the field is watched.
        readings: of the twin for which 0.5 s are enough.
        misses: runs at random moments that may go unnoticed, as the docs say.
        ringing: the drive changed 2 s before the loop closes, so the actuator may still ring.
    """

    name: str
    reason: str
    inject: Callable[[Scene, np.random.Generator], None] = lambda scene, rng: None
    video: bool = False
    reference: str = "hold"
    onset: int = 120
    loop: Callable[[LoopSettings], LoopSettings] = lambda loop: loop
    config: Callable[[TwinConfig], TwinConfig] = lambda config: config
    rated: bool = False
    readings: tuple[str, ...] = ("hz", "rad")
    misses: int = 0
    ringing: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of it: the reason, loop time from the onset, output at the end."""

    reason: str
    after_s: float
    output_v: float


def reference_of(kind: str, blocks: int, onset: int, rng: np.random.Generator) -> NDArray[Any]:
    """A reference whose step, where it has one, is at the onset."""
    time_s = BLOCK_S * np.arange(blocks)
    if kind == "step":
        return np.where(np.arange(blocks) < onset, 0.0, rng.uniform(0.035, 0.045))
    if kind == "far":
        return np.where(np.arange(blocks) < onset, 0.0, 0.09)
    if kind == "sine":
        return 0.02 + 0.02 * np.sin(2.0 * np.pi * rng.uniform(0.4, 0.6) * time_s)
    if kind == "square":  # two steps a second
        return np.where((np.arange(blocks) // 25) % 2, 0.05, 0.0)
    return np.full(blocks, rng.uniform(0.0, 0.03))


def play(case: Case, reading: str, seed: int, blocks_after: int = 80) -> Outcome:
    """Close the loop, let the fault strike, see what trips."""
    rng = np.random.default_rng([seed, len(case.name)])
    onset = case.onset and case.onset + int(rng.integers(0, 40))
    config = case.config(twin_of_reading(reading))
    twin = TwinBench(config, 1000 + seed)
    scene = Scene(twin, onset)
    case.inject(scene, rng)
    to_volt, to_strain, saturation = MAPS[reading]
    rest_v = float(to_volt.voltage_v(0.0))
    loop = case.loop(LoopSettings(GAINS[reading].controller(), saturation, to_volt, to_strain))
    rating = None
    if case.rated:
        # Thickness at rest: known here from the twin's own field.
        twin.write(rest_v)
        twin.wait(20.0)
        thickness_m = twin.output_v / twin.native.field_v_m
        farad = twin.native.capacitance(twin.length_m)
        rating = FieldRating(1.5 * twin.native.field_v_m, thickness_m, farad)
        twin.write(0.0)
        twin.wait(20.0)
    settings = SafetySettings(rating=rating)
    plain = dataclasses.replace(rig_of(twin, config), source=scene, acquisition=scene)
    rig = guard(plain, Safety(settings))
    rig.safety.arm(rig.safety.request())
    reason, tripped_s, start_s = "", math.nan, 0.0
    try:
        with (
            patched_sensor(scene),
            Runner(rig, NoRecord(), scene, 2000.0, 0.02, SilentProgress()) as runner,
        ):
            runner.settle(rest_v, 20.0)
            if case.ringing:
                runner.settle(rest_v + 0.8, 6.0)
                runner.settle(rest_v, 2.0)
            if case.video:
                loop = replace(loop, video_zero_px=twin.length_m / 0.35e-3)
            scene.block = -1
            reference = reference_of(case.reference, onset + blocks_after, onset, rng)
            start_s = twin.time_s
            runner.close_loop("x", reference, loop, 100.0, config.load.mass_kg)
    except SafetyError:
        reason, tripped_s = rig.safety.reason, (scene.block + 1) * BLOCK_S + start_s
    after_s = tripped_s - start_s - onset * BLOCK_S
    return Outcome(reason, after_s, twin.output_v)


class patched_sensor:  # noqa: N801
    """The self-sensing of the runner, with a scene's faults."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def __enter__(self) -> None:
        scene = self._scene
        self._kept = plain = CapacitanceSensor.strain

        def strain(sensor: CapacitanceSensor, codes: Codes) -> float:
            value = plain(sensor, codes)
            if scene.capacitance is not None and sensor.capacitance_f is not None:
                farad = scene.capacitance(scene.since, sensor.capacitance_f)
                sensor.capacitance_f = farad
                m = sensor._map
                value = _core.strain_from_capacitance(*m.coefficients, farad)
            return value if scene.strain is None else scene.strain(scene.since, value)

        CapacitanceSensor.strain = strain  # type: ignore[method-assign]

    def __exit__(self, *_: object) -> None:
        CapacitanceSensor.strain = self._kept  # type: ignore[method-assign]


# ---- what can go wrong -------------------------------------------------------------------------


def on_codes(change: Callable[[int, Codes, np.random.Generator], Codes]) -> Any:
    """A fault of the blocks from the onset on."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        scene.codes = lambda k, codes: codes if k < 0 else change(k, codes.copy(), rng)

    return inject


def on_strain(change: Callable[[int, float, list[float]], float]) -> Any:
    """A fault of the strain; the list holds all true ones."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        def faulty(k: int, strain: float) -> float:
            scene.past.append(strain)
            return strain if k < 0 else change(k, strain, scene.past)

        scene.strain = faulty

    return inject


def on_capacitance(change: Callable[[int, float], float]) -> Any:
    """A fault of the capacitance."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        scene.capacitance = lambda k, farad: farad if k < 0 else change(k, farad)

    return inject


def on_frame(change: Callable[[int, Seen, list[Seen]], Seen | None]) -> Any:
    """A fault of the camera; the list holds all true frames."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        def faulty(k: int, seen: Seen) -> Seen | None:
            scene.past.append(seen)
            return seen if k < 0 else change(k, seen, scene.past)

        scene.frame = faulty

    return inject


def held(period: int) -> Any:
    """The same blocks again and again."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        def faulty(k: int, codes: Codes) -> Codes:
            if k < 0:
                scene.past.append(codes)
                return codes
            return np.array(scene.past[-period:][k % period])

        scene.codes = faulty

    return inject


def late_blocks(blocks: int) -> Any:
    """The acquisition hands on what it took some blocks before."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        def faulty(k: int, codes: Codes) -> Codes:
            scene.past.append(codes)
            return codes if k < 0 else np.array(scene.past[-1 - min(k, blocks)])

        scene.codes = faulty

    return inject


def late_outputs(blocks: int) -> Any:
    """Outputs wait in a queue that nobody knows of."""

    def inject(scene: Scene, rng: np.random.Generator) -> None:
        def faulty(k: int, volt: float) -> float:
            scene.past.append(volt)
            return volt if k < 0 else scene.past[-1 - min(k, blocks, len(scene.past) - 1)]

        scene.written = faulty

    return inject


def _scaled(column: int, factor: Callable[[int], float]) -> Any:
    def change(k: int, codes: Codes, rng: np.random.Generator) -> Codes:
        wide = codes[:, column].astype(float) * factor(k)
        codes[:, column] = np.clip(np.round(wide), -32768, 32767)
        return codes

    return change


def _noisy(k: int, codes: Codes, rng: np.random.Generator) -> Codes:
    codes[:, 1] += np.round(2500.0 * rng.standard_normal(len(codes))).astype(np.int16)
    return codes


def _flat(k: int, codes: Codes, rng: np.random.Generator) -> Codes:
    codes[:, 1] = 7
    return codes


def _open(k: int, codes: Codes, rng: np.random.Generator) -> Codes:
    codes[:, 1] = rng.integers(-2, 3, len(codes))
    return codes


def _gaps(k: int, codes: Codes, rng: np.random.Generator) -> Codes:
    return _flat(k, codes, rng) if k % 4 != 3 else codes


def other_actuator(scene: Scene, rng: np.random.Generator) -> None:
    """The current monitor belongs to something that does not move; it has noise of its own."""

    def faulty(k: int, codes: Codes) -> Codes:
        if k < 0:
            scene.past.append(codes)
            return codes
        codes = codes.copy()
        noise = rng.integers(-1, 2, len(codes))
        codes[:, 1] = scene.past[-1][:, 1] + noise.astype(np.int16)
        return codes

    scene.codes = faulty


def carrier_off(scene: Scene, rng: np.random.Generator) -> None:
    """The generator goes off by itself."""
    scene.strike = scene.twin.off


def gains(kp: float, ki: float, kd: float = 0.0) -> Any:
    """Other gains than the study's."""
    return lambda loop: replace(loop, controller=PidGains(kp, ki, kd).controller())


def _mirrored(loop: LoopSettings) -> LoopSettings:
    m = loop.strain_map
    return replace(loop, strain_map=StrainMap(*(-factor for factor in m.coefficients)))


def _falling(loop: LoopSettings) -> LoopSettings:
    """A voltage map whose voltage falls with strain, about the same voltage of zero strain."""
    v = loop.voltage_map
    return replace(
        loop,
        voltage_map=VoltageMap(v.a1_v, -v.b1, v.a2_v, -v.b2, -v.strain_high, -v.strain_low),
        saturation=Saturation(-loop.saturation.high, -loop.saturation.low),
    )


RANGE = "out of range"
LOST = "No strain in 5 blocks|Strain lost"
FROZEN = "Block (stuck|repeating)"
STUCK = "Strain (stuck|repeating)"
JUMP = "Strain (jumped|alternates)"
SWINGS = "Output (oscillates|charges)"
AGAINST = "against the drive"
DEAD = "does not respond"
DELAY = "Delay too long"
NOT_FOLLOWING = "Output does not follow"

CASES = [
    Case("capacitance infinite", RANGE, on_capacitance(lambda k, c: math.inf)),
    Case("capacitance 1e300", RANGE, on_capacitance(lambda k, c: 1e300)),
    Case("capacitance negative", RANGE, on_capacitance(lambda k, c: -c)),
    Case("capacitance not a number", LOST, on_capacitance(lambda k, c: math.nan)),
    Case("capacitance out of range", RANGE, on_capacitance(lambda k, c: 4.0 * c)),
    Case("capacitance stuck", STUCK, on_capacitance(lambda k, c: 5.5e-10)),
    Case("capacitance jumps", f"{JUMP}|{RANGE}", on_capacitance(lambda k, c: 1.3 * c)),
    Case("capacitance alternates", JUMP,
         on_capacitance(lambda k, c: c * (1.0 + 0.06 * (-1) ** k))),
    Case("capacitance falls to nothing", f"{RANGE}|{JUMP}|{AGAINST}",
         on_capacitance(lambda k, c: c * 0.97**k)),
    Case("strain infinite", RANGE, on_strain(lambda k, s, past: math.inf)),
    Case("strain 1e300", RANGE, on_strain(lambda k, s, past: -1e300)),
    Case("strain stuck", STUCK, on_strain(lambda k, s, past: past[-1 - k])),
    Case("strain stuck in a step", STUCK, on_strain(lambda k, s, past: past[-1 - k]),
         reference="step"),
    Case("strain frozen: old values again", STUCK,
         on_strain(lambda k, s, past: past[-1 - k - 7 + k % 7])),
    Case("strain alternates by 0.5", RANGE, on_strain(lambda k, s, past: 0.5 * (-1) ** k)),
    Case("strain alternates by 0.02", JUMP, on_strain(lambda k, s, past: s + 0.02 * (-1) ** k)),
    Case("strain jumps in a sine", JUMP, on_strain(lambda k, s, past: s + 0.08),
         reference="sine"),
    Case("strain jumps now and then", JUMP,
         on_strain(lambda k, s, past: s + 0.07 * (k % 20 > 17))),
    Case("strain lost in three blocks of four", LOST, on_codes(_gaps)),
    Case("acquisition frozen", FROZEN, held(1)),
    Case("acquisition frozen in a sine", f"{FROZEN}|{NOT_FOLLOWING}", held(1),
         reference="sine"),
    Case("acquisition repeats eight blocks", FROZEN, held(8)),
    Case("current monitor stuck", LOST, on_codes(_flat)),
    Case("current monitor open", LOST, on_codes(_open)),
    Case("current monitor reversed", f"{LOST}|{RANGE}", on_codes(_scaled(1, lambda k: -1.0))),
    Case("current monitor loses gain", f"{JUMP}|{RANGE}", on_codes(_scaled(1, lambda k: 0.6))),
    Case("current monitor noisy", f"{JUMP}|{LOST}", on_codes(_noisy)),
    Case("contact comes and goes", JUMP,
         on_codes(_scaled(1, lambda k: 1.0 if k % 3 else 0.85))),
    Case("voltage monitor loses gain", f"{NOT_FOLLOWING}|{JUMP}|{RANGE}",
         on_codes(_scaled(0, lambda k: 0.5))),
    Case("monitors swapped", f"{NOT_FOLLOWING}|Breakdown",
         on_codes(lambda k, codes, rng: codes[:, ::-1].copy())),
    Case("carrier lost", LOST, carrier_off),
    # Noise of its own looks like a reaction in one of about 24 runs: docs/bench/safety.md says so.
    Case("sensor of another actuator", f"{DEAD}|{AGAINST}", other_actuator, reference="step",
         misses=1),
    Case("gains too high: kp = 50", SWINGS, loop=gains(50.0, 1.5), onset=0, readings=("hz",)),
    Case("gains too high: kp = 50 in a step", f"{SWINGS}|{JUMP}", loop=gains(50.0, 1.5),
         onset=0, reference="step", readings=("hz",)),
    Case("derivative too high", f"{SWINGS}|{JUMP}", loop=gains(0.4, 0.7, 3.0), onset=0),
    Case("strain map reversed", AGAINST, loop=_mirrored, onset=0, reference="step"),
    Case("voltage map reversed", AGAINST, loop=_falling, onset=0, reference="step"),
    Case("strain map reversed while it rings", AGAINST, loop=_mirrored, onset=0, reference="far",
         ringing=True),
    Case("voltage map reversed while it rings", AGAINST, loop=_falling, onset=0, reference="far",
         ringing=True, readings=("hz",)),
    Case("strain reversed in a step", AGAINST, on_strain(lambda k, s, past: -s),
         reference="step", readings=("hz",)),
    Case("blocks late by 5", DELAY, late_blocks(5)),
    Case("blocks late by 5 in a sine", f"{DELAY}|{NOT_FOLLOWING}", late_blocks(5),
         reference="sine"),
    Case("outputs late by 3", DELAY, late_outputs(3)),
    Case("field above its limit", "Field too high", reference="far", rated=True, readings=("hz",)),
    Case("camera stops", "No frame", on_frame(lambda k, seen, past: None), video=True),
    Case("picture frozen", STUCK,
         on_frame(lambda k, seen, past: replace(past[-1 - k], time_s=seen.time_s)), video=True),
    Case("fiducial lost", "fiducial", on_frame(lambda k, seen, past: Seen(seen.time_s, math.nan)),
         video=True),
    Case("fiducial confused", f"{JUMP}|{RANGE}",
         on_frame(lambda k, seen, past: Seen(seen.time_s, 1.12 * seen.length_px)), video=True),
    Case("length not finite", RANGE,
         on_frame(lambda k, seen, past: Seen(seen.time_s, math.inf)), video=True),
    Case("frames late", "Frame too old",
         on_frame(lambda k, seen, past: None if k % 3 else past[-1 - k + k // 3]), video=True),
    Case("camera shows another actuator", f"{DEAD}|{AGAINST}",
         on_frame(lambda k, seen, past: Seen(
             seen.time_s, past[-1 - k].length_px * (1.0 + 1e-5 * math.sin(7.7 * k)))),
         video=True, reference="step"),
    Case("picture turned: length falls", AGAINST,
         on_frame(lambda k, seen, past: Seen(
             seen.time_s, 2.0 * past[-1 - k].length_px - seen.length_px)),
         video=True, reference="step", readings=("hz",)),
    Case("video gains too high", SWINGS, loop=gains(50.0, 1.5), onset=0, video=True,
         readings=("hz",)),
]  # fmt: skip


def board(seeds: range) -> Iterator[tuple[Case, str, int]]:
    """All cases on all their twins."""
    for case in CASES:
        for reading in case.readings:
            for seed in seeds:
                yield case, reading, seed
