"""No driver is energised without a valid permission, whoever wrote it and whoever calls it."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from haselab.base import SafetyError
from haselab.rig import (
    FunctionGenerator,
    GaplessAcquisition,
    PreloadsOutputs,
    ReportsOutput,
    ReportsOutputState,
)
from haselab.safety import gate as gate_module
from haselab.safety.gate import Gate


class Driver:
    """An instrument of somebody else's: like NI's, it puts out what it was last asked for."""

    def __init__(self) -> None:
        self.identity = "their own"
        self.missed_outputs = 0
        self.requested_v = self.output_v = self.carrier_v = 0.0
        self.at_once = lambda voltage_v: self.write(voltage_v)  # callable, but no method

    @property
    def level(self) -> float:
        return self.output_v

    @level.setter
    def level(self, value: float) -> None:
        self.output_v = value

    def __getattr__(self, name: str) -> object:
        if name.startswith("_") or "remote" not in name:
            raise AttributeError(name)
        return lambda voltage_v: self.write(voltage_v)

    def write(self, voltage_v: float, offset_v: float = 0.0) -> None:
        self.requested_v = voltage_v + offset_v

    def preload(self, voltages_v: np.ndarray) -> int:
        self.requested_v = float(voltages_v[-1])
        return 0

    def zero(self) -> None:
        self.requested_v = self.output_v = 0.0

    def read(self) -> float:
        self.output_v = self.requested_v
        return self.output_v

    def keep(self, on: bool) -> None:
        self.output_v = self.requested_v

    def read_back(self) -> float:
        return self.output_v

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        self.carrier_v = amplitude_v

    def off(self) -> None:
        self.carrier_v = 0.0

    def is_off(self) -> bool:
        return self.carrier_v == 0.0

    def full_power(self) -> None:
        self.output_v = 2.0


@pytest.fixture
def gate() -> Gate:
    return Gate()


def permit(gate: Gate) -> None:
    gate.permit(gate.interlock.revision)


def test_a_wrapped_driver_is_recognised_by_every_protocol_that_it_fulfils(gate: Gate) -> None:
    wrapped = gate.instrument(Driver())
    for protocol in (PreloadsOutputs, GaplessAcquisition, ReportsOutputState, ReportsOutput):
        assert isinstance(wrapped, protocol)
    source: FunctionGenerator = wrapped
    assert source is gate.instrument(wrapped)
    assert wrapped.identity == "their own"
    assert wrapped.missed_outputs == 0


@pytest.mark.parametrize(
    "request_output",
    [
        lambda d: d.write(1.5),
        lambda d: d.write(voltage_v=1.5),
        lambda d: d.write(np.float64(-1e-9)),
        lambda d: d.write(float("nan")),
        lambda d: d.preload(np.array([0.0, 1.0])),
        lambda d: d.sine(2000.0, 0.02),
        lambda d: d.sine(frequency_hz=2000.0, amplitude_v=0.02),
        lambda d: d.full_power(),
        lambda d: d.sine(amplitude_v=1.0, frequency_hz=0.0),
        lambda d: d.write(0.0, 1.0),
        lambda d: setattr(d, "level", 1.0),
        lambda d: d.at_once(1.0),
        lambda d: d.made_up_by_a_remote_driver(1.0),
    ],
)
def test_nothing_is_requested_without_a_permission_nor_after_its_end(gate, request_output) -> None:
    driver = Driver()
    wrapped = gate.instrument(driver)
    with pytest.raises(SafetyError, match="not armed"):
        request_output(wrapped)
    permit(gate)
    request_output(wrapped)
    gate.interlock.revoke("Smoke.")
    with pytest.raises(SafetyError, match=r"was revoked: Smoke \(on "):
        request_output(wrapped)
    wrapped.read()
    assert (driver.output_v, driver.requested_v, driver.carrier_v) == (0.0, 0.0, 0.0)


def test_zero_and_passive_calls_need_no_permission(gate: Gate) -> None:
    wrapped = gate.instrument(Driver())
    wrapped.write(0.0)
    wrapped.preload(np.zeros(3))
    wrapped.sine(2000.0, 0.0)
    wrapped.keep(True)
    assert wrapped.read() == 0.0 and wrapped.read_back() == 0.0 and wrapped.is_off()
    wrapped.zero()
    wrapped.off()


@pytest.mark.parametrize("call", [lambda d: d.keep(False), lambda d: d.read()])
def test_a_request_of_before_is_never_put_out_again(gate: Gate, call) -> None:
    """The reported fault: the output of a bench that was made safe came back to 9.5 kV."""
    driver = Driver()
    wrapped = gate.instrument(driver)
    permit(gate)
    wrapped.write(1.9)
    wrapped.read()
    assert driver.output_v == 1.9
    gate.interlock.revoke("Made safe by somebody else")
    driver.output_v = 0.0  # over another connection: the driver's own memory still has 1.9 V
    call(wrapped)
    assert (driver.output_v, driver.requested_v) == (0.0, 0.0)


def test_a_request_of_before_needs_a_new_one_after_a_new_permission(gate: Gate) -> None:
    driver = Driver()
    wrapped = gate.instrument(driver)
    permit(gate)
    wrapped.write(1.9)
    gate.interlock.revoke("Smoke.")
    wrapped.read()
    permit(gate)
    assert wrapped.read() == 0.0
    wrapped.write(0.5)
    assert wrapped.read() == 0.5


def test_an_old_permission_that_a_trip_met_in_mid_call_leaves_nothing_behind(gate: Gate) -> None:
    """A call passes the check; meanwhile another thread revokes and zeroes; then the call ends."""
    inside, go_on = threading.Event(), threading.Event()

    class Slow(Driver):
        def write(self, voltage_v: float) -> None:
            inside.set()
            assert go_on.wait(60.0)
            super().write(voltage_v)
            self.read()

    driver = Slow()
    wrapped = gate.instrument(driver)
    permit(gate)
    thread = threading.Thread(target=wrapped.write, args=(1.9,))
    thread.start()
    assert inside.wait(60.0)
    gate.interlock.revoke("Smoke.")
    wrapped.zero()
    go_on.set()
    gate.settle(60.0)
    thread.join(60.0)
    gate.settle(60.0)
    assert (driver.output_v, driver.requested_v) == (0.0, 0.0)


def test_a_permission_that_ends_during_a_call_takes_back_what_the_call_put_out(gate: Gate) -> None:
    """By one who did not wait for the call, since the lock's file had been removed."""

    class Slow(Driver):
        def write(self, voltage_v: float) -> None:
            gate.interlock.revoke("Smoke.")
            super().write(voltage_v)
            self.read()

    driver = Slow()
    permit(gate)
    gate.instrument(driver).write(1.9)
    assert (driver.output_v, driver.requested_v) == (0.0, 0.0)


def test_a_driver_whose_zero_fails_is_zeroed_again_before_any_other_call(gate: Gate) -> None:
    class Stubborn(Driver):
        refuses = 2

        def zero(self) -> None:
            self.refuses -= 1
            if self.refuses >= 0:
                raise OSError("no answer")
            super().zero()

    driver = Stubborn()
    wrapped = gate.instrument(driver)
    permit(gate)
    wrapped.write(1.9)
    wrapped.read()
    gate.interlock.revoke("Smoke.")
    with pytest.raises(OSError, match="no answer"):
        wrapped.zero()
    with pytest.raises(OSError, match="no answer"):
        wrapped.read()
    assert wrapped.read() == 0.0


def test_a_permission_for_an_earlier_revision_is_none(gate: Gate) -> None:
    before = gate.interlock.revision
    gate.interlock.revoke("Smoke.")
    gate.permit(before)
    assert not gate.permitted and gate.revoked.startswith("Smoke (on ")
    gate.end()
    assert gate.revoked == ""


class SlowDriver(Driver):
    """One connection: two calls at the same time would mix up the replies."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = self.most = 0
        self.entered, self.both, self.end = (threading.Event() for _ in range(3))

    def off(self) -> None:
        self.calls += 1
        self.most = max(self.most, self.calls)
        (self.both if self.entered.is_set() else self.entered).set()
        self.end.wait()
        self.calls -= 1
        super().off()


def test_a_driver_is_not_switched_off_by_two_threads_at_the_same_time(
    gate: Gate, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refused call of the source takes every driver to 0 V that another thread switches off."""
    monkeypatch.setattr(gate_module, "_TURN_S", 600.0)
    source, driver = gate.instrument(Driver()), SlowDriver()
    supply = gate.instrument(driver)
    first = threading.Thread(target=supply.off)
    first.start()
    driver.entered.wait()
    second = threading.Thread(target=source.read_back)
    second.start()
    driver.both.wait(0.2)
    driver.end.set()
    first.join()
    second.join()
    assert driver.most == 1


def test_a_driver_that_hangs_is_switched_off_all_the_same(gate: Gate) -> None:
    driver = SlowDriver()
    supply = gate.instrument(driver)
    threads = [threading.Thread(target=supply.off) for _ in range(2)]
    threads[0].start()
    driver.entered.wait()
    threads[1].start()
    assert driver.both.wait(600.0)
    driver.end.set()
    for thread in threads:
        thread.join()
