"""A browser sees the newest frame of each camera while a rig runs."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest

from tacpipe.errors import UsageError
from tacpipe.links.link import parse
from tacpipe.recording.pictures import serve_pictures
from tacpipe.recording.rig import RigStream, build_sensor
from tacpipe.recording.watch import Watch

FIRST, SECOND = b"\xff\xd8first\xff\xd9", b"\xff\xd8second\xff\xd9"


def watch(kind: str) -> Watch:
    address = parse("mjpeg:http://127.0.0.1:8080/stream" if kind == "camera" else "udp:127.0.0.1:9000")
    return Watch(RigStream("gel", kind, build_sensor(kind, {}, "stream gel"), address))


@pytest.fixture
def camera() -> Watch:
    return watch("camera")


@pytest.fixture
def address(camera: Watch) -> Iterator[str]:
    with serve_pictures({"gel": camera}, 0) as page:
        yield urlsplit(page).netloc


def get(address: str, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(address, timeout=60)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def next_frame(response: http.client.HTTPResponse) -> bytes:
    assert response.readline() == b"--tacpipe-frame\r\n"
    assert response.readline() == b"Content-Type: image/jpeg\r\n"
    size = int(response.readline().removeprefix(b"Content-Length: "))
    assert response.readline() == b"\r\n"
    return response.read(size + 2).removesuffix(b"\r\n")


def test_the_page_names_each_camera(address: str) -> None:
    assert b'<img src="/gel" alt=""><figcaption>gel</figcaption>' in get(address, "/").read()


def test_each_new_frame_is_sent_as_it_was_recorded(camera: Watch, address: str) -> None:
    camera.newest_packet = FIRST
    response = get(address, "/gel")
    assert next_frame(response) == FIRST
    camera.newest_packet = SECOND
    frames = [next_frame(response)]
    while frames[-1] != SECOND:
        frames.append(next_frame(response))
    assert set(frames) <= {FIRST, SECOND}


@pytest.mark.parametrize(("path", "host", "status"), [("/other", None, 404), ("/gel", "evil.example:80", 403)])
def test_other_names_and_pages_of_other_sites_get_nothing(address: str, path: str, host: str, status: int) -> None:
    assert get(address, path, host).status == status


def test_a_rig_without_a_camera_is_refused() -> None:
    with pytest.raises(UsageError, match="this rig has none"), serve_pictures({}, 8081):
        pass


def test_without_the_option_nothing_is_served(camera: Watch) -> None:
    with serve_pictures({"gel": camera}, None) as page:
        assert page == ""
