"""The last line before every driver: no call energises anything without a valid permission.

`Gate.instrument` wraps a driver in an object with the same attributes. Whoever holds a reference
to an instrument of a bench (the runner, the camera that keeps the clock running, the stand that
lets time pass) holds the wrapped one, so nothing reaches a driver past this module. Drivers written
by others are wrapped in the same way and need no line of their own: methods and settings of
attributes are checked. Reading an attribute is not: it must not change the output.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import sys
import weakref
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from haselab.base import DeviceError, SafetyError
from haselab.rig.drivers import quietly
from haselab.safety.interlock import Interlock, InterlockBusyError, interlock_folder

__all__ = ["Gate"]

_T = TypeVar("_T")

# Calls that only take the output down, or ask an instrument: never delayed, never refused.
_SAFE = frozenset(
    {"zero", "off", "stop", "close", "is_off", "read_voltage", "check_power", "acquired"}
)
_FORGETS = ("zero", "off")  # after these a driver has no earlier request left
# Calls that request nothing themselves, but in which a driver may put out what was requested
# before: reading a block starts a stream, pausing one writes its last value.
_PASSIVE = frozenset({"read", "keep", "pause", "catch_up", "pass_time", "read_back"})
# Calls that request an output: their arguments, the last of which says how much.
_REQUESTS = {
    "write": ("voltage_v",),
    "preload": ("voltages_v",),
    "set_voltage": ("voltage_v",),
    "sine": ("frequency_hz", "amplitude_v"),
}

_NONE = -2  # no permission; `interlock.DAMAGED` is another number below zero
_CALL_S = 5.0  # that another holder of the output lock is waited for: one that makes safe


def _requests_output(name: str, arguments: tuple[Any, ...], named: dict[str, Any]) -> bool:
    """Whether a call requests an output other than 0 V; a method not known here always does."""
    if name not in _REQUESTS:
        return name not in _PASSIVE
    known = _REQUESTS[name]
    given = dict(zip(known, arguments, strict=False)) | named
    if len(arguments) > len(known) or set(given) != set(known):
        return True  # arguments of the driver's own: nobody here knows what they do
    return not _is_zero(given[known[-1]])


def _is_zero(amount: Any) -> bool:
    """Whether this is nothing but 0: a number or a sequence of them. A mask, an empty array or an
    object of somebody's own could be another number to a driver."""
    if type(amount) in (int, float):
        return bool(amount == 0)
    if isinstance(amount, (list, tuple)):
        return bool(amount) and all(map(_is_zero, amount))
    plain = type(amount) is np.ndarray or isinstance(amount, np.generic)
    return plain and amount.dtype.kind in "fiu" and amount.size > 0 and not amount.any()


def _never() -> str:
    """Of a permission that does not expire."""
    return ""


class Gate:
    """Lets calls through to the drivers of one bench while its permission is valid.

    Args:
        interlock: of the bench; None: a bench that lives in this process alone.
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
        """The gate that one of these drivers is behind already, in another rig; else a new one."""
        known = (_gates.get(id(driver)) for driver in drivers if driver is not None)
        return next((gate for gate in known if gate is not None), None) or Gate()

    def claim(self, key: str, call_s: float, shared: Collection[str] = ()) -> bool:
        """Use the interlock of this output device, and be the only program that does.

        Args:
            key: product and serial number of the device.
            call_s: longest time that one call of its driver may take, in s.
            shared: addresses of further instruments that another bench could name as well.
        Returns:
            Whether the last program that used it has vanished, perhaps with the device reserved.
        Raises:
            DeviceError: another program uses it, or the interlock's folder cannot be used.
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
                f"The bench with {key} is in use by {error}. Wait until it has ended, or stop it "
                "with 'haselab rig safe RIG.toml'; one with own drivers with 'haselab rig safe "
                f'--bench "{key}"\'.'
            ) from None
        except OSError as error:
            raise DeviceError(
                f"The interlock of {key} cannot be used ({error}). Its folder must be writable and "
                f"have room: {interlock_folder()}"
            ) from None

    def release(self) -> None:
        """Leave the bench to others. Safe to call twice."""
        self.end()
        self.interlock.close()

    # ---- permission --------------------------------------------------------------------------

    @property
    def permitted(self) -> bool:
        """A permission was given, nobody has revoked it since, and it has not expired."""
        mine = os.getpid() == self._pid  # a fork has no permission
        given = mine and self._revision >= 0 and self._revision == self.interlock.revision
        return given and not self._expired()

    def permit(self, revision: int, expired: Callable[[], str] = _never) -> None:
        """Energising is permitted from now on, for as long as the interlock has this revision.

        Args:
            revision: of the interlock.
            expired: why the permission is no longer valid; empty while it is.
        """
        self._revision, self._expired = revision, expired
        self.interlock.set_live(True)

    def end_permission(self) -> None:
        """No call is let through any more; the bench may still be live."""
        self._revision = _NONE

    def end(self) -> None:
        """The permission is returned and the bench is at 0 V; nothing is latched."""
        self.end_permission()
        self.interlock.set_live(False)

    @property
    def requests(self) -> int:
        """Calls let through so far that requested an output: what was read back before one of them
        is out of date."""
        return self._requests

    @property
    def has_requests(self) -> bool:
        """A driver was given a request and has not been taken to 0 V since."""
        return any(instrument._gate_pending for instrument in self._wrapped.values())

    @property
    def revoked(self) -> str:
        """Why a permission that was given is no longer valid; empty without one, or if it is."""
        if self._revision < 0 or self.permitted or self.expired:
            return ""
        return self.interlock.reason or "the permission was revoked"

    @property
    def expired(self) -> str:
        """Why a permission that nobody revoked is no longer valid; empty without one."""
        return self._expired() if self._revision == self.interlock.revision else ""

    # ---- drivers -----------------------------------------------------------------------------

    def instrument(self, driver: _T) -> _T:
        """The driver behind the gate; the same object for the same driver.

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
        """A camera or a stand behind the gate: its calls are let through, and watched.

        It puts out nothing itself, and a call may take as long as a person needs. But it may use
        a driver of the bench directly. Without a valid permission every driver is therefore taken
        to 0 V after each of its calls; a voltage is not prevented for the time of the call.

        Args:
            driver: camera or stand.
        Returns:
            An object with the driver's attributes. What is behind the gate already is returned
            as it is.
        """
        if isinstance(driver, _Instrument):
            return driver
        if id(driver) not in self._companions:
            kind = _wrapper_of(type(driver), driver, _Companion)
            self._companions[id(driver)] = kind(self, driver)  # type: ignore[assignment]
        return self._companions[id(driver)]  # type: ignore[return-value]

    @staticmethod
    def has_wrapped(driver: object) -> bool:
        """Whether this is a driver behind a gate."""
        return isinstance(driver, _Instrument)

    @staticmethod
    def behind(driver: _T) -> _T:
        """The camera or stand that `companion` has wrapped, for who takes all to 0 V afterwards."""
        return driver._driver if isinstance(driver, _Companion) else driver  # type: ignore[return-value]

    def call(
        self,
        instrument: _Instrument,
        name: str,
        method: Callable[..., Any],
        arguments: tuple[Any, ...],
        named: dict[str, Any],
    ) -> Any:
        """One call of a driver's method, checked and then made under the output lock."""
        if isinstance(instrument, _Companion):
            try:
                return method(*arguments, **named)
            finally:
                if self.permitted:  # it may have put out something
                    self._requests += 1
                    for driver in self._wrapped.values():
                        driver._gate_pending = set(driver._gate_clearing)
                else:
                    self._to_zero()
        if name in _SAFE:
            answer = method(*arguments, **named)
            instrument._gate_pending.discard(name)
            return answer

        def checked(acquired: bool) -> Any:
            if not acquired:
                raise SafetyError(
                    f"{name}: the bench is being made safe by another program, which has not "
                    f"finished for {_CALL_S:g} s. Check that program; the output was not changed."
                )
            if not self.permitted:
                failed = self._forget()
                if failed is not None:  # it may remember a request, and put it out in this call
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
                if not self.permitted:  # ended during the call, by one who could not wait for it
                    self._forget()

        answer = self.interlock.holding_output(checked, _CALL_S)
        if inspect.isgenerator(answer) or inspect.isawaitable(answer):
            raise SafetyError(
                f"{name} of the driver returned a generator or a coroutine, which could act after "
                "the bench was made safe. Let it act before it returns."
            )
        return answer

    def _forget(self) -> Exception | None:
        """Take back what was requested of any driver under a permission that has ended.

        Returns:
            The first error of a driver; the others were taken down all the same.
        """
        first = None
        for instrument in self._wrapped.values():
            for name in sorted(instrument._gate_pending):
                first = quietly(getattr(instrument, name)) or first
        return first

    def _to_zero(self) -> None:
        """Take all drivers down, whatever is known of their requests."""
        for instrument in self._wrapped.values():
            for name in sorted(instrument._gate_clearing):
                quietly(getattr(instrument, name))

    def _refusal(self) -> SafetyError:
        if self.expired:
            return SafetyError(self.expired)
        why = self.revoked or self.interlock.reason
        if why:
            return SafetyError(f"The bench was made safe: {why}. Arm it again before applying a "
                               "voltage.")  # fmt: skip
        return SafetyError("The bench is not armed. Arm it before applying a voltage.")

    def settle(self, wait_s: float) -> None:
        """After `zero` and `off`: calls that were under way in other threads have ended as well.

        Args:
            wait_s: for such a call.
        """
        self.interlock.holding_output(lambda acquired: self._forget(), wait_s)


# By the identity of a driver behind it, which lives as long as its gate.
_gates: weakref.WeakValueDictionary[int, Gate] = weakref.WeakValueDictionary()


class _Instrument:
    """Base of all wrapped drivers."""

    def __init__(self, gate: Gate, driver: object) -> None:
        self._gate, self._driver = gate, driver
        self._gate_clearing = frozenset(name for name in _FORGETS if hasattr(driver, name))
        # Of these, to be called before the driver is known to hold no request.
        self._gate_pending = set(self._gate_clearing)

    def __getattr__(self, name: str) -> Any:
        """What the driver makes up when it is asked, as a remote instrument does."""
        found = getattr(self._driver, name)
        if name.startswith("_") or not callable(found):
            return found
        return lambda *given, **named: self._gate.call(self, name, found, given, named)


class _Companion(_Instrument):
    """Base of a wrapped camera or stand."""


def _wrapper_of(
    kind: type, driver: object, base: type[_Instrument] = _Instrument
) -> type[_Instrument]:
    """A class whose methods pass the gate: real attributes, so that protocols are recognised."""
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
    """An attribute: reading it must not change the output; setting it counts as a request."""

    def put(self: _Instrument, value: Any) -> None:
        self._gate.call(self, f"set {name}", lambda: setattr(self._driver, name, value), (), {})

    return property(lambda self: getattr(self._driver, name), put)
