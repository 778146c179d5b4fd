"""A PI is only played where the loop's dead time leaves it a margin."""

from __future__ import annotations

from dataclasses import replace

import pytest

from haselab.base import ResultError
from haselab.control import LoopSetting, PidGains, Saturation, margins, simulate_loop
from haselab.models.plant import Plant, SlowMode
from haselab.study.fits.loops import _delay_text, _lowered, _margin_note, reduce_gains

# What the quick study found on the twin's reading "hz".
PLANT = Plant(0.9955, 32.58, 0.1185, 0.0, (SlowMode(0.7268, 5.276),))
PRINTED = PidGains(0.4269, 0.7534)
WIDE = Saturation(-10.0, 10.0)  # that of the study would hide what diverges


def setting(delay_s: float) -> LoopSetting:
    return LoopSetting(measurement_delay_s=delay_s, rate_hz=100.0, saturation=WIDE)


def least_db(gains: PidGains, delay_s: float) -> float:
    return margins(PLANT, gains, loop_delay_s=delay_s, rate_hz=100.0).gain_margin_db


def rings(gains: PidGains, delay_s: float) -> float:
    """Swing over the last two of twenty seconds after a step, part of it: by simulation."""
    last = simulate_loop(PLANT, gains, [0.04] * 2000, setting(delay_s)).y[-800:]
    return float(last.max() - last.min()) / 0.04


def test_the_printed_pi_is_played_where_it_holds() -> None:
    assert least_db(PRINTED, 5.7e-3) > 2.0
    assert reduce_gains(PLANT, PRINTED, setting(5.7e-3)) == PRINTED


@pytest.mark.parametrize("delay_s", [15.7e-3, 25.7e-3, 35.7e-3])
def test_outputs_that_wait_lower_the_gain_until_the_loop_holds(delay_s: float) -> None:
    assert rings(PRINTED, delay_s) > 1.0  # it oscillates without end
    played = reduce_gains(PLANT, PRINTED, setting(delay_s))
    assert played.ki == PRINTED.ki
    assert least_db(played, delay_s) >= 6.0
    assert rings(played, delay_s) < 0.1
    one_up = PidGains(played.kp + 0.01 * PRINTED.kp, played.ki)
    assert least_db(one_up, delay_s) < 6.0  # and no lower than it has to be


def test_where_no_gain_holds_it_says_what_to_change() -> None:
    still = Plant(1.0, 32.58, 1e-4)
    with pytest.raises(ResultError, match=r"No PI reaches .* 6 dB .* 500 ms\. Queue fewer outputs"):
        reduce_gains(still, PidGains(0.4, 500.0), setting(0.5))


def test_the_delay_that_a_note_states_is_the_one_that_its_margin_has() -> None:
    """Before, it stated the loop's part alone: at that delay the margin is another one."""
    slow = replace(PLANT, natural_frequency_rad_s=5.2, damping_ratio=0.095, delay_s=0.0107)
    loop = setting(15.6e-3)
    whole = margins(replace(slow, delay_s=0.0), PRINTED, loop_delay_s=26.3e-3, rate_hz=100.0)
    own = margins(slow, PRINTED, loop_delay_s=15.6e-3, rate_hz=100.0)
    assert own.gain_margin_db == pytest.approx(whole.gain_margin_db, abs=1e-6)
    assert _delay_text(loop, slow) == (
        "a delay of 31.3 ms (20.6 ms of the loop and 10.7 ms of the fitted plant, S20.delay)"
    )
    assert _delay_text(loop, PLANT) == "a delay of 20.6 ms"
    alone = margins(replace(slow, delay_s=0.0), PRINTED, loop_delay_s=15.6e-3, rate_hz=100.0)
    assert f"with the loop's delay only {alone.gain_margin_db:.3g} dB" in _margin_note(
        PRINTED, slow, loop
    )


def test_a_controller_without_a_proportional_part_is_called_integral() -> None:
    lower = PidGains(0.0, 0.5)
    assert ", an integral controller: " in _lowered(PRINTED, lower, setting(15e-3), PLANT)
    assert "integral" not in _lowered(PRINTED, PidGains(0.1, 0.5), setting(15e-3), PLANT)
    assert _lowered(PRINTED, PRINTED, setting(15e-3), PLANT) == ""
