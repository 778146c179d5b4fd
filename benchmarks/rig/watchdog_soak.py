"""One hour of loop time and 20 random twins under the loop watchdog: it must not trip once.

python -m benchmarks.rig.watchdog_soak [seconds of loop time] [twins]
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import SafetyError, SilentProgress
from haselab.control import PidGains, Saturation
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Seen
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.loop_watchdog import LoopWatchdog
from haselab.study.definition import Study, builtin_study
from haselab.study.fits.maps import Maps
from haselab.study.pipeline import play_and_fit
from haselab.study.simulated.noise_free import NoiseFreeBench

BLOCKS_PER_S = 100
CARRIER = (2000.0, 0.02)
Floats = NDArray[np.float64]


class Nothing:
    """Neither records nor watches."""

    def append_block(self, *given: Any) -> None: ...
    def flush(self, name: str) -> None: ...
    def event(self, time_s: float, what: str) -> None: ...
    def condition(self, *given: Any) -> None: ...
    def start(self, *given: Any, **named: Any) -> None: ...
    def look(self) -> Seen | None: ...
    def finish(self) -> None: ...


def random_twin(seed: int) -> TwinConfig:
    """Parameters within factors of 0.7 and 1.4, monitors with gain errors, noise up to 10x."""
    rng = np.random.default_rng(seed)
    data = twin_of_reading("hz" if seed % 2 else "rad").model_dump()

    def scale(section: str, *names: str) -> None:
        for name in names:
            data[section][name] *= float(rng.uniform(0.7, 1.4))

    scale("load", "mass_kg", "added_inertia_kg")
    scale("shell", "shear_modulus_pa")
    scale("electrodes", "stiffness_n_per_m")
    scale("viscosity", "damping_n_s_per_m")
    scale("dielectric", "permittivity", "series_ohm")
    scale("amplifier", "bandwidth_hz")
    data["dielectric"]["breakdown_v_per_m"] = 1e8  # some of them are too thin for 10 kV
    for name in ("gain_error", "v_monitor_gain_error", "i_monitor_gain_error"):
        data["amplifier"][name] = float(rng.uniform(-0.03, 0.03))
    noise = float(rng.choice([1.0, 1.0, 3.0, 10.0]))
    data["acquisition"]["v_noise_v"] *= noise
    data["acquisition"]["i_noise_v"] *= noise
    return TwinConfig.model_validate(data)


def maps_of(config: TwinConfig) -> Maps:
    """Of the triangle test, without noise."""
    reference = builtin_study(quick=True).model_dump(mode="json")
    study = Study.model_validate({key: reference[key] for key in ("name", "sensing", "triangle")})
    quiet = NoiseFreeBench(config, study)
    with Runner(quiet.rig, quiet, quiet, *CARRIER, SilentProgress()) as runner:
        found = play_and_fit(quiet.observation, study, quiet.rig.description, runner)
    maps = found.find(Maps)
    assert maps is not None
    return maps


def loop_of(config: TwinConfig, maps: Maps, gains: PidGains) -> LoopSettings:
    """The study's saturation, narrowed to what the drive can put out."""
    grid = np.linspace(-0.05, 0.1, 1501)
    volt = maps.voltage_map.voltage_v(grid)
    daq = config.acquisition
    inside = grid[(volt >= daq.drive_low_v) & (volt <= daq.drive_high_v)]
    saturation = Saturation(float(inside[0]), float(inside[-1]))
    return LoopSettings(gains.controller(), saturation, maps.voltage_map, maps.strain_map)


def references() -> dict[str, Floats]:
    """Steps small and large, sines, one beyond reach, one that begins in open loop."""

    def hold(strain: float, seconds: float) -> Floats:
        return np.full(round(seconds * BLOCKS_PER_S), strain)

    time_s = np.arange(6 * BLOCKS_PER_S) / BLOCKS_PER_S
    return {
        "steps": np.concatenate(
            [hold(0.0, 4), hold(0.04, 5), hold(0.1, 3), hold(0.0, 3), hold(0.06, 3)]
        ),
        "large": np.concatenate(
            [hold(np.nan, 1), hold(0.0, 1), hold(0.1, 3), hold(-0.02, 3), hold(0.1, 3)]
        ),
        "sine 0.5 Hz": 0.03 + 0.03 * np.sin(np.pi * time_s),
        "sine 2 Hz": 0.03 + 0.02 * np.sin(4.0 * np.pi * time_s),
        "beyond reach": np.concatenate([hold(0.0, 2), hold(0.3, 4)]),
    }


def play(config: TwinConfig, seed: int, loop: LoopSettings, reference: Floats) -> str:
    """Close the loop from 0 V; why it tripped, empty if it did not."""
    twin = TwinBench(config, seed)
    rig = guard(rig_of(twin, config), Safety(SafetySettings(permit_age_s=1e6)))
    rig.safety.arm(rig.safety.request())
    nothing = Nothing()
    try:
        with Runner(rig, nothing, nothing, *CARRIER, SilentProgress()) as runner:
            runner.settle(0.0, 20.0)
            runner.close_loop("x", reference, loop, 20.0, config.load.mass_kg)
    except SafetyError as error:
        return str(error)
    return ""


def twins(count: int) -> int:
    """Trips on random twins, each with its own maps and two controllers."""
    trips = loops = blocks = found = seed = 0
    while found < count:
        seed += 1
        config = random_twin(seed)
        try:
            maps = maps_of(config)
        except SafetyError:  # so soft that 10 kV pulls it to breakdown: no actuator
            continue
        found += 1
        rng = np.random.default_rng(seed)
        slow = PidGains(0.35 * rng.uniform(0.5, 1.0), 1.2 * rng.uniform(0.5, 1.0))
        fast = PidGains(0.05, 6.0 * rng.uniform(0.4, 1.0), 0.015)
        # A derivative without a filter makes large swings of noise ten times the usual: no fault
        # of the watchdog's. The resonance of the other reading needs a derivative of its own.
        noisy = config.acquisition.v_noise_v > 1e-3
        for gains in (slow, fast) if config.reading == "hz" and not noisy else (slow,):
            for name, reference in references().items():
                why = play(config, seed, loop_of(config, maps, gains), reference)
                loops, blocks, trips = loops + 1, blocks + len(reference), trips + bool(why)
                if why:
                    print(f"twin {seed} ({config.reading}), {gains}, {name}: {why}", flush=True)
    print(f"{count} random twins: {loops} loops, {blocks} blocks, {trips} trips", flush=True)
    return trips


def soak(seconds: float) -> int:
    """Trips in one long loop; prints what the watchdog costs."""
    config = twin_of_reading("hz")
    loop = loop_of(config, maps_of(config), PidGains(0.4265, 0.7527))
    rng = np.random.default_rng(5)
    count = round(seconds * BLOCKS_PER_S)
    held = rng.uniform(-0.01, 0.06, count // 1000 + 1).repeat(1000)[:count]
    wave = 0.01 * np.sin(np.pi * np.arange(count) / BLOCKS_PER_S)
    reference = held + wave * (np.arange(count) // 3000 % 2)
    spent, plain = [0], LoopWatchdog.fault

    def timed(*given: Any) -> str:
        begun = time.perf_counter_ns()
        try:
            return plain(*given)
        finally:
            spent[0] += time.perf_counter_ns() - begun

    LoopWatchdog.fault = timed  # type: ignore[method-assign]
    begun_s = time.perf_counter()
    why = play(config, 11, loop, reference)
    took_s = time.perf_counter() - begun_s
    LoopWatchdog.fault = plain  # type: ignore[method-assign]
    cost_us = spent[0] / 1e3 / count
    print(
        f"soak of {seconds:g} s, {count} blocks in {took_s:.0f} s: {'1 trip' if why else '0 trips'}"
        f"; watchdog {cost_us:.0f} us a block {why}"
    )
    return bool(why)


if __name__ == "__main__":
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 3600.0
    number = int(sys.argv[2]) if len(sys.argv) > 2 else 20
    sys.exit(2 if (twins(number) if number else 0) + (soak(seconds) if seconds else 0) else 0)
