"""The checks of a data acquisition device: how late readings come, where outputs begin."""

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
_WIRE_S = 5e-6  # that an edge takes through the board itself
_LEAST_CODES = 20.0  # of a step that stands out of the noise
_SPREAD = 1.5  # samples between the earliest and the latest start of outputs that are in step


@runtime_checkable
class CountsSamples(Protocol):
    """An acquisition that knows how many samples have come in."""

    def acquired(self) -> int:
        """Samples that have come in since the start.

        Raises:
            DeviceError: the device does not answer.
        """


def _inside(found: StartMeasurement, daq: DaqConfig) -> float:
    """Samples from where a step should have come in its block to where it came."""
    return float(np.nanmedian(found.late_samples)) - found.late_blocks * daq.block_samples


def lateness_check(rig: Rig, daq: DaqConfig) -> Iterator[CheckResult]:
    """How late blocks can be read, and how many outputs have to wait in the device for that.

    Args:
        rig: a bench in real time; nothing is put out.
        daq: section `daq` of the rig file.
    Yields:
        One result; none where the device does not count its samples.
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
        # The question takes about as long as giving the device its next output.
        late_s.append(board.acquired() / daq.rate_hz - rig.acquisition.time_s)
    keep(rig, False)
    worst_s = max(late_s)
    blocks = max(recommended_ahead_blocks(worst_s, 0.0, daq), 1 if worst_s > 0.0 else 0)
    found = f"median {1e3 * float(np.median(late_s)):.2g} ms, worst {1e3 * worst_s:.2g} ms"
    left_s = blocks * block_s + daq.output_delay_s
    advice = (
        f"Set daq.ahead_blocks = {blocks}, so that {1e3 * left_s:.3g} ms are left for an output; "
        "or close other programs, or use another USB port"
    )
    good, recommended = daq.ahead_blocks >= blocks, {"daq.ahead_blocks": float(blocks)}
    yield CheckResult("dry", "read latency", found, good, advice, recommended)


def start_checks(rig: Rig, daq: DaqConfig, step_v: float, probe_v: float) -> Iterator[CheckResult]:
    """Fifty starts of the output, seen at the input to which it is wired.

    Args:
        rig: its output is wired to the voltage monitor's input, and the amplifier is not.
        daq: section `daq` of the rig file.
        step_v: of the output, in V.
        probe_v: a smaller one of the same sign, for the first start, in V.
    Yields:
        Whether the wire is there, and whether the outputs come when they should.
    Raises:
        DeviceError: the board failed on the way.
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
    # One small step at first: the amplifier may be connected all the same.
    first = measure_start(board, daq, starts=1, step_v=probe_v)
    if first.seen and _inside(first, daq) > _WIRE_S * daq.rate_hz + 1.0:
        late_us = 1e6 * _inside(first, daq) / daq.rate_hz
        yield CheckResult(
            "live",
            "loop-back wire",
            f"a step arrives {late_us:.3g} us late: the amplifier seems to be connected",
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
        "and check that both are those terminals",
    )
    if found.seen < _STARTS:
        return
    blocks, spread = found.late_blocks, found.spread_samples
    late = f"{np.median(found.late_samples):.3g} samples late, {spread:.3g} from first to last"
    in_step = blocks == 0 and spread <= _SPREAD + _WIRE_S * daq.rate_hz
    yield CheckResult(
        "live",
        "starts of the output",
        f"{_STARTS}, {late}",
        in_step,
        "The device gives "
        "outputs whole blocks late: raise daq.ahead_blocks, close other programs, or use "
        "another USB port",
    )
