"""The registry of plug-ins: stages, formats, sensors and so on, found through entry points and loaded when needed."""

from __future__ import annotations

import ast
import contextlib
import functools
import importlib
import importlib.util
import inspect
import operator
import os
import sys
from collections.abc import Iterator, Sequence
from configparser import ConfigParser
from contextvars import ContextVar
from importlib.machinery import EXTENSION_SUFFIXES, SOURCE_SUFFIXES
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tacpipe.errors import TacpipeError, UsageError
from tacpipe.io import memory
from tacpipe.io.hashing import digest, file_digest
from tacpipe.plugins import extras, failures
from tacpipe.plugins.stage import AnyStage, Stage
from tacpipe.printable import plain

if TYPE_CHECKING:
    from tacpipe.plugins.requirements import Requirements

STAGES, FORMATS, SENSORS = "tacpipe.stages", "tacpipe.formats", "tacpipe.sensors"
TASKS = "tacpipe.tasks"  # name: a subclass of `tacpipe.tasks.task.Task`
EXPORTS = "tacpipe.exports"
EXECUTORS = "tacpipe.executors"
COMMANDS = "tacpipe.commands"  # package: the order of its commands and the help of its groups
OWN = "tacpipe"  # name of tacpipe's entry point in that group
TRACKERS = "tacpipe.trackers"
MODELS = "tacpipe.models"  # TASK.NAME: params of an architecture of a task (`tacpipe.plugins.architectures`)
CODECS = "tacpipe.codecs"  # kind of codec: its class (`tacpipe.codecs.codec.Codec`)
ENCODERS = "tacpipe.encoders"  # name: a function from a file of weights to a function from images to features
CHECKS = "tacpipe.checks"  # name: a subclass of `tacpipe.checks.check.Check`
GROUPS = (STAGES, FORMATS, EXPORTS, TASKS, COMMANDS, SENSORS, EXECUTORS, TRACKERS, MODELS, CODECS, ENCODERS, CHECKS)
PREFIXES = {FORMATS: "ingest.", EXPORTS: "export.", TASKS: "train."}  # prefixes of stage names in other groups
FIT, PART = ".fit", ".part"  # suffixes of the parts of a stage that have keys of their own
_used_packages: ContextVar[set[str] | None] = ContextVar("used_packages", default=None)


class Package(NamedTuple):
    """An installed package."""

    name: str
    version: str

    def __str__(self) -> str:
        return f"{self.name} {self.version}".strip()


@functools.cache
def entry_points() -> dict[str, dict[str, str]]:
    """Return the target of every entry point in tacpipe's groups, by group and name."""
    return {group: {name: target for name, (target, _) in declared.items()} for group, declared in installed().items()}


@functools.cache
def installed() -> dict[str, dict[str, tuple[str, Path]]]:
    """Return target and declaring file of every entry point in tacpipe's groups, by group and name.

    Reads ``entry_points.txt`` files directly, because ``importlib.metadata`` creates an object per entry point and
    takes as long as the rest of ``tacpipe --help``. As there, the first one on the path has precedence.
    """
    targets_by_group: dict[str, dict[str, tuple[str, Path]]] = {group: {} for group in GROUPS}
    for folder in dict.fromkeys(sys.path):
        for file in _entry_point_files(folder):
            try:
                with open(file, encoding="utf-8") as reading:
                    text = reading.read()
            except (FileNotFoundError, NotADirectoryError, PermissionError):
                continue
            if "[tacpipe." not in text:
                continue
            parser = ConfigParser(delimiters=("=",), interpolation=None)
            parser.optionxform = str  # type: ignore[assignment, method-assign]  # names keep their case
            parser.read_string(text)
            for group, targets in targets_by_group.items():
                if parser.has_section(group):
                    for name, target in parser.items(group):
                        targets.setdefault(name, (target, Path(file)))
    return targets_by_group


@functools.cache
def provider_of(group: str, name: str) -> Package | None:
    """Return the package that provides an entry point, from its metadata, or None for tacpipe's own.

    Metadata are read as text, so that a cache hit that needs them imports nothing.
    """
    target, file = installed()[group][name]
    if target.partition(".")[0].partition(":")[0] in extras.OWN:
        return None
    about = {"Name": file.parent.stem, "Version": ""}
    for metadata in (file.with_name("METADATA"), file.with_name("PKG-INFO")):
        with contextlib.suppress(OSError):
            head, _, _ = metadata.read_text(encoding="utf-8", errors="replace").partition("\n\n")
            about |= {key: value.strip() for key, _, value in (line.partition(":") for line in head.splitlines())}
            break
    return Package(plain(about["Name"]), plain(about["Version"]))


@functools.cache
def plugin_packages() -> dict[str, Path]:
    """Return the entry-point file of each installed package with plug-ins, by package name."""
    files = {}
    for group, targets in installed().items():
        for name, (_, file) in targets.items():
            package = provider_of(group, name)
            if package is not None:
                files[package.name] = file
    return files


def package_of_stage(name: str) -> str | None:
    """Return the package that provides a stage, or None for tacpipe's own stages and unknown names."""
    stage = stage_name(name)
    for group, prefix in (*PREFIXES.items(), (STAGES, "")):
        if stage.startswith(prefix) and stage.removeprefix(prefix) in entry_points()[group]:
            package = provider_of(group, stage.removeprefix(prefix))
            return None if package is None else package.name
    return None


@functools.cache
def package_code(package: str) -> str | None:
    """Return the digest of all code of a plug-in package or of tacpipe, or None if it is not installed.

    The first call determines the result, because a process does not import edited modules again.
    """
    modules = extras.OWN if package == OWN else _top_modules(plugin_packages().get(package))
    files = {name: file for module in modules for name, file in _code_files(module)}
    try:
        return digest({name: file_digest(files[name]) for name in sorted(files)}) if files else None
    except OSError:  # a file was removed in the meantime
        return None


def _top_modules(entry_points_file: Path | None) -> set[str]:
    """Return the top-level modules and packages that a distribution installs."""
    if entry_points_file is None:
        return set()
    targets = (
        target for points in installed().values() for target, file in points.values() if file == entry_points_file
    )
    modules = {target.partition(":")[0].partition(".")[0] for target in targets}
    with contextlib.suppress(OSError):  # only setuptools writes this file
        modules.update(entry_points_file.with_name("top_level.txt").read_text(encoding="utf-8").split())
    with contextlib.suppress(OSError):  # an egg-info folder has no such file
        paths = [line.split(",")[0] for line in entry_points_file.with_name("RECORD").read_text("utf-8").splitlines()]
        modules.update(path.partition("/")[0].removesuffix(".py") for path in paths if path.endswith(".py"))
    return {module for module in modules if module.isidentifier()}


def _code_files(module: str) -> Iterator[tuple[str, Path]]:
    """Yield the relative name and the path of every source file of a top-level module or package. Imports nothing."""
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return
    if spec is None:
        return
    if spec.origin is not None and not spec.submodule_search_locations:
        yield Path(spec.origin).name, Path(spec.origin)
    suffixes = (*SOURCE_SUFFIXES, *EXTENSION_SUFFIXES)
    for folder in spec.submodule_search_locations or ():
        for file in Path(folder).rglob("*"):
            if file.name.endswith(suffixes) and file.is_file():
                yield f"{module}/{file.relative_to(folder).as_posix()}", file


@contextlib.contextmanager
def collect_packages() -> Iterator[set[str]]:
    """Yield a set that collects the packages of all plug-ins loaded by name in the block."""
    packages: set[str] = set()
    token = _used_packages.set(packages)
    try:
        yield packages
    finally:
        _used_packages.reset(token)


def _entry_point_files(folder: str) -> list[str]:
    """Return the possible entry-point files in a folder of installed packages."""
    ending = ".dist-info" if folder.endswith("-packages") else ".egg-info"
    try:
        names = os.listdir(folder or ".")  # noqa: PTH208
    except (FileNotFoundError, NotADirectoryError, PermissionError):  # Python also ignores such a folder
        return []
    return [f"{folder or '.'}/{name}/entry_points.txt" for name in sorted(names) if name.endswith(ending)]


@functools.cache
def stages() -> dict[str, str]:
    """Return the target of every stage by name.

    A format ``x`` is the stage ``ingest.x``, an export is ``export.x``, and ``train`` of a task is ``train.x``.
    """
    points = entry_points()
    targets = dict(points[STAGES])
    for group, prefix in PREFIXES.items():
        member = ".train" if group == TASKS else ""
        targets |= {f"{prefix}{name}": f"{target}{member}" for name, target in points[group].items()}
    return dict(sorted(targets.items()))


def commands() -> dict[str, str]:
    """Return the summary of each command that is a stage or a group of stages, in the order of the help.

    A plug-in's entry point in the group ``tacpipe.commands`` is a dict of names in order. The value is the summary of a
    group, or "" if the stage or the group's module has its own. tacpipe's commands come first; commands that are not
    listed come last in alphabetical order.
    """
    stage_by_command: dict[str, str] = {}
    for name in reversed(stages()):
        stage_by_command[name.partition(".")[0]] = name
    summaries: dict[str, str] = {}
    for name, target in sorted(entry_points()[COMMANDS].items(), key=lambda item: (item[0] != OWN, item[0])):
        with contextlib.suppress(TacpipeError):  # an entry point that cannot be loaded affects only its own order
            summaries = {**summaries, **_import(name, target)}
    names = [*(name for name in summaries if name in stage_by_command), *sorted(set(stage_by_command) - set(summaries))]
    return {name: summaries.get(name) or _own_summary(name) or summary(stage_by_command[name]) for name in names}


def _own_summary(command: str) -> str:
    """Return the summary of a stage, or of a group with a module; empty for other groups."""
    return summary(command) if command in stages() else group_help(command).partition("\n")[0]


def own_module(command: str) -> str:
    """Return the name of the module of tacpipe's stages that is named after a command."""
    return f"{entry_points()[COMMANDS][OWN].partition(':')[0]}.{command}"


def load_command(name: str) -> Any:
    """Return the module of tacpipe's stages with a command that is not a stage."""
    return _import(name, own_module(name))


def group_help(group: str) -> str:
    """Return the docstring of the module that is named after a group or command, or "" if there is none."""
    try:
        return docstring(source(own_module(group)).read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError, ImportError):
        return ""


def docstring(code: str) -> str:
    """Return the docstring in a module's source; only unusual source is parsed.

    >>> docstring("'Split recordings.'")
    'Split recordings.'
    """
    quotes = '"""'
    text, end, _ = code.removeprefix(quotes).partition(quotes)
    if code.startswith(quotes) and end and "\\" not in text:
        return inspect.cleandoc(text)
    return ast.get_docstring(ast.parse(code)) or ""


def stage_name(name: str) -> str:
    """Return the name of the stage that a fit or a part belongs to, or the name of a stage itself.

    >>> stage_name("compress.pca.fit"), stage_name("export.csv.part"), stage_name("split")
    ('compress.pca', 'export.csv', 'split')
    """
    return name.removesuffix(FIT).removesuffix(PART)


def load(name: str) -> AnyStage:
    """Return the stage with this name.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    target = stages().get(name)
    if target is None:
        raise UsageError(f"There is no stage {name}; there are {', '.join(stages())}.")
    loaded = _import(name, target)
    packages = _used_packages.get()
    if packages is not None and (package := package_of_stage(name)) is not None:
        packages.add(package)
    if not isinstance(loaded, Stage):
        raise TacpipeError(f"{target}, registered as stage {name}, is not a stage: decorate it with @stage(version=1).")
    return loaded


def load_step(name: str) -> AnyStage:
    """Return the stage with this name, or a stage's fit or part: ``compress.pca.fit`` is the fit of ``compress.pca``."""
    stage = load(stage_name(name))
    nested = stage.fit if name.endswith(FIT) else stage.part if name.endswith(PART) else stage
    assert nested is not None
    return nested


def requirements(name: str) -> Requirements | None:
    """Return what recordings must contain for a stage ``train.TASK``, or None for other stages."""
    task = name.removeprefix(PREFIXES[TASKS])
    return load_task(task).requirements if task != name and task in tasks() else None


def tasks() -> list[str]:
    """Return the names of all tasks."""
    return sorted(entry_points()[TASKS])


def load_task(name: str) -> Any:
    """Return the task with this name, a `tacpipe.tasks.task.Task`.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported or is not a subclass of that.
    """
    task_class = _load_plugin(TASKS, "task", name)
    try:
        return task_class()
    except TypeError as error:  # a module, an instance, or a class that lacks abstract members
        target = entry_points()[TASKS][str(name)]
        raise TacpipeError(
            f"{target}, registered as task {plain(str(name))}, is not a task ({error}): it must be a subclass of "
            f"tacpipe.tasks.task.Task."
        ) from error


def sensors() -> dict[str, str]:
    """Return the target of every sensor by name."""
    return dict(sorted(entry_points()[SENSORS].items()))


def load_sensor(name: str) -> Any:
    """Return the sensor class with this name, a `tacpipe.sensors.sensor.Sensor`.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(SENSORS, "sensor", name)


def load_executor(name: str) -> Any:
    """Return the function that connects to an executor (`tacpipe.engine.executors.local.Executor`).

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(EXECUTORS, "executor", name)


def trackers() -> dict[str, str]:
    """Return the target of every tracker by name."""
    return dict(sorted(entry_points()[TRACKERS].items()))


def load_tracker(name: str) -> Any:
    """Return the function from a destination to a tracker, a `tacpipe.trackers.tracking.Tracker`.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(TRACKERS, "tracker", name)


def architectures(task: str) -> list[str]:
    """Return the names of the architectures of a task: tacpipe's own first, then those of plug-ins."""
    names = [name.partition(".")[2] for name in installed()[MODELS] if name.partition(".")[0] == task]
    return sorted(names, key=lambda name: (provider_of(MODELS, f"{task}.{name}") is not None, name))


def load_architecture(task: str, name: str) -> Any:
    """Return the params class of an architecture; `tacpipe.plugins.architectures` validates it.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(MODELS, f"architecture of {task}", f"{task}.{name}")


def codecs() -> list[str]:
    """Return the kinds of all codecs."""
    return sorted(entry_points()[CODECS])


def load_codec(kind: str) -> Any:
    """Return the codec class of this kind, a `tacpipe.codecs.codec.Codec`.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(CODECS, "codec of kind", kind)


def load_encoder(name: str) -> Any:
    """Return the function of an image encoder, which takes the path of its weights and returns a function of images.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(ENCODERS, "encoder", name)


def checks() -> list[str]:
    """Return the names of all checks of recordings."""
    return sorted(entry_points()[CHECKS])


def load_check(name: str) -> Any:
    """Return the class of a check, a subclass of `tacpipe.checks.check.Check`.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    return _load_plugin(CHECKS, "check", name)


def _load_plugin(group: str, noun: str, name: Any) -> Any:
    """Return the object of an entry point. ``name`` comes from a file or the user and may have any type.

    Raises `UsageError` if there is none, `TacpipeError` if it cannot be imported.
    """
    targets = entry_points()[group]
    target = targets.get(str(name))
    if target is None:
        raise UsageError(f"There is no {noun} {plain(str(name))}; there are {', '.join(sorted(targets))}.")
    packages = _used_packages.get()
    # all architectures are loaded to collect a task's params, so their own packages are not recorded
    if packages is not None and group != MODELS and (package := provider_of(group, str(name))) is not None:
        packages.add(package.name)
    return _import(name, target)


def _import(name: str, target: str) -> Any:
    """Return the object ``module:attribute`` that the entry point ``name`` refers to.

    Raises `TacpipeError` if the module cannot be imported or has no such attribute, `MissingModuleError` if it needs a
    module that is not installed.
    """
    module, _, attribute = target.partition(":")
    try:
        loaded = importlib.import_module(module)
    except ImportError as error:
        if (short := memory.shortage(error)) is not None:
            raise short from error
        sentence = f"{name} needs {error.name or target}, which cannot be imported ({error})."
        raise extras.missing(error, name, _package(target)) or TacpipeError(sentence) from error
    except TacpipeError:
        raise
    except Exception as error:  # the plug-in's module raises an error
        raise TacpipeError(f"The module {module} of {name} cannot be loaded. {failures.failure_line(error)}") from error
    try:
        return operator.attrgetter(attribute)(loaded) if attribute else loaded
    except AttributeError as error:
        raise TacpipeError(f"{module} has no {attribute}, though it is registered as {name}.") from error


def package(name: str) -> str | None:
    """Return the name of the installed package that provides a stage, if it is known."""
    return _package(stages().get(name, ""))


def _package(target: str) -> str | None:
    """Return the name of the installed package with the entry point ``target``, if it is known."""
    from importlib.metadata import entry_points as installed_points

    distributions = (point.dist for group in GROUPS for point in installed_points(group=group) if point.value == target)
    try:
        return next(
            (
                distribution.metadata["Name"]
                for distribution in distributions
                if distribution is not None and "Name" in distribution.metadata
            ),
            None,
        )
    except FileNotFoundError:  # raised by `importlib_metadata`, once imported, if metadata are missing
        return None


def summary(name: str) -> str:
    """Return the first line of the docstring of a stage's function or module. Imports nothing and never raises."""
    module, _, attribute = stages()[name].partition(":")
    try:
        code = source(module).read_text(encoding="utf-8")
        function = None if is_named_after(module, name) else _definition(ast.parse(code), attribute.split("."))
        text = function and ast.get_docstring(function)
        return (text or docstring(code)).split("\n")[0]
    except (OSError, SyntaxError, ValueError, ImportError):
        return "(its module cannot be read)"


def is_named_after(module: str, stage_name: str) -> bool:
    """Return whether the docstring of a module is the help of the stage ``stage_name``.

    >>> is_named_after("tacpipe_stages.segment_slips", "segment.slips"), is_named_after("lab.stages", "scale")
    (True, True)
    >>> is_named_after("tacpipe_stages.compress", "compress.pca")
    False
    """
    return "." not in stage_name or module.rpartition(".")[2] == stage_name.replace(".", "_")


def _definition(tree: ast.Module, names: Sequence[str]) -> ast.FunctionDef | None:
    """Return the definition of a function or of a class's method in a syntax tree, or None if it does not exist."""
    body = tree.body
    for name in names:
        kinds = ast.FunctionDef if name == names[-1] else ast.ClassDef
        node = next((node for node in body if isinstance(node, kinds) and node.name == name), None)
        if isinstance(node, ast.FunctionDef):
            return node
        body = [] if node is None else node.body
    return None


def source(module: str) -> Path:
    """Return the file of a module without importing it. Raises `ImportError` if it does not exist."""
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        raise ImportError(module)
    return Path(spec.origin)
