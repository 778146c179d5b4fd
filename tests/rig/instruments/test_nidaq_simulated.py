"""The driver against NI's own simulated devices, where NI-DAQmx is installed.

A simulated device verifies and reserves as a real one does, routes and counters included (NI-DAQmx
Help, "Task Behavior of NI-DAQmx Simulated Devices"); it has no timing. The devices come from
data/nidaqmx_simulated_devices.ini.
"""

from __future__ import annotations

import pytest

from haselab.rig.bench_config import DaqConfig, ExposureConfig
from haselab.rig.instruments.nidaq.checks import verify_routes
from haselab.rig.twin.serve.ni.devices import DEVICES

BOARDS = ("USB-6212", "USB-6361", "PCIe-6321", "PXIe-6363")


def simulated(board: str) -> str:
    """Name of the simulated device; without it the test is skipped."""
    nidaqmx = pytest.importorskip("nidaqmx")
    system = pytest.importorskip("nidaqmx.system")
    name = f"haselab{board.replace('-', '')}"
    try:
        names = system.System.local().devices.device_names
    except nidaqmx.errors.DaqNotFoundError:
        pytest.skip("the NI-DAQmx driver is not installed. It comes from ni.com")
    if name not in names:
        pytest.skip(f"there is no {name}. Import tests/rig/data/nidaqmx_simulated_devices.ini")
    return name


@pytest.mark.parametrize("board", BOARDS)
def test_a_simulated_device_of_ni_takes_all_tasks_of_a_bench(board: str) -> None:
    device, rate_hz = DEVICES[board], 100e3
    daq = DaqConfig(
        device=simulated(board),
        rate_hz=rate_hz,
        block_samples=1000,
        skew_s=1.0 / device.convert_rate_hz(2, rate_hz),
    )
    rows = verify_routes(daq, ExposureConfig(input="PFI0", duration_s=1e-3))
    assert [row for row in rows if not row.ok] == []
