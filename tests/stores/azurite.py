"""Run Azurite, Microsoft's emulator of Azure Blob Storage (`npm install -g azurite`), for a test."""

import base64
import contextlib
import hashlib
import hmac
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from email.utils import formatdate
from pathlib import Path

from tests.stores.places import free_ports

ACCOUNT, CONTAINER = "devstoreaccount1", "lab"
KEY = "Eby8vdM02xNOcqFlqUwJPLlmEtlCDXJ1OUzFT50uSRZ6IFsuFq2UVErCz4I6tq/K1SZFPTOtr/KBHBeksoGMGw=="  # a public key
_VERSION = "2021-08-06"


def program() -> str | None:
    """Return the program, None where it is not installed."""
    return shutil.which("azurite-blob")


def environment(endpoint: str) -> dict[str, str]:
    """Return the variables by which clients find the emulator, and its credentials."""
    return {
        "AZURE_STORAGE_ACCOUNT_KEY": KEY,
        "AZURE_STORAGE_USE_EMULATOR": "true",
        "AZURITE_BLOB_STORAGE_URL": endpoint,
    }


@contextlib.contextmanager
def served(root: Path) -> Iterator[str]:
    """Run the emulator with a container ``lab``; yield the address."""
    executable = program()
    assert executable is not None
    (port,) = free_ports(1)
    words = [executable, "--blobPort", str(port), "--location", str(root), "--silent", "--skipApiVersionCheck"]
    with (root / "log").open("wb") as log:
        process = subprocess.Popen(words, cwd=root, stdout=log, stderr=log, start_new_session=True)
    try:
        endpoint = f"http://127.0.0.1:{port}"
        for _ in range(1200):
            assert process.poll() is None, "Azurite ended"
            with contextlib.suppress(OSError):
                _make_container(endpoint)
                break
            time.sleep(0.1)
        yield endpoint
    finally:
        process.terminate()
        process.wait(30)


def _make_container(endpoint: str) -> None:
    date = formatdate(usegmt=True)
    resource = f"/{ACCOUNT}/{ACCOUNT}/{CONTAINER}\nrestype:container"
    text = "PUT" + "\n" * 12 + f"x-ms-date:{date}\nx-ms-version:{_VERSION}\n{resource}"
    signature = base64.b64encode(hmac.new(base64.b64decode(KEY), text.encode(), hashlib.sha256).digest()).decode()
    headers = {
        "x-ms-date": date,
        "x-ms-version": _VERSION,
        "Authorization": f"SharedKey {ACCOUNT}:{signature}",
        "Content-Length": "0",
    }
    url = f"{endpoint}/{ACCOUNT}/{CONTAINER}?restype=container"
    with urllib.request.urlopen(urllib.request.Request(url, method="PUT", headers=headers), timeout=60):
        pass
