"""Every command line in the docs names a command and options that exist."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from haselab.cli.main import cli

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("examples/**/*.md"))
    if path.name != "CHANGELOG.md"  # names commands of former versions
)
_FENCED = re.compile(r"^```\w*\n(.*?)^```", re.DOTALL | re.MULTILINE)
_INLINE = re.compile(r"(?<!`)`(haselab [^`]+)`(?!`)")


def lines_of(text: str) -> Iterator[str]:
    """Command lines of a page: of blocks, of indented lines, and within sentences."""
    text = text.replace("\\\n", " ")
    for block in _FENCED.findall(text):
        for line in block.splitlines():
            if re.match(r"\s*(?:[.\w/]*bin/)?haselab\s", line):
                yield line.strip()
    outside = _FENCED.sub("", text)
    for line in outside.splitlines():
        if line.startswith("    haselab "):
            yield line.strip()
    for found in _INLINE.findall(outside):
        yield " ".join(found.split())


def faults_of(line: str) -> str:
    """What is wrong with a command line; "" if nothing is."""
    if "…" in line or "..." in line:
        line = line.replace("…", "").replace("...", "")
    words = shlex.split(line.partition(" #")[0].partition(" > ")[0].partition(" | ")[0])[1:]
    command: click.Command = cli
    with click.Context(cli) as context:
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            name = words.pop(0)
            if name.isupper():  # a placeholder, as in `haselab COMMAND --help`
                return ""
            found = None
            for each in name.split("|"):  # `haselab firmware build|simulate`
                found = command.get_command(context, each)
                if found is None:
                    return f"no command {each!r}"
            assert found is not None
            command = found
    known = {"-h", "--help"}
    for parameter in command.params:
        known |= {*parameter.opts, *parameter.secondary_opts}
    unknown = [
        option for word in words for option in word.strip("[]").split("|")
        if option.startswith("--") and option.partition("=")[0] not in known
    ]  # fmt: skip
    return f"no option {', '.join(unknown)} of {command.name}" if unknown else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_and_option_on_the_page_exists(page: Path) -> None:
    found = {line: faults_of(line) for line in lines_of(page.read_text(encoding="utf-8"))}
    wrong = [f"{line}: {fault}" for line, fault in found.items() if fault]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("haselab sense F --carrier-hz 2000", ""),
        ("haselab sense F --carrier 2000", "no option --carrier of sense"),
        ("haselab senses F", "no command 'senses'"),
        ("haselab firmware build|simulate A.toml", ""),
    ],
)
def test_the_check_finds_what_does_not_exist(line: str, fault: str) -> None:
    assert faults_of(line) == fault


def test_the_pages_have_many_command_lines() -> None:
    assert sum(len(list(lines_of(page.read_text(encoding="utf-8")))) for page in PAGES) > 250
