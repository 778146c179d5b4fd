"""Make a bench safe from another process, over separate connections to its instruments."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable
from typing import Any

from haselab.base import DeviceError
from haselab.rig.bench_config import BenchConfig, BenchOutputs
from haselab.rig.drivers import quietly
from haselab.rig.instruments.devices import DaqConnection
from haselab.rig.instruments.instrument import DaqInstrument, OutputInstrument
from haselab.safety.interlock import Interlock

__all__ = ["make_safe", "revoke_and_make_safe"]

_WARM_S = 1.0  # time limit for the open connection; after it a new one is made
_HEAD_START_S = 0.05
_WITHIN_S = 5.0  # longest wait for an instrument
_REFUSED_S = 3.0  # how long to retry an instrument that refuses the connection
_NO_KEY = (
    "permission NOT revoked: the board reports no serial number and the rig file has none. Other "
    "programs may still energise this bench. Stop them, and set daq.serial_number"
)
_NO_BOARD = (
    "permission NOT revoked: the driver of the board, which identifies the bench, cannot be used. "
    "Stop the program that uses this bench"
)
_CALL_S = 0.15  # longest wait for a call of the program before acting anyway


def revoke_and_make_safe(config: BenchConfig | BenchOutputs, reason: str) -> list[tuple[str, str]]:
    """Revoke the permission of the program that uses a bench, then take everything to 0 V.

    Args:
        config: of the bench.
        reason: text that the next arming has to acknowledge.
    Returns:
        As `make_safe`; and `interlock` with the fault if the permission was not revoked.
    """
    daq = _daq_of(config)
    if daq is None:
        return [*_behind(Interlock(), config, None, reason), ("interlock", _NO_BOARD)]
    board, section = daq
    link: DaqConnection | None = None
    key = board.key_of(section)
    with contextlib.suppress(DeviceError):  # reported in the board's own row
        link = board.connect(section)
        key = link.key
    try:
        if not key:
            return [*_behind(Interlock(), config, link, reason), ("interlock", _NO_KEY)]
        try:
            interlock = Interlock(key)
        except (OSError, ValueError) as error:
            return [*make_safe(config, link), ("interlock", f"permission NOT revoked ({error})")]
        with contextlib.closing(interlock):
            return _behind(interlock, config, link, reason)
    finally:
        if link is not None:
            link.close()


def _behind(
    interlock: Interlock,
    config: BenchConfig | BenchOutputs,
    link: DaqConnection | None,
    reason: str,
) -> list[tuple[str, str]]:
    """With the permission of the bench, or of whichever program uses its other instruments."""
    unrecorded, shared = "", config.shared_instruments
    others = interlock.sharing(shared) if interlock.key else Interlock.using(shared)
    for each in (interlock, *others):
        try:
            each.revoke(reason)
        except OSError as error:  # a full disk must not come before 0 V
            unrecorded = f"permission NOT revoked ({error})"
    found: list[tuple[str, str]] = []

    def act() -> bool:
        revision = interlock.revision
        found[:] = make_safe(config, link)
        safe = not any(fault for _, fault in found)
        if safe:
            with contextlib.suppress(OSError):
                interlock.confirm_safe(revision)
        return safe

    interlock.make_safe(act, _CALL_S)
    for other in others:  # its program could have made another call
        with contextlib.closing(other):
            other.make_safe(act, _CALL_S)
    return [*found, ("interlock", unrecorded)] if unrecorded else found


def _daq_of(config: BenchConfig | BenchOutputs) -> tuple[DaqInstrument[Any], Any] | None:
    """The board's driver and section; None if its driver cannot be used."""
    for each in config.instruments():
        if isinstance(each.instrument, DaqInstrument):
            return each.instrument, each.config
    return None


def make_safe(
    config: BenchConfig | BenchOutputs, link: DaqConnection | None = None
) -> list[tuple[str, str]]:
    """Shut all instruments down in parallel, so that one that hangs does not delay the others.

    The board is first, since it sets the high voltage. Each instrument is shut down by its own
    driver, see `OutputInstrument.shut_down`, over a separate connection.

    Args:
        config: of the bench.
        link: open connection to the board, if there is one; a new one is made if it fails.
    Returns:
        For each instrument its section and its fault, which is empty if the instrument is off.
    """
    until_s = time.monotonic() + _WITHIN_S
    under_way = []
    if (daq := _daq_of(config)) is not None:
        under_way.append(("daq", _BackgroundCall(lambda: _shut_down_daq(*daq, link), "daq")))
        under_way[0][1].fault(_HEAD_START_S)
    others = [each for each in config.instruments() if each.section != "daq"]
    for each in reversed(others):  # the supply first: it may hold a high voltage
        if isinstance(each.instrument, OutputInstrument):
            act = functools.partial(each.instrument.shut_down, each.config, _REFUSED_S)
            attempts = each.instrument.shutdown_attempts
            under_way.append((each.section, _BackgroundCall(act, each.section, attempts)))
    return [(name, call.fault(until_s - time.monotonic())) for name, call in under_way]


class _BackgroundCall:
    """A call in its own thread, for which the end of the program does not wait."""

    def __init__(self, act: Callable[[], object], name: str, trials: int = 2) -> None:
        self._error: Exception | None = None
        self._act, self._trials = act, trials
        self._thread = threading.Thread(target=self._run, name=f"rest {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for _ in range(self._trials):  # the program may have read our reply
            self._error = quietly(self._act)
            if self._error is None:
                return

    def fault(self, wait_s: float) -> str:
        """The error of the call; empty if it succeeds within this time."""
        self._thread.join(max(0.0, wait_s))
        # of the first attempt, while the second one runs
        found = "" if self._error is None else str(self._error)
        if self._thread.is_alive():
            return found or "timed out while waiting for a reply"
        return found


def _shut_down_daq(board: DaqInstrument[Any], section: Any, link: DaqConnection | None) -> None:
    """Use the open connection first, then a new one if that does not succeed in time."""
    if link is not None and not _BackgroundCall(link.shut_down, "warm").fault(_WARM_S):
        return
    board.shut_down(section, _REFUSED_S)
