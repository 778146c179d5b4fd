"""The twins of a campaign's cases, for other programs."""

from __future__ import annotations

from pathlib import Path

from haselab.base import InputError
from haselab.campaign.definition import load_campaign, with_values
from haselab.campaign.kinds.base_files import TWIN, twin_of
from haselab.campaign.kinds.case_kind import Inputs
from haselab.campaign.plan import Plan
from haselab.rig.twin.config import TwinConfig

__all__ = ["load_twins"]


def load_twins(path: Path | str) -> list[TwinConfig]:
    """Draw the twins of a campaign, one for each of its points.

    Args:
        path: of a campaign file with a twin in `[base]`.
    Returns:
        Their configurations, in the order of the cases.
    Raises:
        InputError: the file cannot be used, or its kind has no twin.
    Example:
        >>> len(load_twins("tolerance.toml"))  # doctest: +SKIP
        200
    """
    campaign = load_campaign(Path(path))
    if TWIN.name not in campaign.tables:
        raise InputError(
            f"The campaign has the kind {campaign.kind!r}, which has no twin. Choose another kind, "
            f"such as 'geometry'. {path}"
        )
    plan = Plan(campaign)
    cases = range(0, plan.count, campaign.design.repeats)
    return [twin_of(Inputs(with_values(campaign.tables, plan.values(case)))) for case in cases]
