"""Options of the commands that describe a control loop."""

from __future__ import annotations

from collections.abc import Callable

from haselab.cli.common import REAL
from haselab.cli.options import shared_option
from haselab.control import LoopSetting

__all__ = ["loop_options"]

_USUAL = LoopSetting()


def loop_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add `--delay-s` and `--rate-hz`, which describe the control loop."""
    for option in (
        shared_option(
            "--delay-s", type=REAL,
            detail="Half the sampling period is added for the hold. Default: loop_delay_s in the "
            f"model file, else {_USUAL.measurement_delay_s:g}.",
        ),
        shared_option(
            "--rate-hz", type=REAL,
            detail="It is the rate of the control loop. Default: rate_hz in the model file, else "
            f"{_USUAL.rate_hz:g}.",
        ),
    ):  # fmt: skip
        command = option(command)
    return command
