"""Bad campaign files are refused in one line, with the value found, before anything is written."""

from __future__ import annotations

import re
from typing import Any

import pytest

from haselab.base import InputError
from haselab.campaign.definition import MOST_CASES, with_values

GRID = 'name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = [0.4, 0.6]\n'
DRAWN = (
    'name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = { uniform = [0.4, 0.6] }\n'
    '[design]\nkind = "random"\nsamples = 4\n'
)
GEOMETRY = 'name = "a"\nkind = "geometry"\n[base]\ntwin = "hz"\n[parameters]\n'
# file: what the message must say
BAD = {
    "nothing": ("", "has no key name"),
    "kind": (GRID.replace("transfer", "transfers"), "No kind of case 'transfers' is registered"),
    "axis": (GRID.replace("case.gain", "case.gian"), "case.gian: no such key"),
    "table": (
        GRID.replace("case.gain", "twin.gain"),
        r"kind 'transfer' has no table 'twin'\. Begin the path with case\."),
    "whole table": (GRID.replace("case.gain", "case"), "case is a table, not a key.*: gain, "),
    "through a value": (
        GRID.replace("case.gain", "case.gain.low"), r"case\.gain: unknown key 'low'\. Use one of"),
    "misspelt distribution": (
        DRAWN.replace("uniform", "gauss"),
        r"case\.gain: unknown key 'gauss'\. Use one of uniform, log-uniform, normal, choice\."),
    "misspelt distribution beside another one": (
        DRAWN.replace("[design]", "case.delay_s = { gaus = [1, 2] }\n[design]"),
        r"case\.delay_s: unknown key 'gaus'\. Use one of uniform"),
    "inner table": (
        GEOMETRY + "twin.sheel.width_m = [0.05]\n", r"there is no table 'sheel'\. Use .* shell"),
    "index of a list": (
        GEOMETRY + "twin.viscosity.share.7 = [0.1]\n",
        r"'7' is not an index of a list of 3 values\. Use 0 to 2\."),
    "index with a leading zero": (  # the same value as 0, so that one value would be lost
        GEOMETRY + "twin.viscosity.share.00 = [0.1]\n", "'00' is not an index of a list of 3"),
    "integer that no column has": (
        GRID.replace("0.6", f"1{'0' * 400}"), r"case\.gain has an integer of 401 digits"),
    "bound that no float has": (
        DRAWN.replace("0.6", f"1{'0' * 400}"), r"case\.gain\.uniform has an integer of 401 digits"),
    "no values": (GRID.replace("[0.4, 0.6]", "[]"), "has no values, so the campaign has 0 cases"),
    "one value": (GRID.replace("[0.4, 0.6]", "0.4"), "neither a list of values nor a distrib"),
    "twice": (GRID.replace("[0.4, 0.6]", "[0.4, 0.4]"), "lists a value more than once"),
    "mixed": (GRID.replace("[0.4, 0.6]", '[0.4, "a"]'), "mixes float, str"),
    "not finite": (GRID.replace("0.6", "inf"), "has the value inf, which is not finite"),
    "nan bound": (DRAWN.replace("0.6", "nan"), "must be two finite bounds"),
    "three bounds": (DRAWN.replace("0.6]", "0.6, 0.7]"), r"\[0.4, 0.6, 0.7\], but must be two"),
    "reversed": (DRAWN.replace("[0.4, 0.6]", "[0.6, 0.4]"), "is from 0.6 to 0.4"),
    "log of 0": (DRAWN.replace("uniform = [0.4", "log-uniform = [0.0"), "begins at 0"),
    "no spread": (
        DRAWN.replace("uniform", "normal").replace("0.6", "0"), "standard deviation of 0"),
    "two shapes": (DRAWN.replace("0.6] }", "0.6], normal = [1, 2] }"), "uniform, normal"),
    "out of limits": (
        GRID.replace("case.gain = [0.4, 0.6]", "case.damping_ratio = [0.1, 1.5]"),
        r"^parameters\.case\.damping_ratio: must be less than 1 \(got 1\.5\)\. Change it\. "),
    "drawn out of limits": (
        DRAWN.replace("case.gain = { uniform = [0.4, 0.6] }",
                      "case.damping_ratio = { uniform = [0.9, 1.5] }"),
        r"^parameters\.case\.damping_ratio: must be less than 1 \(got 1\..*its distribution\. "),
    "no distribution": (GRID + '[design]\nkind = "random"\nsamples = 4\n', r"empty \(0 points\)"),
    "grid with distribution": (DRAWN.replace('"random"', '"grid"'), "is 'grid', but case.gain has"),
    "grid with samples": (GRID + "[design]\nsamples = 4\n", "has no effect with design.kind"),
    "key without effect": (
        GEOMETRY + "twin.acquisition.v_noise_v = [1e-4]\n", "v_noise_v has no effect on cases of"),
    "table without effect": (
        GEOMETRY.replace("geometry", "controller") + "twin.camera.edge_px = [1.0]\n",
        "edge_px has no effect on cases of the kind 'controller'"),
    "delay of the loop": (
        GEOMETRY.replace("geometry", "controller") + "twin.acquisition.output_delay_s = [1e-3]\n",
        "output_delay_s has no effect"),
    "name": (GEOMETRY + 'twin.name = ["a", "b"]\n', "name has no effect"),
    "reading": (
        GEOMETRY.replace("geometry", "controller") + 'twin.reading = ["hz", "rad"]\n',
        "reading has no effect"),
    "monitor of the chip": (
        GEOMETRY.replace("geometry", "controller").replace(
            "[parameters]", '[case]\nloop = "chip-1khz"\n[parameters]')
        + "twin.acquisition.bits = [8, 16]\n",
        "bits has no effect"),
    "monitor of two loops of the chip": (
        GEOMETRY.replace("geometry", "controller")
        + 'case.loop = ["chip-1khz", "oracle"]\ntwin.acquisition.bits = [8, 16]\n',
        "bits has no effect"),
    "no samples": (DRAWN.replace("samples = 4\n", ""), "design.samples is missing; random"),
    "no samples at all": (DRAWN.replace("= 4", "= 0"), "design.samples: .*greater than or equal"),
    "not a power of two": (
        DRAWN.replace("random", "sobol").replace("= 4", "= 1000"), "power of two. Use 1024"),
    "repeated indices": (
        DRAWN.replace("random", "saltelli") + "repeats = 2\n", "one result for each point"),
    "a milliard": (DRAWN.replace("= 4", "= 1000000000"), "1,000,000,000 cases, but at most"),
    "a product": (DRAWN + "repeats = 1000000\n", "4,000,000 cases, but at most 1,000,000"),
    "base": (GRID.replace("[param", '[base]\ntwin = "hz"\n[param'), "uses no file"),
    "no base": (GEOMETRY.replace('[base]\ntwin = "hz"\n', "") + "case.voltage_v = [1.0]\n",
                r'\[base\] has no twin.*twin = "hz"'),
    "no such file": (GEOMETRY.replace('"hz"', '"none.toml"') + "case.voltage_v = [1.0]\n",
                     "none.toml"),
    "case": (GRID + "[case]\nrate_hz = -1\n", "case.rate_hz: .*greater than 0"),
    "few samples": (GRID + "[case]\nduration_s = 0.1\n", "is 10 samples, but it must be 50 to"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_campaign_file_is_refused_in_one_line_with_its_path(
    campaigns: Any, name: str
) -> None:
    text, message = BAD[name]
    with pytest.raises(InputError, match=message) as caught:
        campaigns.plan(text)
    assert "\n" not in str(caught.value)
    assert re.search(r"campaign\.toml|none\.toml", str(caught.value))
    assert [path.name for path in campaigns.folder.iterdir()] == ["campaign.toml"]


def test_the_most_cases_are_counted_without_drawing_them(campaigns: Any) -> None:
    """10^300 of them would not fit into any memory."""
    repeats = DRAWN + f"repeats = {10**18}\n"
    with pytest.raises(InputError, match=f"{4 * 10**18:,} cases, but at most {MOST_CASES:,}"):
        campaigns.plan(repeats)


def test_keys_are_set_in_copies_of_the_tables() -> None:
    tables: dict[str, Any] = {"twin": {"viscosity": {"share": [0.1, 0.2]}}, "case": {"a": 1}}
    changed = with_values(tables, {"twin.viscosity.share.1": 0.3, "case.b": 2})
    assert changed == {"twin": {"viscosity": {"share": [0.1, 0.3]}}, "case": {"a": 1, "b": 2}}
    assert tables == {"twin": {"viscosity": {"share": [0.1, 0.2]}}, "case": {"a": 1}}
