"""The linear feedback of a controller in a file: gains of a PI or PID, or of another kind."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import MISSING, fields
from pathlib import Path

from haselab.base import HaselabError, InputError, described
from haselab.base.exits import no_exit
from haselab.control import LinearController, PidGains
from haselab.controllers import CONTROLLERS, LinearisableController
from haselab.models.actuator import ActuatorTables, ControllerSection
from haselab.pipelines.design.model_file import read_tables

__all__ = ["default_note", "feedback_of", "read_controller"]


def read_controller(path: Path, kind: str | None) -> ControllerSection:
    """Read a controller of an actuator file.

    Args:
        path: of the actuator file.
        kind: its kind or name; None: the one of `[controller]` itself.
    Returns:
        Its section; with the default parameters for a registered kind that is not in the file.
    Raises:
        InputError: the file has no such controller, and no such kind is registered, or it has a
            parameter without a default.
    """
    tables = read_tables(path)
    if kind is not None and _is_absent(tables, kind):
        chosen = CONTROLLERS.find(kind).choose(source=path)
        return ControllerSection(kind=chosen.kind.name, parameters=dict(chosen.values))
    try:
        return tables.designed(kind)
    except InputError as error:
        raise InputError(f"{error} {path}") from None


def default_note(path: Path, kind: str | None) -> str:
    """Say which parameters are used for a controller that an actuator file does not have.

    Args:
        path: of the actuator file.
        kind: as in `read_controller`.
    Returns:
        One sentence; empty if the controller is in the file, or has no parameters.
    """
    if kind is None or not _is_absent(read_tables(path), kind):
        return ""
    chosen = CONTROLLERS.find(kind).choose(source=path)
    if not chosen.values:
        return ""
    return (
        f"{kind!r} is not in the file, so its default parameters are used ({chosen.summary()}). "
        f"Others belong to [controller.parameters] or to an alternative. {path}"
    )


def _is_absent(tables: ActuatorTables, kind: str) -> bool:
    """Whether a kind other than PI and PID is not in a file."""
    held = {} if tables.controller is None else tables.controller.all_kinds
    return kind not in held and kind not in ("pi", "pid")


def _gains(held: ControllerSection) -> PidGains:
    """Gains of a PI or PID by name; a name that is missing or unknown is an `InputError`."""
    known = {field.name: field.default is MISSING for field in fields(PidGains)}
    lacking = [name for name, needed in known.items() if needed and name not in held.parameters]
    unknown = sorted(set(held.parameters) - set(known))
    if lacking or unknown:
        wrong = [f"lacks {name}" for name in lacking] + [f"has the key {n}" for n in unknown]
        raise InputError(
            f"[controller.parameters] {', '.join(wrong)}. A {held.kind} has {', '.join(known)}."
        )
    return PidGains(**held.parameters)


def feedback_of(held: ControllerSection, rate_hz: float) -> PidGains | LinearController:
    """Return the linear feedback of a controller from the measurement.

    Args:
        held: its section.
        rate_hz: steps per second.
    Returns:
        Gains of a PI or PID; for another kind the result of its method `linear_feedback`.
    Raises:
        InputError: the kind has no linear feedback, or does not accept its parameters.
    """
    if held.kind in ("pi", "pid"):
        return _gains(held)
    chosen = CONTROLLERS.find(held.kind).choose(held.parameters)
    with _named_failures(held.kind):
        controller = chosen.make()
    if not isinstance(controller, LinearisableController):
        raise InputError(
            f"Controllers of kind {held.kind!r} have no method linear_feedback, so their margins "
            "cannot be computed. Add it to the class (see 'Add your own controller' in the docs), "
            "or test the loop on the twin: haselab run STUDY.toml --rig RIG.toml --actuator A.toml"
        )
    with _named_failures(held.kind):
        numerator, denominator = map(tuple, controller.linear_feedback(1.0 / rate_hz))
    return LinearController(numerator, denominator, rate_hz)


@contextlib.contextmanager
def _named_failures(kind: str) -> Iterator[None]:
    """Report any failure of a controller's own code as that controller's."""
    try:
        with no_exit():
            yield
    except HaselabError:
        raise
    except Exception as error:
        raise InputError(
            f"Controller {kind!r} failed: {described(error)}. Fix the controller, or "
            "change its parameters."
        ) from error
