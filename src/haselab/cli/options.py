"""Options that several commands share: one name, one metavar and one meaning in all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

__all__ = ["OTHER_SIGN", "shared_option"]

F = TypeVar("F", bound=Callable[..., Any])

OTHER_SIGN = "a minus before the name (-Laser) changes the sign"
# option: (metavar, None for click's own; what it does)
_SHARED: dict[str, tuple[str | None, str]] = {
    "--actuator": ("A.toml", "Use this actuator file, or that in the folder of a run."),
    "--ampere-per-monitor-volt": (None, "Set the scale of the current monitor in A/V."),
    "--at-rest": (None, "Assume that each record starts in a steady state."),
    "--blank-s": (None, "Ignore this time after each step of the output, in s."),
    "--block-s": (None, "Set the length of a block in s. Each block gives one capacitance."),
    "--board": (None, "Choose the board."),
    "--bootstrap": (None, "Set the number of bootstrap replicates for the confidence intervals."),
    "--capacitance-f": (None, "Set the capacitance of the actuator in F."),
    "--capacitor": (None, "State the capacitor connected in the actuator's place, in F."),
    "--carrier-hz": (None, "Set the frequency of the sensing signal in Hz."),
    "--carrier-v": (None, "Set the peak of the sensing signal before the amplifier, in V."),
    "--controller": ("KIND", "Choose the controller."),
    "--controller-source": ("FILE.c", "Compile this C file in place of the PID controller."),
    "--current-limit-a": (None, "Set the current limit of the amplifier in A."),
    "--delay-s": (
        None,
        "Set the age of a measurement when the output computed from it takes effect, in s.",
    ),
    "--draw": (
        None,
        "Draw the parameters of the identified actuator with this seed, within their uncertainty. "
        "Default: the estimates.",
    ),
    "--duration-s": (None, "Set the duration in s."),
    "--experiment": ("NAME", "State the name of the experiment in the session."),
    "--gain-v-per-v": (None, "State the gain of the amplifier in V/V."),
    "--held-at-hz": (None, "State the update rate of the output converter in Hz."),
    "--hold": (
        None,
        "Choose how the input behaves between its samples. zero: it is constant; first: straight "
        "lines; band-limited: it was measured behind an anti-aliasing filter.",
    ),
    "--i": ("COLUMN", f"Name the column of the current monitor, in V; {OTHER_SIGN}."),
    "--input": ("COLUMN", f"Name the column of the input; {OTHER_SIGN}."),
    "--keep-means": (None, "Keep the means of the columns instead of subtracting them."),
    "--keep-video": (None, "Choose which camera frames to keep."),
    "--kind": (None, "Choose the kind of actuator."),
    "--mass-kg": (None, "State the hung mass in kg."),
    "--method": (None, "Choose the method."),
    "--model": (None, "Choose the model."),
    "--no-browser": (None, "Print the address only; open no browser."),
    "--page-port": (
        None,
        "Set the TCP port of the page. 0 uses a free one.",
    ),
    "--out": (None, "Write the result to this path."),
    "--output": ("COLUMN", f"Name the column of the output; {OTHER_SIGN}."),
    "--physical-model/--no-physical-model": (
        None,
        "Identify the physical model from the recording.",
    ),
    "--quick": (None, "Use the short version."),
    "--rate-hz": (None, "Set the sampling rate in Hz."),
    "--reading": (
        None,
        "Use the default twin of this interpretation of the paper's frequency axis: rad/s as "
        "printed, or Hz.",
    ),
    "--rig": ("RIG.toml", "Read the bench from this rig file."),
    "--seed": (None, "Set the seed of the random numbers."),
    "--skew-s": (None, "Set the time from a voltage sample to its current sample, in s."),
    "--slow-modes": (None, "Fit this many slow modes, 0 to 3."),
    "--stretch-max": (None, "Leave out rows above this stretch."),
    "--stretch-min": (None, "Leave out rows below this stretch."),
    "--through-voltage-map": (None, "Convert the input from V to strain with [drive.voltage_map]."),
    "--to": (None, "Choose the output format."),
    "--twin": (
        "FILE.toml",
        "Use the twin of this TWIN.toml, or of the identified actuator of this actuator file (or "
        "folder of a run).",
    ),
    "--v": ("COLUMN", f"Name the column of the voltage monitor, in V; {OTHER_SIGN}."),
    "--volt-per-monitor-volt": (None, "Set the scale of the voltage monitor in V/V."),
    "--workers": (None, "Use this many processes. Default: one for each processor."),
    "--yes": (None, "Permit this step without a question."),
    "--zero-length-m": (None, "State the length at zero strain in m."),
}


def shared_option(
    name: str, *declarations: str, detail: str = "", **settings: Any
) -> Callable[[F], F]:
    """Add an option that has the same meaning in every command.

    Args:
        name: of the option, such as `--rate-hz`.
        declarations: further declarations of `click.option`, such as the parameter's name.
        detail: what is particular to this command; follows the common help text.
        settings: further settings of `click.option`.
    Returns:
        The decorator.
    """
    metavar, text = _SHARED[name]
    settings.setdefault("metavar", metavar)
    return click.option(name, *declarations, help=f"{text} {detail}".rstrip(), **settings)
