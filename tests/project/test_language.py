"""The prose of the package and its pages avoids words that mean too many things (CONTRIBUTING.md, "Language")."""

from __future__ import annotations

import ast
import io
import json
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from places import ROOT

AVOIDED = re.compile(
    r"\b(told|untold|tells?|bears?|borne|anew|besides?|whoever|nobody|deeds?|foretold|alike|holds?|held|said|speaks?"
    r"|of its own|of their own|of one's own|rests? (?:up)?on|(?:cannot|can) be had|(?:is|are) had|stands? in the place"
    r"|stands? for all|courses?)\b",
    re.IGNORECASE,
)
TERMS = re.compile(
    r"zero[- ]order[- ]hold|sample[- ]and[- ]hold|holds? (?:a|the) lock|lock is held|of course|threshold", re.IGNORECASE
)
"""Terms of the field that contain such a word."""

EXCEPTIONS = {
    "docs/devices.md": (["told"], "key of the JSON document of `identify`, valid until version 2.0"),
    "docs/logs.md": (["hold"], "value of the profile's key `blanks`"),
    "pipeline/profiles/profile_model.py": (["hold"], "the same"),
    "pipeline/readers/rows.py": (["hold"], "the same"),
    "pipeline/planning/cost_search.py": (["holds"], "name of a field, in its description"),
    "pipeline/simulation/setup.py": (["held"], "name of an array, in its description"),
    "pipeline/surface/identify.py": (["told"] * 2, "key of the JSON document, and a column"),
    "schemas/device.json": (["held"], "title of the key held_samples"),
    "schemas/experiment.json": (["held"], "title of the key held_samples"),
    "pipeline/service/catalogue.py": (["said"] * 4, "name of a column in SQL"),
}
MOST_EXCEPTIONS = 20


def prose_of(path: Path) -> Iterator[str]:
    """Docstrings, comments and strings of three words or more of Python; the whole text of other files."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield text
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield token.string
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and len(node.value.split()) >= 3:
            yield node.value


def avoided_in(path: Path) -> list[str]:
    return [word.lower() for text in prose_of(path) for word in AVOIDED.findall(TERMS.sub("", text))]


def texts() -> list[Path]:
    found = [*(ROOT / "pipeline").rglob("*.py"), *(ROOT / "pipeline").rglob("*.j2"), *(ROOT / "docs").glob("*.md")]
    return [*found, *(ROOT / "schemas").rglob("*.json"), ROOT / "README.md"]


def test_prose_avoids_ambiguous_words() -> None:
    found = {path.relative_to(ROOT).as_posix(): avoided_in(path) for path in texts()}
    allowed = {name: Counter(words) for name, (words, _) in EXCEPTIONS.items()}
    more = {name: dict(Counter(words) - allowed.get(name, Counter())) for name, words in found.items()}
    assert json.dumps({name: words for name, words in more.items() if words}, indent=1) == "{}"


def test_exceptions_are_few_needed_and_explained() -> None:
    assert sum(len(words) for words, _ in EXCEPTIONS.values()) <= MOST_EXCEPTIONS
    for name, (words, reason) in EXCEPTIONS.items():
        assert not Counter(words) - Counter(avoided_in(ROOT / name)), name
        assert len(reason.split()) >= 2


def test_the_search_finds_words_where_they_are(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    file.write_text('"""What is told here."""\n# a lock is held by nobody\nX = "held"\n', encoding="utf-8")
    assert sorted(avoided_in(file)) == ["nobody", "told"]
