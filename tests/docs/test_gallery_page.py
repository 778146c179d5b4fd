"""The gallery shows every figure, and the lines beside it name what exists.

The lines that take minutes are not run here; those of the CSV run with docs/start.
"""

import ast
import re
import shlex
from pathlib import Path

import click
import pytest

from haselab.cli.main import cli

ROOT = Path(__file__).resolve().parents[2]
PICTURES = ROOT / "docs" / "pictures"
TEXT = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
LINES = re.findall(r"^    (\S.*)", TEXT, re.MULTILINE)


def test_every_figure_is_shown() -> None:
    shown = {
        (ROOT / "docs" / name).resolve() for name in re.findall(r"!\[[^]]+\]\(([^)]+)\)", TEXT)
    }
    drawn = {path for path in PICTURES.rglob("*.*") if path.suffix in (".svg", ".png", ".gif")}
    assert shown == drawn


@pytest.mark.parametrize("line", sorted({each for each in LINES if each.startswith("haselab ")}))
def test_a_command_and_its_options_exist(line: str) -> None:
    group, context = cli, click.Context(cli)
    words = shlex.split(line)[1:]
    while isinstance(group, click.Group):
        command = group.get_command(context, words.pop(0))
        assert command is not None, line
        group = command
    known = {name for each in group.params for name in (*each.opts, *each.secondary_opts)}
    assert {word for word in words if word.startswith("-")} <= known


@pytest.mark.parametrize("line", [each for each in LINES if each.startswith("python ")])
def test_a_module_draws_what_the_gallery_shows_above_it(line: str) -> None:
    _, first, *rest = line.split()
    path = ROOT / (f"{rest[0].replace('.', '/')}.py" if first == "-m" else first)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    named = {node.value for part in (tree, *_siblings(path)) for node in ast.walk(part)
             if isinstance(node, ast.Constant) and isinstance(node.value, str)}  # fmt: skip
    above = TEXT.partition(line)[0].rpartition("\n## ")[2]
    figures = {Path(name).stem for name in re.findall(r"\]\((pictures/[^)]+)\)", above)}
    assert (
        figures and {name for name in figures if not any(name in text for text in named)} == set()
    ), line


def _siblings(path: Path) -> list[ast.Module]:
    """Modules that a module of pictures gets drawings from."""
    found = path.parent.glob(f"{path.stem}_*.py")
    return [ast.parse(each.read_text(encoding="utf-8")) for each in found]
