"""The API reference: a page for each public package, from `__all__` and the docstrings.

The docstrings are Markdown with the sections of CONTRIBUTING.md; here they become reStructuredText.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment

import haselab

FOLDER = Path(__file__).resolve().parents[1] / "reference" / "api"
_LONGEST_VALUE = 200  # characters of a constant that is shown
_SECTION = re.compile(r"^(Args|Returns|Yields|Raises|Source|Example):(?:\s+(.*))?$")
_ENTRY = re.compile(r"^(\*{0,2}\w[\w., *]*): ?(.*)$")
_ARRAY = re.compile(
    r"~?(?:numpy\.)?ndarray\[tuple\[~?(?:typing\.)?Any, \.\.\.\], "
    r"~?(?:numpy\.)?dtype\[([^\[\]]*)\]\]"
)
_SPAN = re.compile(r"``.+?``|`([^`]+)`|\$([^$]+)\$|(\*|\||\\)|(?<=\w)(_)(?!\w)", re.DOTALL)


def public_packages() -> list[str]:
    """Names of the packages that export names, sorted."""
    found = ["haselab"] if haselab.__all__ else []
    for each in pkgutil.walk_packages(haselab.__path__, "haselab."):
        if each.ispkg and getattr(importlib.import_module(each.name), "__all__", ()):
            found.append(each.name)
    return sorted(found)


def _homes() -> dict[str, str]:
    """Where each exported name is documented: full names by every name that an object has."""
    packages = public_packages()
    # The deepest package that contains the object's module comes first, haselab itself last.
    places: dict[int, list[tuple[int, str, object]]] = {}
    for package in packages:
        module = importlib.import_module(package)
        for name in module.__all__:
            value = getattr(module, name)
            if not isinstance(value, ModuleType):
                own = str(getattr(value, "__module__", "")).startswith(f"{package}.")
                rank = package.count(".") + (10 if own else 0)
                places.setdefault(id(value), []).append((-rank, f"{package}.{name}", value))
    homes = {}
    for each in places.values():
        home = sorted(each, key=lambda place: place[:2])[0][1]
        for _, name, value in each:
            homes[name] = home
            homes[f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '')}"] = home
    return homes


HOMES = _homes()
BY_NAME: dict[str, str] = {}
for _home in sorted(set(HOMES.values())):
    BY_NAME.setdefault(_home.rpartition(".")[2], _home)


# ---- Pages ----------------------------------------------------------------------------------


def _heading(text: str, mark: str) -> list[str]:
    return [text, mark * len(text), ""]


def _documented(package: str, names: list[str]) -> Iterator[str]:
    """Entries of the names that are documented on the page of this package."""
    module = importlib.import_module(package)
    groups: dict[str, list[str]] = {"Classes": [], "Functions": [], "Data": []}
    for name in names:
        value = getattr(module, name)
        if inspect.isclass(value):
            options = [] if issubclass(value, BaseException) else ["   :members:"]
            if value.__bases__ != (object,):
                options.append("   :show-inheritance:")
            groups["Classes"] += [f".. autoclass:: {package}.{name}", *options, ""]
        elif callable(value) and hasattr(value, "__qualname__"):
            groups["Functions"] += [f".. autofunction:: {package}.{name}", ""]
        else:
            shown = [] if len(repr(value)) <= _LONGEST_VALUE else ["   :no-value:"]
            groups["Data"] += [f".. autodata:: {package}.{name}", *shown, ""]
    for title, lines in groups.items():
        if lines:
            yield from _heading(title, "-")
            yield from lines


def page_of(package: str) -> str:
    """The page of a package, in reStructuredText."""
    module = importlib.import_module(package)
    names = [name for name in module.__all__ if not isinstance(getattr(module, name), ModuleType)]
    here = [name for name in names if HOMES[f"{package}.{name}"] == f"{package}.{name}"]
    lines = [*_heading(package, "="), f".. automodule:: {package}", ""]
    lines += [f".. currentmodule:: {package}", ""]
    lines += [".. autosummary::", "   :nosignatures:", ""]
    homes = (HOMES[f"{package}.{name}"] for name in names)
    lines += [f"   {home.removeprefix(f'{package}.')}" for home in homes]
    return "\n".join([*lines, "", *_documented(package, here)])


def write_pages(folder: Path, pages: dict[str, str]) -> None:
    """Write generated pages, but leave alone those that are as before, which need no new build."""
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.rst"):
        if path.stem not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / f"{name}.rst"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _write(_: Sphinx) -> None:
    write_pages(FOLDER, {package: page_of(package) for package in public_packages()})


# ---- Docstrings -----------------------------------------------------------------------------


def _span(match: re.Match[str]) -> str:
    code, formula, mark, underscore = match.groups()
    if formula is not None:
        return f":math:`{formula}`"
    if mark or underscore:
        return f"\\{mark or underscore}"
    if code is None:
        return match[0]
    home = HOMES.get(code.removesuffix("()")) or BY_NAME.get(code.removesuffix("()"))
    return f":py:obj:`{code} <{home}>`" if home else f"``{code}``"


def _text(lines: list[str]) -> list[str]:
    """Prose with code, formulas and references in reStructuredText; examples stay as they are."""
    done: list[str] = []
    prose: list[str] = []
    example = False

    def flush() -> None:
        if prose:
            done.extend(_SPAN.sub(_span, "\n".join(prose)).split("\n"))
            prose.clear()

    for line in lines:
        starts = line.lstrip().startswith(">>>")
        if starts and not example:
            flush()
            if done and done[-1].strip():
                done.append("")
        example = starts or (example and bool(line.strip()))
        (done if example else prose).append(line)
    flush()
    return done


def _dedented(lines: list[str]) -> list[str]:
    indents = [len(line) - len(line.lstrip()) for line in lines if line.strip()]
    least = min(indents, default=0)
    return [line[least:] for line in lines]


def _entries(field: str, lines: list[str]) -> list[str]:
    """`name: text` of Args and Raises as fields."""
    done: list[str] = []
    for line in _dedented(lines):
        entry = _ENTRY.match(line)
        if entry:
            names, text = entry.groups()
            names = re.sub(r"\s+or\s+|\s*,\s*", ", ", names)
            done += [f":{field} {name.strip()}:" for name in names.split(", ")[:-1]]
            done.append(f":{field} {names.split(', ')[-1].strip()}: {text}")
        else:
            done.append(f"    {line}" if line.strip() else "")
    return _text(done)


def _section(title: str, lines: list[str]) -> list[str]:
    while lines and not lines[-1].strip():
        lines = lines[:-1]
    if title in ("Args", "Raises"):
        return ["", *_entries({"Args": "param", "Raises": "raises"}[title], lines), ""]
    body = _text(_dedented(lines))
    if title in ("Returns", "Yields"):
        return ["", f":{title.lower()}: {body[0]}", *(f"    {line}" for line in body[1:]), ""]
    return ["", f".. rubric:: {title}", "", *body, ""]


def converted(lines: list[str]) -> list[str]:
    """A docstring in reStructuredText."""
    done: list[str] = []
    prose: list[str] = []
    rest = list(lines)
    while rest:
        line = rest.pop(0)
        found = _SECTION.match(line)
        if not found:
            prose.append(line)
            continue
        done += _text(prose)
        prose = []
        title, inline = found.groups()
        body = [inline] if inline else []
        while rest and not _SECTION.match(rest[0]) and (
            rest[0].startswith(" ") or not rest[0].strip() or (inline and body[-1].strip())
        ):  # fmt: skip
            body.append(rest.pop(0).strip() if inline else rest.pop(0))
        done += _section(title, body)
    return [*done, *_text(prose)]


def _process(_app: Sphinx, what: str, _name: str, value: object, _options: object,
             lines: list[str]) -> None:  # fmt: skip
    own = what != "data" or inspect.isclass(value) or callable(value)
    lines[:] = converted(lines) if own else []  # a constant has only the docstring of its type


def _without_annotated(text: str) -> str:
    """Leave out the limits of `Annotated[type, limits]`, which the text of a field states."""
    while found := re.search(r"~?(?:\w+\.)*Annotated\[", text):
        depth, end, comma = 1, found.end(), 0
        while depth:
            depth += {"[": 1, "(": 1, "]": -1, ")": -1}.get(text[end], 0)
            comma = comma or (end if text[end] == "," and depth == 1 else 0)
            end += 1
        text = text[: found.start()] + text[found.end() : comma] + text[end:]
    return text


def _sign(_app: Sphinx, _what: str, _name: str, _object: object, _options: object,
          signature: str | None, result: str | None) -> tuple[str | None, str | None]:  # fmt: skip
    """Show arrays as NDArray, and a default without a text in Python as three dots."""
    if signature is None:
        return signature, result
    shown = _ARRAY.sub(r"NDArray[\1]", re.sub(r"= ?<[^<>]*>", "= ...", signature))
    return _without_annotated(shown), result and _ARRAY.sub(r"NDArray[\1]", result)


# ---- References -----------------------------------------------------------------------------


@functools.cache
def _internal_names() -> frozenset[str]:
    """Names of all modules of haselab that the public packages import: types in signatures."""
    modules = [module for name, module in sys.modules.items() if name.startswith("haselab.")]
    return frozenset(name for module in modules for name in vars(module))


def _is_internal(target: str) -> bool:
    return target.startswith("haselab.") or target in _internal_names()


def _resolve(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.TextElement
) -> nodes.Node | None:
    """Lead a name to the page that documents it; an internal type of haselab stays text."""
    if node.get("refdomain") != "py":
        return None
    target = node["reftarget"]
    home = HOMES.get(target) or BY_NAME.get(target.rpartition(".")[2])
    if home and (home != target or "." not in target):
        return env.domains.python_domain.resolve_xref(
            env, node["refdoc"], app.builder, "obj", home, node, content
        )
    return content if not home and _is_internal(target) else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the parts."""
    app.connect("builder-inited", _write)
    app.connect("autodoc-process-docstring", _process)
    app.connect("autodoc-process-signature", _sign)
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
