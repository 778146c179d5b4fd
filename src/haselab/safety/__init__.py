"""Everything that keeps the output safe: limits, arming, trips, watchdogs, guardians, shutdown."""
