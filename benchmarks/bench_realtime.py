"""The closed loop at 1 kHz in C beside a running recording: ticks missed, late, and latencies.

`python benchmarks/bench_realtime.py [--seconds 60] [--rate-hz 1000] [--priority 50] [--spin 0.7]`

The twin is the plant, stepped in real time by the loop's own thread: 200 readings of both monitors
a tick. Every block is recorded (2 x 200 kHz, compressed) by the same process meanwhile. The latency
is from the deadline, a block's last sample, to the new output; it holds waking up, the twin's block
and the loop's body. `--priority 0` runs as an ordinary thread. `--spin` is the share of a tick in
which the thread looks at the clock instead of sleeping.

Meanwhile a thread of the same kind that does nothing wakes up at the same rate: what it misses is
the machine's fault (a virtual machine that its host holds up), and no loop can be better.
"""

import argparse
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rows import Row

from haselab import _realtime
from haselab.control import PidGains, Saturation
from haselab.models.maps import VoltageMap
from haselab.rig.twin.bench import TwinBench, rig_of
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.fast_loop import FastLoop, FastOptions, FastReport
from haselab.runtime.runner import LoopSettings, StrainMap
from haselab.sensing import LockinConfig
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionReader, SessionWriter

SAMPLING_HZ, CARRIER_HZ = 200e3, 10e3
LOOP = LoopSettings(
    PidGains(0.2, 0.7), Saturation(-0.04, 0.1), VoltageMap(1.324, 3.124, -0.2805, -26.92),
    StrainMap(4.9e8, -0.27),
)  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """One run."""

    report: FastReport
    recorded: int
    idle_missed: int
    idle_longest_s: float


def measure(seconds: float, rate_hz: float, priority: int, spin: float) -> Measured:
    samples = round(SAMPLING_HZ / rate_hz)
    config = TwinConfig()
    daq = config.acquisition.model_copy(
        update={"block_samples": samples, "output_delay_s": 0.1 / rate_hz}
    )
    config = config.model_copy(update={"acquisition": daq})
    twin = TwinBench(config, 1)
    rig = rig_of(twin, config)
    d = rig.description
    sensing = LockinConfig(
        SAMPLING_HZ, samples, CARRIER_HZ, d.skew_s, d.i_monitor_v_per_a / d.v_monitor_v_per_v,
        blank=(0, round(0.4 * samples)),
    )  # fmt: skip
    ticks = round(seconds * rate_hz)
    reference = 0.01 + 0.005 * np.sign(np.sin(2.0 * np.pi * 0.5 * np.arange(ticks) / rate_hz))
    header = {"rig": {"rate_hz": SAMPLING_HZ, "volt_per_code": d.volt_per_code}}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session.h5"
        plans = [ExperimentPlan("x", "bench", 1, {})]
        with SessionWriter(path, plans, samples, header, QueueRule(patience_s=0.0)) as session:
            options = FastOptions(priority=priority, patience_missed=1000, spin_s=spin / rate_hz)
            loop = FastLoop(rig, twin, sensing, LOOP, options)
            with ThreadPoolExecutor(1) as beside:
                idle = beside.submit(_realtime.idle, round(1e9 / rate_hz), ticks, priority)
                report = loop.run("x", reference, 0.05, session)
                missed, longest_ns = idle.result()
        with SessionReader(path) as reader:
            recorded = len(reader.follow("x", 0).start_s)
    return Measured(report, recorded, missed, 1e-9 * longest_ns)


def rows(
    seconds: float = 60.0, rate_hz: float = 1000.0, priority: int = 50, spin: float = 0.7
) -> list[Row]:
    run = measure(seconds, rate_hz, priority, spin)
    r = run.report
    us = [1e6 * x for x in (r.latency_s(0.5), r.latency_s(0.999), r.work_s(0.5))]
    load = f"load {os.getloadavg()[0]:.1f}"
    own = float(r.work[int(1.0 / rate_hz / r.bin_s) :].sum())
    how = ("real-time thread" if r.has_priority else "ordinary thread") + f", {load}"
    return [
        Row(f"{rate_hz:g} Hz loop: ticks missed", 100.0 * r.missed / r.ticks, "%", 0.1, False,
            f"{r.missed} of {r.ticks} in {seconds:g} s, {how}"),
        Row("  an empty thread beside it misses", 100.0 * run.idle_missed / r.ticks, "%",
            note=f"longest {1e6 * run.idle_longest_s:.0f} us: the machine's own"),
        Row("  missed by the loop's own work", 100.0 * own / r.ticks, "%", 0.1, False,
            "from waking up to the output longer than a tick"),
        Row("  late, beyond the switch sample", 100.0 * r.late / r.ticks, "%"),
        Row("  latency to the new output, median", us[0], "us"),
        Row("  latency to the new output, 99.9 %", us[1], "us"),
        Row("  latency to the new output, longest", 1e6 * r.longest_s, "us"),
        Row("  of it twin and body, median", us[2], "us"),
        Row("  delay for a design", 1e6 * r.loop_delay_s, "us"),
        Row("  blocks not recorded", r.ticks - run.recorded, "blocks", 0, False),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-hz", type=float, default=1000.0)
    parser.add_argument("--priority", type=int, default=50)
    parser.add_argument("--spin", type=float, default=0.7)
    asked = parser.parse_args()
    for row in rows(asked.seconds, asked.rate_hz, asked.priority, asked.spin):
        print(row)


if __name__ == "__main__":
    main()
