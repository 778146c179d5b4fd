"""`make fuzz`: mutates valid input of every parser and runs each case in a limited child.

Case K of seed S is always the same, whatever ran before it: a run that was interrupted goes on where
it stopped, and a fixed number of cases is the same test everywhere.
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
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"  # a pool of threads does not survive a fork

import targets
from forked import Outcome, run
from mutations import Case, mutated
from seeds import seed_files

import haselab.app

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
_SMALL_BYTES = 20_000  # of a case worth keeping
_TRIES = 60  # of the minimisation


def _preload() -> None:
    """Import what the commands import, once, so that a case costs a fork alone."""
    for module in pkgutil.iter_modules(haselab.app.__path__):
        if module.name != "__main__":
            importlib.import_module(f"haselab.app.{module.name}")
    for folder in ("store", "sensing", "identify", "control", "rig.twin"):
        package = importlib.import_module(f"haselab.{folder}")
        for module in pkgutil.iter_modules(package.__path__):
            importlib.import_module(f"haselab.{folder}.{module.name}")
    for name in _LIBRARIES:
        importlib.import_module(name)


def _name_of(outcome: Outcome) -> str:
    """What tells one defect from another: its kind, and the place in haselab."""
    places = re.findall(r'File "[^"]*/(haselab/[^"]+)", line \d+, in (\S+)', outcome.where)
    kind = re.search(r"^(\w+(?:\.\w+)*(?:Error|Exception|Warning)\b)", outcome.where, re.MULTILINE)
    return " ".join([outcome.fault, kind[1] if kind else "", *(places[-1] if places else ())])


def load(path: Path) -> Case:
    """A case that was kept."""
    data = json.loads(path.read_text(encoding="utf-8"))
    files = {
        name: base64.b64decode(item["base64"]) if isinstance(item, dict) else item.encode()
        for name, item in data["files"].items()
    }
    return Case(data["target"], tuple(data["argv"]), files, data["special"])


def _keep(case: Case, found: str, folder: Path) -> None:
    files: dict[str, Any] = {}
    for name, data in case.files.items():
        try:
            files[name] = data.decode()
        except UnicodeDecodeError:
            files[name] = {"base64": base64.b64encode(data).decode()}
    document = {"found": found, "target": case.target, "argv": list(case.argv), "files": files,
                "special": dict(case.special)}  # fmt: skip
    text = json.dumps(document, indent=1) + "\n"
    name = re.sub(r"\W+", "-", case.target) + "-" + hashlib.sha256(text.encode()).hexdigest()[:8]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(text, encoding="utf-8")


def _smaller(case: Case, seed: Case, name: str) -> Case:
    """A case with the same defect that differs less from the valid one, within some tries."""
    left = _TRIES

    def same(candidate: Case) -> bool:
        nonlocal left
        left -= 1
        return left >= 0 and candidate != case and _name_of(run(candidate)) == name

    if name.startswith("hang"):
        return case
    for candidate in (replace(case, argv=seed.argv),
                      *(replace(case, files={**case.files, file: data}) for file, data in seed.files.items()
                        if file not in case.special)):  # fmt: skip
        if same(candidate):
            case = replace(case, argv=candidate.argv, files={
                file: data for file, data in candidate.files.items()})  # fmt: skip
    for file in list(case.files):
        if case.files[file] == seed.files.get(file):
            continue
        step = max(1, len(case.files[file]) // 2)
        while step and left > 0:
            data, at = case.files[file], 0
            while at < len(data) and left > 0:
                candidate = replace(case, files={**case.files, file: data[:at] + data[at + step :]})
                if same(candidate):
                    case, data = candidate, candidate.files[file]
                else:
                    at += step
            step //= 4
    return case


def _fuzz(options: argparse.Namespace) -> int:
    """Run cases until time or count is up; the number of defects."""
    valid = [case for case in targets.cases() if re.search(options.only, case.target)]
    others = sorted(seed_files().values())
    state_file = options.state / "state.json" if options.state else None
    state: dict[str, Any] = {"seed": options.seed, "next": 0, "counts": {}, "names": {}}
    if state_file is not None and state_file.exists():
        kept = json.loads(state_file.read_text())
        state = kept if kept["seed"] == options.seed else state
    counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for target, numbers in state["counts"].items():
        counts[target].update(numbers)
    names: dict[str, int] = state["names"]
    end = time.monotonic() + options.seconds
    first = state["next"]
    for number in range(first, first + options.cases):
        if time.monotonic() > end:
            break
        seed = valid[number % len(valid)]
        case = mutated(seed, Random(f"{options.seed}:{number}"), others)
        outcome = run(case)
        row = counts[seed.target]
        row["cases"] += 1
        row[f"exit {outcome.exit_code}" if not outcome.fault else outcome.fault] += 1
        row["most ms"] = max(row["most ms"], round(1e3 * outcome.cpu_s))
        row["most MB"] = max(row["most MB"], outcome.bytes >> 20)
        if outcome.fault:
            name = _name_of(outcome)
            names[name] = names.get(name, 0) + 1
            if names[name] == 1:
                print(
                    f"case {number}, {seed.target}: {name}\n  {shown(case)}\n{outcome.where}\n",
                    flush=True,
                )
                if options.state:
                    small = _smaller(case, seed, name)
                    _keep(small, name, options.state / "found")
        state |= {"next": number + 1, "counts": counts, "names": names}
        if state_file is not None and (number % 50 == 0 or outcome.fault):
            state_file.parent.mkdir(parents=True, exist_ok=True)
            state_file.write_text(json.dumps(state))
    if state_file is not None:
        state_file.parent.mkdir(parents=True, exist_ok=True)
        state_file.write_text(json.dumps(state))
    _print(counts)
    return sum(names.values())


def shown(case: Case) -> str:
    """The command line, shortened."""
    return " ".join(word[:60] for word in case.argv) + (
        f"  {dict(case.special)}" if case.special else ""
    )


def _print(counts: dict[str, Counter[str]]) -> None:
    columns = [
        "cases",
        "exit 0",
        "exit 2",
        "exit 3",
        "exit 4",
        "exit 1",
        "traceback",
        "hang",
        "memory",
    ]
    total: Counter[str] = Counter()
    print(
        f"{'parser':28s}"
        + "".join(f"{name:>10s}" for name in [*columns, "other", "most ms", "most MB"])
    )
    for target, row in [*sorted(counts.items()), ("all", total)]:
        other = sum(n for k, n in row.items() if k not in {*columns, "other", "most ms", "most MB"})
        cells = [row[name] for name in columns] + [
            row["other"] + other,
            row["most ms"],
            row["most MB"],
        ]
        print(f"{target:28s}" + "".join(f"{cell:10d}" for cell in cells))
        if row is not total:
            most = {name: max(total[name], row[name]) for name in ("most ms", "most MB")}
            total.update({k: n for k, n in row.items() if k in columns})
            total["other"] += other
            total |= Counter(most)


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
            print(
                f"{case.target:28s} {outcome.exit_code:3d} {outcome.cpu_s:6.2f} s {outcome.fault} {outcome.where}"
            )
        return
    defects = _fuzz(options) if options.replay is None else _replay(options.replay)
    sys.exit(1 if defects else 0)


if __name__ == "__main__":
    main()
