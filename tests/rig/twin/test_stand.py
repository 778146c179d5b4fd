"""Who hangs the weights, and what the clock does meanwhile."""

import io

import pytest

from haselab.base import DeviceError, LimitError
from haselab.rig.operator import BenchStand, OperatorWeights


class Clock:
    def __init__(self) -> None:
        self.reported: list[str] = []

    def pause(self) -> None:
        self.reported.append("pause")

    def catch_up(self) -> None:
        self.reported.append("catch up")

    def pass_time(self, duration_s: float) -> None:
        self.reported.append(f"pass {duration_s:g}")


def test_a_person_is_asked_to_hang_a_mass_and_the_clock_continues_afterwards() -> None:
    clock, tell = Clock(), io.StringIO()
    stand = BenchStand(OperatorWeights(io.StringIO("\n\n"), tell), clock)
    stand.hang(0.25)
    stand.wait(3.0)
    stand.lift()
    stand.drop()
    assert clock.reported == ["pause", "catch up", *["pass 0.5"] * 6, "pause", "catch up"]
    hang, lift = tell.getvalue().split("press Enter: ")[:2]
    for step in (
        "amplifier off, short the electrodes and measure",
        "hang 250 g on the lower clamp",
    ):
        assert step in hang
        hang = hang.split(step)[1]  # in this order
    assert lift.startswith("HIGH VOLTAGE MAY BE ON. Do not touch")
    assert tell.getvalue().endswith("Release the mass now.\n")


def test_no_weight_is_an_instruction_too() -> None:
    tell = io.StringIO()
    OperatorWeights(io.StringIO("\n"), tell).hang(0.0)
    assert "Then remove the mass, remove the short" in tell.getvalue()


def test_nobody_at_the_terminal_is_a_fault_and_not_a_hung_weight() -> None:
    stand = BenchStand(OperatorWeights(io.StringIO(""), io.StringIO()), Clock())
    with pytest.raises(DeviceError, match=r"prompt to hang 250 g .* was not answered\. Run this"):
        stand.hang(0.25)


def test_a_mass_that_cannot_be_is_refused_before_anybody_moves() -> None:
    clock = Clock()
    with pytest.raises(LimitError, match=r"mass is 25 kg, but it must be within \[0, 20\] kg"):
        BenchStand(OperatorWeights(io.StringIO("\n"), io.StringIO()), clock).hang(25.0)
    assert clock.reported == []
