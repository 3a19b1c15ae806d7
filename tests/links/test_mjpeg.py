"""Test that images by HTTP are independent of how bytes are divided, and that invalid streams are rejected."""

import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacpipe.errors import DeviceError, UsageError
from tacpipe.links import mjpeg
from tacpipe.links.link import LinkLostError, parse
from tacpipe.links.mjpeg import MultipartParser
from tacpipe.links.opening import open_link
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
def serve(content: bytes) -> Iterator[str]:
    """Serve ``content`` to one host and close the connection; yield the address."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(4096)
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
