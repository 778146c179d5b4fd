"""What the firmware does when things break, counted in cycles of the co-simulated chip."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError
from haselab.firmware import ChipSettings
from haselab.firmware.messages import (
    ClearFault,
    Fault,
    Hello,
    KeepAlive,
    RequestArming,
    Result,
    Run,
    SetReference,
    State,
    Status,
)
from haselab.rig.chip import CoSim, Firmware, Output, build_firmware
from haselab.rig.twin.twin_bench import TwinBench

CODE_HIGH = 3800  # 1.9 V in steps of 0.5 mV
# Registers, input and output, memory, stack.
PLACES = ((0x00, 0x20), (0x20, 0x137), (0x200, 0x420), (0x2180, 0x2200))
WATCHDOG_S = 2048 / 128e3  # nominal


def close_loop(chip: CoSim, reference: float = 0.03, duration_s: float = 0.4) -> None:
    chip.arm()
    chip.execute(Run(reference))
    end_s = chip.time_s + duration_s
    while chip.time_s < end_s:
        chip.execute(KeepAlive(), 0.05)
    assert status(chip).state == State.RUNNING
    assert chip.outputs[-1].on


def status(chip: CoSim) -> Status:
    return next(m for m in reversed(chip.messages) if isinstance(m, Status))


def off_s(chip: CoSim) -> float:
    """When the output went off for good."""
    assert not chip.outputs[-1].on, chip.outputs[-3:]
    last_on = max(k for k, out in enumerate(chip.outputs) if out.on)
    return chip.outputs[last_on + 1].time_s


def check_clamps(outputs: list[Output]) -> None:
    assert max((out.code for out in outputs), default=0) <= CODE_HIGH


def test_power_up_leaves_the_output_off_and_no_single_command_changes_that(chip: CoSim) -> None:
    chip.query(Hello(1))
    for message in (Run(0.03), SetReference(0.03), KeepAlive(), RequestArming()):
        chip.query(message)
    chip.run(0.1)
    assert not [out for out in chip.outputs if out.enable or out.code]
    assert status(chip).state == State.OFF


def test_the_loop_closes_and_the_strain_is_the_true_one(chip: CoSim) -> None:
    chip.command("track 80")
    close_loop(chip, 0.03, 2.0)
    now = status(chip)
    assert now.fault == Fault.NONE
    # The map's own error and the simulator's converter, 1/2 LSB of 290 codes through a slope of
    # strain over capacitance below 0.5: both below 0.5 % strain.
    assert abs(now.strain - 0.03) < 5e-3
    length_m = 0.05110285281865306  # zero_strain_length_m of data/model.json
    assert abs(chip.tracks[-1].length_m / length_m - 1.0 - 0.03) < 5e-3
    check_clamps(chip.outputs)


@pytest.mark.long
def test_a_capacitance_far_outside_the_strain_map_has_no_strain_and_trips(
    settings: ChipSettings, tmp_path: Path, cosim_program: Path, twin: TwinBench
) -> None:
    """The map ends at the capacitance of a strain of 0.02; the loop is asked for 0.05."""
    slope, offset, *bent = settings.strain_map
    grid_f = np.linspace(*settings.capacitance_range_f, 2000)
    strain = ((bent[1] * grid_f + bent[0]) * grid_f + slope) * grid_f + offset
    usable_f = (float(grid_f[0]), float(grid_f[np.searchsorted(strain, 0.02)]))
    built = build_firmware(replace(settings, usable_f=usable_f), tmp_path)
    with CoSim(cosim_program, built.elf, twin) as chip:
        close_loop(chip, 0.0, 0.3)
        chip.execute(SetReference(0.05))
        chip.run(0.5)
        assert status(chip).fault == Fault.SENSING
        assert not chip.outputs[-1].on


def test_a_hang_is_noticed_by_the_sampling_interrupt(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault("hang")
    chip.run(0.1)
    assert off_s(chip) - at < 6e-3  # four frames that nobody took, and one slot


def test_a_hang_with_interrupts_off_ends_by_the_watchdog_before_main(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault("hang_blind")
    chip.run(0.1)
    assert off_s(chip) - at < 20e-3
    assert off_s(chip) - at < WATCHDOG_S + 1e-3
    assert chip.counts["resets"] >= 1
    assert chip.outputs[-1].code == 0  # the converter too, not the pin alone


@pytest.mark.parametrize("fault", ["carrier", "wire_v", "wire_i", "stall"])
def test_lost_sensing_takes_the_output_off_within_5_ms(fault: str, chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault(fault)
    chip.run(0.05)
    assert off_s(chip) - at < 5e-3
    # A wire that had 1.4 V on it throws its stage to the rail: that is reported as a breakdown.
    expected = Fault.BREAKDOWN if fault == "wire_v" else Fault.SENSING
    assert status(chip).fault == expected


def test_a_refused_command_names_the_fault_that_tripped_the_chip(chip: CoSim) -> None:
    close_loop(chip)
    chip.fault("carrier")
    chip.run(0.05)
    with pytest.raises(DeviceError, match=r"did not accept SetReference \(tripped: sensing\)"):
        chip.execute(SetReference(0.03))


def test_a_module_that_does_not_follow_trips(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault("stuck")
    # 15 % of the range, 0.29 V, is where it trips: the integral alone, 11.4/s of an error of 0.06
    # and 5 V for 1 of strain, asks for 0.4 V within 0.12 s.
    chip.send(SetReference(-0.03))
    chip.run(0.14)
    assert off_s(chip) - at < 0.13
    assert status(chip).fault == Fault.WRONG_OUTPUT


def test_a_level_that_is_gone_counts_as_breakdown(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault("level")
    chip.run(0.05)
    assert off_s(chip) - at < 2e-3  # a frame, and a slot
    assert status(chip).fault == Fault.BREAKDOWN


@pytest.mark.parametrize("instant", range(8))
def test_breakdown_drops_the_enable_pin_within_half_a_millisecond(
    instant: int, chip: CoSim
) -> None:
    close_loop(chip, 0.03, 0.2)
    chip.run(125e-6 * (instant + 0.3))  # in each slot of a frame
    at = chip.fault("breakdown")
    chip.run(0.05)
    assert off_s(chip) - at < 0.5e-3
    assert status(chip).fault == Fault.BREAKDOWN
    assert status(chip).state == State.TRIPPED


def test_a_fault_stays_until_it_is_cleared(chip: CoSim) -> None:
    close_loop(chip)
    chip.fault("breakdown")
    chip.run(0.02)
    chip.fault("none")
    for message in (RequestArming(), Run(0.03), SetReference(0.01), KeepAlive()):
        chip.query(message)
    chip.run(0.05)
    assert status(chip).state == State.TRIPPED
    assert not chip.outputs[-1].enable
    chip.execute(ClearFault())
    chip.run(0.02)
    assert status(chip).state == State.OFF
    close_loop(chip, 0.0, 0.1)


def test_silence_ramps_down_within_200_ms_and_no_faster_than_set(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.time_s
    chip.run(1.0)
    falling = [(a, b) for a, b in itertools.pairwise(chip.outputs) if b.time_s > at + 0.14]
    assert falling[0][1].time_s - at < 0.2
    assert status(chip).fault == Fault.LINK
    assert status(chip).state == State.TRIPPED
    whole = [a.code - b.code for a, b in falling if b.enable]
    assert max(whole) <= 9  # 4 V/s at 0.5 mV and 1 ms: 8, and one of rounding
    assert not chip.outputs[-1].enable


def test_garbage_torn_and_replayed_frames_change_nothing(chip: CoSim) -> None:
    close_loop(chip, 0.0, 0.2)
    rng = random.Random(7)
    old = chip.send(SetReference(0.05))
    chip.run(0.01)
    chip.execute(SetReference(0.0))
    before = len(chip.outputs)
    for _ in range(20):
        chip.command(f"send {old.hex()}")  # replayed
        chip.command(f"send {old[: rng.randrange(1, len(old) - 1)].hex()}00")  # torn
        chip.command(f"send {bytes(rng.randrange(256) for _ in range(40)).hex()}00")
        chip.run(0.005)
        assert chip.execute(KeepAlive()).result == Result.ACCEPTED
    codes = [out.code for out in chip.outputs[before:]]
    assert status(chip).state == State.RUNNING
    assert status(chip).bad_frames > 0
    # 0.05 of strain is 0.2 V of drive beyond 0: the loop would have gone there by 10 V/s.
    assert max(codes) - min(codes) < 300
    check_clamps(chip.outputs)


def test_a_flood_on_the_link_takes_no_update(chip: CoSim) -> None:
    close_loop(chip, 0.0, 0.1)
    before = status(chip)
    for k in range(8):
        chip.command(f"send {'5a' * 500}")
        chip.run(0.012)
        if k % 4 == 3:
            chip.command("send 00")
            chip.execute(KeepAlive())
    assert status(chip).state == State.RUNNING
    assert status(chip).overruns == before.overruns


def test_a_brown_out_resets_to_off_and_says_so(chip: CoSim) -> None:
    close_loop(chip)
    at = chip.fault("brown_out")
    chip.run(0.1)
    assert off_s(chip) - at < 1e-3
    assert chip.outputs[-1].code == 0
    assert status(chip).state == State.TRIPPED
    assert status(chip).fault == Fault.BROWN_OUT


@pytest.mark.parametrize("seed", range(20))
def test_no_flipped_bit_puts_the_output_above_its_clamp(
    seed: int, firmware: Firmware, cosim_program: Path, twin: TwinBench
) -> None:
    rng = random.Random(seed)
    with CoSim(cosim_program, firmware.elf, twin) as chip:
        chip.run(0.02)
        close_loop(chip, 0.03, 0.15)
        chip.run(rng.random() * 2e-3)
        low, high = rng.choice(PLACES)
        address = rng.randrange(low, high)
        chip.command(f"flip {address} {rng.randrange(8)}")
        chip.run(0.15)
        check_clamps(chip.outputs)
        chip.run(0.75)  # nobody talks: whatever became of it, the output ends
        assert not chip.outputs[-1].on, (hex(address), chip.counts)
