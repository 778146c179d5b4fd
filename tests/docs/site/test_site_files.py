"""The built site as files: no warning, no dead link, nothing from another host, all names."""

from __future__ import annotations

import importlib
import pkgutil
import re
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import click
import pytest

import haselab
from haselab.cli.main import cli

ROOT = Path(__file__).resolve().parents[3]
# Where an address is only followed by a reader's click.
_CLICKED = {"a", "form"}
_GENERATED = {"genindex.html", "py-modindex.html", "search.html", "index.html"}


class _Html(HTMLParser):
    """The anchors of a page, and its links as (tag, address)."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[tuple[str, str]] = []
        self.text: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.anchors.add(value)
            if name in ("href", "src", "action", "data", "poster") and value:
                self.links.append((tag, value))

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@cache
def _page(path: Path) -> _Html:
    return _Html(path.read_text(encoding="utf-8"))


def _pages(site: Path) -> list[Path]:
    return sorted(path for path in site.rglob("*.html") if "_static" not in path.parts)


def test_the_build_has_no_warning(built: Path) -> None:
    log = (built / "log").read_text(encoding="utf-8")
    assert not log, log


def _broken(site: Path, page: Path) -> Iterator[str]:
    for _, address in _page(page).links:
        if re.match(r"(https?|mailto|data):", address):
            continue
        target, _, anchor = unquote(address.partition("?")[0]).partition("#")
        other = (page.parent / target).resolve() if target else page
        if not other.is_file():
            yield f"{page.relative_to(site)} points to {address}"
        elif anchor and other.suffix == ".html" and anchor not in _page(other).anchors:
            yield f"{page.relative_to(site)} points to {address}, which has no such anchor"


def test_every_link_leads_to_a_file_and_an_anchor(site: Path) -> None:
    broken = [fault for page in _pages(site) for fault in _broken(site, page)]
    assert not broken, "\n".join(broken)


def test_no_page_shows_a_raw_row_of_a_table(site: Path) -> None:
    """As below an empty line in a Markdown table, or in a docstring, which has no tables."""
    raw = [
        f"{page.relative_to(site)}: {row}"
        for page in _pages(site)
        for row in re.findall(r"<p>\s*(\|.*)", page.read_text(encoding="utf-8"))
    ]
    assert not raw, "\n".join(raw)


def test_no_paragraph_becomes_a_row_of_a_table() -> None:
    """Markdown takes each line below a table as a further row of it, up to an empty line."""
    sources = [*(ROOT / "docs").rglob("*.md"), *ROOT.glob("[A-Z]*.md")]
    swallowed = []
    for path in sources:
        text = re.sub(r"^ *```.*?^ *```$", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
        lines = re.findall(r"^\|.*\n(?!\s*(?:\||$))(.*)", text, re.M)
        swallowed += [f"{path.relative_to(ROOT)}: {line}" for line in lines]
    assert not swallowed, "\n".join(swallowed)


def test_nothing_comes_from_another_host(site: Path) -> None:
    foreign = [
        f"{page.relative_to(site)}: <{tag}> {address}"
        for page in _pages(site)
        for tag, address in _page(page).links
        if tag not in _CLICKED and re.match(r"(https?:)?//", address)
    ]
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        foreign += [f"{style.name}: {each}" for each in re.findall(
            r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^\"')]+)", text)]  # fmt: skip
    assert not foreign, "\n".join(foreign)


def test_no_path_of_the_computer_is_in_the_site(site: Path) -> None:
    words = {str(ROOT), str(Path.home())} - {"/", "/root"}
    found = [
        str(path.relative_to(site))
        for path in site.rglob("*")
        if path.suffix in (".html", ".js", ".ipynb", ".svg")
        and any(word in path.read_text(encoding="utf-8") for word in words)
    ]
    assert not found


def test_every_page_of_the_docs_is_in_the_site(site: Path) -> None:
    sources = {*(ROOT / "docs").rglob("*.md"), *ROOT.glob("[A-Z]*.md")}
    named = {path.relative_to(ROOT).with_suffix(".html") for path in sources}
    assert not {str(path) for path in named if not (site / path).is_file()}


def _commands(group: click.Group, path: tuple[str, ...]) -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield " ".join((*path, name)), command
        if isinstance(command, click.Group):
            yield from _commands(command, (*path, name))


COMMANDS = dict(_commands(cli, ("haselab",)))


@pytest.mark.parametrize("name", list(cli.list_commands(click.Context(cli))))
def test_every_command_and_option_is_in_the_reference(site: Path, name: str) -> None:
    page = _page(site / "docs" / "reference" / "commands" / f"{name}.html")
    lines = {line.strip() for line in "".join(page.text).splitlines()}
    for path, command in COMMANDS.items():
        if path.split()[1] != name:
            continue
        assert path in {line.rstrip("#¶") for line in lines}, path
        for option in (each for each in command.params if isinstance(each, click.Option)):
            anchor = f"cmdoption-{path.replace(' ', '-')}-{option.opts[0].lstrip('-')}"
            assert option.hidden or anchor in page.anchors, f"{path} {option.opts[0]}"


PACKAGES = ["haselab", *(
    each.name for each in pkgutil.walk_packages(haselab.__path__, "haselab.")
    if each.ispkg and getattr(importlib.import_module(each.name), "__all__", ())
)]  # fmt: skip


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_in_the_reference(site: Path, package: str) -> None:
    page = _page(site / "docs" / "reference" / "api" / f"{package}.html")
    linked = {address.rpartition("#")[2].rpartition(".")[2] for _, address in page.links}
    module = importlib.import_module(package)
    packages = {name for name in module.__all__ if f"{package}.{name}" in PACKAGES}
    assert not {*module.__all__} - packages - linked


def test_the_reference_leads_to_the_source_which_has_colours(site: Path) -> None:
    page = _page(site / "docs" / "reference" / "api" / "haselab.sensing.html")
    sources = {address.partition("#")[0] for _, address in page.links if "_modules/" in address}
    assert sources
    for address in sources:
        path = site / "docs" / "reference" / "api" / address
        assert '<span class="k">' in path.read_text(encoding="utf-8"), address
