"""The examples in docstrings are run."""

import doctest
import importlib
import itertools
import pkgutil
from pathlib import Path

import pytest

import tacpipe

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(tacpipe.__path__, "tacpipe.")
    if not module.name.endswith("__main__")
)


def run_examples(name: str) -> doctest.TestResults:
    """Import a module and run its examples; none are looked for where no line begins one, which takes its time."""
    module = importlib.import_module(name)
    has_examples = Path(str(module.__file__)).read_text().count(">>> ")
    return doctest.testmod(module) if has_examples else doctest.TestResults(0, 0)


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_give_what_they_say(name: str) -> None:
    assert run_examples(name).failed == 0


def test_there_are_examples() -> None:
    counts = itertools.accumulate(run_examples(name).attempted for name in MODULES)
    assert any(count >= 10 for count in counts)
