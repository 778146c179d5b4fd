"""The last check before every driver: no call energises anything without a valid permission.

`Gate.instrument` wraps a driver in an object with the same attributes. Whoever holds a reference
to an instrument of a bench (the runner, the camera that keeps the clock running, the stand that
lets time pass) holds the wrapped one, so nothing can bypass this module. Drivers of other packages
are wrapped in the same way and need no code for it: method calls and assignments to attributes
are checked. Reading an attribute is not checked: it must not change the output.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import sys
import threading
import weakref
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from haselab.base import DeviceError, JsonObject, SafetyError
from haselab.base.exits import SignalExit
from haselab.rig.drivers import quietly
from haselab.safety.interlock import Interlock, InterlockBusyError, interlock_folder

__all__ = ["Gate"]

_T = TypeVar("_T")

# Calls that only lower the output or query an instrument: never refused.
_SAFE = frozenset(
    {"zero", "off", "stop", "close", "is_off", "read_voltage", "check_power", "acquired"}
)
# Calls that wait for one another: two threads on one connection would mix up the replies.
_ONE_BY_ONE = frozenset({"off", "is_off", "read_voltage", "check_power"})
_TURN_S = 0.25  # longest such wait; after it the call is made anyway
_FORGETS = ("zero", "off")  # after these a driver has no earlier request left
# Calls that request nothing themselves, but in which a driver may put out an earlier request:
# reading a block starts a stream, pausing one writes its last value.
_PASSIVE = frozenset({"read", "keep", "pause", "catch_up", "pass_time", "read_back", "reopen"})
# Calls that request an output, with their arguments; the last one is the amount.
_REQUESTS = {
    "write": ("voltage_v",),
    "preload": ("voltages_v",),
    "set_voltage": ("voltage_v",),
    "sine": ("frequency_hz", "amplitude_v"),
}

_VALUES = frozenset({type(None), bool, int, float, np.ndarray})  # answers that cannot act later

_NONE = -2  # no permission; `interlock.DAMAGED` is another number below zero
_CALL_S = 5.0  # longest wait for a program that makes the bench safe and holds the output lock


def _requests_output(name: str, arguments: tuple[Any, ...], named: dict[str, Any]) -> bool:
    """Whether a call requests an output other than 0 V; a method not known here always does."""
    if name not in _REQUESTS:
        return name not in _PASSIVE
    known = _REQUESTS[name]
    given = dict(zip(known, arguments, strict=False)) | named
    if len(arguments) > len(known) or set(given) != set(known):
        return True  # the driver's own arguments: their effect is unknown here
    return not _is_zero(given[known[-1]])


def _is_zero(amount: Any) -> bool:
    """Whether this is 0 or a sequence of zeros. A masked or empty array, or an object of another
    type, could be a different number to a driver."""
    if type(amount) in (int, float):
        return bool(amount == 0)
    if isinstance(amount, (list, tuple)):
        return bool(amount) and all(map(_is_zero, amount))
    plain = type(amount) is np.ndarray or isinstance(amount, np.generic)
    return plain and amount.dtype.kind in "fiu" and amount.size > 0 and not amount.any()


def _never() -> str:
    """The expiry check of a permission that does not expire."""
    return ""


class Gate:
    """Lets calls through to the drivers of one bench while its permission is valid.

    Args:
        interlock: of the bench; None: a bench that exists only in this process.
    """

    def __init__(self, interlock: Interlock | None = None) -> None:
        self.interlock = interlock or Interlock()
        self._revision = _NONE  # of the interlock for which the permission was given
        self._expired: Callable[[], str] = _never
        self._wrapped: dict[int, _Instrument] = {}
        self._companions: dict[int, _Companion] = {}
        self._requests = 0
        self._pid = os.getpid()

    @staticmethod
    def of(*drivers: object) -> Gate:
        """Return the gate that already wraps one of these drivers, or a new one."""
        known = (_gates.get(id(driver)) for driver in drivers if driver is not None)
        return next((gate for gate in known if gate is not None), None) or Gate()

    def claim(self, key: str, call_s: float, shared: Collection[str] = ()) -> bool:
        """Take the interlock of this output device for this program alone.

        Args:
            key: product and serial number of the device.
            call_s: longest time that one call of its driver may take, in s.
            shared: addresses of instruments that another bench could also use.
        Returns:
            Whether the last program that used it crashed, perhaps with the device still reserved.
        Raises:
            DeviceError: Another program uses it, or the interlock's folder cannot be used.
        """
        try:
            interlock = Interlock(key)
            with contextlib.ExitStack() as undo:
                undo.callback(interlock.close)
                vanished = interlock.own(Path(sys.argv[0]).name or "python", call_s, shared)
                undo.pop_all()
            self.interlock = interlock
            return vanished
        except InterlockBusyError as error:
            raise DeviceError(
                f"The bench with {key} is in use by {error}. Wait until that program ends, or stop "
                "it with 'haselab rig safe RIG.toml'; if the bench uses your own drivers, with "
                f"'haselab rig safe --bench \"{key}\"'."
            ) from None
        except OSError as error:
            raise DeviceError(
                f"The software interlock of {key} cannot be used ({error}). Make its folder "
                f"writable and free disk space there: {interlock_folder()}"
            ) from None

    def release(self) -> None:
        """Release the bench for other programs. Safe to call twice."""
        self.end()
        self.interlock.close()

    # ---- permission --------------------------------------------------------------------------

    @property
    def permitted(self) -> bool:
        """Whether a permission was given and has neither been revoked nor expired."""
        mine = os.getpid() == self._pid  # a fork has no permission
        given = mine and self._revision >= 0 and self._revision == self.interlock.revision
        return given and not self._expired()

    def permit(self, revision: int, expired: Callable[[], str] = _never) -> None:
        """Permit energising for as long as the interlock keeps this revision.

        Args:
            revision: of the interlock.
            expired: returns why the permission is no longer valid, or an empty text.
        """
        self._revision, self._expired = revision, expired
        self.interlock.set_live(True)

    def end_permission(self) -> None:
        """Refuse all further calls; the bench may still be live."""
        self._revision = _NONE

    def end(self) -> None:
        """Return the permission of a bench that is at 0 V; no reason is latched."""
        self.end_permission()
        self.interlock.set_live(False)

    @property
    def requests(self) -> int:
        """Number of calls so far that requested an output; each one outdates earlier read-backs."""
        return self._requests

    @property
    def has_requests(self) -> bool:
        """Whether a driver was given a request and has not been taken to 0 V since."""
        return any(instrument._gate_pending for instrument in self._wrapped.values())

    @property
    def revoked(self) -> str:
        """Why the permission was revoked; empty while it is valid or if there was none."""
        if self._revision < 0 or self.permitted or self.expired:
            return ""
        return self.interlock.reason or "the permission was revoked"

    @property
    def expired(self) -> str:
        """Why the permission expired; empty while it is valid or if there was none."""
        return self._expired() if self._revision == self.interlock.revision else ""

    # ---- drivers -----------------------------------------------------------------------------

    def instrument(self, driver: _T) -> _T:
        """Wrap a driver; the same driver always gives the same object.

        Args:
            driver: any instrument of `haselab.rig`.
        Returns:
            An object with the driver's attributes, whose calls are checked.
        """
        if isinstance(driver, _Instrument):
            return driver
        if id(driver) not in self._wrapped:
            self._wrapped[id(driver)] = _wrapper_of(type(driver), driver)(self, driver)
            _gates[id(driver)] = self
        return self._wrapped[id(driver)]  # type: ignore[return-value]

    def companion(self, driver: _T) -> _T:
        """Wrap a camera or a stand: its calls are let through, and watched.

        It has no output of its own, and a call may wait for a person. But it may use a driver of
        the bench directly. Without a valid permission, every driver is therefore taken to 0 V
        after each of its calls; during the call itself a voltage is not prevented.

        Args:
            driver: camera or stand.
        Returns:
            An object with the driver's attributes. An object that is already wrapped is returned
            unchanged.
        """
        if isinstance(driver, _Instrument):
            return driver
        if id(driver) not in self._companions:
            kind = _wrapper_of(type(driver), driver, _Companion)
            self._companions[id(driver)] = kind(self, driver)  # type: ignore[assignment]
        return self._companions[id(driver)]  # type: ignore[return-value]

    @staticmethod
    def has_wrapped(driver: object) -> bool:
        """Whether this driver is wrapped by a gate."""
        return isinstance(driver, _Instrument)

    @staticmethod
    def behind(driver: _T) -> _T:
        """Unwrap a camera or stand, for a caller that takes everything to 0 V afterwards."""
        return driver._driver if isinstance(driver, _Companion) else driver  # type: ignore[return-value]

    def call(
        self,
        instrument: _Instrument,
        name: str,
        method: Callable[..., Any],
        arguments: tuple[Any, ...],
        named: JsonObject,
    ) -> Any:
        """Check one call of a driver's method, then make it under the output lock.

        Raises:
            DeviceError: The driver called `sys.exit()`, which must not end the program.
        """
        try:
            return self._call(instrument, name, method, arguments, named)
        except SignalExit:
            raise
        except SystemExit as stop:
            raise DeviceError(
                f"The driver {type(instrument._driver).__name__!r} called sys.exit({stop.code!r}) "
                f"in {name!r}. Report the fault to the authors of the driver."
            ) from stop

    def _call(
        self,
        instrument: _Instrument,
        name: str,
        method: Callable[..., Any],
        arguments: tuple[Any, ...],
        named: JsonObject,
    ) -> Any:
        if isinstance(instrument, _Companion):
            try:
                return method(*arguments, **named)
            finally:
                if self.permitted:  # the call may have applied a voltage
                    self._requests += 1
                    for driver in self._wrapped.values():
                        driver._gate_pending = set(driver._gate_clearing)
                else:
                    self._to_zero()
        if name in _SAFE:
            with instrument._gate_turn(name):
                answer = method(*arguments, **named)
            instrument._gate_pending.discard(name)
            return answer

        def checked(acquired: bool) -> Any:
            if not acquired:
                raise SafetyError(
                    f"{name} was refused: another program is taking the bench to 0 V and has not "
                    f"finished after {_CALL_S:g} s. The output was not changed. Check that program."
                )
            if not self.permitted:
                failed = self._forget()
                if failed is not None:  # this call could still put out an earlier request
                    raise failed
                if _requests_output(name, arguments, named):
                    raise self._refusal()
                return method(*arguments, **named)
            instrument._gate_pending = set(instrument._gate_clearing)
            self._requests += _requests_output(name, arguments, named)
            try:
                return method(*arguments, **named)
            finally:  # whatever other threads did meanwhile
                instrument._gate_pending = set(instrument._gate_clearing)
                if not self.permitted:  # revoked during the call, without waiting for it
                    self._forget()

        answer = self.interlock.holding_output(checked, _CALL_S)
        if type(answer) not in _VALUES and (
            inspect.isgenerator(answer) or inspect.isawaitable(answer)
        ):
            raise SafetyError(
                f"{name} of the driver returned a generator or a coroutine, which could act after "
                "the bench was taken to 0 V. Make it act before it returns."
            )
        return answer

    def _forget(self) -> Exception | None:
        """Cancel what was requested of any driver under a permission that has ended.

        Returns:
            The first error of a driver; the other drivers were cancelled as well.
        """
        first = None
        for instrument in self._wrapped.values():
            for name in sorted(instrument._gate_pending):
                first = quietly(getattr(instrument, name)) or first
        return first

    def _to_zero(self) -> None:
        """Take all drivers to 0 V, whether or not they have a request."""
        for instrument in self._wrapped.values():
            for name in sorted(instrument._gate_clearing):
                quietly(getattr(instrument, name))

    def _refusal(self) -> SafetyError:
        if self.expired:
            return SafetyError(self.expired)
        why = self.revoked or self.interlock.reason
        if why:
            return SafetyError(f"The permission of the bench was revoked: {why}. Arm it again "
                               "before applying a voltage.")  # fmt: skip
        return SafetyError("The bench is not armed. Arm it before applying a voltage.")

    def settle(self, wait_s: float) -> None:
        """Wait, after `zero` and `off`, until calls in other threads have ended as well.

        Args:
            wait_s: longest wait for such a call.
        """
        self.interlock.holding_output(lambda acquired: self._forget(), wait_s)


# By the id of a wrapped driver, which exists as long as its gate.
_gates: weakref.WeakValueDictionary[int, Gate] = weakref.WeakValueDictionary()


class _Instrument:
    """Base of all wrapped drivers."""

    def __init__(self, gate: Gate, driver: object) -> None:
        self._gate, self._driver = gate, driver
        self._gate_clearing = frozenset(name for name in _FORGETS if hasattr(driver, name))
        # Those still to be called before the driver is known to have no request.
        self._gate_pending = set(self._gate_clearing)
        self._gate_calling = threading.RLock()

    @contextlib.contextmanager
    def _gate_turn(self, name: str) -> Iterator[None]:
        """Wait at most `_TURN_S` until such a call of another thread has ended."""
        taken = name in _ONE_BY_ONE and self._gate_calling.acquire(timeout=_TURN_S)
        try:
            yield
        finally:
            if taken:
                self._gate_calling.release()

    def __getattr__(self, name: str) -> Any:
        """Forward attributes that the driver creates on access, as remote proxies do."""
        found = getattr(self._driver, name)
        if name.startswith("_") or not callable(found):
            return found
        return lambda *given, **named: self._gate.call(self, name, found, given, named)


class _Companion(_Instrument):
    """Base of a wrapped camera or stand."""


def _wrapper_of(
    kind: type, driver: object, base: type[_Instrument] = _Instrument
) -> type[_Instrument]:
    """Make a class whose methods pass the gate; real attributes, so that protocols match."""
    members: dict[str, Any] = {}
    for name in dir(driver):
        if name.startswith("_"):
            continue
        attribute = inspect.getattr_static(driver, name)
        plain = isinstance(attribute, property) or not callable(getattr(driver, name))
        members[name] = _forwarded(name) if plain else _checked(name)
    return type(f"Gated{kind.__name__}", (base,), members)


def _checked(name: str) -> Callable[..., Any]:
    def call(self: _Instrument, *arguments: Any, **named: Any) -> Any:
        return self._gate.call(self, name, getattr(self._driver, name), arguments, named)

    return functools.wraps(call, assigned=())(call)


def _forwarded(name: str) -> property:
    """A property: reading it must not change the output; setting it counts as a request."""

    def put(self: _Instrument, value: Any) -> None:
        self._gate.call(self, f"set {name}", lambda: setattr(self._driver, name, value), (), {})

    return property(lambda self: getattr(self._driver, name), put)
