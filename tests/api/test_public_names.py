"""`import haselab as hl`: quick, and every name is there, for people and for type checkers."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import haselab as hl

HEAVY = ("numpy", "scipy", "h5py", "matplotlib", "pandas", "pydantic", "click")


def test_the_import_loads_nothing_heavy():
    code = f"import sys, haselab; print([m for m in {HEAVY} if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


@pytest.mark.long
@pytest.mark.parametrize("name", hl.__all__)
def test_every_public_name_is_there_and_has_a_docstring(name):
    assert getattr(hl, name).__doc__
    assert name in dir(hl)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(hl.__file__).read_text(encoding="utf-8"))
    (branch,) = [node for node in tree.body if isinstance(node, ast.If)]
    imports = [node for node in branch.body if isinstance(node, ast.ImportFrom)]
    seen = {alias.name for node in imports for alias in node.names}
    assert seen == set(hl.__all__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = hl.nothing
