"""Whether records, and what a fit makes of them, can be those of an actuator."""

from haselab.identify.physical.plausible.estimates import judge_estimates
from haselab.identify.physical.plausible.records import find_implausible, motion_before_drive

__all__ = ["find_implausible", "judge_estimates", "motion_before_drive"]
