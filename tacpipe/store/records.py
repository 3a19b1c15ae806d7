"""The records of a store: what each states, how it is written and read, and the records that name an object."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NotRequired, TypedDict, cast, final

from tacpipe.io.hashing import bytes_digest, canonical, digest

if TYPE_CHECKING:
    from tacpipe.io import Json
    from tacpipe.plugins.stage import Attribute, StoredParams, Values

_RECORD = re.compile(rb'\{"check":"(?P<check>[0-9a-f]{64})","digest":"(?P<digest>[0-9a-f]{64})","identity":')
_parse_at = json.JSONDecoder().raw_decode  # maps a text and a start to the value there and its end


# ---- the content of a record


class Content(TypedDict):
    """An object that is a file of a dataset. Key inputs contain only its digest."""

    digest: str
    bytes: NotRequired[int]


class Shard(Content):
    """The object of a recording's stream. Key inputs contain only its digest."""

    rows: NotRequired[int]


class RecordingEntry(TypedDict):
    """A recording in a dataset or a record."""

    attributes: Mapping[str, Attribute]
    shards: Mapping[str, Shard]  # shards by name of the stream


class StoredResult(TypedDict):
    """The ``result`` of a record. The recording of a stage that works recording by recording has the name ``""``."""

    recordings: Mapping[str, RecordingEntry]
    files: Mapping[str, Content]


class Step(TypedDict):
    """A stage that the recordings of a dataset went through: a link of the dataset's ``chain``."""

    stage: str
    version: int
    params: StoredParams
    fitted: Mapping[str, str] | None  # digests of the files that the stage was fitted to


@final
class StageIdentity(TypedDict):
    """The identity of a stage's result, whose digest is its key."""

    stage: str
    version: int
    params: StoredParams
    inputs: Values  # values by argument, in a form that depends on its kind in `tacpipe.plugins.stage`


@final
class RunIdentity(TypedDict):
    """The identity of a whole command, whose digest is its key."""

    run: str  # name of the stage
    version: Sequence[int | None]  # versions of the stage and of its fit
    params: StoredParams
    datasets: Sequence[str]  # digests of manifests
    named: Mapping[str, str]  # digests of the manifests of models and splits, by name of the option
    sources: Mapping[str, Mapping[str, str]]  # digests of raw files by recording
    fold: int
    role: str | None
    equal: NotRequired[
        Sequence[Sequence[str]]
    ]  # groups of recordings with equal content that keep a split from separating them


@final
class GroupIdentity(TypedDict):
    """The identity of the results of a group of recordings, whose digest is their key."""

    group: str  # name of the stage
    step: Step
    recordings: str  # digest of the inputs of all recordings


Identity = StageIdentity | RunIdentity | GroupIdentity


class Processor(TypedDict, total=False):
    """The processor that computed a result."""

    model: str
    instructions: list[str]  # vector instructions that numerical kernels are chosen by
    chosen: dict[str, str]  # environment variables that choose kernels
    threads: int


class Environment(TypedDict, total=False):
    """The computer and the software that computed a result. Older versions state less of it."""

    libraries: dict[str, str]  # versions by name
    git_commit: str | None
    host: str
    python: str
    device: str
    processor: Processor
    seconds: float
    worker: str  # name of the executor's worker


class Provenance(Environment, total=False):
    """The computer and the code that computed the result of a stage."""

    irreplaceable: bool  # no stage can compute it again
    code: str | None  # digest of the file of the stage
    packages: dict[str, str]  # digests of the code of plug-ins by package
    notes: list[str]
    rows: Json  # `StageRows`; missing in older records, and if the stage states nothing
    stage_rows: dict[str, Json]  # rows of an acquired dataset up to this recording
    columns: dict[str, list[str]]  # names of columns by stream, of a recording that was read from files


class Summary(TypedDict, total=False):
    """The code that computed several results, the notes on them, and the rows that they account for."""

    code: dict[str, dict[str, int]]  # number of results by stage and digest of its code
    packages: dict[str, dict[str, int]]  # number of results by package and digest of its code
    notes: dict[str, list[str]]  # names of recordings by note
    stage_rows: dict[str, Json]  # `StageRows` by stage


class RunProvenance(Environment, Summary):
    """The computer and the code that computed the results of a command or of a group of recordings."""


class ComputedResult(TypedDict):
    """The part of a record that a command uses after the result was computed."""

    result: StoredResult
    provenance: Provenance  # a `RunProvenance` for a `RunIdentity` or a `GroupIdentity`: see `summary`


class Record(ComputedResult):
    """A result and how it was made, stored under the digest of its identity."""

    identity: Identity
    digest: str  # digest of identity and result
    check: str  # digest of the provenance


# ---- how it is written and read


def record_content(
    identity: Identity, result: StoredResult, provenance: Provenance | RunProvenance
) -> tuple[Record, bytes]:
    """Return the record of the ``result`` of ``identity``, with digests of itself, and its canonical JSON."""
    record: Record = {
        "identity": identity,
        "result": result,
        "digest": digest({"identity": identity, "result": result}),
        "provenance": cast("Provenance", provenance),
        "check": digest(provenance),
    }
    return record, canonical(record)


def summary(record: Record) -> Summary:
    """Return the code and the notes in the record of a command or of a group of recordings; older records have none."""
    return cast("RunProvenance", record["provenance"])


def parse_record(content: bytes, key: str) -> Record | None:
    """Parse the record of ``key``, or return None if it is damaged.

    The digests of canonical JSON, as `record_content` returns it, are those of its parts, so nothing is encoded again.
    Raises `ValueError` if it is not JSON.
    """
    head = _RECORD.match(content)
    if head is None:  # not canonical JSON, as records of format 1 may be
        record: Record = json.loads(content)
        return record if _is_sound(record, key) else None
    text = content.decode("ascii")
    identity, identity_end = _parse_at(text, head.end())
    provenance_start = _after(text, identity_end, ',"provenance":')
    provenance, provenance_end = _parse_at(text, provenance_start)
    result_start = _after(text, provenance_end, ',"result":')
    result, result_end = _parse_at(text, result_start)
    if text[result_end:] != "}":
        return None
    check, digest_of_body = head["check"].decode(), head["digest"].decode()
    identity_text = content[head.end() : identity_end]
    body = b'{"identity":%b,"result":%b}' % (identity_text, content[result_start:result_end])
    if (
        bytes_digest(identity_text) != key
        or bytes_digest(body) != digest_of_body
        or bytes_digest(content[provenance_start:provenance_end]) != check
    ):
        return None
    return {"identity": identity, "result": result, "digest": digest_of_body, "provenance": provenance, "check": check}


def _after(text: str, start: int, words: str) -> int:
    """Return where ``text`` continues after ``words``, which must be at ``start``. Raises `ValueError` if they are not."""
    if not text.startswith(words, start):
        raise ValueError(f"{words} is missing")
    return start + len(words)


def _is_sound(record: Record, key: str) -> bool:
    """Return whether a record belongs to the key and is unchanged since it was written."""
    identity, result = canonical(record["identity"]), canonical(record["result"])  # once: a store has many records
    body = b'{"identity":%b,"result":%b}' % (identity, result)
    is_valid = set(record) == {"identity", "result", "digest", "provenance", "check"}
    is_valid = is_valid and record["check"] == digest(record["provenance"])
    return is_valid and bytes_digest(identity) == key and bytes_digest(body) == record["digest"]


# ---- the objects that it names


def digests(result: StoredResult) -> Iterator[str]:
    """Yield the digests of all shards and files in a record's ``result``, or in a manifest."""
    return (content["digest"] for content in named_objects(result))


def named_objects(result: StoredResult) -> Iterator[Content]:
    """Yield the digests and sizes of all shards and files in a record's ``result``, or in a manifest."""
    for entry in result["recordings"].values():
        yield from entry["shards"].values()
    yield from result["files"].values()
