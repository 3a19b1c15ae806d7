"""Explain failures of optional code: the extra that provides a missing module, and the traceback of a stage's exception."""

from __future__ import annotations

import os
import re
import shlex
import sys
import traceback
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


class StageFailure(TypedDict):
    """The stage that raised an exception."""

    stage: str
    recording: str
    frames: str  # frames of the traceback


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


ALL_FRAMES = "TACPIPE_TRACEBACK"  # environment variable: if set, the full traceback is printed
_NAME = "tacpipe_failure"  # attribute of the exception, which is pickled with it in a worker process


def attach_stage(error: BaseException, stage: str, recording: str, outer: tuple[str, ...]) -> None:
    """Add its stage and recording to ``error``, and its traceback without the leading frames from the files ``outer``."""
    described = traceback.TracebackException.from_exception(error)
    frames = list(described.stack)
    while frames and frames[0].filename in outer:
        frames.pop(0)
    described.stack = traceback.StackSummary.from_list(frames)
    setattr(error, _NAME, {"stage": stage, "recording": recording, "frames": "".join(described.format())})


def failure_text(error: BaseException) -> str | None:
    """Return the message for an exception that a stage raised; None for other exceptions and if all frames are requested."""
    failure: StageFailure | None = getattr(error, _NAME, None)
    if failure is None or os.environ.get(ALL_FRAMES):
        return None
    on_recording = f" on recording {failure['recording']}" if failure["recording"] else ""
    return (
        f"The code of stage {failure['stage']} raised {type(error).__name__}{on_recording}:\n{failure['frames'].rstrip()}\n"
        f"What was finished is kept in the store. Set {ALL_FRAMES}=1 to see the frames of tacpipe too."
    )


def failure_line(error: BaseException) -> str:
    """Return a line with the exception and its location: file and line of the innermost frame, or of the syntax error."""
    described = f"{type(error).__name__}: {error}"
    if isinstance(error, SyntaxError):  # its text already ends with file name and line
        return f"{type(error).__name__}: {error.msg}, in {error.filename}, line {error.lineno}."
    frames = traceback.extract_tb(error.__traceback__)
    return f"{described}, in {frames[-1].filename}, line {frames[-1].lineno}." if frames else f"{described}."
