"""Explain a missing module of optional code: the extra that provides it, and the command that installs it."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, NotRequired, TypedDict

from tacpipe.errors import MissingModuleError

if TYPE_CHECKING:
    from importlib.metadata import Distribution

NAME = "tacpipe"
OWN = (NAME, "tacpipe_stages")
PACKAGES = {  # package by module, if their names differ
    "can": "python-can",
    "cv2": "opencv-python-headless",
    "google": "protobuf",
    "hid": "hidapi",
    "hidraw": "hidapi",
    "mlflow": "mlflow-skinny",
    "mpl_toolkits": "matplotlib",
    "rerun": "rerun-sdk",
    "rerun_cli": "rerun-sdk",
    "serial": "pyserial",
    "sklearn": "scikit-learn",
    "vl_convert": "vl-convert-python",
}
REQUIREMENT = re.compile(r"""\s*([\w.-]+)[^;]*;.*\bextra\s*==\s*["']([\w.-]+)["']""")
TOGETHER = "all"  # the extra that includes all others; errors suggest the specific one


@contextmanager
def explain_missing(needed_by: str, plugin: Callable[[], str | None] = lambda: None) -> Iterator[None]:
    """Report a module that is missing in the block in one sentence that starts with ``needed_by``.

    ``plugin`` returns the package that provides ``needed_by``, if it is known. Raises `MissingModuleError`, a subclass
    of `ImportError`; other import errors are not changed.
    """
    try:
        yield
    except ImportError as error:
        explained = None if isinstance(error, MissingModuleError) else missing(error, needed_by, plugin())
        if explained is None:
            raise
        raise explained from error


def require(needed_by: str, *modules: str) -> None:
    """Raise `MissingModuleError` for the first of these modules that is not installed."""
    for module in modules:
        if not _is_installed(module):
            absent = ModuleNotFoundError(f"No module named {module!r}", name=module)
            raise missing(absent, needed_by) or absent


def missing(error: ImportError, needed_by: str, plugin: str | None = None) -> MissingModuleError | None:
    """Return the error for a module that is not installed, or None if the import failed for another reason.

    ``plugin`` is the package that provides ``needed_by``, for modules that are not in tacpipe's own extras.
    """
    module = (error.name or "").partition(".")[0]
    if not module or module in OWN or module in sys.modules:  # the error is in the importing module itself
        return None
    extra, absent = extra_for(module), isinstance(error, ModuleNotFoundError) and not _is_installed(module)
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


def extra_for(module: str) -> str | None:
    """Return the extra that includes a module, or None if there is none or tacpipe is not installed."""
    package = _normal(PACKAGES.get(module, module))
    distribution = _distribution()
    optional = _packages_by_extra(distribution.requires or []) if distribution is not None else {}
    return next((extra for extra, packages in optional.items() if extra != TOGETHER and package in packages), None)


def command(extra: str) -> str:
    """Return the shell command that installs an extra of tacpipe from the source of this installation."""
    distribution = _distribution()
    source = _source(distribution) if distribution is not None else None
    pip = _pip()
    if source is not None:
        return " ".join([pip, "install", *_pip_arguments(source, extra)])
    if distribution is not None and _from_index(distribution):
        return f"{pip} install {shlex.quote(f'{NAME}[{extra}]')}"
    # if the source no longer exists, install only the packages of the extra
    requires = (distribution.requires or []) if distribution is not None else []
    packages = [text.partition(";")[0].strip() for text in requires if _extra(text) == extra]
    return " ".join([pip, "install", *(shlex.quote(package) for package in packages)])


class VersionControl(TypedDict):
    """The version of a repository that a distribution was installed from (PEP 610)."""

    vcs: str
    commit_id: str


class InstalledFolder(TypedDict, total=False):
    """The folder that a distribution was installed from (PEP 610)."""

    editable: bool


class DirectUrl(TypedDict):
    """The direct URL that a distribution was installed from (PEP 610)."""

    url: str
    vcs_info: NotRequired[VersionControl]
    dir_info: NotRequired[InstalledFolder]


def _pip_arguments(source: DirectUrl, extra: str) -> list[str]:
    """Return the arguments of ``pip install`` for an extra of a package with this direct URL."""
    url = str(source["url"])
    if "vcs_info" in source:
        version = source["vcs_info"]
        return [shlex.quote(f"{NAME}[{extra}] @ {version['vcs']}+{url}@{version['commit_id']}")]
    path = _path(url)
    if path is None:
        return [shlex.quote(f"{NAME}[{extra}] @ {url}")]
    from pathlib import Path

    is_working_folder = Path.cwd() == Path(path)
    requirement = shlex.quote(f"{'.' if is_working_folder else path}[{extra}]")
    return ["-e", requirement] if source.get("dir_info", {}).get("editable") else [requirement]


def _source(distribution: Distribution) -> DirectUrl | None:
    """Return the direct URL that a distribution was installed from (PEP 610), or None if it is unknown or gone."""
    import json
    from pathlib import Path

    try:
        value: DirectUrl = json.loads(distribution.read_text("direct_url.json") or "null")
        path = _path(str(value["url"]))
    except (ValueError, TypeError, KeyError):
        return None
    return value if path is None or Path(path).exists() else None


def _from_index(distribution: Distribution) -> bool:
    return distribution.read_text("direct_url.json") is None and distribution.read_text("INSTALLER") is not None


def _path(url: str) -> str | None:
    """Return the path of a ``file:`` URL, or None for other URLs."""
    from urllib.parse import unquote, urlsplit

    split = urlsplit(url)
    return unquote(split.path) if split.scheme == "file" else None


def _pip() -> str:
    """Return the command for the pip of this installation: its name if the shell finds it, else its path."""
    import shutil
    from pathlib import Path

    pip = shutil.which("pip")
    ours = pip is not None and Path(pip).parent == Path(sys.executable).parent
    return "pip" if ours else f"{shlex.quote(sys.executable)} -m pip"


def _distribution() -> Distribution | None:
    """Return the installed distribution of tacpipe, preferably one with a direct URL, or None if there is none."""
    from importlib.metadata import distributions

    installed = list(distributions(name=NAME))
    return next(
        (distribution for distribution in installed if distribution.read_text("direct_url.json")),
        installed[0] if installed else None,
    )


def _packages_by_extra(requires: list[str]) -> dict[str, set[str]]:
    """Return the packages of each extra, in the order of the metadata.

    >>> _packages_by_extra(["numpy>=1.26", 'torch>=2.4; extra == "learn"', 'polars>=1; extra == "tables"'])
    {'learn': {'torch'}, 'tables': {'polars'}}
    """
    packages: dict[str, set[str]] = {}
    for text in requires:
        match = REQUIREMENT.match(text)
        if match:
            packages.setdefault(match[2], set()).add(_normal(match[1]))
    return packages


def _extra(text: str) -> str | None:
    match = REQUIREMENT.match(text)
    return match[2] if match else None


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def _is_installed(module: str) -> bool:
    from importlib.util import find_spec

    try:
        return module in sys.modules or find_spec(module) is not None
    except (ImportError, ValueError):
        return False
