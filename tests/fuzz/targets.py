"""Every parser of haselab as a valid call of the command line, from which the fuzzer starts."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from mutations import Case
from seeds import seed_files

__all__ = ["cases"]

_SENSE = "--carrier-hz 2000 --rate-hz 2e4 --block-s 0.005"
_TRACK = "--points points.csv --scale-mm-per-px 0.1 --rest-frames 1 --out out.csv"
_COLUMNS = ("csv", "npz", "npy", "tdms", "h5", "mat", "73.mat")
_RECORD = "record.csv --rate-hz 100"
_RUN = {
    "run/" + name: "run/" + name
    for name in ("model.json", "controller.toml", "results.json", "analysis.json")
}
_BENCH = {"rig.toml": "bench.toml"}
_SESSION = {name: name for name in ("session/session.h5", "session/manifest.json")}
_CHIP = {"rig.toml": "chip.toml"} | {name.removeprefix("run/"): name for name in _RUN}

# name: (arguments, files by the name of their seed where that is another one)
_TARGETS: dict[str, tuple[str, dict[str, str]]] = {
    "design": ("design model.json --rate-hz 100 --delay-s 0.01 --limits -0.05 0.1", {}),
    "design, measured loop": ("design model.json --structure pi --accept-shortfalls", {}),
    "design, specification": ("design model.json --spec spec.toml --accept-shortfalls", {}),
    "design, actuator file": (
        "design actuator.toml --structure pi --accept-shortfalls", {}),
    "compare": ("compare actuator.toml record.csv", {}),
    "firmware build, actuator file": ("firmware build actuator.toml --build-dir out", {}),
    "transfer, actuator file": (
        "identify transfer record.csv --delay 0 --actuator actuator.toml", {}),
    "voltage-map, actuator file": (
        "identify voltage-map voltage.csv --actuator actuator.toml", {}),
    "export json": ("export model.json --to json --out o.json", {}),
    "export mat": ("export rational.json --to mat --out o.mat", {}),
    "export from mat": ("export model.mat --to json --out o.json", {}),
    "plan carrier": ("plan carrier --carrier-hz 2000 --rate-hz 2e5 --update-s 0.002 "
                     "--capacitance-f 1e-9 --series-ohm 5e3 --step-v 1 --block-s 0.01", {}),
    "plan feasibility": ("plan feasibility study.toml --rig rig.toml", {"twin.toml": "twin.toml"}),
    "plan feasibility, bench": ("plan feasibility study.toml --rig rig.toml", _BENCH),
    "plan-experiment": ("plan-experiment model.json --rig rig.toml --goal damping_ratio "
                        "--duration-s 10",
                        {"twin.toml": "twin.toml"}),
    "run": ("run study.toml --rig rig.toml --quick --out out", {"twin.toml": "twin.toml"}),
    "run, chip": ("run steps.toml --rig rig.toml --out out", _CHIP),
    "reproduce": ("reproduce --twin twin.toml --quick --no-physical-model --out out", {}),
    "calibrate": ("calibrate --rig rig.toml --capacitor 1e-9 --capacitor 2e-9,5,0.01 "
                  "--carrier-hz 2000 --carrier-v 0.1 --duration-s 0.1 --out c.toml",
                  {"twin.toml": "twin.toml"}),
    "firmware build": ("firmware build run --build-dir out", _RUN),
    "firmware build, front end": (
        "firmware build run --build-dir out --rig rig.toml", _RUN | _CHIP
    ),
    "report": ("report run", _RUN),
    "rig check": ("rig check rig.toml", _BENCH),
    "sense, calibrated": (f"sense monitors.csv {_SENSE} --calibration calibration.toml", {}),
    "verdict agreement": ("identify model-comparison estimate.json other.json --question agreement",
                          {"other.json": "estimate.json"}),
    "arx": (f"identify arx {_RECORD} --na 2 --nb 2 --nk 1", {}),
    "subspace": (f"identify subspace {_RECORD} --order 2 --bootstrap 2", {}),
    "transfer": (f"identify transfer {_RECORD} --poles 2 --zeros 0 --delay 0", {}),
    "frequency-response": (
        f"identify frequency-response {_RECORD} --method h1 --segment-s 0.5", {}),
    "free-response": ("identify free-response free.csv --output y", {}),
    "creep": ("identify creep creep.csv --model prony", {}),
    "hysteresis": (f"identify hysteresis {_RECORD} --model prandtl-ishlinskii --operators 4", {}),
    "map": ("identify map voltage.csv --x strain --y voltage_v", {}),
    "regions": ("identify regions load.csv --segments 2", {}),
    "voltage-map": ("identify voltage-map voltage.csv", {}),
    "capacitance-map": ("identify capacitance-map farad.csv", {}),
    "hyperelastic": ("identify hyperelastic sheet.csv --model neo-hooke --at-stretch 1.5", {}),
    **{f"sense {k}": (f"sense monitors{'' if k[0] == '7' else '.'}{k} {_SENSE}", {})
       for k in _COLUMNS},
    **{f"import {k}": (f"session import monitors{'' if k[0] == '7' else '.'}{k} "
                       "--rate-hz 2e4 --block-samples 100 --out out", {}) for k in _COLUMNS[:3]},
    **{f"track {k}": (f"track {k} {_TRACK}", {}) for k in (
        "plain.tif", "packed.tif", "clip.avi", "clip.mkv", "clip.mp4", "clip.cine")},
    "sense session": ("sense session/session.h5 --experiment chirp", _SESSION),
    "sense session, unverified": (
        "sense session/session.h5 --experiment chirp --unverified", _SESSION),
    "export session": ("session export session --to mat --out o.mat", _SESSION),
    "export session, unverified": (
        "session export session --to csv --out o --unverified", _SESSION),
    "recover": ("recover session", _SESSION),
    "analyse": ("analyse session --out out", _SESSION),
    "track folder": (f"track frames {_TRACK}", {n: n for n in ("frames/a.png", "frames/b.pgm")}
                     | {"frames/times.csv": "times.csv"}),
    "track cih": (f"track clip.mraw {_TRACK}", {"clip.cih": "clip.cih"}),
    "track cihx": (f"track other.mraw {_TRACK} --times times.csv", {"other.cihx": "other.cihx"}),
}  # fmt: skip


def cases() -> Iterator[Case]:
    """A valid case of each target."""
    seeds = seed_files()
    for name, (line, more) in _TARGETS.items():
        argv = tuple(shlex.split(line))
        named = {word: word for word in argv if word in seeds} | more
        if "rig.toml" in argv:
            named = {"rig.toml": "rig.toml"} | named
        yield Case(name, argv, {file: seeds[seed] for file, seed in named.items()}, {})
