"""Late and missed ticks by a clock that the test moves."""

from __future__ import annotations

from haselab.safety.watchdog.deadlines import Deadlines

BLOCK_S = 0.01


class Wall:
    """A clock; and a loop on it whose delays are given."""

    def __init__(self, missed: int = 5, late: int = 20) -> None:
        self.now_s, self.rig_s = 1000.0, 3.0
        self.deadlines = Deadlines(BLOCK_S, missed, late, lambda: self.now_s)

    def tick(self, delay_s: float, arrival_s: float = 0.0) -> str:
        """One block, `arrival_s` late on the wall clock, answered `delay_s` after its end."""
        self.rig_s += BLOCK_S
        end_s = 1000.0 + self.rig_s
        self.now_s = end_s + arrival_s
        self.deadlines.arrived(self.rig_s)
        self.now_s = end_s + delay_s
        return self.deadlines.answered()


def test_ticks_are_counted_by_their_delay() -> None:
    wall = Wall()
    reported = [wall.tick(delay_s) for delay_s in (0.001, 0.004, 0.006, 0.011, 0.002)]
    assert reported == [""] * 5
    ticks = wall.deadlines.ticks
    assert (ticks.count, ticks.late, ticks.missed) == (5, 2, 1)
    assert abs(ticks.worst_s - 0.011) < 1e-9
    assert str(ticks) == "5 ticks, 2 late, 1 missed, worst 11.0 ms"


def test_a_backlog_counts_although_each_answer_is_quick() -> None:
    wall = Wall()
    wall.tick(0.001)
    reported = [wall.tick(0.031, arrival_s=0.030) for _ in range(5)]
    assert reported[:4] == [""] * 4
    assert reported[4].startswith("Lost deadline: 5 deadlines missed in a row (missed_limit = 5)")


def test_one_good_tick_ends_a_row_and_late_ones_are_limited_in_a_hundred() -> None:
    wall = Wall(missed=3, late=10)
    for _ in range(4):
        assert wall.tick(0.012) == ""
        assert wall.tick(0.013) == ""
        assert wall.tick(0.001) == ""
    assert wall.tick(0.006) == ""
    assert "10 of the last 14 outputs late (late_limit = 10)" in wall.tick(0.006)


def test_late_ticks_are_forgotten_after_a_hundred() -> None:
    wall = Wall(late=3)
    for _ in range(5):
        assert wall.tick(0.006) == ""
        assert [wall.tick(0.001) for _ in range(60)] == [""] * 60


def test_clocks_that_part_slowly_are_no_late_ticks() -> None:
    wall = Wall()
    for k in range(100_000):  # 1000 s with a rig that is slow by 50 parts in a million
        assert wall.tick(0.001 + 50e-6 * BLOCK_S * k, arrival_s=50e-6 * BLOCK_S * k) == ""
    assert wall.deadlines.ticks.late == 0


def test_a_block_with_no_answer_is_no_tick() -> None:
    wall = Wall()
    wall.deadlines.arrived(3.0)
    wall.deadlines.arrived(3.01)
    assert wall.deadlines.answered() == ""
    assert wall.deadlines.answered() == ""
    assert wall.deadlines.ticks.count == 1


def test_a_rig_s_clock_that_stood_still_is_forgiven_after_sixteen_blocks() -> None:
    wall = Wall()
    for _ in range(5):
        assert wall.tick(0.001) == ""
    for _ in range(40):  # 6 ms behind from here on
        assert wall.tick(0.007, arrival_s=0.006) == ""
    assert wall.deadlines.ticks.late == 15  # until the last of the soonest has left the sixteen


def test_a_lost_deadline_names_the_part_that_took_most_of_the_time() -> None:
    wall = Wall(missed=3)
    wall.tick(0.001)
    for _ in range(2):
        wall.deadlines.spent("The step of controller 'slow'", 0.012)
        assert wall.tick(0.013) == ""
    wall.deadlines.spent("The step of controller 'slow'", 0.0)
    fault = wall.tick(0.013)
    assert "The step of controller 'slow' took up to 12.0 ms of this delay. Make it faster" in fault


def test_a_quick_part_is_not_blamed_for_a_late_computer() -> None:
    wall = Wall(missed=3)
    wall.tick(0.001)
    wall.deadlines.spent("The step of controller 'quick'", 0.004)
    assert [wall.tick(0.013), wall.tick(0.013)] == ["", ""]
    assert "Close other programs" in wall.tick(0.013)
