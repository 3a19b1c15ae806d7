"""The examples in docstrings are run."""

import doctest
import importlib
import pkgutil

import pytest

import tacpipe

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(tacpipe.__path__, "tacpipe.")
    if not module.name.endswith("__main__")
)


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_give_what_they_say(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_there_are_examples() -> None:
    assert sum(doctest.testmod(importlib.import_module(name)).attempted for name in MODULES) >= 10
