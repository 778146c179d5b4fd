"""A bench made safe from outside, over connections of its own, whoever holds the instruments."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Callable

from haselab.base import DeviceError
from haselab.rig.bench_config import BenchConfig, DaqConfig
from haselab.rig.instruments.drivers import quietly
from haselab.rig.instruments.keysight33500 import switch_generator_off
from haselab.rig.instruments.nidaq.link import NidaqLink, key_of
from haselab.rig.instruments.petapicovoltron import switch_supply_off
from haselab.safety.interlock import Interlock

__all__ = ["make_safe", "revoke_and_make_safe"]

_WARM_S = 1.0  # a connection that stood has to do it in this time; then a new one is made
_HEAD_START_S = 0.05
_WITHIN_S = 5.0  # the longest that an instrument is waited for
_REFUSED_S = 3.0  # that a generator is tried which refuses the connection
_FULL_V = 10.0  # range of the analogue outputs
_NO_SERIAL = (
    "permission NOT revoked: the board reports no serial number and the rig file has none. Other "
    "programs may still energise this bench: stop them, and set daq.serial_number"
)
_CALL_S = 0.15  # that a call of the program is waited for before acting all the same


def revoke_and_make_safe(config: BenchConfig, reason: str) -> list[tuple[str, str]]:
    """Take a bench from whoever uses it: revoke the permission, then take all to 0 V.

    Args:
        config: of the bench.
        reason: that the next arming has to acknowledge.
    Returns:
        As `make_safe`; and `interlock` with what is wrong where the permission was not revoked.
    """
    link: NidaqLink | None = None
    serial = config.daq.serial_number or ""
    with contextlib.suppress(DeviceError):  # the board's own row says so
        link = NidaqLink(config.daq)
        serial = link.serial_number
    try:
        if not serial:
            return [*make_safe(config), ("interlock", _NO_SERIAL)]
        try:
            interlock = Interlock(key_of(serial))
        except (OSError, ValueError) as error:
            return [*make_safe(config, link), ("interlock", f"permission NOT revoked ({error})")]
        with contextlib.closing(interlock):
            return _behind(interlock, config, link, reason)
    finally:
        if link is not None:
            link.close()


def _behind(
    interlock: Interlock, config: BenchConfig, link: NidaqLink | None, reason: str
) -> list[tuple[str, str]]:
    unrecorded = ""
    others = interlock.sharing(config.shared_instruments)
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
    for other in others:  # a call of its program could have followed
        with contextlib.closing(other):
            other.make_safe(act, _CALL_S)
    return [*found, ("interlock", unrecorded)] if unrecorded else found


def make_safe(config: BenchConfig, link: NidaqLink | None = None) -> list[tuple[str, str]]:
    """Take every instrument to its rest, all at once: one that hangs does not keep the others.

    The board has a head start, since it has the high voltage.

    The board is reset, which aborts the tasks of every program and puts its outputs at their
    power-up state; then 0 V is put out, since a power-up state may have been set to something else.
    The supply is switched off with everything that could keep it on, and has to run down. The
    generator takes few connections, and the program may hold one: a single one is made, for one
    line, and again for a while where it is refused. Board and supply do not wait for it.

    Args:
        config: of the bench.
        link: to the board, where one stands already; another one is made if it fails.
    Returns:
        For each instrument its name and what is wrong, empty where it is at rest.
    """
    until_s = time.monotonic() + _WITHIN_S
    board = _BackgroundCall(lambda: _rest_board(config.daq, link), "daq")
    off = functools.partial(switch_generator_off, config.generator, _REFUSED_S)
    generator = _BackgroundCall(off, "generator", trials=1)
    under_way = [("daq", board)]
    board.fault(_HEAD_START_S)
    if config.supply is not None:
        act = functools.partial(switch_supply_off, config.supply)
        under_way.append(("supply", _BackgroundCall(act, "supply")))
    under_way.append(("generator", generator))
    return [(name, aside.fault(until_s - time.monotonic())) for name, aside in under_way]


class _BackgroundCall:
    """An act in a thread of its own, which the end of the program does not wait for."""

    def __init__(self, act: Callable[[], object], name: str, trials: int = 2) -> None:
        self._error: Exception | None = None
        self._act, self._trials = act, trials
        self._thread = threading.Thread(target=self._run, name=f"rest {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for _ in range(self._trials):  # the program may take what was meant for us
            self._error = quietly(self._act)
            if self._error is None:
                return

    def fault(self, wait_s: float) -> str:
        """What is wrong; empty if the act is done within this time."""
        self._thread.join(max(0.0, wait_s))
        found = "" if self._error is None else str(self._error)  # of the first trial, if two
        if self._thread.is_alive():
            return found or "timed out while waiting for a reply"
        return found


def _rest_board(config: DaqConfig, link: NidaqLink | None) -> None:
    if link is not None and not _BackgroundCall(lambda: _reset(link, config), "warm").fault(
        _WARM_S
    ):
        return
    new = NidaqLink(config)
    try:
        _reset(new, config)
    finally:
        new.close()


def _reset(link: NidaqLink, config: DaqConfig) -> None:
    link.reset()
    with link.words():
        task = link.task()
        output = f"{config.device}/{config.output}"
        task.ao_channels.add_ao_voltage_chan(output, min_val=-_FULL_V, max_val=_FULL_V)
        try:
            link.writer(task, auto_start=True).write_one_sample(0.0)
        finally:
            task.stop()  # the output stays, and is not held against another program
