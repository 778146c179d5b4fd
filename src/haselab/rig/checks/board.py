"""Checks of a data acquisition device: read latency and start of the outputs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol, cast, runtime_checkable

import numpy as np

from haselab.rig import Rig
from haselab.rig.check_result import CheckResult
from haselab.rig.checks.output_timing import (
    StartMeasurement,
    measure_start,
    recommended_ahead_blocks,
)
from haselab.rig.checks.signals import keep
from haselab.rig.instruments.devices import DaqDevice
from haselab.rig.instruments.sections import DaqConfig

__all__ = ["CountsSamples", "lateness_check", "start_checks"]

_BLOCKS = 100
_STARTS = 50
_WIRE_S = 5e-6  # longest delay of an edge through the board itself
_LEAST_CODES = 20.0  # smallest step that stands out from the noise
_SPREAD = 1.5  # largest spread of the output starts that counts as synchronous, in samples


@runtime_checkable
class CountsSamples(Protocol):
    """An acquisition that counts the samples that it has acquired."""

    def acquired(self) -> int:
        """Number of samples acquired since the start.

        Raises:
            DeviceError: The device does not reply.
        """


def _inside(found: StartMeasurement, daq: DaqConfig) -> float:
    """Delay of a step within its block, in samples."""
    return float(np.nanmedian(found.late_samples)) - found.late_blocks * daq.block_samples


def lateness_check(rig: Rig, daq: DaqConfig) -> Iterator[CheckResult]:
    """Measure the read latency, and derive how many outputs must be queued because of it.

    Args:
        rig: a bench in real time; its output stays at 0 V.
        daq: section `daq` of the rig file.
    Yields:
        One result; none if the device does not count its samples.
    """
    board = rig.acquisition
    if not isinstance(board, CountsSamples):
        return
    block_s = daq.block_samples / daq.rate_hz
    keep(rig, True)
    rig.acquisition.read()
    late_s = []
    for _ in range(_BLOCKS):
        rig.acquisition.read()
        # This query takes about as long as writing the next output.
        late_s.append(board.acquired() / daq.rate_hz - rig.acquisition.time_s)
    keep(rig, False)
    worst_s = max(late_s)
    blocks = max(recommended_ahead_blocks(worst_s, 0.0, daq), 1 if worst_s > 0.0 else 0)
    found = f"median {1e3 * float(np.median(late_s)):.2g} ms, worst {1e3 * worst_s:.2g} ms"
    left_s = blocks * block_s + daq.output_delay_s
    advice = (
        f"Set daq.ahead_blocks = {blocks}, which leaves {1e3 * left_s:.3g} ms for an output; or "
        "close other programs, or use another USB port"
    )
    good, recommended = daq.ahead_blocks >= blocks, {"daq.ahead_blocks": float(blocks)}
    criterion = f"daq.ahead_blocks of at least {blocks}; the rig file has {daq.ahead_blocks}"
    yield CheckResult("dry", "read latency", found, good, advice, recommended, criterion)


def start_checks(rig: Rig, daq: DaqConfig, step_v: float, probe_v: float) -> Iterator[CheckResult]:
    """Start the output fifty times and measure it at the input to which it is wired.

    Args:
        rig: its output is wired to the voltage monitor's input, and the amplifier is not.
        daq: section `daq` of the rig file.
        step_v: step of the output, in V.
        probe_v: a smaller step of the same sign, for the first start, in V.
    Yields:
        Whether the wire is connected, and whether the outputs are on time.
    Raises:
        DeviceError: The board failed during the check.
    """
    board = cast(DaqDevice, rig.source)
    least_v = _LEAST_CODES * daq.volt_per_code
    if abs(step_v) < least_v:
        yield CheckResult(
            "live",
            "loop-back wire",
            f"a step of {step_v:g} V is below {least_v:.2g} V",
            False,
            "Raise daq.drive_high_v for this check",
        )
        return
    # Start with one small step: the amplifier may be connected by mistake.
    first = measure_start(board, daq, starts=1, step_v=probe_v)
    if first.seen and _inside(first, daq) > _WIRE_S * daq.rate_hz + 1.0:
        late_us = 1e6 * _inside(first, daq) / daq.rate_hz
        yield CheckResult(
            "live",
            "loop-back wire",
            f"a step is {late_us:.3g} us late: the amplifier seems to be connected",
            False,
            "Disconnect the amplifier, and wire daq.output straight to daq.v_monitor",
        )
        return
    found = measure_start(board, daq, starts=_STARTS, step_v=step_v)
    yield CheckResult(
        "live",
        "loop-back wire",
        f"{found.seen} of {_STARTS} steps seen",
        found.seen == _STARTS,
        "Wire daq.output to daq.v_monitor, without the amplifier, "
        "and check that these are the right terminals",
        criterion=f"all {_STARTS}",
    )
    if found.seen < _STARTS:
        return
    blocks, spread = found.late_blocks, found.spread_samples
    late = f"{np.median(found.late_samples):.3g} samples late, {spread:.3g} from first to last"
    largest = _SPREAD + _WIRE_S * daq.rate_hz
    in_step = blocks == 0 and spread <= largest
    yield CheckResult(
        "live",
        "starts of the output",
        f"{_STARTS}, {late}",
        in_step,
        "The device puts "
        "outputs out whole blocks late. Raise daq.ahead_blocks, close other programs, or use "
        "another USB port",
        criterion=f"no whole block late, and at most {largest:.3g} samples from first to last",
    )
