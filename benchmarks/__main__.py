"""Measure the published figures and compare them with other libraries: `make bench`.

    python -m benchmarks [--full] [--minutes M] [SECTION ...]

The default takes a representative part of each section: fewer seeds, records and sizes, and not
the twins that are hard to identify. `--full` (`make bench-full`) takes all of them. Speeds are
medians of several rounds of wall time, in which haselab and the other libraries take turns, so
that another program slows down both. Trust the ratios. At the end every goal is listed, the missed
ones last. The exit code is 1 if a benchmark failed, and 0 otherwise: a missed goal is a result.
"""

import argparse
import math
import sys
import time

from benchmarks.measurement import Measurement
from benchmarks.rows import Row, summary

__all__ = ["SECTIONS"]

_MINUTES = 10.0

SECTIONS: dict[str, tuple[Measurement, ...]] = {
    "twin": (Measurement("rig.twin"),),
    "sensing": (
        Measurement("sensing.accuracy", quick={"blocks": 300}),
        Measurement("sensing.speed"),
        Measurement("sensing.calibration"),
        Measurement("control.pid_step"),
    ),
    "identify": (
        Measurement("identification.static_laws", quick={"runs": 60}),
        Measurement(
            "identification.transfer", quick={"runs": 10, "structures": 0, "libraries": False}
        ),
        Measurement("control.many_loops"),
        Measurement("identification.frequency_response", quick={"runs": 5}),
        Measurement("identification.model_comparison", quick={"count": 1, "readings": ("hz",)}),
        Measurement("identification.hysteresis", quick={"runs": 8}),
        Measurement(
            "identification.physical_model",
            quick={"twins": 0, "starts": 2, "planted": 0, "short": 3, "bad": 1},
        ),
        Measurement("identification.prediction", quick={"twins": (), "short": 1}),
        Measurement("identification.hard_twins", quick=None),
    ),
    "random-plants": (
        Measurement("identification.random_plants", quick={"plants": 100}),
        Measurement("control.margins", quick={"loops": 200}),
    ),
    "scoreboard": (Measurement("control.scoreboard", full={"whole": True, "seeds": 5}),),
    "campaign": (Measurement("campaign.campaign", quick={"cases": 1000}),),
    "learning": (Measurement("control.learning"),),
    "recording": (
        Measurement("rig.recording", quick={"seconds": 10.0, "live": 5.0, "kills": 3}),
        Measurement("rig.wire", quick={"seconds": 5.0}),
    ),
    "disturbances": (Measurement("sensing.disturbances", quick={"blocks": 200, "seeds": 1}),),
    "stream": (
        Measurement("sensing.stream", quick={"size_gb": 0.2, "rounds": 1}),
        Measurement(
            "tracking.stream", quick={"frames": 2000, "kinds": ("tiff", "ffv1"), "rounds": 1}
        ),
    ),
    "tracking": (
        Measurement("tracking.points", quick={"quick": True, "only": ("bias",)}),
        Measurement("tracking.difficult", quick={"every": 12}),
    ),
    "firmware": (
        Measurement(
            "rig.firmware",
            quick={"flips": 20, "tries": 2, "seeds": 1},
            full={"flips": 200, "tries": 20, "seeds": 3},
        ),
    ),
    "safety": (Measurement("rig.safety", quick={"twin": 50, "wire": 10, "trials": 1}),),
    "panel": (
        Measurement(
            "rig.panel",
            quick={"presses": 30, "seconds": 3.0, "armed_presses": 5},
            full={"seconds": 1800.0},
        ),
        Measurement("rig.panel_chromium", quick={"presses": 30, "outages_of_each": 2}),
        Measurement("rig.panel_disturbance", quick={"seconds": 5.0, "rounds": 1}),
    ),
    "command": (Measurement("command"),),
}


def measured(names: list[str], full: bool, most_s: float) -> bool:
    """Run the sections and print the summary, also after Ctrl-C; whether every process ended well.

    Args:
        names: of the sections.
        full: measure all cases.
        most_s: what is not measured after this time, in s, is left out.
    """
    tables: list[tuple[str, list[Row]]] = []
    begun = time.monotonic()
    good = True
    try:
        for name in names:
            for measurement in SECTIONS[name]:
                if measurement.quick is None and not full:
                    continue
                start = time.monotonic()
                found = measurement.run(full, begun + most_s - start)
                tables.append((name, found.rows))
                good = good and not found.failed
                wall_s = time.monotonic() - start
                print(
                    f"-- {name}, {measurement.module}: {found.cpu_s:.1f} s of CPU, {wall_s:.1f} s\n"
                )
    finally:
        print(summary(tables))
        print(f"Measured in {time.monotonic() - begun:.0f} s.")
    return good


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("sections", nargs="*", help=f"of {', '.join(SECTIONS)}; default: all")
    parser.add_argument("--full", action="store_true", help="measure all seeds, records and sizes")
    parser.add_argument(
        "--minutes",
        type=float,
        help="end after this time; the summary lists what was left out (default: 10 without "
        "sections and without --full, else no limit)",
    )
    options = parser.parse_args()
    names = options.sections or list(SECTIONS)
    unknown = [name for name in names if name not in SECTIONS]
    if unknown:
        parser.error(f"no section {', '.join(unknown)}. Choose from {', '.join(SECTIONS)}.")
    minutes = options.minutes
    if minutes is None:
        minutes = math.inf if options.full or options.sections else _MINUTES
    try:
        sys.exit(0 if measured(names, options.full, 60.0 * minutes) else 1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
