"""An environment without tacpipe's extras: only what its own requirements bring can be imported.

`hide` fills a folder; with it first in ``PYTHONPATH`` every Python process, workers among them, finds no other module.
"""

import re
import sys
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

from packaging.requirements import Requirement

TACPIPE, KEPT = "tacpipe", ("pip", "setuptools", "wheel")
HOOK = '''
import sys
from importlib.machinery import PathFinder

HIDDEN = frozenset({hidden!r})


class Visible(PathFinder):
    """Finds nothing of what is hidden, as if it were not installed."""

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in HIDDEN else super().find_spec(name, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Visible
'''


def normal(name: str) -> str:
    """Return the name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def core() -> set[str]:
    """Return the packages that `pip install tacpipe` brings where no extra is named."""
    names: set[str] = set()
    waiting = [TACPIPE]
    while waiting:
        name = normal(waiting.pop())
        if name in names:
            continue
        names.add(name)
        try:
            texts = distribution(name).requires or []
        except PackageNotFoundError:  # Other platforms need this package.
            continue
        requirements = [Requirement(text) for text in texts]
        waiting += [
            requirement.name
            for requirement in requirements
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        ]
    return names


def hidden() -> set[str]:
    """Return the modules that only other packages bring."""
    installed = core() | set(KEPT)
    return {
        module
        for module, packages in packages_distributions().items()
        if not installed & {normal(name) for name in packages} and module not in sys.stdlib_module_names
    }


def hide(folder: Path) -> Path:
    """Fill ``folder`` with what hides them; return it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(HOOK.format(hidden=sorted(hidden())))
    return folder
