"""What the firmware takes of the chip: exact numbers, of cycles that were counted."""

from __future__ import annotations

from haselab.firmware.messages import Run, SetReference, State, Status
from haselab.rig.chip import CoSim, Firmware

UPDATE_CYCLES = 16_000
RAM_BYTES = 1024
FLASH_BYTES = 16 * 1024


def test_pid_at_1_khz_takes_at_most_60_percent_of_the_cycles_with_telemetry_at_100_hz(
    chip: CoSim, firmware: Firmware
) -> None:
    chip.arm()
    chip.execute(Run(0.0))
    start, asleep, conversions = (chip.counts[k] for k in ("cycle", "asleep", "conversions"))
    known = len(chip.messages)
    for k in range(10):
        chip.execute(SetReference(0.005 * k), 0.1)
    passed = chip.counts["cycle"] - start
    reported = [m for m in chip.messages[known:] if isinstance(m, Status)]
    load = 1.0 - (chip.counts["asleep"] - asleep) / passed
    updates = (reported[-1].update - reported[0].update) / (len(reported) - 1)
    assert reported[-1].state == State.RUNNING
    assert reported[-1].overruns == 0
    assert updates == 10.0  # status at 100 Hz of updates at 1 kHz
    assert abs(passed / UPDATE_CYCLES - 10.0 * len(reported)) <= 10.0
    assert load <= 0.60, f"{load:.4f}"
    assert max(m.busy_cycles for m in reported) < UPDATE_CYCLES
    # 125 kHz converter clock, within the 50 to 200 kHz of full resolution: 8,000 a second.
    rate_hz = (chip.counts["conversions"] - conversions) / (passed / 16e6)
    assert abs(rate_hz - 8000.0) < 2.0
    assert chip.counts["short_slots"] == 0
    assert firmware.flash_bytes < FLASH_BYTES
    assert firmware.static_bytes + chip.counts["stack"] < RAM_BYTES
