"""One thing that `haselab rig check` looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

__all__ = ["CheckResult"]


@dataclass(frozen=True)
class CheckResult:
    """One thing that was verified, or was not.

    Args:
        step: mock, dry or live.
        what: was looked at.
        found: in words.
        passed: it is as it should be.
        advice: what to change where it is not; empty where it is.
        recommended: keys of the rig file, as `daq.skew_s`, with the values that were measured.
    """

    step: str
    what: str
    found: str
    passed: bool
    advice: str = ""
    recommended: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "passed", bool(self.passed))  # numpy's own is no bool for JSON
        if self.passed:
            object.__setattr__(self, "advice", "")
