"""Check the settings other than frequency and amplitude that change a 33500B's output.

Source: 33500 Series Operating and Service Guide (33500-90901), the subsystems named below. The
defaults of `*RST` are those of each command's table there.
"""

from __future__ import annotations

import math

__all__ = ["check_settings", "is_two_channel", "settings_query"]

_SETTINGS = (  # header after SOURce, replies without effect, text for any other reply
    ("BURS:STAT", {"0", "OFF"}, "burst mode is on"),
    ("SWE:STAT", {"0", "OFF"}, "a frequency sweep is on"),
    ("FREQ:MODE", {"CW", "FIX"}, "its frequency follows a sweep or a list"),
    ("AM:STAT", {"0", "OFF"}, "amplitude modulation is on"),
    ("FM:STAT", {"0", "OFF"}, "frequency modulation is on"),
    ("PM:STAT", {"0", "OFF"}, "phase modulation is on"),
    ("FSK:STAT", {"0", "OFF"}, "frequency-shift keying is on"),
    ("BPSK:STAT", {"0", "OFF"}, "phase-shift keying is on"),
    ("PWM:STAT", {"0", "OFF"}, "pulse width modulation is on"),
    ("SUM:STAT", {"0", "OFF"}, "a second signal is added"),
    ("VOLT:LIM:STAT", {"0", "OFF"}, "voltage limits are on, which clip the amplitude"),
)
_OUTPUT = (
    ("MODE", {"NORM"}, "its output is gated by the trigger input"),
    ("POL", {"NORM"}, "its output is inverted"),
)
_SIGNAL = (  # query with braces for the channel
    "OUTP{}:LOAD?",  # the amplitude is stated for this load
    "SOUR{}:VOLT:UNIT?",
    "SOUR{}:FUNC?",
    "SOUR{}:VOLT:OFFS?",
)
_OPEN_LOAD_OHM = 1e30  # the answer to a load of INF is 9.9E+37
_NO_OFFSET_V = 1e-4  # the panel's smallest step (inferred): 0.5 V after an amplifier of 5000 V/V
_COUPLED = (  # of an instrument with two channels
    ("FREQ:COUP:STAT", {"0", "OFF"}, "the frequencies of both channels are coupled"),
    ("VOLT:COUP:STAT", {"0", "OFF"}, "the amplitudes of both channels are coupled"),
    ("TRAC", {"OFF", "0"}, "one channel tracks the other"),
    ("COMB:FEED", {"NONE"}, "the other channel is added to the output"),
)


def is_two_channel(model: str) -> bool:
    """Whether a 33500B has two channels: 33510B, 33512B, 33520B, 33522B.

    Args:
        model: as in `*IDN?`.
    Example:
        >>> [is_two_channel(model) for model in ("33522B", "33511B", "33509B", "33520B")]
        [True, False, False, True]
    """
    number = "".join(letter for letter in model if letter.isdigit())
    return bool(number) and int(number) % 2 == 0


def _queries(channels: int) -> tuple[tuple[str, set[str], str], ...]:
    return (*_OUTPUT, *_SETTINGS, *(_COUPLED if channels == 2 else ()))


def settings_query(channel: int, channels: int) -> str:
    """Build one line that queries all of these settings.

    Args:
        channel: whose output is used.
        channels: of the instrument.
    """
    outputs = [f"OUTP{channel}:{header}?" for header, _, _ in _OUTPUT]
    settings = [f"SOUR{channel}:{header}?" for header, _, _ in _queries(channels)[len(_OUTPUT) :]]
    return ";:".join([*(each.format(channel) for each in _SIGNAL), *outputs, *settings])


def check_settings(answer: str, channels: int, load: str) -> str:
    """Find the settings that change the output.

    Args:
        answer: reply to `settings_query`.
        channels: of the instrument.
        load: as in the rig file: INF, or ohms.
    Returns:
        What is wrong, or an empty text.
    Example:
        >>> check_settings("9.9E+37;VPP;SIN;0;NORM;NORM;1;0;CW;0;0;0;0;0;0;0;0", 1, "INF")
        'burst mode is on'
        >>> check_settings("50;VRMS;SIN;0.3;NORM;NORM;0;0;CW;0;0;0;0;0;0;0;0", 1, "50")
        'its amplitude is in VRMS, an offset of 0.3 V is added'
    """
    reported = [part.strip().upper() for part in answer.split(";")]
    questions = _queries(channels)
    wanted = len(_SIGNAL) + len(questions)
    if len(reported) != wanted:
        return f"{len(reported)} of {wanted} settings were reported"
    found = _signal(reported[: len(_SIGNAL)], load)
    rest_reported = reported[len(_SIGNAL) :]
    found += [
        what
        for (_, rest, what), each in zip(questions, rest_reported, strict=True)
        if each not in rest
    ]
    return ", ".join(found)


def _signal(reported: list[str], load: str) -> list[str]:
    """Find differences of load, unit, waveform and offset."""
    ohm, unit, shape, offset_v = (
        _number(reported[0]),
        reported[1],
        reported[2],
        _number(reported[3]),
    )
    right = ohm > _OPEN_LOAD_OHM if load == "INF" else math.isclose(ohm, float(load), rel_tol=1e-4)
    shown = "INF" if ohm > _OPEN_LOAD_OHM else f"{ohm:g}"
    found = [] if right else [f"its load is set to {shown} ohm, expected {load}"]
    if unit != "VPP":
        found.append(f"its amplitude is in {unit}")
    if shape != "SIN":
        found.append(f"its waveform is {shape}")
    if not abs(offset_v) <= _NO_OFFSET_V:  # also if it is not a number
        found.append(f"an offset of {offset_v:g} V is added")
    return found


def _number(reported: str) -> float:
    try:
        return float(reported)
    except ValueError:
        return math.nan
