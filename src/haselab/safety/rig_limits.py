"""[rating] and [safety] of RIG.toml: what a bench withstands, and its safety limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from pydantic import Field

from haselab.base import InputError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile
from haselab.rig.rig_file import RigFile
from haselab.safety.state_machine import SafetySettings
from haselab.safety.watchdog.settings import FieldRating, WatchdogSettings
from haselab.store.toml import Section, validated

__all__ = ["RatingSection", "SafetySection", "rating_section", "runs_by_wall_clock", "safety_of"]

_LOCK_STEP_LEASE_S = 10.0
_HOST_CHECKS = frozenset(  # checks of blocks and deadlines, which a microcontroller rig lacks
    {"rate_limit_v_per_s", "current_limit_a", "follow", "settle_s", "missed_limit", "late_limit"}
)


class RatingSection(Section):
    """[rating] of RIG.toml: what amplifier and actuator withstand, see `Rating`."""

    current_limit_a: float = Field(
        gt=0, description="largest output current of the amplifier", examples=[0.012]
    )
    slew_v_per_s: float = Field(gt=0, description="slew rate of the amplifier", examples=[350e6])
    bandwidth_hz: float = Field(gt=0, description="bandwidth of the amplifier", examples=[6000.0])
    capacitance_f: float = Field(
        gt=0, description="capacitance of actuator and cable at the largest strain", examples=[1e-9]
    )
    thickness_m: float = Field(
        gt=0, description="thickness of the dielectric at that strain", examples=[1.2e-4]
    )
    breakdown_v_per_m: float = Field(
        gt=0, description="dielectric strength of the actuator", examples=[40e6]
    )
    field_margin: float = Field(0.9, gt=0, le=1)
    stretch_high: float = Field(math.inf, gt=1)
    stretch: float = Field(math.nan)
    settle_s: float = Field(5e-3, gt=0)


class SafetySection(Section):
    """[safety] of RIG.toml, see `SafetySettings`."""

    rate_limit_v_per_s: float = Field(2000.0, gt=0)
    current_limit_a: float = Field(1e-3, gt=0)
    follow: float = Field(0.1, gt=0, le=1)
    carrier_limit_v: float | None = Field(None, gt=0)
    supply_limit_v: float | None = Field(None, gt=0)
    settle_s: float = Field(5e-3, gt=0)
    residual_v: float = Field(50.0, gt=0, le=50)
    missed_limit: int = Field(5, ge=1)
    late_limit: int = Field(20, ge=1)
    lease_s: float = Field(2.0, ge=0.2, le=10)
    idle_s: float = Field(600.0, gt=0)
    permit_age_s: float = Field(12 * 3600.0, gt=0)
    loop: dict[str, float] = Field({}, description="see `WatchdogSettings`")


def runs_by_wall_clock(file: RigFile) -> bool:
    """Whether the rig runs in real time, so that the program can be late; not on most twins."""
    if isinstance(file, ChipFile):
        return file.port is not None
    return isinstance(file, BenchConfig) and not file.stand.lock_step


def safety_of(file: RigFile, given: Mapping[str, Any], path: Path) -> SafetySettings:
    """Build the safety limits of a rig file for the kind of rig that it describes.

    A bench runs in real time. A recorded session has no output to read back, and its current was
    limited when it was recorded.

    Args:
        file: from `load_rig`.
        given: its table `safety`.
        path: of the rig file, for errors.
    """
    section = validated(SafetySection, dict(given), path, "safety")
    if isinstance(file, ChipFile) and (unused := sorted(_HOST_CHECKS & set(given))):
        raise InputError(
            f"safety.{unused[0]} has no effect on a microcontroller rig: its limits are compiled "
            f"into the firmware. Remove it. {path}"
        )
    recorded = file.kind == "replay"
    given_s = section.model_dump(exclude={"loop"})
    if isinstance(file, BenchConfig) and file.stand.lock_step:  # computing its physics takes time
        given_s["lease_s"] = max(section.lease_s, _LOCK_STEP_LEASE_S)
    return SafetySettings(
        **given_s,
        real_time=runs_by_wall_clock(file),
        read_back=not recorded,
        compare_output=not recorded,
        loop=_loop_limits(section.loop, path),
        rating=_field_rating(file, path),
    )


def _loop_limits(given: Mapping[str, float], path: Path) -> WatchdogSettings:
    """[safety.loop] of a rig file."""
    known = {field.name for field in fields(WatchdogSettings)}
    if unknown := sorted(set(given) - known):
        raise InputError(
            f"safety.loop has no limit named {unknown[0]!r}. Use one of "
            f"{', '.join(sorted(known))}. {path}"
        )
    return WatchdogSettings(**given)  # type: ignore[arg-type]


def rating_section(file: RigFile, path: Path) -> RatingSection | None:
    """Table [rating] of a bench; None where the file has none.

    Args:
        file: from `load_rig`.
        path: of the rig file, for errors.
    """
    given = getattr(file, "rating", None)
    if not isinstance(file, BenchConfig) or not given:
        return None
    return validated(RatingSection, dict(given), path, "rating")


def _field_rating(file: RigFile, path: Path) -> FieldRating | None:
    """The dielectric of [rating]; None where the file has none."""
    rating = rating_section(file, path)
    if rating is None:
        return None
    limit_v_per_m = rating.field_margin * rating.breakdown_v_per_m
    return FieldRating(limit_v_per_m, rating.thickness_m, rating.capacitance_f)
