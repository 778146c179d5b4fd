"""Studies from the panel: what is checked, what is recorded, and each way in which one ends."""

import asyncio
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from haselab.base import InputError
from haselab.panel.files import PanelFiles
from haselab.panel.pages import study_job
from haselab.panel.pages.recordings import analyse, compare, listed, note, report
from haselab.panel.pages.study_job import StudyJob, available, check, chosen_study
from haselab.rig.rig_file import load_rig
from haselab.store.session.reader import SessionReader
from tests.panel.running import (
    TRIANGLE,
    WAIT_S,
    Page,
    RunningPanel,
    connected,
    ended,
    started,
)

STUDY = {"study": "triangle.toml", "keep_video": "none"}
LONG = {"study": "reference study", "experiments": ["triangle", "static_load"]}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder from which a panel is started, with a study."""
    (tmp_path / "triangle.toml").write_text(TRIANGLE)
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def files(folder: Path) -> PanelFiles:
    return PanelFiles(folder / "rig.toml", None, folder / "out")


async def play(page: Page, study: dict[str, Any], limit_v: float = 1.8) -> dict[str, Any]:
    asked = (await page.ask("request"))["answer"]
    return await page.ask(
        "arm", number=asked["number"], limit_v=limit_v, acknowledged=asked["reason"], study=study
    )


def recorded(folder: Path) -> tuple[dict[str, Any], str]:
    """Manifest and all events of the only recording."""
    (session,) = folder.glob("out/*/session.h5")
    manifest = json.loads((session.parent / "manifest.json").read_text())
    with SessionReader(session) as reader:
        return manifest, " ".join(text for _, text in reader.events())


def request(panel: RunningPanel, name: str, body: bytes = b"{}", **headers: str) -> dict[str, Any]:
    given = {"Content-Type": "application/json", "X-Panel-Token": panel.token, **headers}
    asked = urllib.request.Request(f"http://{panel.host}/request/{name}", body, given)
    with urllib.request.urlopen(asked, timeout=WAIT_S) as answer:
        return json.load(answer)


def test_a_study_from_a_page_is_recorded_and_analysed_like_one_of_haselab_run(
    folder: Path,
) -> None:
    """Both play the same twin with the same noise, but the panel's has been idle before."""
    panel = started()

    async def through_the_page() -> None:
        async with connected(panel) as page:
            answer = await play(page, STUDY)
            assert "answer" in answer, answer
            assert (await page.until(lambda state: state["mode"] == "study"))["drive_v"] == 0.0
            seen = []
            while page.state["mode"] == "study":
                await page.receive()
                seen.append(page.state["drive_v"])
            assert 1.0 < max(seen) <= 1.8
            assert page.state["stage"] == "off" and page.state["drive_v"] == 0.0
            assert "The study has ended." in page.state["reason"]
            assert "triangle" in [text for _, text in page.state["events"]]
            await page.arm(1.5)  # the bench works as before, and so does STOP
            await page.ask("drive", value_v=1.0)
            await page.until(lambda state: state["drive_v"] > 0.2)
            stopped = await asyncio.to_thread(panel.stop, Origin=f"http://{panel.host}")
            assert stopped["commanded"]
            await page.until(lambda state: state["stage"] == "tripped" and not state["holder"])
            assert "answer" in await page.arm(1.5)

    try:
        asyncio.run(through_the_page())
        (name,) = (one["name"] for one in request(panel, "recordings")["recordings"])
        end_s = time.monotonic() + 8 * WAIT_S
        while not (found := request(panel, "recordings")["recordings"][0])["report"]:
            assert not found["problem"] and time.monotonic() < end_s
            time.sleep(0.5)
    finally:
        ended(panel)
    manifest, events = recorded(folder)
    assert manifest["ended"] == "complete" and "end triangle" in events
    assert (
        "SIMULATED"
        in report(PanelFiles(folder / "rig.toml", None, folder / "out"), {"name": name})["html"]
    )
    command = [sys.executable, "-m", "haselab.cli", "run", "triangle.toml", "--rig", "rig.toml"]
    done = subprocess.run([*command, "--out", "out/run"], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    files = PanelFiles(folder / "rig.toml", None, folder / "out")
    rows = compare(files, {"first": name, "second": "run"})["rows"]
    deviations = {row["id"]: row["deviations"] for row in rows if row["deviations"] is not None}
    assert "S14.a1" in deviations and "S15.slope" in deviations
    assert max(map(abs, deviations.values())) < 4.0  # of about ten rows, chance: 1e-3
    assert "one triangle" in report(files, {"name": name})["html"]


@pytest.mark.parametrize("how", ["end", "stop", "lost page", "signal"])
def test_every_end_of_a_study_is_at_zero_with_the_reason_and_the_data(
    folder: Path, how: str
) -> None:
    panel = started(lease_s=1.5 if how == "lost page" else 10.0)
    gone = "The page that started the study has disconnected"
    said = {
        "end": "The study was ended from a page", "stop": "STOP", "lost page": gone,
        "signal": "The panel has ended",
    }[how]  # fmt: skip

    async def play_and_end() -> None:
        async with connected(panel) as watching:
            async with connected(panel) as page:
                assert "answer" in await play(page, LONG, 2.0)
                await page.until(lambda state: state["drive_v"] > 0.5)
                await watching.until(lambda state: state["mode"] == "study")
                if how == "end":
                    assert "A study is being" in (await page.ask("drive", value_v=1.0))["error"]
                    assert "Another page" in (await watching.ask("drive", value_v=1.0))["error"]
                    assert "Another page" in (await watching.ask("confirm"))["error"]
                    await watching.ask("disarm")  # everybody may end it
                elif how == "stop":
                    panel.stop(Origin=f"http://{panel.host}")
                elif how == "signal":
                    panel.process.send_signal(signal.SIGTERM)
                    return
            after = await watching.until(lambda state: state["mode"] == "idle")
            assert after["drive_v"] == 0.0
            assert said in after["reason"]
            assert after["stage"] == ("tripped" if how == "stop" else "off")

    try:
        asyncio.run(play_and_end())
    finally:
        ended(panel)
    manifest, events = recorded(folder)
    assert manifest["state"] == "SEALED" and manifest["ended"] != "complete"
    # A panel that ends closes its pages first.
    assert said in events or (how == "signal" and gone in events)
    assert "output at 0 V" in events


REFUSED = [
    (STUDY, 1.5, "The study needs 1.8 V, but the typed limit is 1.5 V"),
    ({"study": "../triangle.toml"}, 1.8, "There is no study '../triangle.toml'"),
    ({"study": 7}, 1.8, "There is no study 7"),
    ({**STUDY, "experiments": ["chirp"]}, 1.8, "The study has no experiment 'chirp'"),
    ({**STUDY, "experiments": [[]]}, 1.8, "The study has no experiment []"),
    ({**STUDY, "sha256": "0"}, 1.8, "The study has changed since it was checked"),
    ({**STUDY, "experiments": []}, 1.8, "None is chosen. Choose from its experiments: triangle"),
    ({"study": "high.toml"}, 2.0, "1) highest drive voltage is 2.5 V in triangle (limit 2 V)"),
    ("triangle.toml", 1.8, "This panel cannot play a study"),
]


def test_a_study_that_cannot_be_played_leaves_the_bench_off(folder: Path) -> None:
    (folder / "high.toml").write_text(TRIANGLE.replace("1.8", "2.5"))
    (folder / ".#triangle.toml").symlink_to("user@host.1:2")  # as an editor leaves it
    panel = started()

    async def attempt() -> None:
        async with connected(panel) as page:
            for study, limit_v, said in REFUSED:
                assert said in (await play(page, study, limit_v))["error"]
                state = await page.until(lambda state: True)
                assert state["stage"] in ("off", "requested") and state["mode"] == "idle"

    try:
        asyncio.run(attempt())
    finally:
        ended(panel)
    assert not list(folder.glob("out/*/"))


def test_a_study_of_another_page_does_not_disturb_the_one_that_has_armed(folder: Path) -> None:
    """It was checked for seconds, and meanwhile no message that renews the lease was read."""
    panel = started(lease_s=1.5)

    async def attempt() -> None:
        async with connected(panel) as first, connected(panel) as second:
            number = (await second.ask("request"))["answer"]["number"]
            await first.arm(1.5)
            await first.ask("drive", value_v=1.0)
            await first.until(lambda state: state["holder"] == first.holder)
            receiving = asyncio.create_task(first.until(lambda state: not state["holder"]))
            for _ in range(3):
                values = {"number": number, "limit_v": 2.0, "study": LONG}
                assert "Another page" in (await second.ask("arm", **values))["error"]
            assert second.state["holder"] == first.holder, second.state["reason"]
            receiving.cancel()

    try:
        asyncio.run(attempt())
    finally:
        ended(panel)


def test_the_limits_of_the_actuator_file_are_those_of_the_panel(
    folder: Path, actuator_file: Path
) -> None:
    own = folder / "actuator.toml"
    own.write_text(actuator_file.read_text().replace("[drive]", "[drive]\nhigh_v = 1.2"))
    panel = started("--actuator", str(own))

    async def attempt() -> None:
        async with connected(panel) as page:
            assert (await page.until(lambda state: True))["high_v"] == 1.2
            assert "at most 1.2 V" in (await page.arm(1.5))["error"]

    try:
        asyncio.run(attempt())
    finally:
        ended(panel)


@pytest.mark.parametrize(
    ("name", "body", "headers", "code"),
    [
        ("recordings", b"{}", {"X-Panel-Token": "guess"}, 403),
        ("recordings", b"a=1", {"Content-Type": "application/x-www-form-urlencoded"}, 400),
        ("recordings", b"[]", {}, 400),
        ("recordings", b"{", {}, 400),
        ("note", b'{"text": "' + b"x" * (1 << 20) + b'"}', {}, 400),
        ("nothing", b"{}", {}, 404),
        ("report", b'{"name": "../secret"}', {}, 422),
        ("note", b'{"name": "/etc", "text": ""}', {}, 422),
        ("recordings", b"{}", {"Origin": "http://example.org"}, 403),
        ("recordings", b"{}", {"Host": "example.org"}, 403),
    ],
)
def test_a_request_that_is_not_of_the_page_is_refused(
    shared_panel: RunningPanel, name: str, body: bytes, headers: dict[str, str], code: int
) -> None:
    with pytest.raises(urllib.error.HTTPError, match=rf"HTTP Error {code}") as refused:
        request(shared_panel, name, body, **headers)
    refused.value.close()


def test_the_doctor_of_the_panel_says_what_haselab_doctor_says(shared_panel: RunningPanel) -> None:
    found = request(shared_panel, "doctor")
    kinds = {one["kind"] for one in found["findings"]}
    assert {"runtime", "extension", "rig"} <= kinds and not found["in_use"]


# ---- without a bench ---------------------------------------------------------------------------


def test_studies_of_the_folder_are_listed_and_other_files_are_not(files: PanelFiles) -> None:
    Path("broken.toml").write_text("name = [")
    Path("other.toml").write_text("a = 1")
    os.mkfifo("pipe.toml")  # to read it would never end
    names = [one["name"] for one in available(files)["studies"]]
    assert names == ["reference study", "triangle.toml"]


def test_some_experiments_of_a_study_keep_their_settings(files: PanelFiles) -> None:
    whole = chosen_study(files, {"study": "reference study"})
    part = chosen_study(files, {"study": "reference study", "experiments": ["triangle"]})
    assert part.triangle == whole.triangle and not part.has("chirp")
    assert not part.is_reference
    for odd in (True, 0, "", "triangle", {}):  # which are not all experiments
        with pytest.raises(InputError, match="must be a list of names"):
            chosen_study(files, {"study": "reference study", "experiments": odd})


def test_studies_that_begin_within_a_second_have_folders_of_their_own(
    files: PanelFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stopped(datetime):
        @classmethod
        def now(cls, tz: Any = None) -> "Stopped":
            return cls(2026, 11, 28, 18, 4, 50)

    monkeypatch.setattr(study_job, "datetime", Stopped)
    names = []
    for _ in range(3):
        job = StudyJob.of(files, load_rig(files.rig), {"study": "triangle.toml"})
        job.options.folder.mkdir(parents=True)
        names.append(job.options.folder.name)
    assert names == [f"2026-11-28-180450-one-triangle{end}" for end in ("", "-2", "-3")]


def test_a_study_beyond_the_bench_is_found_by_the_check(files: PanelFiles) -> None:
    Path("high.toml").write_text(TRIANGLE.replace("1.8", "2.5"))
    found = check(files, {"study": "high.toml"})
    assert not found["ok"]
    (bad,) = (one for one in found["checks"] if one["name"] == "highest drive voltage")
    assert (bad["requested"], bad["limit"], bad["ok"]) == (2.5, 2.0, False)
    assert bad["advice"]
    fine = check(files, {"study": "triangle.toml"})
    assert fine["ok"] and fine["highest_v"] == 1.8
    assert fine["seconds"] == pytest.approx(0.2 + 8.0)  # what is recorded before the first rise


def recording(files: PanelFiles, name: str, rows: dict[str, tuple[float, float]]) -> None:
    folder = files.runs / name
    folder.mkdir(parents=True)
    (folder / "session.h5").touch()
    quantities = [
        {"id": key, "name": key, "unit": "V",
         "measured": {"value": value, "std": std, "ci95": [value - 1.96 * std, value + 1.96 * std]}}
        for key, (value, std) in rows.items()
    ]  # fmt: skip
    (folder / "results.json").write_text(json.dumps({"quantities": quantities}))


def test_the_difference_of_two_recordings_is_in_deviations_of_both(files: PanelFiles) -> None:
    recording(files, "a", {"x": (1.0, 0.3), "gone": (1.0, 0.1), "exact": (20.0, 0.0)})
    recording(files, "b", {"x": (2.5, 0.4), "new": (1.0, 0.1), "exact": (20.0, 0.0)})
    rows = {row["id"]: row for row in compare(files, {"first": "a", "second": "b"})["rows"]}
    assert rows["x"]["deviations"] == pytest.approx(3.0)  # 1.5 over hypot(0.3, 0.4)
    assert rows["x"]["difference"] == 1.5 and rows["x"]["exceeds"] is True
    assert rows["x"]["difference_ci95"] == pytest.approx([0.52, 2.48])  # 1.5 +- 1.96 * 0.5
    assert rows["gone"]["second"] is None and rows["new"]["first"] is None
    assert rows["exact"]["deviations"] is None
    in_mv = (files.runs / "b" / "results.json").read_text().replace('"V"', '"mV"')
    (files.runs / "b" / "results.json").write_text(in_mv)
    both = [
        row for row in compare(files, {"first": "a", "second": "b"})["rows"] if row["id"] == "x"
    ]
    assert [row["unit"] for row in both] == ["V", "mV"], "numbers of two units are not compared"
    assert all(row["deviations"] is None for row in both)
    (files.runs / "b" / "results.json").write_text("{}")
    message = r"results.json of the run cannot be read.*/b'. On this page, press Analyse"
    with pytest.raises(InputError, match=message):
        compare(files, {"first": "a", "second": "b"})


def test_a_number_that_is_not_known_does_not_prevent_a_comparison(files: PanelFiles) -> None:
    """A reference study has such a row: a settling time of a trial that does not settle."""
    unknown = {"value": None, "std": None, "ci95": [None, None]}
    for name, last in (("a", unknown), ("b", {"value": 1.0, "std": 0.1, "ci95": [0.8, 1.2]})):
        recording(files, name, {"x": (1.0, 0.3)})
        rows = [{"id": "x", "name": "x", "unit": "V",
                 "measured": {"value": 1.0, "std": 0.3, "ci95": [0.4, 1.6]}},
                {"id": "s", "name": "s", "unit": "s", "measured": last}]  # fmt: skip
        (files.runs / name / "results.json").write_text(json.dumps({"quantities": rows}))
    found = {row["id"]: row for row in compare(files, {"first": "a", "second": "b"})["rows"]}
    assert found["x"]["deviations"] == 0.0
    assert found["s"]["first"] == unknown and found["s"]["deviations"] is None


@pytest.mark.parametrize(
    "row",
    [{"value": "x", "std": 1, "ci95": [0, 1]}, {"value": 1, "ci95": [0, 1]}, 1,
     {"value": 1, "std": 1, "ci95": 1}],
)  # fmt: skip
def test_results_that_are_not_of_haselab_are_refused(files: PanelFiles, row: Any) -> None:
    recording(files, "a", {})
    (files.runs / "a" / "results.json").write_text(
        json.dumps({"quantities": [{"id": "x", "name": "x", "unit": "", "measured": row}]})
    )
    with pytest.raises(InputError, match=r"results.json of the run cannot be read"):
        compare(files, {"first": "a", "second": "a"})


def test_odd_folders_do_not_empty_the_list_of_recordings(files: PanelFiles) -> None:
    recording(files, "a", {})
    odd = files.runs / "b"
    odd.mkdir()
    (odd / "session.h5").touch()
    (odd / "manifest.json").write_text('{"state": "SEALED", "study": {"name": {"x": Infinity}}}')
    undecoded = Path(os.fsdecode(os.fsencode(files.runs) + b"/\xff"))
    undecoded.mkdir()
    (undecoded / "session.h5").touch()
    found = listed(files, {})["recordings"]
    assert {one["name"] for one in found} == {"a", "b"}
    assert all(isinstance(one["study"], str) for one in found)
    with pytest.raises(InputError, match="A note must be a text"):
        note(files, {"name": "a", "text": "\ud800"})


@pytest.mark.parametrize(
    ("manifest", "shown", "is_open"),
    [
        ({"state": "SEALED", "ended": "complete"}, "complete", False),
        ({"state": "SEALED", "ended": "StudyEndedError: The study was ended from a page."},
         "The study was ended from a page.", False),
        ({"state": "SEALED", "ended": "SafetyError: Lost: 3 blocks."}, "Lost: 3 blocks.", False),
        ({"state": "SEALED", "ended": "KeyboardInterrupt"}, "ended with Ctrl-C", False),
        ({"state": "OPEN"}, "Not closed. If no program records it, run: haselab recover", True),
        ({"state": "RECOVERED"}, "recovered", False),
    ],
)  # fmt: skip
def test_the_list_says_how_a_recording_ended_without_names_of_classes(
    files: PanelFiles, manifest: dict[str, str], shown: str, is_open: bool
) -> None:
    recording(files, "a", {})
    text = json.dumps({"format": "haselab manifest 1", **manifest})
    (files.runs / "a" / "manifest.json").write_text(text)
    (found,) = listed(files, {})["recordings"]
    assert found["state"].startswith(shown) and found["open"] is is_open


def test_a_changed_manifest_is_read_again_and_a_command_can_be_pasted(files: PanelFiles) -> None:
    recording(files, "it's a", {})
    path = files.runs / "it's a" / "manifest.json"
    path.write_text(json.dumps({"format": "haselab manifest 1", "state": "OPEN"}))
    (found,) = listed(files, {})["recordings"]
    assert shlex.split(found["state"].partition("run: ")[2])[2:] == [str(path.parent)]
    path.write_text(json.dumps({"format": "haselab manifest 1", "state": "SEALED"}))
    (found,) = listed(files, {})["recordings"]
    assert not found["open"] and found["state"] == ""


def test_a_note_stays_with_its_recording(files: PanelFiles) -> None:
    recording(files, "a", {})
    note(files, {"name": "a", "text": "new shell\nno drift", "before": ""})
    (found,) = listed(files, {})["recordings"]
    assert found["note"] == "new shell\nno drift"
    assert re.search("manifest", found["state"]), "a folder without a manifest is listed as such"
    with pytest.raises(InputError, match="at most 10000 characters"):
        note(files, {"name": "a", "text": "x" * 10_001})
    with pytest.raises(InputError, match=r"no recording '\.\./a'"):
        note(files, {"name": "../a", "text": "", "before": ""})


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        (b"of an editor", "has changed meanwhile"),
        (b"\xff\xfe", "cannot be read, so it was not changed"),
        (b"x" * 10_001, "has 10001 characters, but a page shows at most 10000"),
    ],
)
def test_a_note_that_the_page_has_not_shown_is_not_overwritten(
    files: PanelFiles, kept: bytes, message: str
) -> None:
    recording(files, "a", {})
    path = files.runs / "a" / "notes.txt"
    path.write_bytes(kept)
    (shown,) = listed(files, {})["recordings"]
    before = "" if kept == b"of an editor" else shown["note"]
    with pytest.raises(InputError, match=message):
        note(files, {"name": "a", "text": "new", "before": before})
    assert path.read_bytes() == kept


def test_an_analysis_that_fails_is_named_in_the_list(files: PanelFiles) -> None:
    recording(files, "a", {})
    analyse(files, {"name": "a"})
    end_s = time.monotonic() + WAIT_S
    while (found := listed(files, {})["recordings"][0])["analysing"]:
        assert time.monotonic() < end_s
        time.sleep(0.1)
    assert found["problem"].startswith("haselab: ") and "session.h5" in found["problem"]
