"""Every example in a docstring runs."""

import doctest
import importlib
import pkgutil

import pytest

import haselab

NAMES = sorted(
    module.name
    for module in pkgutil.walk_packages(haselab.__path__, "haselab.")
    if not module.name.endswith("__main__")
)


@pytest.mark.parametrize("name", NAMES)
def test_examples_in_docstrings_run(name: str) -> None:
    module = importlib.import_module(name)
    failures, _ = doctest.testmod(module)
    assert failures == 0
