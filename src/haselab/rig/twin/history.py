"""Precondition a sheet before an experiment."""

from __future__ import annotations

from haselab.rig.twin.twin_bench import TwinBench
from haselab.signals import constant, triangle

__all__ = ["precondition"]

_FREQUENCY_HZ = 0.25
_UPDATE_HZ = 100.0
_REST_S = 60.0


def precondition(bench: TwinBench, peak_v: float) -> float:
    """Drive a sheet to a voltage and back once, then wait.

    The first stretch softens a new sheet permanently (Mullins effect), so a controller designed
    for a sheet after its first cycle is too fast for a new one.

    Args:
        bench: at 0 V, with its mass.
        peak_v: highest drive voltage, in V; 0 leaves the sheet new.
    Returns:
        Longest length of the sheet meanwhile, in m.
    Raises:
        LimitError: The voltage is outside the limits of the drive.
    """
    longest_m = bench.length_m
    if peak_v == 0.0:
        return longest_m
    for drive_v in (
        *triangle(0.0, peak_v, _FREQUENCY_HZ, 1, _UPDATE_HZ),
        *constant(0.0, 1.0 / _UPDATE_HZ, _UPDATE_HZ),
    ):
        bench.write(float(drive_v))
        bench.wait(1.0 / _UPDATE_HZ)
        longest_m = max(longest_m, bench.length_m)
    bench.wait(_REST_S)
    return longest_m
