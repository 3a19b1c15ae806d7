"""Optional parts: which extra of tacpipe brings a module, and the command that installs it into this installation."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from tacpipe.errors import MissingModuleError

if TYPE_CHECKING:
    from importlib.metadata import Distribution

NAME = "tacpipe"
OWN = (NAME, "tacpipe_stages")
PLUGINS = "tacpipe."  # groups of entry points
PACKAGES = {  # modules whose package has another name
    "can": "python-can",
    "google": "protobuf",
    "hid": "hidapi",
    "hidraw": "hidapi",
    "mlflow": "mlflow-skinny",
    "mpl_toolkits": "matplotlib",
    "serial": "pyserial",
    "sklearn": "scikit-learn",
    "vl_convert": "vl-convert-python",
}
REQUIREMENT = re.compile(r"""\s*([\w.-]+)[^;]*;.*\bextra\s*==\s*["']([\w.-]+)["']""")
TOGETHER = "all"  # the extra that brings all others: a user wants the one that is missing


@contextmanager
def named(needed_by: str, plugin: Callable[[], str | None] = lambda: None) -> Iterator[None]:
    """Have a module that is missing in the block reported in one sentence that begins with ``needed_by``.

    ``plugin`` returns the package that ``needed_by`` comes from, if it is known. Raises `MissingModuleError`, which is an
    `ImportError` too; other import errors pass.
    """
    try:
        yield
    except ImportError as error:
        found = None if isinstance(error, MissingModuleError) else missing(error, needed_by, plugin())
        if found is None:
            raise
        raise found from error


def require(needed_by: str, *modules: str) -> None:
    """Raise `MissingModuleError` for the first of these modules that is not installed."""
    for module in modules:
        if not _installed(module):
            absent = ModuleNotFoundError(f"No module named {module!r}", name=module)
            raise missing(absent, needed_by) or absent


def missing(error: ImportError, needed_by: str, plugin: str | None = None) -> MissingModuleError | None:
    """Return the sentence for a module that is not installed; None where the import failed for another reason.

    ``plugin`` is the package that ``needed_by`` comes from, for modules that tacpipe's own extras do not bring.
    """
    module = (error.name or "").partition(".")[0]
    if not module or module in OWN or module in sys.modules:  # a mistake in whoever imports from it
        return None
    extra, absent = of(module), isinstance(error, ModuleNotFoundError) and not _installed(module)
    if extra is None:
        if not absent:
            return None
        source = f", of the package {plugin}," if plugin else ""
        return MissingModuleError(
            f"{needed_by}{source} needs the module {module}, which is not installed: install the package that brings it.",
            name=module,
        )
    package = PACKAGES.get(module, module)
    state = "which is not installed" if absent else f"which cannot be imported ({error})"
    return MissingModuleError(
        f"{needed_by} needs {package}, {state}: install it with the extra {extra}, by `{command(extra)}`.", name=module
    )


def of(module: str) -> str | None:
    """Return the extra that brings a module, None if none does, or if tacpipe is not installed."""
    wanted = _normal(PACKAGES.get(module, module))
    found = _distribution()
    optional = _optional(found.requires or []) if found is not None else {}
    return next((extra for extra, packages in optional.items() if extra != TOGETHER and wanted in packages), None)


def command(extra: str) -> str:
    """Return the shell command that installs an extra of tacpipe, from where this installation came from."""
    found = _distribution()
    source = _source(found) if found is not None else None
    pip = _pip()
    if source is not None:
        return " ".join([pip, "install", *_asked(source, extra)])
    if found is not None and _from_index(found):
        return f"{pip} install {shlex.quote(f'{NAME}[{extra}]')}"
    requires = (found.requires or []) if found is not None else []  # its source is gone: what the extra names is enough
    packages = [text.partition(";")[0].strip() for text in requires if _extra(text) == extra]
    return " ".join([pip, "install", *(shlex.quote(one) for one in packages)])


def _asked(source: dict[str, Any], extra: str) -> list[str]:
    """Return what is given to ``pip install`` for an extra of what a direct URL names."""
    url = str(source["url"])
    if "vcs_info" in source:
        version = source["vcs_info"]
        return [shlex.quote(f"{NAME}[{extra}] @ {version['vcs']}+{url}@{version['commit_id']}")]
    place = _path(url)
    if place is None:
        return [shlex.quote(f"{NAME}[{extra}] @ {url}")]
    from pathlib import Path

    here = Path.cwd() == Path(place)
    wanted = shlex.quote(f"{'.' if here else place}[{extra}]")
    return ["-e", wanted] if source.get("dir_info", {}).get("editable") else [wanted]


def _source(found: Distribution) -> dict[str, Any] | None:
    """Return the direct URL that a distribution was installed from (PEP 610), None if there is none or it is gone."""
    import json
    from pathlib import Path

    try:
        value: dict[str, Any] = json.loads(found.read_text("direct_url.json") or "null")
        place = _path(str(value["url"]))
    except (ValueError, TypeError, KeyError):
        return None
    return value if place is None or Path(place).exists() else None


def _from_index(found: Distribution) -> bool:
    return found.read_text("direct_url.json") is None and found.read_text("INSTALLER") is not None


def _path(url: str) -> str | None:
    """Return the path of a ``file:`` URL, None of another."""
    from urllib.parse import unquote, urlsplit

    split = urlsplit(url)
    return unquote(split.path) if split.scheme == "file" else None


def _pip() -> str:
    """Return the pip of this installation: by its name where the shell finds that one."""
    import shutil
    from pathlib import Path

    pip = shutil.which("pip")
    ours = pip is not None and Path(pip).parent == Path(sys.executable).parent
    return "pip" if ours else f"{shlex.quote(sys.executable)} -m pip"


def _distribution() -> Distribution | None:
    """Return tacpipe as it is installed; a clone's own ``egg-info`` on the path knows less."""
    from importlib.metadata import distributions

    every = list(distributions(name=NAME))
    return next((one for one in every if one.read_text("direct_url.json")), every[0] if every else None)


def _optional(requires: list[str]) -> dict[str, set[str]]:
    """Return the packages of each extra, in the order of the metadata.

    >>> _optional(["numpy>=1.26", 'torch>=2.4; extra == "learn"', 'scikit-learn>=1; extra == "learn"'])["learn"] == {
    ...     "torch", "scikit-learn"}
    True
    """
    found: dict[str, set[str]] = {}
    for text in requires:
        match = REQUIREMENT.match(text)
        if match:
            found.setdefault(match[2], set()).add(_normal(match[1]))
    return found


def _extra(text: str) -> str | None:
    match = REQUIREMENT.match(text)
    return match[2] if match else None


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _installed(module: str) -> bool:
    from importlib.util import find_spec

    try:
        return module in sys.modules or find_spec(module) is not None
    except (ImportError, ValueError):
        return False
