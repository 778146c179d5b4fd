"""The closed loop over the wire: blocks got of those that passed, and the loop's latency.

`python -m benchmarks.rig.wire [--seconds 10] [--ahead 1 2 5]`

The twin is served by a process of its own and follows the wall clock; before it stand nidaqmx over
gRPC, PyMeasure over PyVISA and pyserial. Each block goes through lock-in, strain map and PID.
Latency is from the last sample of a block, by the server's count on the clock that both processes
share, until the call that hands the new output to the board has returned.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.rows import Row
from haselab import _core
from haselab.base import DeviceError
from haselab.control import PidGains, Saturation
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.bench_config import BenchConfig
from haselab.rig.real_bench import RealBench
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.client import TwinClient
from haselab.runtime.lockin import lockin_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.sensors import CapacitanceSensor
from haselab.safety.gate import Gate

CARRIER_HZ, CARRIER_V = 2000.0, 0.02
STEP = 0.02
GAINS = PidGains(0.4, 0.7)


class Served:
    """A twin in a process of its own."""

    def __init__(self, folder: Path, ahead: int) -> None:
        (folder / "twin.toml").write_text('kind = "twin"\n')
        self.path = folder / f"rig-{ahead}.toml"
        command = [sys.executable, "-m", "haselab.cli", "twin", "serve", str(folder / "twin.toml")]
        command += ["--ahead-blocks", str(ahead), "--out", str(self.path)]
        self._process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        while not (self.path.exists() and self.path.stat().st_size):
            if self._process.poll() is not None:
                raise SystemExit("the twin is not served")
            time.sleep(0.05)

    def close(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        self._process.wait()


def loop(config: BenchConfig, blocks: int) -> tuple[int, np.ndarray, float]:
    """Close the loop: blocks without a gap, latency of each in s, and the server's stalls in s."""
    assert config.stand.address is not None
    settings = LoopSettings(
        GAINS.controller(), Saturation(-0.04, 0.1), VoltageMap(1.324, 3.124, -0.2805, -26.92),
        StrainMap(4.9e8, -0.27),
    )  # fmt: skip
    client = TwinClient(config.stand.address)
    gate = Gate()
    with RealBench(config, gate) as bench:
        gate.permit(gate.interlock.revision)  # below the safety chain: the wire alone is measured
        rig = bench.rig
        sensor = CapacitanceSensor(lockin_of(rig.description, CARRIER_HZ), settings.strain_map)
        pid = _core.Pid(
            kp=GAINS.kp, ki=GAINS.ki, kd=0.0,
            period_s=rig.description.block_s, derivative_filter_s=0.0,
            u_low=settings.saturation.low, u_high=settings.saturation.high,
        )  # fmt: skip
        handed: list[float] = []
        put = bench.board._ahead.write_many_sample

        def stamped(values: np.ndarray, timeout_s: float) -> None:
            put(values, timeout_s)
            now_s = time.monotonic()
            # Read each time: the server takes its own stalls off its clock.
            handed.append(now_s - float(client.meters()["sample_zero_s"]))

        rig.generator.sine(CARRIER_HZ, CARRIER_V)
        rig.camera.start(50.0)
        bench.board._ahead.write_many_sample = stamped
        latency_s, got, output_v = [], 0, 1.0
        before_s = rig.acquisition.time_s
        try:
            for _ in range(blocks):
                rig.source.write(output_v)
                codes = rig.acquisition.read()
                latency_s.append(handed[-1] - before_s)
                after_s = rig.acquisition.time_s
                got += abs(after_s - before_s - rig.description.block_s) < 1e-6
                before_s = after_s
                strain = sensor.strain(codes)
                if strain == strain:
                    output_v = float(settings.voltage_map.voltage_v(pid.step(STEP, strain)))
        except DeviceError as error:
            print(f"  ended after {got} blocks: {error}")
        stalled_s = float(client.meters()["stalled_s"])
        client.close()
    return got, np.array(latency_s[1:]), stalled_s


def rows(seconds: float = 10.0, ahead: tuple[int, ...] = (2, 5)) -> list[Row]:
    """The figures that the project claims."""
    found = []
    blocks = round(seconds / 0.01)
    with tempfile.TemporaryDirectory() as folder:
        for queued in ahead:
            served = Served(Path(folder), queued)
            try:
                config = load_rig(served.path)
                assert isinstance(config, BenchConfig)
                got, latency_s, stalled_s = loop(config, blocks)
            finally:
                served.close()
            middle, tail = np.percentile(1e3 * latency_s, [50.0, 99.9])
            name = f"wire, {queued} outputs queued"
            room_ms = 1e3 * config.describe().switch_sample / config.daq.rate_hz
            found += [
                Row(
                    f"{name}: blocks got",
                    got,
                    f"of {blocks}",
                    blocks,
                    note=f"server stalled {1e3 * stalled_s:.0f} ms",
                ),
                Row(f"{name}: latency, median", middle, "ms", room_ms, False),
                Row(f"{name}: latency, 99.9 %", tail, "ms", room_ms, False),
            ]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--ahead", type=int, nargs="+", default=[2, 5])
    chosen = parser.parse_args()
    for row in rows(chosen.seconds, tuple(chosen.ahead)):
        print(row)


if __name__ == "__main__":
    main()
