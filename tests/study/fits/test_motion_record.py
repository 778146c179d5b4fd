"""A session as one motion: what acted when, and when each capacitance was sensed."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, Drive, SampledLaw
from haselab.pipelines.motion import _charged_f, _drive, _late_s, _rise, _weights
from haselab.rig.twin.config import Mullins, TwinConfig
from haselab.rig.twin.twin_bench import native_bench
from haselab.rig.twin.twin_file import load_twin
from haselab.sensing import Lockin, LockinConfig
from haselab.store.session.writer import SessionWriter

KINDS = Path(__file__).resolve().parents[3] / "examples" / "kinds"

RATE_HZ, CARRIER_HZ, BLOCK = 200e3, 2000.0, 2000
AMPLITUDE = 2e4  # codes
RISE_PER_S, STEP = 3.0, 1e-3  # of the capacitance, relative


@pytest.mark.parametrize("phase_rad", [0.0, 0.4, 1.3, 2.2, 3.0])
@pytest.mark.parametrize("blank", [(336, 560), (0, 560)])
def test_a_capacitance_that_changes_is_weighted_as_stated(phase_rad, blank):
    config = LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=blank)
    lockin = Lockin(config, models=False)
    time_s = np.arange(BLOCK) / RATE_HZ
    turn = np.exp(1j * (config.omega_rad_s * time_s + phase_rad))
    rise = RISE_PER_S * (time_s - lockin.middle_s)
    step = STEP * (np.arange(BLOCK) >= blank[1])
    flat = AMPLITUDE * np.stack([turn.real, (1j * turn).real], axis=1)[None]
    weight, later_s = (part[0] for part in _weights(flat[:, :, 0].astype(np.int16), lockin))
    assert weight.sum() == pytest.approx(1.0, abs=5e-7)  # single precision
    used = np.flatnonzero(lockin.counted)
    parts = [used[used < blank[1]], used[used >= blank[1]]][-len(weight) :]
    for change in (rise, step, rise + step):
        codes = flat * np.stack([np.ones(BLOCK), 1.0 + change], axis=1)
        ratio = lockin.sense(codes).capacitance_f[0] / lockin.sense(flat).capacitance_f[0]
        found = sum(w * change[at].mean() for w, at in zip(weight, parts, strict=True))
        found += later_s * RISE_PER_S * (change is not step)
        # the second order of the change, and the rounding of the codes
        assert ratio - 1.0 == pytest.approx(found, abs=STEP**2 + 2.0 / AMPLITUDE**2)


def test_the_phase_of_the_carrier_moves_the_time():
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(336, 560)))
    time_s = np.arange(BLOCK) / RATE_HZ
    phase_rad = np.linspace(0.0, np.pi, 50)[:, None]
    codes = (AMPLITUDE * np.cos(2.0 * np.pi * CARRIER_HZ * time_s + phase_rad)).astype(np.int16)
    later_s = _weights(codes, lockin)[1]
    assert np.ptp(later_s) > 5e-5
    # by half a turn of the carrier and on, it repeats
    assert later_s[0] == pytest.approx(later_s[-1], abs=1e-7)


@pytest.mark.parametrize("from_v", [0.0, 900.0])
def test_the_first_step_of_an_experiment_is_as_late_as_its_monitor_shows(from_v):
    """A slew from one level to the next acts on average half of its duration late."""
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(400, 560)))
    slew = 60  # samples
    at = np.arange(BLOCK)
    ramp = np.clip((at - 400.0) / slew, 0.0, 1.0)
    carrier = 60.0 * np.sin(2.0 * np.pi * CARRIER_HZ * at / RATE_HZ)
    first = from_v + (4000.0 - from_v) * ramp + carrier
    codes = np.round(np.stack([first, np.full(BLOCK, 4000.0) + carrier])).astype(np.int16)
    found = _rise(codes, lockin)
    part = SimpleNamespace(rise=found, lag_s=np.zeros(2))
    late_s = _late_s([part], RATE_HZ)[0]
    # of the square of the voltage, which the force follows; sums of samples
    square = (4000.0**2 - (from_v + (4000.0 - from_v) * ramp[400:560]) ** 2).sum()
    expected = square / (4000.0**2 - from_v**2) - 0.5
    # codes are rounded, and the square of each is uncertain by 2 V / sqrt(12)
    rounding = 3.0 * 2.0 * 4000.0 * np.sqrt(160.0 / 12.0) / (4000.0**2 - from_v**2)
    assert late_s[0] * RATE_HZ == pytest.approx(expected, abs=rounding)
    assert expected > 0.3 * slew
    # a step in two parts has the same area, and the same mean of share (1 - share)
    share = ((from_v + (4000.0 - from_v) * ramp) ** 2 - from_v**2) / (4000.0**2 - from_v**2)
    apart = 4.0 * (share * (1.0 - share)).sum()
    assert found.duration[0] == pytest.approx(apart, abs=4.0 * rounding)
    assert found.duration[1] == 0.0
    assert found.middle[0] == pytest.approx(np.sqrt(0.5 * (4000.0**2 + from_v**2)), abs=1.0)


@pytest.mark.parametrize(
    ("kind", "bound"),
    # with the carrier c of the frequency w, a change from V acts c / (V w) earlier: 1 to 3 us; the
    # ramp of 0.5 ms that charges a stack is followed in two steps: T^2 / 36 of its acceleration
    [("planar-hasel", 1e-4), ("peano-hasel", 2e-5), ("dea-stack", 1.5e-4)],
)
def test_the_drive_of_a_record_moves_the_law_as_the_instruments_moved_the_actuator(kind, bound):
    """Large steps of an amplifier with a lag and a current limit, within `bound` of the motion."""
    if kind == "planar-hasel":
        config = TwinConfig(mullins=Mullins(share=0.0))
    else:
        config = load_twin(KINDS / kind / "twin.toml")
    law, gain = config.law, config.amplifier.gain
    bench = native_bench(config, 1, noise=False)
    bench.carrier_rad_s, bench.carrier_v = 2.0 * np.pi * CARRIER_HZ, 0.02
    load_n = config.load.mass_kg * GRAVITY_M_S2
    middle_v, half_v = (
        0.55 * config.acquisition.drive_high_v,
        0.17 * config.acquisition.drive_high_v,
    )
    drive_v = middle_v + half_v * np.sin(2.0 * np.pi * 5.0 * np.arange(100) / 100.0)
    drive_v[:10] = middle_v
    bench.move(drive_v[:1], 1, load_n, np.empty(1_200_000))  # creep of two minutes
    codes = np.empty((drive_v.size, BLOCK, 2), dtype=np.int16)
    lengths = np.empty((drive_v.size, BLOCK // 20))
    for k, volt in enumerate(drive_v):
        bench.acquire(drive_v[max(k - 1, 0)], volt, 400, load_n, codes[k], lengths[k])
    rig = {"rate_hz": RATE_HZ, "block_samples": BLOCK, "switch_sample": 400, "amplifier_gain": gain,
           "volt_per_code": 20.0 / 2**16, "v_monitor_v_per_v": 1.0 / gain}  # fmt: skip
    lockin = Lockin(LockinConfig(RATE_HZ, BLOCK, CARRIER_HZ, 0.0, 1e6, blank=(400, 560)))
    farad = law.differential_capacitance_f(lengths.mean(axis=1), gain * middle_v)
    start_s = BLOCK / RATE_HZ * np.arange(drive_v.size)
    part = SimpleNamespace(
        start_s=start_s, drive_v=drive_v, spans_s=np.zeros((0, 2)), carrier_v=np.nan,
        rise=_rise(codes[:, :, 0], lockin), lag_s=law.circuit.series_ohm * farad,
    )  # fmt: skip
    names = [("time_s", float), ("drive_v", float), ("carrier_v", float), ("pull_n", float),
             ("mass_kg", float)]  # fmt: skip
    conditions = np.array([(0.0, drive_v[0], 0.02, load_n, config.load.mass_kg)], dtype=names)

    def left_m(drive: Drive) -> float:
        sampled = SampledLaw(law, 12e3, added_inertia_kg=config.load.added_inertia_kg)
        time_s = (start_s[:, None] + 1e-4 * np.arange(1, 101)).ravel()[:-1]
        acts = float(drive.voltage_v[0]), float(drive.ripple_v2[0]), load_n
        found = sampled.respond(drive, time_s, sampled.at_rest(*acts)[0], sensed=np.zeros(
            drive.voltage_v.size, dtype=bool)).length_m  # fmt: skip
        return float(np.std(lengths.ravel()[:-1] - found))

    drive = _drive(conditions, [part], rig)
    motion_m = float(np.std(lengths))
    assert left_m(drive) < bound * motion_m
    # a delay of 10 us is seen
    late = replace(drive, edge_s=drive.edge_s + 1e-5 * (drive.edge_s > 0.0))
    assert left_m(late) > bound * motion_m


def test_in_fast_motion_the_lag_follows_the_capacitance_at_each_switch():
    """A swing of 10 Hz by a third of the length, where one block in ten has a capacitance."""
    block_s, middle_s, switch_s, scale = 0.01, 6e-3, 2e-3, 1e-4
    count = 300
    start_s = block_s * np.arange(count)

    def length_m(time_s):
        return 0.036 * (1.0 + 0.3 * np.sin(2.0 * np.pi * 9.7 * time_s))

    def farad(time_s):  # of a stack: its volume and the number of its layers are constant
        return 1e-9 * (0.036 / length_m(time_s)) ** 2

    frame_s = np.arange(0.0, count * block_s + 0.005, 0.005)
    tracks = np.zeros((frame_s.size, 6), SessionWriter.track_dtype())
    tracks["valid"], tracks["std_y_px"] = True, 0.02
    tracks["y_px"][:, 3:] = (length_m(frame_s) / scale)[:, None]
    sensed = SimpleNamespace(
        valid=np.arange(count) % 10 == 0, capacitance_f=np.where(
            np.arange(count) % 10 == 0, farad(start_s + middle_s), np.nan)
    )  # fmt: skip
    record = SimpleNamespace(block_start_s=start_s, frame_time_s=frame_s, tracks=tracks)
    found = _charged_f(record, scale, sensed, middle_s, switch_s)
    true = farad(start_s + switch_s)
    # a parabola of the logarithm of a square, over 0.7 to 1.3 of the length: third order
    cubic = 2.0 / 3.0 * 0.3**3
    between = 0.3 * 0.5 * (2.0 * np.pi * 9.7 * 0.0025) ** 2  # frames, linearly interpolated
    limit = cubic / 4.0 + 2.0 * between / 0.7
    assert np.abs(found / true - 1.0).max() < limit
    assert np.abs(np.median(true) / true - 1.0).max() > 5.0 * limit  # as one for all would be
    none = _charged_f(SimpleNamespace(**{**vars(record), "tracks": tracks[:, :0]}), scale, sensed,
                      middle_s, switch_s)  # fmt: skip
    assert none[0] == sensed.capacitance_f[0]
    assert none[1] == np.median(sensed.capacitance_f[sensed.valid])
