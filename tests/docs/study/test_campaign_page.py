"""The page on campaigns: its file and its commands, in their order."""

from __future__ import annotations

import json
import math
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.campaign.definition import load_campaign
from haselab.campaign.kinds.case_kind import CASE_KINDS, Inputs
from haselab.campaign.plan import Plan
from haselab.cli.main import cli
from tests.docs.page import Page

ROOT = Path(__file__).resolve().parents[3]
TEXT = (ROOT / "docs" / "study" / "campaign.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    (haselab .*)", TEXT, re.MULTILINE)
FILES = ROOT / "src" / "haselab" / "pipelines" / "examples" / "campaigns"


def test_the_commands_of_the_page_run_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = re.search(r"```toml\n(name.*?)```", TEXT, re.DOTALL)
    assert file is not None and len(COMMANDS) == 4
    Path("tolerance.toml").write_text(file[1])
    for command in COMMANDS:
        words = shlex.split(command)[1:]
        monkeypatch.setattr(sys, "argv", ["haselab", *words])
        cli.main(args=words, prog_name="haselab", standalone_mode=False)
        out = Path(words[words.index("--out") + 1])
        if words[0] == "campaign":
            summary = json.loads((out / "summary.json").read_text())
            assert summary["failed"] == 0
            for name in ("results.parquet", "report.html", "failed.txt"):
                assert (out / name).exists()


def test_the_kind_of_the_page_has_intervals_that_contain_the_truth() -> None:
    """Of 400 means of 1000 samples, within four standard deviations of 95 %."""
    *_, code = Page("study/campaign.md").python
    kind = Page("study/campaign.md").execute(code)["MINE"]
    inputs, rng = Inputs({"case": {"samples": 1000, "voltage_v": 3.0}}), np.random.default_rng(2)
    kind.check(inputs)
    inside = 0
    for _ in range(400):
        found = kind.compute(inputs, rng)
        low, high = found["voltage_v"].ci95
        inside += low <= found["voltage_v.true"] <= high
    assert abs(inside / 400 - 0.95) < 4.0 * math.sqrt(0.95 * 0.05 / 400)
    with pytest.raises(InputError, match="samples"):
        kind.check(Inputs({"case": {"samples": 1}}))


@pytest.mark.parametrize("name", [path.stem for path in FILES.glob("*.toml")
                                  if path.stem != "triangle"])  # fmt: skip
def test_every_example_is_a_campaign_that_can_begin(name: str) -> None:
    plan = Plan(load_campaign(FILES / f"{name}.toml"))
    assert plan.count >= 64
    assert len(set(plan.hashes())) == plan.count


def test_the_table_of_the_settings_of_transfer_has_every_key_with_its_unit_and_default() -> None:
    part = TEXT[TEXT.index("### Settings of transfer") :]
    rows = re.findall(r"^\| `(\w+)` \| ?(.*?) \| (.*?) \| .+ \|$", part, re.MULTILINE)
    fields = CASE_KINDS.find("transfer").settings.model_fields
    assert [name for name, _, _ in rows] == list(fields)
    units = {"rad_s": "rad/s", "hz": "Hz", "s": "s"}
    for name, unit, default in rows:
        assert unit == next((units[end] for end in units if name.endswith(f"_{end}")), "")
        assert default == repr(fields[name].default)


def test_the_table_of_kinds_has_every_kind_with_its_files_and_settings() -> None:
    part = TEXT[: TEXT.index("### Settings of transfer")]
    rows = re.findall(r"^\| `([\w-]+)` \| (.*?) \| (.*?) \| (.*?) \|$", part, re.MULTILINE)
    found = {name: (files, settings) for name, _, files, settings in rows}
    kinds = CASE_KINDS.usable()
    assert set(found) == set(kinds)
    for name, kind in kinds.items():
        files, settings = found[name]
        assert set(re.findall(r"`(\w+)`", files)) == {file.name for file in kind.files}
        assert set(re.findall(r"`(\w+)`", settings)) == set(kind.settings.model_fields)
