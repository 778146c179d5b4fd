"""The rig files that come with the project are the twin that the program builds."""

import tomllib
from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile
from haselab.rig.rig_file import load_rig, load_rig_to_shut_down
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_file import load_twin
from haselab.store.toml import toml_text

_ROOT = Path(__file__).resolve().parents[2]
_RIGS = _ROOT / "rigs"


@pytest.mark.parametrize("reading", ["rad", "hz"])
def test_the_file_of_a_reading_is_the_default_twin(reading):
    assert load_twin(_RIGS / f"twin-{reading}.toml") == twin_of_reading(reading)


@pytest.fixture
def manual(tmp_path: Path) -> Path:
    """The rig file that the manual shows."""
    text = (
        (_ROOT / "docs" / "bench" / "real-bench.md")
        .read_text()
        .split("```toml\n")[1]
        .partition("```")[0]
    )
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return path


def test_the_manuals_rig_file_has_no_fault(manual):
    file = load_rig(manual)
    assert isinstance(file, BenchConfig)
    rig = file.describe()
    assert rig.amplifier == "TREK 50/12, number 123"
    # 2 ms after the end of a block, and one block of queue.
    assert rig.switch_sample == 400 + 2000
    assert rig.switch_in_block == 400


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        ('device = "Dev1"', 'devise = "Dev1"', r"daq\.devise: no such key; the keys are .*device"),
        ("drive_low_v = 0.0", "drive_low_v = 0.5", r"must not be above 0 V, and"),
        ("drive_high_v = 2.0", "drive_high_v = 0.0", r"must not both be 0 V"),
        ("drive_high_v = 2.0", "drive_high_v = 20.0", r"daq\.drive_high_v: must be less"),
        ("ahead_blocks = 1", "ahead_blocks = -1", r"daq\.ahead_blocks: must be greater"),
        ('load = "INF"', 'load = "75"', r"generator\.load: must be 'INF' or '50'"),
        (
            "highest_v = 3000.0",
            "",
            r"\[supply\] has no key highest_v \(.*= 3000\.0",
        ),
        (
            'kind = "bench"',
            'kind = "lab"',
            r"kind: must be 'twin', 'bench', 'chip' or 'replay'",
        ),
        ("mass_kg = 0.25", "mass_kg = 0.25\n[stand]\nkind = 'twin'", r"give an address if kind"),
    ],
)
def test_a_fault_in_a_bench_is_reported_with_its_place(manual, old, new, reported):
    text = manual.read_text()
    assert old in text
    manual.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=reported):
        load_rig(manual)


def test_the_former_kind_of_a_chip_names_the_new_one_but_is_shut_down(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text('kind = "mega"\nrun = "."\n[simulator]\n')
    with pytest.raises(InputError, match=r"kind = 'mega', which is now called 'chip'.*rig\.toml$"):
        load_rig(rig)
    file, faults = load_rig_to_shut_down(rig)
    assert (type(file), faults) == (ChipFile, [])


@pytest.mark.parametrize(
    ("section", "key"),
    [
        ("supply", "port"),
        ("generator", "address"),
        ("generator", "serial_number"),
        ("daq", "device"),
        ("amplifier", "name"),
        ("camera", "name"),
    ],
)
@pytest.mark.parametrize("character", ["\\u0000", "\\n", "\\u001b", "\\u2028"])
def test_a_name_with_a_control_character_is_refused_in_one_line(manual, section, key, character):
    """A null character in supply.port was "A bug in haselab" to the doctor."""
    tables = tomllib.loads(manual.read_text())
    tables["camera"] = {"kind": "aravis"}
    tables.pop("exposure", None)
    tables[section][key] = "MARK"
    manual.write_text(toml_text(tables).replace("MARK", f"/dev/tty{character}x"))
    reported = rf"{section}\.(aravis\.)?{key}: must have no control characters or line breaks"
    with pytest.raises(InputError, match=reported) as error:
        load_rig(manual)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    "path", sorted((_RIGS / "hard").glob("*.toml")), ids=lambda path: path.stem
)
def test_each_hard_twin_differs_in_one_table(path):
    own = tomllib.loads(path.read_text())
    assert own.pop("name") != "twin" and len(own) == 1
    found, usual = load_twin(path), twin_of_reading("hz")
    (table,) = own
    assert getattr(found, table) != getattr(usual, table)
    assert found.model_copy(update={"name": "twin", table: getattr(usual, table)}) == usual
