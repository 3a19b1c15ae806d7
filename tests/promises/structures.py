"""Mutate the structures of containers: boxes of MP4, elements of Matroska, chunks of AVI, parts of XLSX, entries of JSON."""

import copy
import io
import json
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

NUMBERS = (0, 1, 2, 7, 255, 4096, 1 << 20, (1 << 31) - 1, 1 << 31, (1 << 32) - 1)
FILL_BYTES = 600  # length of a lost block


@dataclass(frozen=True)
class Part:
    """A structure with a name and a size in a file: a box, an element or a chunk."""

    name: bytes
    start: int
    size_at: int  # where its size is
    body: int
    end: int
    parents: tuple["Part", ...]


@dataclass(frozen=True)
class Grammar:
    """How a kind of file nests its parts."""

    parse: Callable[[bytes], list[Part]]
    write_size: Callable[[bytearray, Part, int], None]  # add a number to the size of a part
    fields: tuple[tuple[bytes, int, str], ...]  # name of a part, place of a number in its body, and its format
    payload: bytes  # name of the parts that hold frames


# ---- MP4 (ISO/IEC 14496-12)


def parse_boxes(content: bytes) -> list[Part]:
    """Return all boxes of an MP4 file."""
    nesting = {b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"udta", b"dinf"}

    def boxes(at: int, end: int, parents: tuple[Part, ...]) -> Iterator[Part]:
        while at + 8 <= end:
            part = Part(content[at + 4 : at + 8], at, at, at + 8, at + _number(">I", content, at), parents)
            yield part
            if part.name in nesting:
                yield from boxes(part.body, part.end, (*parents, part))
            at = part.end

    return list(boxes(0, len(content), ()))


def _write_box_size(content: bytearray, part: Part, change: int) -> None:
    struct.pack_into(">I", content, part.size_at, _number(">I", content, part.size_at) + change & 0xFFFFFFFF)


BOXES = Grammar(
    parse_boxes,
    _write_box_size,
    (
        *((name, place, ">I") for name in (b"stts", b"stsc", b"stss") for place in (4, 8, 12)),
        *((b"stsz", place, ">I") for place in (4, 8, 12, 20, 36)),
        *((b"stco", place, ">I") for place in (4, 8)),
        *((b"ctts", place, ">I") for place in (4, 8, 12)),
        *((b"mvhd", place, ">I") for place in (12, 16)),
        *((b"mdhd", place, ">I") for place in (12, 16)),
        *((b"tkhd", place, ">I") for place in (12, 20, 76, 80)),
        *((b"elst", place, ">I") for place in (4, 8, 12)),
        *((b"stsd", place, ">H") for place in (6, 40, 42)),
        *((b"stsd", place, ">I") for place in (8, 12)),
        (b"hdlr", 8, ">I"),
    ),
    b"mdat",
)


# ---- Matroska (RFC 8794, RFC 9559)

_MASTERS = ("18538067", "114D9B74", "1549A966", "1654AE6B", "AE", "E0", "1F43B675", "A0", "1C53BB6B", "BB", "B7")
_ELEMENT_FIELDS = {"4489": ">Q", "2AD7B1": ">I", "E7": ">B", "B0": ">B", "BA": ">B", "23E383": ">I", "D7": ">B"}


def parse_elements(content: bytes) -> list[Part]:
    """Return all elements of a Matroska file."""
    masters = set(map(bytes.fromhex, _MASTERS))

    def elements(at: int, end: int, parents: tuple[Part, ...]) -> Iterator[Part]:
        while at < end:
            size_at = at + 9 - content[at].bit_length()
            body = size_at + 9 - content[size_at].bit_length()
            size = int.from_bytes(content[size_at:body]) & ((1 << 7 * (body - size_at)) - 1)
            part = Part(content[at:size_at], at, size_at, body, min(end, body + size), parents)
            yield part
            if part.name in masters:
                yield from elements(body, part.end, (*parents, part))
            at = part.end

    return list(elements(0, len(content), ()))


def _write_element_size(content: bytearray, part: Part, change: int) -> None:
    width = part.body - part.size_at
    size = int.from_bytes(content[part.size_at : part.body]) & ((1 << 7 * width) - 1)
    largest = (1 << 7 * width) - 2
    content[part.size_at : part.body] = (max(0, min(size + change, largest)) | 1 << 7 * width).to_bytes(width)


ELEMENTS = Grammar(
    parse_elements,
    _write_element_size,
    (
        *((bytes.fromhex(name), 0, kind) for name, kind in _ELEMENT_FIELDS.items()),
        *((b"\xa3", place, kind) for place, kind in ((0, ">B"), (1, ">H"), (3, ">B"))),
    ),
    b"\xa3",
)


# ---- AVI (Microsoft, "AVI RIFF File Reference")


def parse_chunks(content: bytes) -> list[Part]:
    """Return all chunks of an AVI file."""

    def chunks(at: int, end: int, parents: tuple[Part, ...]) -> Iterator[Part]:
        while at + 8 <= end:
            size = _number("<I", content, at + 4)
            is_list = content[at : at + 4] in (b"RIFF", b"LIST")
            body = at + 12 if is_list else at + 8
            part = Part(content[at : at + 4], at, at + 4, body, at + 8 + size + size % 2, parents)
            yield part
            if is_list:
                yield from chunks(body, part.end, (*parents, part))
            at = part.end

    return list(chunks(0, len(content), ()))


def _write_chunk_size(content: bytearray, part: Part, change: int) -> None:
    struct.pack_into("<I", content, part.size_at, _number("<I", content, part.size_at) + change & 0xFFFFFFFF)


CHUNKS = Grammar(
    parse_chunks,
    _write_chunk_size,
    (
        *((b"avih", place, "<I") for place in (0, 12, 16, 24, 32, 36)),
        *((b"strh", place, "<I") for place in (0, 4, 8, 20, 24, 28, 32, 36, 44)),
        *((b"strf", place, "<I") for place in (0, 4, 8, 16, 20)),
        *((b"idx1", place, "<I") for place in (0, 4, 8, 12, 24, 28)),
    ),
    b"00dc",
)


# ---- Changes of any grammar


def mutants(content: bytes, grammar: Grammar, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield ``count`` mutants of a file, each with words for what was changed; half of them change a number."""
    random, parts = Random(0), grammar.parse(content)
    present = [field for field in grammar.fields if any(part.name == field[0] for part in parts)]
    changes = (_resize, _rename, _drop, _double, _swap, _lose_block)
    for number in range(count):
        if number % 2:
            name, place, kind = present[number // 2 % len(present)]
            part = random.choice([part for part in parts if part.name == name])
            yield _change_number(content, part, place, kind, random)
            continue
        names = sorted({part.name for part in parts})
        chosen = random.choice(names)  # so that one of many alike counts as much as a single one
        part = random.choice([part for part in parts if part.name == chosen])
        yield changes[number // 2 % len(changes)](content, grammar, part, random)


def _change_number(content: bytes, part: Part, place: int, kind: str, random: Random) -> tuple[str, bytes]:
    changed, at = bytearray(content), part.body + place
    old, most = _number(kind, content, at), (1 << 8 * struct.calcsize(kind)) - 1
    value = random.choice([number & most for number in (*NUMBERS, old + 1, old - 1, old * 2) if number & most != old])
    struct.pack_into(kind, changed, at, value)
    return f"number {part.name!r}+{place} {old} to {value}", bytes(changed)


def _resize(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    changed, change = bytearray(content), random.choice((-9, -8, -2, -1, 1, 2, 8, 100, 1 << 20, 1 << 30))
    grammar.write_size(changed, part, change)
    return f"size {part.name!r} by {change}", bytes(changed)


def _rename(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    changed, at = bytearray(content), part.size_at + (4 if part.size_at == part.start else -1)
    changed[at] ^= 1
    return f"name {part.name!r}", bytes(changed)


def _drop(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    return f"drop {part.name!r}", _replaced(content, grammar, part, b"")


def _double(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    return f"double {part.name!r}", _replaced(content, grammar, part, 2 * content[part.start : part.end])


def _swap(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    following = [other for other in grammar.parse(content) if other.start == part.end and other.parents == part.parents]
    if not following:
        return _double(content, grammar, part, random)
    other = following[0]
    swapped = content[other.start : other.end] + content[part.start : part.end]
    return f"swap {part.name!r} and {other.name!r}", content[: part.start] + swapped + content[other.end :]


def _lose_block(content: bytes, grammar: Grammar, part: Part, random: Random) -> tuple[str, bytes]:
    part = random.choice([part for part in grammar.parse(content) if part.name == grammar.payload])
    start = random.randrange(part.body, max(part.body + 1, part.end - FILL_BYTES))
    end = min(part.end, start + FILL_BYTES)
    return f"zeros in {part.name!r} from {start} to {end}", content[:start] + bytes(end - start) + content[end:]


def _replaced(content: bytes, grammar: Grammar, part: Part, new: bytes) -> bytes:
    """Return a file with other bytes in the place of a part, after which all sizes are right."""
    changed = bytearray(content)
    for parent in part.parents:
        grammar.write_size(changed, parent, len(new) - (part.end - part.start))
    changed[part.start : part.end] = new
    return bytes(changed)


def _number(kind: str, content: bytes | bytearray, at: int) -> int:
    return int(struct.unpack_from(kind, content, at)[0])


# ---- Entries of JSON

ODD_VALUES: Sequence[Any] = (
    *(None, True, "", "x", "9" * 400, "../../../etc/passwd", "/dev/zero", "{", "{0}", "{x:>999999999}", "a\0b"),
    *(0, -1, 1, 2.5, 29, 60, 1 << 31, 1 << 63, 10**30, 1e300, -1e300, float("nan"), float("inf"), 1e-300),
    *([], [0], [-1], [1 << 40], [1 << 40, 1 << 40], [3, 3], [None], ["a"], {}, {"a": {}}),
)
DROP = object()


def json_mutants(text: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield ``count`` mutants of a JSON file: an entry is left out, or has another type, number or list."""
    random, value = Random(0), json.loads(text)
    places = list(_places(value))
    for number in range(count):
        place, odd = places[number % len(places)], random.choice((DROP, *ODD_VALUES))
        changed = copy.deepcopy(value)
        parent = changed
        for key in place[:-1]:
            parent = parent[key]
        if odd is DROP:
            del parent[place[-1]]
        else:
            parent[place[-1]] = odd
        words = "left out" if odd is DROP else repr(odd)[:40]
        yield f"{'/'.join(map(str, place))} {words}", json.dumps(changed).encode()


def _places(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    for key in keys:
        yield (*place, key)
        yield from _places(value[key], (*place, key))


# ---- Parts of an Office Open XML workbook (ISO/IEC 29500)

_ENTITIES = b"".join(b'<!ENTITY e%d "%s">' % (n, b"&e%d;" % (n - 1) * 10 if n else b"a" * 40) for n in range(9))
BOMB = b'<?xml version="1.0"?><!DOCTYPE a [%s]><worksheet><v>&e8;</v></worksheet>' % _ENTITIES
ODD_TEXTS = (
    *(b"", b"-1", b"-2", b"0", b"1", b"3", b"99", b"1048577", b"99999999999"),
    *(b"1e300", b"nan", b"x", b"A0", b"XFD9", b"ZZZ9"),
)
IN_RANGE = (b"0", b"1", b"3")  # other texts of the workbook, which a cell may well have
# what identifies a cell, a row, a style, a kind, a sheet, a range, a relation or a shared text
_TEXT = re.compile(
    rb'(?<= )(?:r|s|t|ref|spans|count|uniqueCount|sheetId|r:id|Id|Target|PartName|numFmtId|state)="([^"]*)"|'
    rb'(?<=t="s">)<v>([^<]*)</v>'
)
_ELEMENT = re.compile(rb"<(row|c|si|xf|sheet|Relationship|Override|dimension|v)\b[^>]*?(?:/>|>.*?</\1>)", re.DOTALL)


def workbook_mutants(content: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield ``count`` mutants of a workbook: a part is missing, cut or a bomb, or an element or a number is changed."""
    random = Random(0)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    names = sorted(name for name in parts if "docProps" not in name and "theme" not in name)
    sheet = next(name for name in names if "sheet1.xml" in name)
    for number in range(count):
        changed = dict(parts)
        name = sheet if number % 2 else names[number // 2 % len(names)]
        text, kind = parts[name], random.choice(("number", "number", "number", "drop", "double", "swap", "part"))
        if kind == "part":
            kind = random.choice(("missing", "cut", "bomb"))
            changed[name] = {"missing": b"", "cut": text[: random.randrange(len(text))], "bomb": BOMB}[kind]
            if kind == "missing":
                del changed[name]
        elif kind == "number" and (places := list(_TEXT.finditer(text))):
            place = random.choice(places)
            group = 1 if place[1] is not None else 2
            odd = random.choice([text for text in ODD_TEXTS if group == 1 or text not in IN_RANGE])
            kind = f"{place[0].decode()} to {odd.decode()}"
            changed[name] = text[: place.start(group)] + odd + text[place.end(group) :]
        elif elements := list(_ELEMENT.finditer(text)):
            row = random.randrange(len(elements))
            first, second = elements[row], elements[min(row + 1, len(elements) - 1)]
            new = {"double": first[0] * 2, "swap": second[0] + first[0]}.get(kind, b"")
            changed[name] = text[: first.start()] + new + text[(second if kind == "swap" else first).end() :]
            kind = f"{kind} {first[0][:60].decode()}"
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            for part, part_text in changed.items():
                archive.writestr(part, part_text)
        yield f"{name}: {kind}", packed.getvalue()
