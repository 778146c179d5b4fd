"""Example data sets: files in the formats of other programs, and the commands that use them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.pipelines.examples import recordings
from haselab.store.folder import write_text

__all__ = ["DATA_SETS", "DataSet", "find_data_set", "write_data_set"]

Floats = NDArray[np.float64]
_SEED = 8


@dataclass(frozen=True)
class DataSet:
    """An example data set.

    Args:
        name: of the data set.
        title: one line about it.
        text: what was recorded and how.
        tables: function that returns the text of each file by its name.
        commands: that use the files, in order, without the word haselab.
        video: function that writes the video; None: the data set has none.
    """

    name: str
    title: str
    text: str
    tables: Callable[[], dict[str, str]]
    commands: Sequence[str]
    video: Callable[[Path], list[Path]] | None = None


def _german(header: str, columns: Sequence[Floats], form: str = "%.7g") -> str:
    """Format a table with a preamble, semicolons and decimal commas, as a German Excel does."""
    lines = ["haselab twin, simulated;;", "Datum;23.11.2026;", "", header]
    for row in zip(*columns, strict=True):
        lines.append(";".join(form % value for value in row).replace(".", ","))
    return "\n".join(lines) + "\n"


def _plain(header: str, columns: Sequence[Floats]) -> str:
    lines = [header, *(",".join(f"{x:.9g}" for x in row) for row in zip(*columns, strict=True))]
    return "\n".join(lines) + "\n"


def _monitors() -> dict[str, str]:
    v, i, rate_hz = recordings.monitors(_SEED)
    time_ms = np.asarray(1e3 * np.arange(v.size) / rate_hz, np.float64)
    table = _german("Zeit [ms];U Monitor [mV];I Monitor [mV]", [time_ms, 1e3 * v, 1e3 * i])
    return {"monitors.csv": table}


def _cycles() -> dict[str, str]:
    found = recordings.cycles(_SEED)
    columns = [1e3 * found.time_s, 1e-3 * found.voltage_v, 1e12 * found.capacitance_f,
               100.0 * found.strain]  # fmt: skip
    return {"cycles.csv": _german("Zeit [ms];U [kV];C (pF);Dehnung [%]", columns)}


def _chirp() -> dict[str, str]:
    time_s, drive_v, x_m = recordings.chirp(_SEED)
    return {"chirp.csv": _plain("Time (s),Drive (V),Displacement (mm)",
                                [time_s, drive_v, 1e3 * x_m])}  # fmt: skip


def _release() -> dict[str, str]:
    time_s, x_m = recordings.release(_SEED)
    # The first samples after the drop are the fall, not the free oscillation.
    return {"release.csv": _plain("Time (ms),Displacement (mm)", [1e3 * time_s, 1e3 * x_m])}


def _tensile() -> dict[str, str]:
    stretch, load_n = recordings.tensile(_SEED)
    return {"tensile.csv": _german("Streckung;Kraft [mN]", [stretch, 1e3 * load_n])}


def _actuator() -> dict[str, str]:
    found = recordings.actuator_records(_SEED)
    v, i = found.monitors_v.T
    time_ms = np.asarray(1e3 * np.arange(v.size) / found.monitor_rate_hz, np.float64)
    tables = {
        f"{name}.csv": _german("Zeit [ms];U [mV];Dehnung [%]",
                               [1e3 * time_s, 1e3 * drive_v, 100.0 * strain])
        for name, (time_s, drive_v, strain) in found.played.items()
    }  # fmt: skip
    columns = [time_ms, 1e3 * v, 1e3 * i]
    monitors = _german("Zeit [ms];U Monitor [mV];I Monitor [mV]", columns, "%.6g")
    return {"monitors.csv": monitors, **tables}


def _video(folder: Path) -> list[Path]:
    path = folder / "triangle.avi"
    recordings.film(_SEED, path)
    return [path, path.with_suffix(".csv")]


def _campaigns() -> dict[str, str]:
    folder = resources.files(__package__).joinpath("campaigns")
    return {each.name: each.read_text(encoding="utf-8") for each in sorted(
        folder.iterdir(), key=lambda each: each.name)}  # fmt: skip


def _bench() -> dict[str, str]:
    from haselab.rig.chip import source_folder  # the import takes half a second

    folder = source_folder() / "rigs"
    names = ("bench.toml", "twin-hz.toml", "twin-rad.toml")
    studies = resources.files("haselab.study") / "studies"
    return {
        **{name: (folder / name).read_text(encoding="utf-8") for name in names},
        "reference-study.toml": (studies / "hasel-iros2018.toml").read_text(encoding="utf-8"),
    }


def _kind(kind: str) -> dict[str, str]:
    from haselab.rig.chip import source_folder  # the import takes half a second

    folder = source_folder() / "examples" / "kinds" / kind
    if not folder.is_dir():
        raise InputError(
            "This installation of haselab does not contain the example. Install haselab again. "
            f"{folder}"
        )
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.toml"))}


def _study_of(kind: str, title: str) -> DataSet:
    """The study of another kind than that of the reference study, with its twin."""
    return DataSet(
        kind,
        f"Study of a {title} on its simulated bench",
        f"`twin.toml` has the parameters of the {title}, `rig.toml` is the rig file of its "
        "bench, and `study.toml` plays all experiments. Change them for your own actuator.",
        lambda: _kind(kind),
        (
            "plan feasibility study.toml --rig rig.toml",
            "run study.toml --rig rig.toml --quick --out run",
        ),
    )


DATA_SETS: tuple[DataSet, ...] = (
    DataSet(
        "monitors",
        "Voltage and current monitor of an amplifier while the drive is a triangle",
        "2 s at 50 kHz with a sensing signal of 2 kHz. The voltage monitor has 5000 V/V, the "
        "current monitor 2 mA/V; it is "
        "sampled 2.5 us later. Semicolons, decimal commas, mV, a preamble.",
        _monitors,
        (
            'sense monitors.csv --v "U Monitor" --i "I Monitor" --carrier-hz 2000 '
            "--skew-s 2.5e-6 --out capacitance.csv --plot capacitance.svg",
            'session import monitors.csv --v "U Monitor" --i "I Monitor" --carrier-hz 2000 '
            "--skew-s 2.5e-6 --block-samples 500 --out session",
            "sense session/session.h5 --experiment imported --out again.csv",
            "session export session --to mat --out session.mat",
        ),
    ),
    DataSet(
        "cycles",
        "Voltage, capacitance and strain of three triangles",
        "A row every 50 ms: voltage at the actuator, capacitance from self-sensing, strain "
        "relative to the first row from a camera.",
        _cycles,
        (
            "identify capacitance-map cycles.csv --capacitance C --strain Dehnung "
            "--plot capacitance-map.svg",
            "identify voltage-map cycles.csv --voltage U --strain Dehnung --plot voltage-map.svg",
            "identify hysteresis cycles.csv --input U --output Dehnung --plot hysteresis.svg",
            "identify map cycles.csv --x C --y Dehnung --plot map.svg",
        ),
    ),
    DataSet(
        "chirp",
        "Displacement while the drive is a chirp around an operating point",
        "80 s at 100 Hz, 0.1 Hz to 3 Hz and back, an amplitude of 0.04 V before the amplifier "
        "(200 V) around 1 V, with a hung mass of 0.25 kg.",
        _chirp,
        (
            "identify transfer chirp.csv --input Drive --output Displacement "
            "--out model.json --plot transfer.svg",
            "identify frequency-response chirp.csv --input Drive --output Displacement "
            "--plot response.svg",
            "export model.json --to json --out exported.json",
        ),
    ),
    DataSet(
        "release",
        "Free oscillation after a hung mass is dropped",
        "8 s at 100 Hz; the mass of 0.25 kg was lifted until the actuator was at rest.",
        _release,
        ("identify free-response release.csv --output Displacement --plot release.svg",),
    ),
    DataSet(
        "tensile",
        "Stretch and force of a slow tensile test",
        "60 loads, each held for 30 s; the stretch is relative to the natural length of the shell, "
        "which is clamped at 3 times its natural width.",
        _tensile,
        ("identify regions tensile.csv --stretch Streckung --load Kraft --plot regions.svg",),
    ),
    DataSet(
        "video",
        "Video of an actuator while the drive is a triangle",
        "triangle.avi: 0.4 s at rest, then one triangle of 0 to 2 V in 2 s, with a hung mass of "
        "0.25 kg; 512 x 512 pixels of 0.35 mm, 50 frames a second, compressed without loss. "
        "triangle.csv has the time of each frame.",
        dict,
        (
            "track triangle.avi --auto --count 60 --rest-frames 10 --scale-mm-per-px 0.35 "
            "--out tracks.csv --report tracks.html --overlay tracks.png",
        ),
        _video,
    ),
    DataSet(
        "actuator",
        "Records of one actuator, for its actuator file and its controller",
        "A planar HASEL with a hung mass of 0.25 kg. triangle.csv: two cycles of 0 to 2 V, 1.5 s "
        "each; monitors.csv records both monitors at 50 kHz during them (5000 V/V and 2 mA/V; the "
        "current is sampled 2.5 us later). chirp.csv: a step, then 0.1 to 10 Hz. steps.csv: steps "
        "that are not used for a fit. These three files have a row every 10 ms: drive before the "
        f"amplifier of 5000 V/V, and strain relative to {1e3 * recordings.ZERO_LENGTH_M:g} mm.",
        _actuator,
        (
            f'init "my HASEL" --zero-length-m {recordings.ZERO_LENGTH_M:g} --high-v 2 '
            "--gain-v-per-v 5000 --out actuator.toml",
            'sense monitors.csv --v "U Monitor" --i "I Monitor" --carrier-hz 2000 '
            "--skew-s 2.5e-6 --out capacitance.csv",
            "identify capacitance-map capacitance.csv --strain Dehnung --strain-file triangle.csv "
            "--actuator actuator.toml",
            "identify voltage-map triangle.csv --voltage U --strain Dehnung "
            "--actuator actuator.toml",
            "identify transfer chirp.csv --input U --output Dehnung --slow-modes 1 "
            "--through-voltage-map --actuator actuator.toml",
            "compare actuator.toml steps.csv --input U --output Dehnung --through-voltage-map",
            "design actuator.toml",
        ),
    ),
    DataSet(
        "campaigns",
        "Campaigns: coverage of intervals, design space, tolerance of controllers",
        "Campaign files to start from. Those of the commands take seconds; coverage.toml, "
        "tolerance.toml and scoreboard.toml take minutes to hours, so run them on more "
        "processors.",
        _campaigns,
        (
            "campaign devices.toml --out devices --workers 2",
            "campaign design-space.toml --out design-space --workers 2",
        ),
    ),
    DataSet(
        "bench",
        "Rig files of the simulated bench, and the reference study",
        "`bench.toml` is a rig for every command with `--rig` or RIG.toml, such as `haselab panel "
        "--rig bench.toml` and `haselab twin serve bench.toml --out served.toml`. `twin-hz.toml` "
        "and `twin-rad.toml` hold the physical parameters, which you may change. "
        "`reference-study.toml` is the study of `haselab reproduce`, to copy from.",
        _bench,
        (
            "rig check bench.toml --out check.json",
            "export twin-hz.toml --to fmu --out twin.fmu",
        ),
    ),
    _study_of("peano-hasel", "Peano-HASEL"),
    _study_of("curling-hasel", "curling HASEL"),
    _study_of("dea-stack", "DEA stack"),
)


def find_data_set(name: str, names: Iterable[str] | None = None) -> DataSet:
    """Return the data set with a name.

    Args:
        name: of the data set.
        names: that the message lists if there is none; None: those of all data sets.
    Returns:
        The data set.
    Raises:
        InputError: there is no data set with this name.
    """
    for data_set in DATA_SETS:
        if data_set.name == name:
            return data_set
    names = names or (data_set.name for data_set in DATA_SETS)
    raise InputError(f"There is no example '{name}'. Use one of {', '.join(names)}.")


def write_data_set(data_set: DataSet, folder: Path) -> list[Path]:
    """Simulate and write a data set, with a README.md that shows the commands to use.

    Args:
        data_set: the data set.
        folder: an existing folder.
    Returns:
        The files, README.md last.
    """
    written = []
    for name, text in data_set.tables().items():
        write_text(folder / name, text)
        written.append(folder / name)
    if data_set.video is not None:
        written += data_set.video(folder)
    commands = "\n".join(f"    haselab {command}" for command in data_set.commands)
    readme = (
        f"# {data_set.title}\n\nSIMULATED by the twin, with its noise. {data_set.text}\n\n"
        f"Type in this folder:\n\n{commands}\n"
    )
    write_text(folder / "README.md", readme)
    return [*written, folder / "README.md"]
