"""Settings other than waveform, frequency, amplitude and offset that change a 33500B's output.

Source: 33500 Series Operating and Service Guide (33500-90901), the subsystems named below. The
defaults of `*RST` are those of each command's table there.
"""

from __future__ import annotations

__all__ = ["check_rest", "is_two_channel", "rest_question"]

_SETTINGS = (  # header after SOURce, answers at rest, what it is otherwise
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


def _questions(channels: int) -> tuple[tuple[str, set[str], str], ...]:
    return (*_OUTPUT, *_SETTINGS, *(_COUPLED if channels == 2 else ()))


def rest_question(channel: int, channels: int) -> str:
    """One line that asks for all of it.

    Args:
        channel: whose output is used.
        channels: of the instrument.
    """
    outputs = [f"OUTP{channel}:{header}?" for header, _, _ in _OUTPUT]
    settings = [f"SOUR{channel}:{header}?" for header, _, _ in _questions(channels)[len(_OUTPUT) :]]
    return ";:".join([*outputs, *settings])


def check_rest(answer: str, channels: int) -> str:
    """What of it changes the output.

    Args:
        answer: to `rest_question`.
        channels: of the instrument.
    Returns:
        What is wrong; empty if nothing is.
    Example:
        >>> check_rest("NORM;NORM;1;0;CW;0;0;0;0;0;0;0;0", 1)
        'burst mode is on'
    """
    told = [part.strip().upper() for part in answer.split(";")]
    questions = _questions(channels)
    if len(told) != len(questions):
        return f"{len(told)} of {len(questions)} settings were answered"
    found = [
        what for (_, rest, what), each in zip(questions, told, strict=True) if each not in rest
    ]
    return ", ".join(found)
