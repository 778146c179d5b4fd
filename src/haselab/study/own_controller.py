"""Step trials with the controller that a study adds to the paper's PI, of any kind."""

from __future__ import annotations

from haselab.base import Estimate
from haselab.controllers import ChosenController, chosen_controller
from haselab.study.definition import Study
from haselab.study.tables import Control

__all__ = ["OWN", "own_controller", "own_names", "own_note", "own_quantities"]

OWN = "own"  # group of trials


def own_controller(study: Study) -> ChosenController | None:
    """Return the controller of `[control] kind = "..."`.

    Args:
        study: with or without such a table.
    Returns:
        The controller with checked parameters; None if the study names no kind.
    Raises:
        InputError: the kind is not registered, or does not accept the parameters.
    """
    if not study.has("control") or study.control.kind is None:
        return None
    control = study.control
    return chosen_controller({"kind": control.kind, "parameters": control.parameters})


def own_names(study: Study) -> list[str]:
    """Names of the step trials with the study's own controller."""
    has_own = study.has("control") and study.control.kind is not None
    trials = study.steps.custom_trials if has_own else 0
    return [f"{OWN}-{k + 1}" for k in range(trials)]


def own_quantities(rise: Estimate, overshoot: Estimate, error: Estimate) -> dict[str, Estimate]:
    """Results of the trials by id."""
    return {"S25.rise_own": rise, "S25.overshoot_own": overshoot, "S25.error_own": error}


def own_note(control: Control) -> str:
    """Note about the controller, and about what the study does not compute for it."""
    values = ", ".join(f"{name} = {value:.6g}" for name, value in control.parameters.items())
    return (
        f"controller {control.kind!r}{f' ({values})' if values else ''}; its margins, if its "
        "feedback is linear, come from haselab margins with --controller"
    )
