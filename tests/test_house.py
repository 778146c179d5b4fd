"""The conventions of CONTRIBUTING.md that a machine can check."""

import ast
import collections
import functools
import importlib
import re
import subprocess
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "haselab"
MODULES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 600

# A name may not end in one of these: the unit is missing.
# fmt: off
QUANTITIES = {
    "acceleration", "amplitude", "angle", "area", "capacitance", "charge", "current", "damping",
    "delay", "distance", "duration", "energy", "exposure", "field", "force", "frequency", "gap",
    "height", "inductance", "inertia", "length", "load", "mass", "omega", "period", "phase",
    "position", "power", "pressure", "radius", "rate", "reactance", "resistance", "sag", "skew",
    "speed", "stiffness", "stress", "temperature", "thickness", "time", "velocity", "voltage",
    "volume", "wavelength", "width",
}
# fmt: on
# The contract's own name; it is a strain.
DIMENSIONLESS = {"hysteresis_width"}
# Units that only cli and report may use.
DISPLAY_UNITS = {"kv", "mm", "ms", "us", "um", "mhz", "khz", "nf", "pf", "kpa", "in"}


def module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def is_public(path: Path) -> bool:
    return path.name != "__main__.py"


PUBLIC = [path for path in MODULES if is_public(path)]


def no_faults(check: Callable[[Path], Iterable[str]], paths: Iterable[Path]) -> None:
    """Every file passes; one that does not is named with all its faults."""
    found = {str(path.relative_to(ROOT)): list(check(path)) for path in paths}
    faults = [f"{name}: {fault}" for name, each in found.items() for fault in each]
    assert not faults, "\n".join(faults)


def test_all_names_what_the_module_defines_or_gathers() -> None:
    def faults(path: Path) -> Iterator[str]:
        module = importlib.import_module(module_name(path))
        own = {
            node.name
            for node in tree_of(path).body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_")
        }
        named = list(getattr(module, "__all__", ()))
        if missing := [name for name in named if not hasattr(module, name)]:
            yield f"__all__ names {missing}, which are not there"
        if hidden := sorted(own - set(named)):
            yield f"defines {hidden} outside __all__: name or underscore them"
        if named != sorted(set(named)) and not _ruff_order(named):
            yield "__all__ is not in order"

    no_faults(faults, PUBLIC)


def _ruff_order(names: list[str]) -> bool:
    """Constants first, then classes, then functions: what ruff's RUF022 calls sorted."""

    def rank(name: str) -> int:
        return 0 if name.isupper() else 1 if name[:1].isupper() else 2

    return [rank(name) for name in names] == sorted(rank(name) for name in names)


def too_long(path: Path) -> Iterator[str]:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    if lines > MAX_LINES:
        yield f"{lines} lines, but at most {MAX_LINES} are allowed: split it"


def test_a_file_is_not_too_long() -> None:
    no_faults(too_long, [*MODULES, *native_sources()])


NAMES = {module_name(path) for path in MODULES}


def imported_modules(path: Path) -> Iterator[str]:
    """Modules of the package that one imports, inside functions too; not for its types alone."""
    nodes: list[ast.AST] = [tree_of(path)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            nodes += node.orelse
        elif isinstance(node, ast.Import):
            yield from (each.name for each in node.names if each.name in NAMES)
        elif isinstance(node, ast.ImportFrom) and node.module in NAMES:
            inner = (f"{node.module}.{each.name}" for each in node.names)
            yield from (each if each in NAMES else node.module for each in inner)
        else:
            nodes += ast.iter_child_nodes(node)


def test_no_modules_import_each_other() -> None:
    """Not in a circle of any length either: an import inside a function would only hide it."""
    left = {module_name(path): set(imported_modules(path)) for path in MODULES}
    while free := {name for name, needed in left.items() if not needed & left.keys()}:
        left = {name: needed for name, needed in left.items() if name not in free}
    # What is left imports in a circle, or imports such modules.
    needed_by_others = set().union(*left.values()) if left else set()
    assert not left, f"modules that import each other: {sorted(needed_by_others & left.keys())}"


def native_sources() -> list[Path]:
    folders = ("core", "native", "firmware", "tests/core")
    return sorted(
        path for folder in folders for kind in ("*.c", "*.h", "*.cpp")
        for path in (ROOT / folder).rglob(kind)
    )  # fmt: skip


def exported_by_packages() -> set[str]:
    """The public API: what the __init__ of a package names."""
    names: set[str] = set()
    for path in PUBLIC:
        if path.name == "__init__.py":
            names.update(getattr(importlib.import_module(module_name(path)), "__all__", ()))
    return names


API = exported_by_packages()


def public_functions(path: Path) -> Iterator[tuple[str, ast.FunctionDef]]:
    for node in tree_of(path).body:
        if isinstance(node, ast.FunctionDef) and node.name in API:
            yield node.name, node


def public_dataclasses(path: Path) -> Iterator[ast.ClassDef]:
    for node in tree_of(path).body:
        if isinstance(node, ast.ClassDef) and node.name in API:
            marks = [ast.unparse(mark) for mark in node.decorator_list]
            if any("dataclass" in mark for mark in marks):
                yield node


def parameters(function: ast.FunctionDef) -> list[ast.arg]:
    a = function.args
    return [*a.posonlyargs, *a.args, *a.kwonlyargs]


def raised(function: ast.FunctionDef) -> set[str]:
    """Names of the errors that the function's own body raises."""
    names = {
        ast.unparse(node.exc.func)
        for node in ast.walk(function)
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)
    }
    return {name for name in names if name.endswith("Error")}


def test_docstrings_have_the_heads_that_apply() -> None:
    def faults(path: Path) -> Iterator[str]:
        for name, function in public_functions(path):
            text = ast.get_docstring(function) or ""
            short = text.count("\n") < 1 and len(parameters(function)) <= 1
            if parameters(function) and "Args:" not in text and not short:
                yield f"{name}: no Args"
            returns = function.returns is not None and ast.unparse(function.returns) != "None"
            if returns and not re.search(r"(Returns|Yields):", text) and not short:
                yield f"{name}: no Returns"
            yield from (f"{name}: no Raises {error}" for error in raised(function)
                        if f"{error}:" not in text)  # fmt: skip
        for node in public_dataclasses(path):
            if "Args:" not in (ast.get_docstring(node) or ""):
                yield f"{node.name}: no Args"

    # In cli the docstring is the help text.
    no_faults(faults, [path for path in PUBLIC if package_of(path) != "cli"])


def heads(text: str) -> list[str]:
    order = ("Args", "Returns", "Yields", "Raises", "Source", "Example")
    return re.findall(rf"^\s*({'|'.join(order)}):", text, flags=re.MULTILINE)


def test_docstring_heads_come_in_one_order() -> None:
    order = {name: k for k, name in enumerate(("Args", "Returns", "Raises", "Source", "Example"))}
    order["Yields"] = order["Returns"]

    def faults(path: Path) -> Iterator[str]:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                found = [order[head] for head in heads(ast.get_docstring(node) or "")]
                if found != sorted(found):
                    yield f"{node.name}: heads out of order"

    no_faults(faults, PUBLIC)


def is_number(annotation: ast.expr | None) -> bool:
    text = ast.unparse(annotation) if annotation is not None else ""
    return bool(re.search(r"\bfloat|Floats\b", text)) and "str" not in text and "Map" not in text


def named_numbers(path: Path) -> Iterator[tuple[str, str]]:
    """`(where, name)` of each number in the public dataclasses and functions of a module."""
    for node in public_dataclasses(path):
        for field in node.body:
            if isinstance(field, ast.AnnAssign) and is_number(field.annotation):
                yield node.name, ast.unparse(field.target)
    for name, function in public_functions(path):
        for parameter in parameters(function):
            if is_number(parameter.annotation):
                yield name, parameter.arg


def test_numbers_with_a_dimension_name_their_si_unit() -> None:
    def faults(path: Path) -> Iterator[str]:
        spoken = package_of(path) in {"cli", "report"}
        for where, name in named_numbers(path):
            words = name.split("_")
            if words[-1] in QUANTITIES and "relative" not in words and name not in DIMENSIONLESS:
                yield f"{where}.{name}: a {words[-1]} in which unit?"
            if not spoken and len(words) > 1 and words[-1] in DISPLAY_UNITS:
                yield f"{where}.{name}: {words[-1]} belongs in cli and report; use SI here"

    no_faults(faults, PUBLIC)


def public_annotations(body: list[ast.stmt]) -> Iterator[ast.expr]:
    """Types of all arguments, results and fields that users of a module see."""
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            if node.name.startswith("_") and node.name != "__init__":
                continue
            given = node.args
            each = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
            yield from (one.annotation for one in each if one is not None and one.annotation)
            if node.returns is not None:
                yield node.returns
        elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_annotations(node.body)
        elif isinstance(node, ast.AnnAssign):
            yield node.annotation


def test_tables_in_signatures_are_json_objects_not_anything() -> None:
    def faults(path: Path) -> Iterator[str]:
        for annotation in public_annotations(tree_of(path).body):
            if "dict[str, Any]" in ast.unparse(annotation):
                yield f"line {annotation.lineno}: dict[str, Any]; use JsonObject"

    no_faults(faults, PUBLIC)


# Packages that may touch files, and packages that may draw.
FILE_PACKAGES = {"panel", "store", "rig", "safety", "cli"}
PLOT_PACKAGES = {"report", "cli"}
FILE_MODULES = {"h5py", "av", "tifffile", "serial", "socket"}


def package_of(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0]


def run_imports(path: Path) -> Iterator[tuple[ast.stmt, set[str]]]:
    """Imports of a module with what they name; not those for type checkers alone."""
    tree = tree_of(path)
    for_checkers = {
        id(node)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If) and ast.unparse(branch.test) == "TYPE_CHECKING"
        for node in ast.walk(branch)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and id(node) not in for_checkers:
            yield node, {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom) and id(node) not in for_checkers:
            module = node.module or ""
            yield node, {module, *(f"{module}.{each.name}" for each in node.names)}


def test_only_permitted_packages_draw_or_touch_files() -> None:
    def faults(path: Path) -> Iterator[str]:
        roots = {name.split(".")[0] for _, names in run_imports(path) for name in names}
        if "matplotlib" in roots and package_of(path) not in PLOT_PACKAGES:
            yield "draws"
        if roots & FILE_MODULES and package_of(path) not in FILE_PACKAGES:
            yield f"touches files: {roots & FILE_MODULES}"

    no_faults(faults, MODULES)


# What takes 0.3 s or more to import, and only some calls need.
SLOW_IMPORTS = {"scipy.signal", "scipy.stats", "pandas", "xarray", "control"}


def test_what_is_slow_to_import_is_imported_where_it_is_used() -> None:
    """At the head of a module it would slow down the start of every command."""

    def faults(path: Path) -> Iterator[str]:
        for node, names in run_imports(path):
            if node.col_offset == 0 and names & SLOW_IMPORTS:
                yield f"line {node.lineno} imports {names & SLOW_IMPORTS} at the head of the file"

    no_faults(faults, MODULES)


TESTS = sorted((ROOT / "tests").rglob("test_*.py"))


def test_every_raises_has_a_match() -> None:
    def faults(path: Path) -> Iterator[str]:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.raises":
                keywords = {keyword.arg for keyword in node.keywords}
                # The message of SystemExit is its code; Ctrl-C has none.
                without = ast.unparse(node.args[0]) in ("SystemExit", "KeyboardInterrupt")
                if not without and "match" not in keywords:
                    yield f"line {node.lineno}"

    no_faults(faults, TESTS)


PAGES = sorted(
    [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")]
)


@functools.cache
def anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to the headings of a page."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.strip().lower()).replace(" ", "-") for line in headings}


def test_links_lead_to_a_file_and_a_heading_that_exist() -> None:
    def faults(page: Path) -> Iterator[str]:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", text):
            if re.match(r"[a-z]+:", target):
                continue
            other = page.parent / target if target else page
            if not other.exists():
                yield f"points to {target}"
            elif anchor and anchor not in anchors(other):
                yield f"points to {target}#{anchor}"

    no_faults(faults, PAGES)


def test_every_page_of_docs_is_reached_from_the_map() -> None:
    docs = ROOT / "docs"
    linked = re.findall(r"\]\(([^)#\s]+)", (docs / "README.md").read_text(encoding="utf-8"))
    missing = {*docs.rglob("*.md")} - {(docs / link).resolve() for link in linked}
    assert missing == {docs / "README.md"}, f"docs/README.md has no link to {missing}"


def test_every_guide_links_the_glossary() -> None:
    docs = ROOT / "docs"
    guides = {*docs.rglob("*.md")} - {*(docs / "adr").rglob("*.md"), docs / "glossary.md"}
    without = [
        str(page.relative_to(docs)) for page in guides
        if "glossary.md" not in page.read_text(encoding="utf-8")
    ]  # fmt: skip
    assert not without, f"link the glossary where a term is first used: {without}"


def test_every_path_in_the_architecture_exists() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/.\-]+(?:\.(?:py|c|h|cpp)|/))`", text))
    folders = ("src/haselab", "core", "native", "firmware", "tests")
    paths = "\n".join(str(path) for folder in folders for path in (ROOT / folder).rglob("*"))
    missing = [n for n in named if not re.search(rf"/{re.escape(n.rstrip('/'))}$", paths, re.M)]
    assert not missing, f"ARCHITECTURE.md names {sorted(missing)}"


MAX_FILES = 15  # of one folder; subfolders do not count


def test_no_folder_has_more_files_than_a_reader_can_survey() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git repository: generated files cannot be distinguished from sources")
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    )  # fmt: skip
    files = [Path(line) for line in listed.stdout.splitlines() if (ROOT / line).exists()]
    counts = collections.Counter(path.parent for path in files)
    crowded = {str(folder): n for folder, n in counts.items() if n > MAX_FILES}
    assert not crowded, f"more than {MAX_FILES} files, sort them into folders: {crowded}"
