"""The result of one check of `haselab rig check`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["CheckResult"]


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Args:
        step: mock, dry or live.
        what: quantity or device that was checked.
        found: what was found, in words.
        passed: whether it is correct.
        advice: what to change if it is not, else empty.
        recommended: keys of the rig file, such as `daq.skew_s`, with the measured values.
        criterion: what is accepted, with the limits that were used; empty if nothing was judged.
    """

    step: str
    what: str
    found: str
    passed: bool
    advice: str = ""
    recommended: Mapping[str, float] = field(default_factory=dict)
    criterion: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "passed", bool(self.passed))  # JSON does not accept numpy's bool
        if self.passed:
            object.__setattr__(self, "advice", "")
