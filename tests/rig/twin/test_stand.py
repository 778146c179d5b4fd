"""Who hangs the weights, and what the clock does meanwhile."""

import io

import pytest

from haselab.base import DeviceError, LimitError
from haselab.rig.operator import BenchStand, OperatorHands


class Clock:
    def __init__(self) -> None:
        self.told: list[str] = []

    def pause(self) -> None:
        self.told.append("pause")

    def catch_up(self) -> None:
        self.told.append("catch up")

    def pass_time(self, duration_s: float) -> None:
        self.told.append(f"pass {duration_s:g}")


def test_a_person_is_told_what_to_hang_and_the_clock_goes_on_afterwards() -> None:
    clock, tell = Clock(), io.StringIO()
    stand = BenchStand(OperatorHands(io.StringIO("\n\n"), tell), clock)
    stand.hang(0.25)
    stand.wait(3.0)
    stand.lift()
    stand.drop()
    assert clock.told == ["pause", "catch up", *["pass 0.5"] * 6, "pause", "catch up"]
    hang, lift = tell.getvalue().split("press Enter: ")[:2]
    for step in (
        "amplifier off, short the electrodes and measure",
        "hang 250 g on the lower clamp",
    ):
        assert step in hang
        hang = hang.split(step)[1]  # in this order
    assert lift.startswith("HIGH VOLTAGE MAY BE ON. Do not touch")
    assert tell.getvalue().endswith("Let go now.\n")


def test_no_weight_is_an_instruction_too() -> None:
    tell = io.StringIO()
    OperatorHands(io.StringIO("\n"), tell).hang(0.0)
    assert "Then remove the weight, remove the short" in tell.getvalue()


def test_nobody_at_the_terminal_is_a_fault_and_not_a_hung_weight() -> None:
    stand = BenchStand(OperatorHands(io.StringIO(""), io.StringIO()), Clock())
    with pytest.raises(DeviceError, match=r"Nobody answered the prompt to hang 250 g .*Run this"):
        stand.hang(0.25)


def test_a_mass_that_cannot_be_is_refused_before_anybody_moves() -> None:
    clock = Clock()
    with pytest.raises(LimitError, match=r"Mass = 25 kg is outside \[0, 20\] kg"):
        BenchStand(OperatorHands(io.StringIO("\n"), io.StringIO()), clock).hang(25.0)
    assert clock.told == []
