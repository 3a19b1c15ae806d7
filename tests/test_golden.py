import json

import pytest

from tests import golden_values


@pytest.fixture(scope="module")
def current() -> dict[str, dict[str, object]]:
    return golden_values.current()


@pytest.mark.parametrize("name", golden_values.COMMANDS)
def test_a_version_and_a_result_change_together(name: str, current: dict[str, dict[str, object]]) -> None:
    pinned = json.loads(golden_values.FILE.read_text())[name]
    if pinned["version"] == current[name]["version"]:
        assert pinned["digest"] == current[name]["digest"], (
            f"{name} gives other values than before under the same version. If that is meant, raise its version and run "
            f"`make bless`; if not, the change is a mistake."
        )
    else:
        raise AssertionError(f"The version of {name} was raised: run `make bless` to pin its new values.")
