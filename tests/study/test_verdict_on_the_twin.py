"""Verdicts on the twin by the path of a user's data: monitors, lock-in, capacitance, strain."""

import numpy as np
import pytest

from haselab.base import SilentProgress
from haselab.identify import Record, compare, creep_hypotheses, reading_hypotheses
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.runtime.lockin import BLANKING_S, lockin_of
from haselab.runtime.runner import Runner
from haselab.signals import constant, linear_chirp, square

RATE_HZ, SLEW_V_S = 100.0, 2400.0  # 12 mA into 1 nF behind a gain of 5,000


class Memory:
    """Recorder and observer that keep the blocks and look at nothing."""

    def __init__(self):
        self.codes, self.start_s = [], []

    def append_block(self, name, codes, start_s, drive_v, reference):
        self.codes.append(codes)
        self.start_s.append(start_s)

    def flush(self, name):
        pass

    def event(self, time_s, what):
        pass

    def condition(self, *given):
        pass

    def start(self, name, rate_hz, mass_kg, part="", particles=""):
        pass

    def look(self):
        return None

    def finish(self):
        pass


def bench_of(reading, creep):
    data = twin_of_reading(reading).model_dump()
    if creep == "electrical":
        data["viscosity"]["share"] = (0.02, 0.02, 0.05)
        data["dielectric"]["relaxation_share"] = 0.35
    data["acquisition"]["drive_low_v"] = -2.0
    return TwinConfig.model_validate(data)


def play(config, drive_v):
    rig, memory = make_twin(config, 5), Memory()
    lockin = lockin_of(rig.description, 2000.0)
    with Runner(rig, memory, memory, 2000.0, 0.02, SilentProgress()) as runner:
        runner.settle(float(drive_v[0]), 40.0)
        runner.play("drive", drive_v, 400.0, runner.mass_kg)
    sensed = lockin.sense(np.stack(memory.codes))
    time_s = np.array(memory.start_s) - memory.start_s[0] + lockin.middle_s
    time_s -= rig.description.switch_sample / rig.description.rate_hz
    moves_s = np.abs(np.diff(drive_v, prepend=drive_v[0])) / SLEW_V_S
    good = sensed.valid & (time_s >= 0.0) & (moves_s < BLANKING_S)
    farad = sensed.capacitance_f[good]
    return Record(
        drive_v, RATE_HZ, (farad / farad[:50].mean()) ** (1 / 3.33) - 1.0, time_s[good], None
    )


@pytest.mark.parametrize("reading", ["rad", "hz"])
def test_the_papers_chirp_decides_the_frequency_axis(reading):
    sweep = 1.0 + 0.6 * linear_chirp(0.1, 10.0, 10.0, RATE_HZ)
    record = play(bench_of(reading, "mechanical"), np.concatenate([np.ones(100), sweep]))
    found = compare(reading_hypotheses(slew_v_s=SLEW_V_S), [record])
    assert found.verdict == f"supports {reading}"


@pytest.mark.parametrize("creep", ["mechanical", "electrical"])
def test_alternating_polarity_identifies_the_creep_and_the_papers_step_does_not(creep):
    config = bench_of("hz", creep)
    held, turns = constant(1.5, 8.0, RATE_HZ), 1.5 * square(0.5, 8.0, RATE_HZ)
    rest = constant(1.0, 8.0, RATE_HZ)
    alternation = np.concatenate([rest[:100], held, turns, rest, turns])
    step = np.concatenate([constant(1.0435, 5.0, RATE_HZ), constant(1.405, 25.0, RATE_HZ)])
    rivals = creep_hypotheses(slew_v_s=SLEW_V_S)
    assert compare(rivals, [play(config, alternation)]).verdict == f"supports {creep}"
    assert compare(rivals, [play(config, step)]).verdict == "cannot tell"
