"""Split the content of a report page into named parts. Parts are table cells, embedded data and sentences.

`verify` splits two pages into parts, the report and a recomputed one, and compares the parts. Some parts, such as run
times, do not depend on logs; for those `digests` stores short hashes in the page.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from html.parser import HTMLParser

from pydantic import BaseModel, ValidationError

from pipeline.base.provenance import sha256

CELLS_META = "pipeline-cells"
DIGESTS_META = "pipeline-digests"
REQUEST_META = "pipeline-request"

FREE_TABLES = ("accuracy", "stages", "provenance")
"""Tables that do not depend on any log. They show run times, reused stages and file locations."""

FREE_SECTIONS = ("sec-accuracy", "sec-origin")
"""Sections whose sentences do not depend on any log."""

DIGITS = 8
"""Number of hexadecimal digits in the hash of a part. A change goes undetected with a probability of 1 in 4e9. The hash
of the page has 64 digits."""

_LEAVES = frozenset({"p", "li", "dt", "dd", "figcaption", "caption", "summary", "h1", "h2", "h3", "h4", "th", "td"})
"""Elements that contain one or a few sentences. Named cells do not count as sentences."""

_DRAWING = re.compile(r"<svg\b.*?</svg>", re.DOTALL)
_BLOCK = re.compile(r"<(script|style)\b([^>]*)>(.*?)</\1>", re.DOTALL)
_ID = re.compile(r'\bid="([^"]*)"')
_META = re.compile(rf'(<meta name="(?:{CELLS_META}|{DIGESTS_META})" content=")[^"]*(")')


class Digests(BaseModel):
    """Hashes stored in a page. There is one for each free part, and one for the whole page."""

    page: str = ""
    cells: dict[str, str] = {}
    texts: dict[str, str] = {}


@dataclass(frozen=True)
class Parts:
    """The parts of a page by name.

    Parameters
    ----------
    cells : dict of str to str
        Visible text of each named cell, including footnote marks.
    doubles : list of str
        Names that occur twice.
    data : dict of str to str
        Content of each script and style block by the id of the block, or by ``script-0``, ``style-0`` and so on.
    texts : dict of str to str
        Sentences outside named cells, named ``<section id>/<number>``.
    metas : dict of str to str
        Content of the ``<meta>`` elements of `pipeline`.
    """

    cells: dict[str, str]
    doubles: list[str]
    data: dict[str, str]
    texts: dict[str, str]
    metas: dict[str, str] = field(default_factory=dict)

    @property
    def digests(self) -> Digests | None:
        """Return the hashes in the page, or None if there are none or they are unreadable."""
        try:
            return Digests.model_validate_json(self.metas.get(DIGESTS_META, ""))
        except ValidationError:
            return None

    @property
    def request(self) -> Mapping[str, object] | None:
        """Return the request of the report, or None if the page does not contain it."""
        try:
            found = json.loads(self.metas.get(REQUEST_META, ""))
        except json.JSONDecodeError:
            return None
        return found if isinstance(found, dict) else None


def take_apart(page: str) -> Parts:
    """Return the parts of a page made by `report.render`. Other HTML documents have few parts or none."""
    data: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for kind, attributes, content in _BLOCK.findall(page):
        named = _ID.search(attributes)
        data[named[1] if named else f"{kind}-{counts[kind]}"] = content
        counts[kind] += not named
    # drawings take up most of a page and contain no cells
    reader = _Reader(_DRAWING.sub("", _BLOCK.sub("", page)))
    return Parts(reader.cells, reader.doubles, data, reader.texts, reader.metas)


def digests_of(page: str, parts: Parts | None = None) -> Digests:
    """Return the hashes of a page, computed with empty hashes in its head.

    Parameters
    ----------
    page : str
    parts : Parts, optional
        Parts of this page, if known.
    """
    found = parts or take_apart(page)
    cells = {name: short(text) for name, text in found.cells.items() if is_free_cell(name)}
    texts = {name: short(text) for name, text in found.texts.items() if is_free_text(name)}
    return Digests(page=page_digest(page), cells=cells, texts=texts)


def page_digest(page: str) -> str:
    """Return the SHA-256 of a page without the hashes in its head."""
    return sha256(_META.sub(r"\1\2", page).encode())


def short(text: str) -> str:
    """Return the short hash of a part."""
    return sha256(text.encode())[:DIGITS]


def is_free_cell(name: str) -> bool:
    """Return True if a cell does not depend on any log."""
    return name.partition("/")[0] in FREE_TABLES


def is_free_text(name: str) -> bool:
    """Return True if a sentence of the report does not depend on any log."""
    return name.partition("/")[0] in FREE_SECTIONS


class _Reader(HTMLParser):
    """Parser that collects cells, sentences and the page's own ``<meta>`` elements."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.cells: dict[str, str] = {}
        self.doubles: list[str] = []
        self.texts: dict[str, str] = {}
        self.metas: dict[str, str] = {}
        self._sections: list[str] = []
        self._numbers: Counter[str] = Counter()
        self._row = ""
        self._cell: str | None = None
        self._cell_parts: list[str] = []
        self._text_parts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        name = found.get("name") or ""
        if tag == "meta" and name.startswith("pipeline-"):
            self.metas[name] = found.get("content") or ""
        elif tag == "section":
            self._end_text()
            self._sections.append(found.get("id") or "section")
        elif tag == "tr":
            self._row = found.get("data-row") or ""
        elif tag in _LEAVES:
            self._end_text()
            if found.get("data-cell"):
                self._cell, self._cell_parts = f"{self._row}/{found['data-cell']}", []

    def handle_data(self, data: str) -> None:
        (self._text_parts if self._cell is None else self._cell_parts).append(data)

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self._cell is not None:
            if self._cell in self.cells:
                self.doubles.append(self._cell)
            self.cells[self._cell] = _plain(self._cell_parts)
            self._cell = None
        elif tag in _LEAVES:
            self._end_text()
        elif tag == "section" and self._sections:
            self._end_text()
            self._sections.pop()

    def close(self) -> None:
        super().close()
        self._end_text()

    def _end_text(self) -> None:
        text = _plain(self._text_parts)
        self._text_parts = []
        if text:
            section = self._sections[-1] if self._sections else "page"
            self.texts[f"{section}/{self._numbers[section]}"] = text
            self._numbers[section] += 1


def _plain(parts: list[str]) -> str:
    return " ".join(" ".join(parts).split())
