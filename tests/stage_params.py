"""A stage's params as a command would build them, for tests that call stages and tasks without one."""

from collections.abc import Mapping
from typing import Any

from tacpipe.plugins import given_params, registry
from tacpipe.plugins import params as params_of


def build_params(name: str, preset: str | None = None, /, **options: Any) -> Any:
    """Return the params of stage ``name`` with these options."""
    return given_params.build(name, registry.load(name), preset=preset, options=options)


def fitting(name: str, usual: Mapping[str, Any], **changed: Any) -> Any:
    """Return the params of stage ``name``; of the ``usual`` ones those that the chosen architecture has."""
    stage = registry.load(name)
    tag = params_of.tag(stage) or ""
    chosen = changed.get(tag, usual.get(tag, (params_of.defaults(stage, tag) or [""])[0]))
    counting = {
        key: value for key, value in usual.items() if chosen in (params_of.choices_with(stage, key) or [chosen])
    }
    return build_params(name, **{**counting, **changed})
