"""What a page is made of, read back from its HTML."""

from __future__ import annotations

import re
from html.parser import HTMLParser

VOID = ("meta", "br")


class Elements(HTMLParser):
    """Collects what a page loads, and checks that its elements close."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def check(page: str) -> None:
    """A page is whole, loads nothing, and has no number that is none."""
    elements = Elements()
    elements.feed(page)
    assert elements.open == []
    assert all(one.startswith("#") for one in elements.loads)
    assert "nan" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL).lower()


def cells(html: str, name: str) -> list[str]:
    """The cells of the row that begins with ``name``, as text, lines parted by a bar."""
    found = re.search(rf"<tr[^>]*><td>{re.escape(name)}</td>(.*?)</tr>", html)
    assert found, name
    return [re.sub(r"<br><small>(.*?)</small>", r" | \1", cell) for cell in re.findall(r"<td>(.*?)</td>", found[1])]
