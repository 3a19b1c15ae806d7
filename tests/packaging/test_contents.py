"""The wheel contains every package of the sources, and `make test-install` tries each of the extras."""

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.packaging import environments

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def settings() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_package_of_the_sources_is_in_the_wheel(settings: dict[str, Any]) -> None:
    packages = settings["tool"]["setuptools"]["packages"]

    assert packages == sorted(set(packages))
    folders = [path.parent.relative_to(ROOT) for path in (ROOT / "tacpipe").rglob("__init__.py")]
    assert set(packages) == {*(".".join(folder.parts) for folder in folders), "tacpipe_stages"}


def test_every_folder_with_modules_is_a_package() -> None:
    folders = {path.parent for top in ("tacpipe", "stages") for path in (ROOT / top).rglob("*.py")}

    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_the_page_on_installation_has_a_row_for_every_extra(settings: dict[str, Any]) -> None:
    page = (ROOT / "docs/install.md").read_text()
    rows = set(re.findall(r"^\| `pip install '\.\[(\w+)\]'` \|", page, re.MULTILINE))

    assert rows == set(settings["project"]["optional-dependencies"]) - set(environments.NOT_FOR_USERS)


def test_every_extra_for_users_is_tried_in_an_environment_of_its_own(settings: dict[str, Any]) -> None:
    extras = set(settings["project"]["optional-dependencies"])

    assert set(environments.EXTRAS) == extras - set(environments.NOT_FOR_USERS)
