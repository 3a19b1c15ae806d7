"""Prepare a live session: check rig, model and settings, and add the session's own streams to the rig."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from tacpipe.datasets import model_files
from tacpipe.datasets.dataset import Dataset
from tacpipe.engine.pipeline import open_dataset
from tacpipe.errors import UsageError
from tacpipe.links.link import Address
from tacpipe.live import publishing
from tacpipe.live.settings import LiveTask, SessionOptions, Settings, SettingValues, parse_option
from tacpipe.plugins import fields, registry
from tacpipe.plugins.stage import Attribute
from tacpipe.printable import plain
from tacpipe.recording import recorder, scheduling
from tacpipe.recording import rig as rigs
from tacpipe.recording.rig import Rig, RigStream
from tacpipe.sensors.sensor import Options

PATHS = ("model",)


class LiveModel(NamedTuple):
    """A trained model whose task runs live."""

    task: str
    live: LiveTask
    dataset: Dataset


@dataclass(frozen=True)
class PreparedSession:
    """A checked live session that may start."""

    rig: Rig  # includes the session's own streams
    options: SessionOptions
    attributes: Mapping[str, Attribute]  # further attributes of the recordings


def prepare(rig: Rig, rig_file: str, options: SettingValues) -> PreparedSession:
    """Return a session for a rig, read from ``rig_file``, and options of the command, which are None if not given.

    Raises `UsageError`, which names the option, or file and key, if this computer, the model or the rig does not
    support it.
    """
    path = str(options.get("model") or rig.live.get("model", ""))
    if not path:
        raise UsageError(
            f'A live session needs a model: give --model models/forward, or state model = "models/forward" in the '
            f"table [live] of {rig_file}."
        )
    common = Settings(path, places={} if options.get("model") else {"model": f"{rig_file}, live"})
    with common.naming("model"):
        model = open_model(path)
    kinds = {**fields.hints(Settings), **fields.hints(model.live.settings)}
    parsed = {name: parse_option(name, text, kinds[name]) if name in kinds else text for name, text in options.items()}
    settings = Settings.from_sources(model.live.settings, rig.live, rig_file, parsed)
    if settings.realtime:
        with settings.naming("realtime"):
            scheduling.check_realtime()
    with settings.naming("publish"):
        for address in settings.publish:
            publishing.parse_publish_address(address)
    plan = model.live.plan(model.dataset, rig, settings)
    streams = {name: {"task": model.task, "output": name, **options} for name, options in plan.streams.items()}
    complete_rig = add_streams(recorder.complete_rig(plan.rig), streams)
    settings = with_absolute_paths(replace(settings, task=plan.settings))
    session = SessionOptions(model.task, complete_rig.text, tuple(plan.rig.streams), tuple(streams), settings)
    return PreparedSession(complete_rig, session, {"live_model": model.dataset.digest, **plan.attributes})


def open_model(path: str) -> LiveModel:
    """Return the model at a path. Raises `UsageError` if it is not a model, or its task does not run live."""
    dataset = open_dataset(path)
    name = model_files.task_name(dataset.files, path)
    live: LiveTask | None = registry.load_task(name).live
    if live is None:
        raise UsageError(f"{path} was trained for {plain(name)}, whose models do not run live.")
    return LiveModel(name, live, dataset)


def with_absolute_paths(settings: Settings) -> Settings:
    """Return settings in which the paths of the model and of the task's files are absolute."""
    task = {
        name: str(Path(getattr(settings.task, name)).absolute())
        for name in PATHS
        if getattr(settings.task, name, "") and name in {field.name for field in dataclasses.fields(settings.task)}
    }
    return replace(settings, model=str(Path(settings.model).absolute()), task=replace(settings.task, **task))


def add_streams(rig: Rig, streams: Mapping[str, Options]) -> Rig:
    """Return a rig with additional streams of the sensor ``live``, given by their options, at free local ports.

    Raises `UsageError` if the rig already has a stream of that name, and for messages too large for a packet.
    """
    conflicting = [name for name in streams if name in rig.streams]
    if conflicting:
        raise UsageError(
            f"The rig file has a stream {conflicting[0]}, as a live session adds itself; give it another name."
        )
    new_streams = {
        name: RigStream(
            name, "live", rigs.build_sensor("live", options, "live"), Address("udp", f"127.0.0.1:{port}"), dict(options)
        )
        for (name, options), port in zip(streams.items(), free_ports(len(streams)), strict=True)
    }
    extended = replace(rig, streams={**rig.streams, **new_streams})
    return replace(extended, text=rigs.to_toml(extended))


def free_ports(count: int) -> list[int]:
    """Return free local UDP ports."""
    with contextlib.ExitStack() as sockets:
        ports = []
        for _ in range(count):
            port = sockets.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            port.bind(("127.0.0.1", 0))
            ports.append(int(port.getsockname()[1]))
    return ports
