"""Check what other packages add: whether it loads, and what a controller needs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from haselab.actuators import ACTUATORS
from haselab.base import InputError
from haselab.base.registry import Registry
from haselab.campaign.kinds.case_kind import CASE_KINDS
from haselab.cli.doctor.machine import Finding
from haselab.controllers import CONTROLLERS, ControllerKind
from haselab.store.columns.reader import FORMATS
from haselab.study.registry import EXPERIMENTS

__all__ = ["extension_findings"]

_REGISTRIES: tuple[Registry[Any], ...] = (
    CONTROLLERS, ACTUATORS, EXPERIMENTS, FORMATS, CASE_KINDS,
)  # fmt: skip


def extension_findings() -> Iterator[Finding]:
    """Yield one row for each controller, actuator, experiment or the like of another package."""
    for registry in _REGISTRIES:
        for name, package in registry.packages().items():
            if package == "haselab":
                continue
            try:
                about = _about(registry.find(name))
            except InputError as error:
                what, _, advice = str(error).rpartition(". ")
                yield Finding(registry.what, name, False, what, advice)
            else:
                yield Finding(registry.what, name, True, f"{package}{about}")


def _about(found: object) -> str:
    if not isinstance(found, ControllerKind):
        return ""
    parameters = ", ".join(parameter.name for parameter in found.parameters) or "none"
    chip = "C step" if found.c_source is not None else "no C step"
    return f"; {chip}; parameters: {parameters}"
