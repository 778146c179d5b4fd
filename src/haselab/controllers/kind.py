"""Kinds of controllers with declared parameters, and controllers with values for them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from haselab.base import InputError, is_real, shown
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.protocol import Controller, ControllerSetting

__all__ = ["ChosenController", "ControllerKind", "Parameter"]

_NO_ACTUATOR = (
    "needs the physical model of the actuator, which the file does not have. Add it with: haselab "
    "identify actuator RUN --actuator A.toml"
)
MOST_C_PARAMETERS = 8  # HS_CONTROLLER_PARAMETERS of core/include/hs_controller.h


@dataclass(frozen=True)
class Parameter:
    """One number that a kind of controller takes.

    Args:
        name: keyword of the controller's class and key of the section `[controller]`.
        unit: in SI, "" where it has none.
        default: value if the section does not give one; None: the section must give one.
        low: lowest value that is accepted.
        high: highest one.
    """

    name: str
    unit: str = ""
    default: float | None = None
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True)
class ControllerKind:
    """A registered kind of controller.

    Args:
        name: in `kind = "..."`.
        make: class or function that takes the parameters by name and returns a `Controller`.
        parameters: in the order in which the C step gets them.
        c_source: file with `hs_controller_init` and `hs_controller_step` for the microcontroller;
            None: the kind runs only on the computer, unless it is a `ChipController`.
        output: what `step` returns: the corrected strain, which the voltage map of the loop turns
            into a voltage, or the voltage itself, before the amplifier.
        needs_actuator: whether the controller uses `ControllerSetting.actuator`.
        design: computes the parameters from the actuator and the timing of the loop, which the
            setting states; None: the parameters are typed, or searched by `haselab design`.
        robustness: computes margins that the parameters guarantee in a setting, by name; None: the
            docstring of `design` states all.
        loop: setting of the only loop that the kind is designed for; None: that of the caller.
        preview_s: how far the controller looks ahead in the reference, see `Measurement.preview`.
        alternates: whether the sign of the voltage alternates on purpose. The watchdog of a bench
            then compares its magnitude with the strain, and ignores the strain of blocks in which
            the sign changes.
    """

    name: str
    make: Callable[..., Controller]
    parameters: tuple[Parameter, ...] = ()
    c_source: Path | None = None
    output: Literal["strain", "voltage"] = "strain"
    needs_actuator: bool = False
    design: Callable[[ControllerSetting], Mapping[str, float]] | None = None
    robustness: Callable[[ControllerSetting, Mapping[str, float]], Mapping[str, float]] | None = (
        None
    )
    loop: Callable[[KnownActuator], ControllerSetting] | None = None
    preview_s: float = 0.0
    alternates: bool = False

    def check(self, setting: ControllerSetting) -> None:
        """Refuse a setting that lacks what the kind needs.

        Args:
            setting: in which a controller would be started or designed.
        Raises:
            InputError: The kind needs the identified actuator, and there is none.
        """
        self.check_actuator(setting.actuator)

    def check_actuator(self, actuator: KnownActuator | None) -> None:
        """Refuse a missing actuator if the kind needs it.

        Args:
            actuator: identified; None: it is not known.
        Raises:
            InputError: The kind needs the identified actuator, and there is none.
        """
        if actuator is None and (self.needs_actuator or self.output == "voltage"):
            raise InputError(f"Controller of kind {self.name!r} {_NO_ACTUATOR}")

    def preview_steps(self, period_s: float) -> int:
        """Number of coming desired strains that the controller gets in each step."""
        return math.ceil(self.preview_s / period_s - 1e-9)

    def choose(
        self, values: Mapping[str, object] | None = None, source: object = ""
    ) -> ChosenController:
        """Check the values of the parameters.

        Args:
            values: by name; a missing parameter takes its default.
            source: file of the values, for the message.
        Returns:
            The controller, ready to be started.
        Raises:
            InputError: Parameters are unknown or missing, or values out of range; all in one line.
        Example:
            >>> kind = ControllerKind("gain", lambda k: None, (Parameter("k", "", 1.0, 0.0, 9.0),))
            >>> kind.choose({"k": 2}).values
            (('k', 2.0),)
        """
        given = dict(values or {})
        known = {parameter.name: parameter for parameter in self.parameters}
        faults = [
            f"{name} is not a parameter; the parameters are {', '.join(known) or 'none'}"
            for name in given if name not in known
        ]  # fmt: skip
        checked = []
        for name, parameter in known.items():
            value = given.get(name, parameter.default)
            if fault := _fault(parameter, value):
                faults.append(fault)
            else:
                checked.append((name, float(value)))  # type: ignore[arg-type]
        if faults:
            where = f" {source}" if source else ""
            raise InputError(
                f"Controller of kind {self.name!r}: {'; '.join(faults)}. Change the "
                f"parameters of the controller.{where}"
            )
        return ChosenController(self, tuple(checked))


def _fault(parameter: Parameter, value: object) -> str:
    """Return what is wrong with a value, or an empty text."""
    name = parameter.name
    unit = f" {parameter.unit}" if parameter.unit else ""
    if value is None:
        return f"{name}{f' ({parameter.unit})' if unit else ''} is missing"
    if not is_real(value):
        return f"{name} = {shown(value)} is not a number"
    if not math.isfinite(value) or not parameter.low <= value <= parameter.high:
        return f"{name} = {value:g}{unit} is outside {parameter.low:g} to {parameter.high:g}{unit}"
    return ""


@dataclass(frozen=True)
class ChosenController:
    """A kind of controller with values for all of its parameters.

    Args:
        kind: of it.
        values: names and values, in the order of the kind's parameters.
    """

    kind: ControllerKind
    values: tuple[tuple[str, float], ...]

    def make(self) -> Controller:
        """Create a new controller for one experiment."""
        return self.kind.make(**dict(self.values))

    def table(self) -> dict[str, str | dict[str, float]]:
        """The section `[controller]` of a TOML file.

        Example:
            >>> from haselab.controllers import CONTROLLERS
            >>> CONTROLLERS.find("pi").choose({"kp": 0.85, "ki": 1.5}).table()
            {'kind': 'pi', 'parameters': {'kp': 0.85, 'ki': 1.5}}
        """
        return {"kind": self.kind.name, "parameters": dict(self.values)}

    def summary(self) -> str:
        """Kind, values and units in one line, as the session records them."""
        units = {parameter.name: parameter.unit for parameter in self.kind.parameters}
        parts = [f"{name} = {value:.9g} {units[name]}".rstrip() for name, value in self.values]
        return ", ".join([self.kind.name, *parts])
