"""The recordings that a panel lists: their notes, reports, and the comparison of two."""

from __future__ import annotations

import functools
import shlex
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from haselab.base import InputError, Json, JsonObject, shown, to_plain
from haselab.panel.files import PanelFiles
from haselab.pipelines.compare_results import compare_results
from haselab.store.folder import write_text
from haselab.store.manifest import MANIFEST, read_manifest, recorded_when
from haselab.store.text_file import read_text

__all__ = ["analyse", "analyse_recorded", "compare", "listed", "note", "report"]

_NOTES, _LOG = "notes.txt", "analysis.log"
_MOST_LETTERS = 10_000
_MOST_REPORT = 10_000_000  # bytes; those of haselab have at most 3 MB
_MOST_FOLDERS = 2000
_running: dict[Path, subprocess.Popen[bytes]] = {}  # analyses by folder
_starting, _noting = threading.Lock(), threading.Lock()


def _recording(files: PanelFiles, name: object) -> Path:
    """The folder of a recording by its name in the list.

    Raises:
        InputError: there is no such recording.
    """
    found = {path.name: path for path in _folders(files)}
    if not isinstance(name, str) or name not in found:
        raise InputError(f"There is no recording {shown(name)} in {files.runs}.")
    return found[name]


def _folders(files: PanelFiles) -> list[Path]:
    if not files.runs.is_dir():
        return []
    found = sorted(path.parent for path in files.runs.glob("*/session.h5"))
    return [path for path in found if _is_text(path.name)][-_MOST_FOLDERS:]


def _is_text(text: str) -> bool:
    """Whether a name can be sent; one that is not UTF-8 on the disk cannot."""
    try:
        return bool(text.encode())
    except UnicodeEncodeError:
        return False


def listed(files: PanelFiles, values: JsonObject) -> JsonObject:
    """All recordings in the folder of the panel, the newest first.

    Args:
        files: of the panel.
        values: none.
    Returns:
        `folder`, whether it `is_there`, and `recordings`: name, study, date, seconds, state,
        whether it is open (being recorded, or interrupted), note, whether it is being analysed,
        what the last analysis failed with, and whether there is a report.
    """
    found = [_described(path) for path in _folders(files)]
    found.sort(key=lambda one: str(one["opened"]), reverse=True)
    there = files.runs.is_dir()
    return {"folder": str(files.runs.resolve()), "is_there": there, "recordings": found}


def _described(folder: Path) -> dict[str, Any]:
    try:
        about = (folder / MANIFEST).stat()
        version = about.st_mtime_ns, about.st_size, about.st_ino
    except OSError:
        version = 0, 0, 0
    running = _running.get(folder)
    return {
        **_of_manifest(folder, version),
        "note": _read(folder / _NOTES),
        "analysing": running is not None and running.poll() is None,
        "problem": " ".join(_read(folder / _LOG).split()) if running and running.poll() else "",
        "report": (folder / "report.html").is_file(),
    }


@functools.lru_cache(2 * _MOST_FOLDERS)
def _of_manifest(folder: Path, version: tuple[int, int, int]) -> dict[str, Any]:
    """What the manifest says; `version` is that of its file, which takes a millisecond to read."""
    try:
        manifest = read_manifest(folder)
    except InputError as error:
        manifest, state = {}, " ".join(str(error).split())
    else:
        state = _ended(str(manifest.get("ended", "")))
        if manifest.get("state") == "OPEN":
            command = f"haselab recover {shlex.quote(str(folder))}"
            state = f"Not closed. If no program records it, run: {command}"
        elif manifest.get("state") == "RECOVERED":
            state = f"{state}, recovered".lstrip(", ")
    study, when = manifest.get("study"), recorded_when(manifest) if manifest else {}
    return {
        "name": folder.name,
        "study": str(study.get("name", "")) if isinstance(study, dict) else "",
        "opened": str(manifest.get("opened", "")),
        "seconds": when.get("wall_time_s"),
        "state": state,
        "open": manifest.get("state") == "OPEN",
    }


def _ended(text: str) -> str:
    """How a recording ended, without the class of the error that ended it."""
    name, colon, reason = text.partition(": ")
    if text == KeyboardInterrupt.__name__:
        return "ended with Ctrl-C"
    return reason if colon and name.isidentifier() else text


def _read(path: Path) -> str:
    try:
        return read_text(path)[:_MOST_LETTERS]
    except InputError:
        return ""


def note(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Save a note about a recording in `notes.txt` in its folder.

    Args:
        files: of the panel.
        values: `name` of the recording, `text` of the note, and `before`, the note that is
            replaced.
    Returns:
        An empty object.
    Raises:
        InputError: there is no such recording, the note is no text or too long, or it is not
            `before` that would be replaced.
    """
    folder, text = _recording(files, values.get("name")), values.get("text")
    if not isinstance(text, str) or len(text) > _MOST_LETTERS or not _is_text(text + " "):
        raise InputError(
            f"A note must be a text of at most {_MOST_LETTERS} characters. Shorten it."
        )
    with _noting:
        path = folder / _NOTES
        try:
            now = path.read_text(encoding="utf-8") if path.exists() else ""
        except (OSError, ValueError) as error:
            raise InputError(
                f"The note cannot be read, so it was not changed: {error}. Use an editor. {path}"
            ) from None
        if now != values.get("before"):
            raise InputError(
                f"Not saved: the note about {folder.name} has changed meanwhile. Read it, then "
                "save again."
                if len(now) <= _MOST_LETTERS
                else f"Not saved: the note has {len(now)} characters, but a page shows at most "
                f"{_MOST_LETTERS}. Use an editor. {path}"
            )
        write_text(path, text)
    return {}


def report(files: PanelFiles, values: JsonObject) -> JsonObject:
    """The report of a recording, one HTML page without scripts.

    Args:
        files: of the panel.
        values: `name` of the recording.
    Returns:
        `html`.
    Raises:
        InputError: there is no such recording, no report yet, or one that is too large.
    """
    folder = _recording(files, values.get("name"))
    path = folder / "report.html"
    if not path.is_file():
        why = " ".join(_read(folder / _LOG).split())
        raise InputError(
            f"There is no report of {folder.name} yet."
            + (f" Messages of the last analysis: {why}" if why else " Press Analyse.")
        )
    size = path.stat().st_size
    if size > _MOST_REPORT:
        raise InputError(
            f"The report has {1e-6 * size:.0f} MB, but the panel shows at most "
            f"{1e-6 * _MOST_REPORT:.0f} MB: a larger one would keep STOP waiting. Open it in a "
            f"browser of its own. {path}"
        )
    return {"html": read_text(path, "report")}


def analyse(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Start `haselab analyse` on a recording; the list says when it has ended, and how.

    Args:
        files: of the panel.
        values: `name` of the recording.
    Returns:
        An empty object.
    Raises:
        InputError: there is no such recording.
    """
    _analysis(_recording(files, values.get("name")))
    return {}


def analyse_recorded(files: PanelFiles, name: str) -> None:
    """Start the analysis of a study that was just recorded, without waiting for its end.

    Args:
        files: of the panel.
        name: of the recording.
    """
    _analysis(_recording(files, name))


def _analysis(folder: Path) -> subprocess.Popen[bytes]:
    """`haselab analyse` on a folder, with a low priority: the one that runs, or a new one."""
    with _starting:
        running = _running.get(folder)
        if running is None or running.poll() is not None:
            words = ["-m", "haselab.cli", "analyse", str(folder), "--force", "--json"]
            nice = [] if sys.platform == "win32" else ["nice", "-n", "10"]
            with (folder / _LOG).open("wb") as log:
                running = _running[folder] = subprocess.Popen(
                    [*nice, sys.executable, *words], stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL, stderr=log,
                )  # fmt: skip
        return running


def compare(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Compare the results of two recordings, row by row.

    Args:
        files: of the panel.
        values: `first` and `second`, names of recordings.
    Returns:
        `rows`: id, name, unit, both values with their intervals, the difference, its interval and
        its size in standard deviations of both together, and whether it is larger than noise
        explains; null where a recording has no such row or no deviation. A row with two units is
        two rows. `limit`: the standard deviations beyond which noise does not explain a difference
        in so many rows. `notes`: what else differs.
    Raises:
        InputError: there is no such recording, or one has no results.
    """
    first, second = (_recording(files, values.get(which)) for which in ("first", "second"))
    try:
        found = compare_results(first, second)
    except InputError as error:
        reason = str(error).rstrip(".")
        raise InputError(f"{reason}. On this page, press Analyse.") from None
    rows: list[Json] = [to_plain(row.to_dict()) for row in found.rows]
    return {"rows": rows, "limit": found.limit_deviations, "notes": list(found.notes)}
