"""Campaigns: many cases of one kind, over parameters and seeds, on processes, Dask or Slurm."""

from haselab.campaign.definition import Campaign, load_campaign
from haselab.campaign.kinds.case_kind import BaseFile, CaseKind, Inputs, Results
from haselab.campaign.plan import Plan
from haselab.campaign.twins import load_twins

__all__ = [
    "BaseFile", "Campaign", "CaseKind", "Inputs", "Plan", "Results", "load_campaign", "load_twins",
]  # fmt: skip
