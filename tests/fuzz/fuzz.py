"""`make fuzz`: mutates valid input of every parser and runs each case in a limited child.

Case K of seed S is always the same, whatever ran before it: a run that was interrupted goes on
where it stopped, and a fixed number of cases is the same test everywhere.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import importlib
import json
import os
import pkgutil
import re
import sys
import time
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # a pool of threads does not survive a fork

import targets  # noqa: E402
from forked import ExperimentResult, run  # noqa: E402
from mutations import Case, mutated  # noqa: E402
from seeds import seed_files  # noqa: E402

__all__ = ["load", "main"]

_LIBRARIES = (
    "tifffile",
    "av",
    "h5py",
    "nptdms",
    "scipy.io",
    "scipy.signal",
    "scipy.optimize",
    "rich.progress",
)
_LONGEST_TEXT = 2000  # bytes of a file that is kept readable
_TRIES = 60  # of the minimisation


def _preload() -> None:
    """Import what the commands import, once, so that a case costs a fork alone."""
    for folder in ("cli", "pipelines", "store", "sensing", "identify", "control", "rig.twin"):
        package = importlib.import_module(f"haselab.{folder}")
        for module in pkgutil.walk_packages(package.__path__, f"haselab.{folder}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    for name in _LIBRARIES:
        importlib.import_module(name)


def _name_of(outcome: ExperimentResult) -> str:
    """What tells one defect from another: its kind, and the place in haselab."""
    places = re.findall(r'File "[^"]*/(haselab/[^"]+)", line \d+, in (\S+)', outcome.where)
    kind = re.search(r"^(\w+(?:\.\w+)*(?:Error|Exception|Warning)\b)", outcome.where, re.MULTILINE)
    return " ".join([outcome.fault, kind[1] if kind else "", *(places[-1] if places else ())])


def load(path: Path) -> Case:
    """A case that was kept; files that it does not name are those of the valid case."""
    data = json.loads(path.read_text(encoding="utf-8"))
    valid = next(case for case in targets.cases() if case.target == data["target"])
    files = {name: item for name, item in valid.files.items() if name not in data["special"]}
    for name, item in data["files"].items():
        packed = isinstance(item, dict)
        files[name] = zlib.decompress(base64.b64decode(item["zlib"])) if packed else item.encode()
    return Case(data["target"], tuple(data["argv"]), files, data["special"])


def _keep(case: Case, found: str, folder: Path) -> None:
    """Write a case: text as it is where it is short, else packed."""
    valid = next(other for other in targets.cases() if other.target == case.target)
    files: dict[str, Any] = {}
    for name, data in case.files.items():
        if data == valid.files.get(name):
            continue
        try:
            files[name] = data.decode()
        except UnicodeDecodeError:
            files[name] = ""
        if len(data) > _LONGEST_TEXT or not files[name]:
            files[name] = {"zlib": base64.b64encode(zlib.compress(data, 9)).decode()}
    document = {
        "found": found,
        "target": case.target,
        "argv": list(case.argv),
        "files": files,
        "special": dict(case.special),
    }
    text = json.dumps(document, indent=1) + "\n"
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    folder.mkdir(parents=True, exist_ok=True)
    name = re.sub(r"\W+", "-", case.target)
    (folder / f"{name}-{digest}.json").write_text(text, encoding="utf-8")


class _Smaller:
    """Makes a case smaller that has a certain defect, within some tries."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._left = _TRIES

    def _same(self, candidate: Case) -> bool:
        self._left -= 1
        return self._left >= 0 and _name_of(run(candidate)) == self._name

    def of(self, case: Case, seed: Case) -> Case:
        """A case that differs less from the valid one: whole files first, then their parts."""
        whole = [replace(case, argv=seed.argv)]
        for file, data in seed.files.items():
            if file in case.files and case.files[file] != data:
                whole.append(replace(case, files={**case.files, file: data}))
        case = next((candidate for candidate in whole if self._same(candidate)), case)
        for file in case.files:
            if case.files[file] != seed.files.get(file):
                case = self._without_parts(case, file)
        return case

    def _without_parts(self, case: Case, file: str) -> Case:
        step = len(case.files[file]) // 2
        while step and self._left > 0:
            at = 0
            while at < len(case.files[file]) and self._left > 0:
                data = case.files[file]
                shorter = {**case.files, file: data[:at] + data[at + step :]}
                if self._same(replace(case, files=shorter)):
                    case = replace(case, files=shorter)
                else:
                    at += step
            step //= 4
        return case


def _load_state(file: Path | None, seed: int) -> dict[str, Any]:
    """Where to go on: number of the next case, counts of each parser, defects by name."""
    if file is not None and file.exists():
        kept: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        if kept["seed"] == seed:
            return kept
    return {"seed": seed, "next": 0, "counts": {}, "names": {}}


def _save_state(file: Path | None, state: dict[str, Any]) -> None:
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(state), encoding="utf-8")


def _count(row: dict[str, int], outcome: ExperimentResult) -> None:
    for name in ("cases", outcome.fault or f"exit {outcome.exit_code}"):
        row[name] = row.get(name, 0) + 1
    row["most ms"] = max(row.get("most ms", 0), round(1e3 * outcome.cpu_s))
    row["most MB"] = max(row.get("most MB", 0), outcome.bytes >> 20)


def _fuzz(options: argparse.Namespace) -> int:
    """Run cases until time or count is up; the number of defects."""
    valid = [case for case in targets.cases() if re.search(options.only, case.target)]
    others = sorted(seed_files().values())
    file = options.state / "state.json" if options.state else None
    state = _load_state(file, options.seed)
    end_s = time.monotonic() + options.seconds
    for number in range(state["next"], state["next"] + options.cases):
        if time.monotonic() > end_s:
            break
        seed = valid[number % len(valid)]
        case = mutated(seed, Random(f"{options.seed}:{number}"), others)
        outcome = run(case)
        _count(state["counts"].setdefault(seed.target, {}), outcome)
        state["next"] = number + 1
        if outcome.fault:
            name = _name_of(outcome)
            state["names"][name] = state["names"].get(name, 0) + 1
            if state["names"][name] == 1:
                _report(number, case, name, outcome)
                if options.state:
                    small = case if outcome.fault == "hang" else _Smaller(name).of(case, seed)
                    _keep(small, name, options.state / "found")
        if number % 50 == 0 or outcome.fault:
            _save_state(file, state)
    _save_state(file, state)
    _print(state["counts"])
    return sum(state["names"].values())


def _report(number: int, case: Case, name: str, outcome: ExperimentResult) -> None:
    line = " ".join(word[:60] for word in case.argv)
    print(f"case {number}, {case.target}: {name}\n  {line}  {dict(case.special) or ''}")
    print(f"{outcome.where}\n", flush=True)


def _print(counts: dict[str, dict[str, int]]) -> None:
    """A table: what became of the cases of each parser."""
    columns = ("cases", "exit 0", "exit 2", "exit 3", "exit 4", "exit 1")
    faults = ("traceback", "hang", "memory")
    largest = ("most ms", "most MB")
    print(f"{'parser':26s}" + "".join(f"{n:>10s}" for n in (*columns, *faults, "other", *largest)))
    rows = []
    for target, row in sorted(counts.items()):
        known = {name: row.get(name, 0) for name in (*columns, *faults)}
        known["other"] = row["cases"] - sum(n for name, n in known.items() if name != "cases")
        rows.append((target, known | {name: row[name] for name in largest}))
    if rows:
        total = {n: sum(row[n] for _, row in rows) for n in rows[0][1] if n not in largest}
        rows.append(("all", total | {n: max(row[n] for _, row in rows) for n in largest}))
    for target, numbers in rows:
        print(f"{target:26s}" + "".join(f"{number:10d}" for number in numbers.values()))


def _replay(paths: Sequence[Path]) -> int:
    """Run what was kept; the number of defects."""
    defects = 0
    for path in paths:
        outcome = run(load(path))
        if outcome.fault:
            defects += 1
            print(f"{path.name}: {_name_of(outcome)}\n{outcome.where}\n")
    print(f"{len(paths)} kept cases, {defects} with a defect")
    return defects


def main() -> None:
    """Fuzz, or replay the cases that are named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1800.0, help="Stop after this time.")
    parser.add_argument(
        "--cases", type=int, default=sys.maxsize, help="Stop after this many cases."
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="Regular expression of the parsers to fuzz.")
    parser.add_argument("--state", type=Path, help="Folder to go on from, and for what is found.")
    parser.add_argument("--valid", action="store_true", help="Run the unchanged seeds alone.")
    parser.add_argument("--replay", type=Path, nargs="*", help="Kept cases to run instead.")
    options = parser.parse_args()
    _preload()
    if options.valid:
        for case in targets.cases():
            outcome = run(case)
            print(f"{case.target:26s} {outcome.exit_code:3d} {outcome.cpu_s:6.2f} s", outcome.where)
        return
    defects = _fuzz(options) if options.replay is None else _replay(options.replay)
    sys.exit(1 if defects else 0)


if __name__ == "__main__":
    main()
