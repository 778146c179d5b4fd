"""The cut of a block into parts is the best of all cuts, and what it leaves out is what is hit."""

from itertools import product

import numpy as np
import pytest

from haselab import _sense
from haselab.sensing import Lockin, LockinConfig
from haselab.sensing.block.drive import DriveLibrary
from haselab.sensing.block.segments import Segments

SEGMENTS, PRICE, CUT, LEFT_OUT = 7, 8.0, 6.0, 10.0
WIDE = _sense.PART_COLUMNS


def tables(rng):
    """Orthonormal columns for runs of each length, two at the most."""
    found = []
    for count in range(1, SEGMENTS + 1):
        q, _ = np.linalg.qr(rng.standard_normal((2 * count, 2)))
        found.append(np.pad(q, ((0, 0), (0, WIDE - 2))))
    return found


def exhaustive(y, columns):
    """Least score over every choice of segments left out; runs between them are parts."""
    best = np.inf
    for used in product((0, 1), repeat=SEGMENTS):
        score, at = LEFT_OUT * (SEGMENTS - sum(used)), 0
        while at < SEGMENTS:
            end = at
            while end < SEGMENTS and used[end] == used[at]:
                end += 1
            if used[at]:
                values = y[:, 2 * at : 2 * end]
                taken = values @ columns[end - at - 1][:, :2]
                score += (values**2).sum() - (taken**2).sum() + 2 * PRICE
                score += np.inf if end - at < 2 else 0.0  # two coordinates are left over
            else:
                score += CUT
            at = end
        best = min(best, score)
    return best


def test_the_cut_is_the_best_of_all(rng):
    columns = tables(rng)
    y = rng.standard_normal((40, 2, 2 * SEGMENTS)) * rng.uniform(1, 4, (40, 1, 1))
    y[::2, :, 6:8] += 30.0
    parts, result = np.zeros((40, SEGMENTS), _sense.PART), np.empty(40, _sense.PARTS_RESULT)
    _sense.parts(y, [np.concatenate(columns)], [2, 2, 1, 2], [PRICE, CUT, LEFT_OUT], parts, result)
    assert result["score"] == pytest.approx([exhaustive(one, columns) for one in y], rel=1e-12)
    assert (parts["count"].sum(axis=1) < SEGMENTS)[::2].all()  # segment 3 is left out
    assert (result["parts"] == (parts["count"] > 0).sum(axis=1)).all()


def test_tables_that_do_not_fit_are_refused(rng):
    parts, result = np.zeros((1, SEGMENTS), _sense.PART), np.empty(1, _sense.PARTS_RESULT)
    with pytest.raises(ValueError, match="a table does not fit the segments"):
        _sense.parts(
            np.zeros((1, 2, 2 * SEGMENTS)), [np.zeros((5, WIDE))], [2, 2, 1, 2],
            [PRICE, CUT, LEFT_OUT], parts, result,
        )  # fmt: skip


def test_rows_of_another_dtype_are_refused(rng):
    y, columns = np.zeros((1, 2, 2 * SEGMENTS)), [np.concatenate(tables(rng))]
    parts, plain = np.zeros((1, SEGMENTS), _sense.PART), np.empty((1, 3))
    with pytest.raises(ValueError, match="the array has the wrong dtype"):
        _sense.parts(y, columns, [2, 2, 1, 2], [PRICE, CUT, LEFT_OUT], parts, plain)


@pytest.mark.parametrize("tau_s", [0.0, 4e-4, 2e-3])
def test_what_a_drive_puts_into_the_carrier_is_what_the_choice_takes_off(tau_s):
    """A noise-free drive with two steps; the choice must predict its part in the carrier."""
    config = LockinConfig(200e3, 2000, 2000.0, 0.0, 2.5e6, search_updates=True)
    segments = Segments(config)
    time = np.arange(2000) / 200e3
    block = 0.3 + 20.0 * time
    for start, height in ((2.3e-3, 0.2), (6.7e-3, -0.1)):
        after = np.maximum(time - start, 0.0)
        rise = 1.0 - np.exp(-after / tau_s) if tau_s else 1.0
        block = block + np.where(time >= start, height * rise, 0.0)
    readings = np.repeat(np.stack([block, -2.0 * block], axis=1)[np.newaxis], 20, axis=0)
    projected = segments.project(segments.cut(readings))
    noise = np.full((20, 2), 1e-6)  # 1 mV rms
    drive = DriveLibrary(segments, expected=True).choose(projected.slow, noise, harmonics=False)
    left = projected.carrier - drive.carrier.reshape(projected.carrier.shape)
    used = drive.used[:, np.newaxis, :, np.newaxis] & np.ones_like(left, dtype=bool)
    assert (~drive.used).sum() <= 20 * 6
    # Evidence stops where a misfit is lost in the noise: no coordinate is off by more than that.
    assert np.abs(left[used]).max() < 1e-3
    assert np.sqrt(np.mean(left[used] ** 2)) < 0.3e-3
    assert "step" in drive.texts[0] or "transient" in drive.texts[0]
    assert bool(tau_s) == ("tail" in drive.texts[0] or "degree" in drive.texts[0])


@pytest.mark.long
@pytest.mark.parametrize("late_s", [0.0, 2e-4, 4e-4, 8e-4])
def test_a_slowed_step_at_a_blocks_start_is_found(late_s: float) -> None:
    # 5 kOhm and 1 nF behind an amplifier with a lag of 0.1 ms; a step in every fourth block.
    rng = np.random.default_rng(5)
    rate_hz, tau_s, rc_s, omega = 200e3, 1e-4, 5e-6, 2 * np.pi * 2000.0
    time_s = np.arange(2000 * 60) / rate_hz
    carrier = 0.02 * np.exp(1j * omega * time_s)
    v, i = carrier.real + 1.0, (2.5e6 * 1j * omega * 1e-9 / (1 + 1j * omega * rc_s) * carrier).real
    for block in range(4, 60, 4):
        size = rng.choice([-1, 1]) * rng.uniform(0.05, 0.2)
        after = np.maximum(time_s - block * 0.01 - late_s, 0.0)
        slow, fast = np.exp(-after / tau_s), np.exp(-after / rc_s)
        v += size * (1 - slow)
        i += size * 2.5e6 * 1e-9 * (slow - fast) / (tau_s - rc_s)
    noise = 1e-3 * rng.standard_normal((2, time_s.size))
    sensed = Lockin(
        LockinConfig(
            rate_hz, 2000, 2000.0, 0.0, 2.5e6, min_amplitude_codes=1e-6, search_updates=True
        )
    )
    found = sensed.sense(np.stack([v + noise[0], i + noise[1]], axis=1).reshape(-1, 2000, 2))
    z = (found.capacitance_f / 1e-9 - 1.0) * 1e-9 / found.capacitance_std_f
    assert found.valid.mean() > 0.9
    # No normal error of 60 exceeds 4.5.
    assert np.abs(z[found.valid]).max() < 4.5
