"""Test that images by HTTP are independent of how bytes are divided, and that invalid streams are rejected."""

import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import mjpeg
from tacpipe.links.link import LinkLostError, parse
from tacpipe.links.mjpeg import MultipartParser
from tacpipe.links.opening import open_link
from tacpipe.recording import rig
from tacpipe.sensors.camera import Camera, unpack_frame, unpack_settings
from tacpipe.video.images import ImageShape, read_shape
from tests.video import videos

OK = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"


def response(images: list[bytes], *, sized: bool = True, stamped: bool = False) -> bytes:
    """Return a response with these images, as mjpg-streamer (``sized``) or a small script writes it."""
    parts = []
    for number, image in enumerate(images):
        head = b"--frame\r\nContent-Type: image/jpeg\r\n"
        head += b"Content-Length: %d\r\n" % len(image) if sized else b""
        head += b"X-Timestamp: 1700000000.%06d\r\n" % number if stamped else b""
        parts.append(head + b"\r\n" + image + b"\r\n")
    return OK + b"".join(parts) + b"--frame\r\n"


@contextmanager
def serve(content: bytes, requests: list[bytes] | None = None) -> Iterator[str]:
    """Serve ``content`` to one host and close the connection; yield the address. Its request is added to ``requests``."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                request = connection.recv(4096)
                if requests is not None:
                    requests.append(request)
                connection.sendall(content)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield f"mjpeg:http://127.0.0.1:{server.getsockname()[1]}/stream"
        thread.join()


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    return videos.packets(videos.write(tmp_path_factory.mktemp("video") / "gel.avi", "mjpeg", 5))


@given(cuts=st.lists(st.integers(1, 3000), max_size=40), sized=st.booleans(), stamped=st.booleans())
def test_images_are_the_same_however_the_bytes_are_cut(
    images: list[bytes], cuts: list[int], sized: bool, stamped: bool
) -> None:
    parser, remaining, received = MultipartParser(), response(images, sized=sized, stamped=stamped), []
    for cut in [*cuts, 1 << 30]:
        received += parser.feed(remaining[:cut])
        remaining = remaining[cut:]
    assert [image for _, image in received] == images
    assert not parser.fault


@given(st.binary(max_size=300))
def test_any_bytes_are_images_or_a_fault_and_never_an_error(content: bytes) -> None:
    parser = MultipartParser()
    parser.feed(content)
    MultipartParser().feed(OK + content)


def test_each_image_is_an_entry_with_its_size_and_the_stamp_of_the_server(images: list[bytes]) -> None:
    with serve(response(images, stamped=True)) as address:
        link = open_link(parse(address), Camera(), "gel")
        entries: list[tuple[int, bytes]] = []
        with pytest.raises(LinkLostError, match="the server ended the connection"):
            while True:
                entries += link.read(1.0)
        link.close()
    settings = unpack_settings(entries[0][1])
    frames = [frame for _, packet in entries[1:] if (frame := unpack_frame(packet)) is not None]
    assert settings == {"stamps": "server"}
    assert [frame.content for frame in frames] == images
    assert [frame.t_device_ns for frame in frames] == [1_700_000_000 * 10**9 + row * 1000 for row in range(5)]
    assert all(late.t_us > early.t_us for early, late in itertools.pairwise(frames))
    assert read_shape(images[0]) == ImageShape(videos.WIDTH, videos.HEIGHT, "yuvj420p")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"HTTP/1.0 404 Not Found\r\nContent-Type: text/plain\r\n\r\nno", "404 Not Found"),
        (b"HTTP/1.0 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "text/html"),
        (b"HTTP/1.0 200 OK\r\n\r\n", "of no type"),
        (b"x" * (mjpeg.MAX_HEAD_BYTES + 1), "a head has more than"),
        (b"", "it ended the connection"),
    ],
)
def test_what_is_no_stream_of_images_is_refused_with_the_reason(content: bytes, reason: str) -> None:
    with serve(content) as address, pytest.raises(DeviceError, match=reason):
        open_link(parse(address), Camera(), "gel")


@pytest.mark.parametrize("place", ["https://a/b", "http://", "192.168.1.20:8080", "http://a:99999/"])
def test_an_address_that_is_none_is_refused(place: str) -> None:
    with pytest.raises(UsageError, match="it should read like mjpeg:http"):
        open_link(parse(f"mjpeg:{place}"), Camera(), "gel")


def test_a_padded_image_is_whole_and_a_cut_one_is_none(images: list[bytes]) -> None:
    assert read_shape(images[0] + bytes(100)) == read_shape(images[0])
    assert read_shape(images[0][: len(images[0]) // 2]) is None
    assert read_shape(b"") is None


SECRET_PLACES = [
    "mjpeg:http://lee:hidden@127.0.0.1:8080/stream",
    "mjpeg:http://hidden@127.0.0.1/",
    "mjpeg:http://127.0.0.1/stream?user=lee&pwd=hidden",
    "ws:lee:hidden@127.0.0.1:5000",
    "tcp:lee:hidden@127.0.0.1:5000",
]


@pytest.mark.parametrize("place", SECRET_PLACES)
def test_an_address_with_credentials_is_refused_without_printing_them(place: str, tmp_path: Path) -> None:
    sensor = Camera()
    with pytest.raises(UsageError, match="user name, a password or a token") as opened:
        open_link(parse(place), sensor, "gel")
    rig_path = tmp_path / "rig.toml"
    rig_path.write_text(f'[[stream]]\nname = "gel"\nsensor = "camera"\ntransport = "mjpeg:{place.partition(":")[2]}"\n')
    assert "hidden" not in str(opened.value)
    if "//" in place:
        with pytest.raises(UsageError, match="has an address that contains a user name") as read:
            rig.read(rig_path)
        assert "hidden" not in str(read.value)


def test_the_credentials_of_netrc_are_sent_to_their_host_only(
    images: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    netrc_path = tmp_path / ".netrc"
    for host, expected in (("127.0.0.1", b"Authorization: Basic bGVlOmhpZGRlbg=="), ("other.example", None)):
        netrc_path.write_text(f"machine {host} login lee password hidden\n")
        netrc_path.chmod(0o600)
        requests: list[bytes] = []
        with serve(response(images), requests) as place:
            open_link(parse(place), Camera(), "gel").close()
        fields = requests[0].split(b"\r\n")
        assert [field for field in fields if field.startswith(b"Authorization")] == ([expected] if expected else [])


def test_a_netrc_that_cannot_be_read_is_not_quoted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / ".netrc").write_text("machine 127.0.0.1 hidden\n")
    with pytest.raises(UsageError, match="cannot be read") as error:
        open_link(parse("mjpeg:http://127.0.0.1:9/"), Camera(), "gel")
    assert "hidden" not in str(error.value)
