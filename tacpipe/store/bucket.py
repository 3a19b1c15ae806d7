"""Object storage as a backend, through `obstore`: objects are written completely, and one of several creations succeeds."""

from __future__ import annotations

import contextlib
import random
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import timedelta
from itertools import chain
from threading import Semaphore
from typing import Any, TypeVar

from tacpipe.errors import StorageError, UsageError
from tacpipe.io import memory, regular
from tacpipe.plugins import extras
from tacpipe.store import addresses
from tacpipe.store.addresses import BucketAddress
from tacpipe.store.backend import Entry

Result = TypeVar("Result")
TRIES = 5  # attempts per request
RETRIES = 2  # retries of the client within each attempt
PAUSE_S = 0.2  # pause after the first attempt; each further pause is four times longer
PART_BYTES = 8 << 20  # maximum size of an object that is sent in one request
PAGE = 1000  # names listed per request
_AHEAD = 4  # parts of an object transferred concurrently
_LARGE = 4  # multi-part objects transferred concurrently, which limits memory to 128 MB
_COPY_BYTES = 5 * 10**9  # largest object that S3 copies in one request
_STATUS = re.compile(r"status code: (\d{3}[ A-Za-z]*)")
_NO_BUCKET = ("NoSuchBucket", "bucket does not exist", "ContainerNotFound")
# hosts that are used last, if nothing else provides credentials
_METADATA = ("169.254.169.254", "metadata.google.internal")


class Bucket:
    """A folder in a bucket. Thread-safe; credentials stay in the client."""

    def __init__(self, address: BucketAddress | str, client: Any = None) -> None:
        self.place = str(address)
        self._client = client if isinstance(address, str) else _connect(address)
        self._large = Semaphore(_LARGE)

    def create(self, name: str, content: bytes | Iterable[bytes]) -> bool:
        """Implement `Backend.create`.

        Content larger than one part is uploaded in parts and replaces an object that was created in the meantime. An
        error of ``content`` aborts the upload. After a lost connection ``content`` is iterated again, unless it is an
        iterator.
        """
        if isinstance(content, bytes):
            return self._create(name, content)
        blocks = iter(content)
        first_part = _part(blocks)
        if len(first_part) <= PART_BYTES:
            return self._create(name, first_part)
        if self.stat(name) is not None:
            return False
        import obstore

        remaining: Iterable[bytes] = chain([first_part], blocks)

        def send() -> None:
            nonlocal remaining
            sent, remaining = remaining, content
            obstore.put(
                self._client, name, _parts(sent), use_multipart=True, chunk_size=PART_BYTES, max_concurrency=_AHEAD
            )

        with self._large:
            self._retry(send, tries=1 if blocks is content else TRIES)
        return True

    def _create(self, name: str, content: bytes) -> bool:
        """Create a name with one request; return False if it exists.

        Raises `StorageError` if the server refuses the request although nothing has the name.
        """
        import obstore

        tries = 0

        def put_object() -> bool | None:
            nonlocal tries
            tries += 1
            try:
                obstore.put(self._client, name, content, mode="create")
            except obstore.exceptions.AlreadyExistsError:
                if self.stat(name) is None:  # S3 also returns this if requests collide and nothing was stored
                    return None
                return tries > 1 and self.read(name) == content  # a request whose response was lost may have succeeded
            return True

        try:
            for _ in range(TRIES):
                created = self._retry(put_object)
                if created is not None:
                    return created
                time.sleep(PAUSE_S)
        except FileNotFoundError:
            raise StorageError(
                f"{self.place} answers 404 Not Found to an upload. Check the address and AWS_ENDPOINT_URL."
            ) from None
        raise StorageError(
            f"{self.place} refuses to create {name} as if it existed, but does not have it. Run the same command "
            f"again; uploaded objects stay."
        )

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Implement `Backend.read`."""
        return b"".join(self._blocks(name, max_bytes))

    def blocks(self, name: str, max_bytes: int) -> Iterator[bytes]:
        """Implement `Backend.blocks`; parts of a large object are prefetched."""
        return self._blocks(name, max_bytes)

    def _blocks(self, name: str, max_bytes: int | None) -> Iterator[bytes]:
        """Yield the content of a name, fetching parts concurrently.

        Raises `IrregularError` if it exceeds ``max_bytes``.
        """
        import obstore

        def fetch_first() -> tuple[bytes, int]:
            response = obstore.get(self._client, name)
            size = int(response.meta["size"])
            return bytes(response.bytes()) if size <= PART_BYTES else b"", size

        first, size = self._retry(fetch_first)
        if max_bytes is not None and size > max_bytes:
            raise regular.IrregularError(
                f"{self.place}/{name} has {size:,} bytes, and should have {max_bytes:,} at most. It is damaged "
                f"or forged."
            )
        if max_bytes is None:
            memory.require(size, f"{self.place}/{name}", error=StorageError)
        if size <= PART_BYTES:
            yield first
            return
        with self._large, ThreadPoolExecutor(_AHEAD) as threads:
            parts: deque[Future[bytes]] = deque()
            for start in range(0, size, PART_BYTES):
                parts.append(threads.submit(self._range, name, start, min(start + PART_BYTES, size)))
                if len(parts) > _AHEAD:
                    yield parts.popleft().result()
            while parts:
                yield parts.popleft().result()

    def _range(self, name: str, start: int, end: int) -> bytes:
        import obstore

        return self._retry(lambda: bytes(obstore.get_range(self._client, name, start=start, end=end)))

    def stat(self, name: str) -> Entry | None:
        """Implement `Backend.stat`, returning None if the name does not exist."""
        import obstore

        try:
            head = self._retry(lambda: obstore.head(self._client, name))
        except FileNotFoundError:
            return None
        return Entry(name, head["size"], head["last_modified"].timestamp())

    def list(self, folder: str) -> Iterator[Entry]:
        """Implement `Backend.list`; other names are also listed."""
        import obstore

        pages: Iterator[Sequence[Any]] | None = None
        listed: set[str] = set()

        def next_page() -> list[Entry]:
            nonlocal pages
            if pages is None:  # the first time, and after each failure
                pages = iter(obstore.list(self._client, folder, chunk_size=PAGE))
            try:
                page = next(pages, [])
            except BaseException:
                pages = None
                raise
            return [Entry(item["path"], item["size"], item["last_modified"].timestamp()) for item in page]

        while page := self._retry(next_page):  # one request per page, so that reading only some names costs no more
            new = [entry for entry in page if entry.name not in listed]
            listed.update(entry.name for entry in new)
            yield from new

    def move(self, name: str, to: str) -> bool:
        """Implement `Backend.move` as a copy on the server followed by a deletion."""
        import obstore

        entry = self.stat(name)
        if entry is None:
            return False
        try:
            if entry.bytes > _COPY_BYTES:
                self.create(to, self._blocks(name, None))
            else:
                self._retry(lambda: obstore.copy(self._client, name, to))
        except FileNotFoundError:
            return False
        self.delete(name)
        return True

    def delete(self, name: str) -> None:
        """Implement `Backend.delete`."""
        import obstore

        with contextlib.suppress(FileNotFoundError):
            self._retry(lambda: obstore.delete(self._client, name))

    def _retry(self, request: Callable[[], Result], tries: int = 0) -> Result:
        """Return the result of a request, repeating it if the connection or the server fails.

        Raises `FileNotFoundError` if the name does not exist, and the error of `_describe_error` if all ``tries`` (0:
        `TRIES`) fail.
        """
        import obstore
        from obstore.exceptions import BaseError

        pause_s = PAUSE_S
        for remaining_tries in reversed(range(tries or TRIES)):
            try:
                return request()
            except obstore.exceptions.GenericError as error:
                if remaining_tries == 0 or not _may_pass(error):
                    # the client's error is suppressed, because it may contain confidential text
                    raise self._describe_error(error) from None
            except FileNotFoundError as error:
                if any(mark in str(error) for mark in _NO_BUCKET):
                    raise self._describe_error(error) from None
                raise FileNotFoundError(f"{self.place} has no such name") from None
            except BaseError as error:
                raise self._describe_error(error) from None
            time.sleep(pause_s * random.uniform(0.5, 1.5))
            pause_s *= 4
        raise AssertionError

    def _describe_error(self, error: Exception) -> StorageError | UsageError:
        """Return an error that describes the server's response; only the status of its text is shown."""
        from obstore.exceptions import PermissionDeniedError, UnauthenticatedError

        text = str(error)
        status = _STATUS.search(text)
        answer = f" It answers {status[1].strip()}." if status else ""
        if any(mark in text for mark in _NO_BUCKET):
            return UsageError(
                f"There is no bucket at {self.place}. Create it, or correct its name or AWS_ENDPOINT_URL."
            )
        if any(mark in text for mark in _METADATA):
            return StorageError(
                f"No credentials were found for {self.place}. Set them in the environment (AWS_ACCESS_KEY_ID and "
                f"AWS_SECRET_ACCESS_KEY), or name a profile in AWS_PROFILE."
            )
        if isinstance(error, PermissionDeniedError | UnauthenticatedError):
            return StorageError(
                f"{self.place} refuses the credentials.{answer} Check those of the environment or of the profile, and what "
                f"they allow: reading, writing, listing and deleting below this address."
            )
        if status is None:
            return StorageError(
                f"{self.place} cannot be reached, the connection is lost again and again, or another program answers, such "
                f"as a login page. Check the network and AWS_ENDPOINT_URL, then run the same command again: what went over "
                f"stays there."
            )
        return StorageError(f"{self.place} fails.{answer} Run the same command again: what went over stays there.")


def _may_pass(error: Exception) -> bool:
    """Return whether a failed request may succeed if it is repeated.

    It may not if the server refused it (4xx, except timeouts and too many requests), and if the client could not even
    send it, because it found no credentials or could not build the request.
    """
    text = str(error)
    status = _STATUS.search(text)
    is_refusal = status is not None and status[1][0] == "4" and status[1][:3] not in ("408", "429")
    return not is_refusal and not any(mark in text for mark in (*_METADATA, "builder error"))


def _part(blocks: Iterator[bytes]) -> bytes:
    """Return the next ``blocks`` joined, up to slightly more than one part."""
    parts: list[bytes] = []
    size = 0
    for block in blocks:
        parts.append(block)
        size += len(block)
        if size > PART_BYTES:
            break
    return parts[0] if len(parts) == 1 else b"".join(parts)


def _parts(blocks: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the same bytes in pieces of about one part, because each step of the client costs a thread switch."""
    blocks = iter(blocks)
    while part := _part(blocks):
        yield part


def _connect(address: BucketAddress) -> Any:
    """Return obstore's client for an address, with credentials from the environment or a profile.

    Raises `UsageError` if the client refuses the settings.
    """
    with extras.explain_missing(f"A store at {address.scheme}://"):
        from obstore.exceptions import BaseError
        from obstore.store import from_url

    client_settings = addresses.settings(address)
    arguments: dict[str, Any] = {
        "config": client_settings.config,
        "client_options": {"timeout": "120s", "connect_timeout": "5s", "allow_http": client_settings.plaintext},
        "retry_config": {
            "max_retries": RETRIES,
            "retry_timeout": timedelta(seconds=60),
            "backoff": {"init_backoff": timedelta(milliseconds=100), "max_backoff": timedelta(seconds=2), "base": 2},
        },
    }
    if client_settings.provider is not None:
        arguments["credential_provider"] = client_settings.provider
    try:
        return from_url(client_settings.url or str(address), **arguments)
    except (BaseError, ValueError, TypeError):  # the error is suppressed, because it may contain a credential
        raise UsageError(
            f"The settings for {address} cannot be used. Look at the variables {_VARIABLES[address.scheme]} and the profile."
        ) from None


_VARIABLES = {"s3": "AWS_…", "gs": "GOOGLE_…", "az": "AZURE_…"}
