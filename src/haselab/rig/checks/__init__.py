"""`haselab rig check`: the checks of a bench before a study is run on it."""

from haselab.rig.check_result import CheckResult
from haselab.rig.checks.dry import DryPlan, dry_checks
from haselab.rig.checks.edges import edge_check
from haselab.rig.checks.live import CARRIER_V, SUPPLY_V, LivePlan, live_checks, live_step_v

__all__ = [
    "CARRIER_V",
    "SUPPLY_V",
    "CheckResult",
    "DryPlan",
    "LivePlan",
    "dry_checks",
    "edge_check",
    "live_checks",
    "live_step_v",
]
