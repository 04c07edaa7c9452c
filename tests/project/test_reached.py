"""Every public function, class and method is reached from a command, a page, a route or the Python surface.

Names are followed through the source: a name leads to what the module defines or imports under it, an attribute to
what a module or any reached class has under it. What only tests name is reached by nobody.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator

import pytest
from test_architecture import FILES, PACKAGE

import pipeline

BY_NAME = ("shell.commands.", "readers.formats.", "readers.mapping")
"""Modules that are imported by a name put together at run time; a string or an attribute leads into them, and into
modules that are handed on as such."""

PLAIN = {
    "property",
    "cached_property",
    "cache",
    "lru_cache",
    "staticmethod",
    "classmethod",
    "contextmanager",
    "dataclass",
}
"""Decorators that call nothing by themselves; others, as of commands, routes and checks of records, register."""

LONGEST_NAME = 60
"""Characters of a string that may name something; longer ones are sentences."""

Key = tuple[str, ...]
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def is_def(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)


def registers(node: Definition) -> bool:
    names = (n.func if isinstance(n, ast.Call) else n for n in node.decorator_list)
    return any(getattr(n, "attr", getattr(n, "id", "")) not in PLAIN for n in names)


class Source:
    """What each module defines, what its names stand for, and which names each definition uses."""

    def __init__(self, texts: dict[str, str]) -> None:
        self.definitions: dict[Key, list[ast.AST]] = {}
        self.names: dict[str, dict[str, set[Key]]] = defaultdict(lambda: defaultdict(set))
        self.as_modules: set[str] = set()
        self.start: list[tuple[str, ast.AST]] = []
        self.foreign: set[Key] = set()
        for module, text in texts.items():
            self._read(module, ast.parse(text), set(texts))
        self.called: dict[str, list[Key]] = defaultdict(list)
        self.parts: dict[Key, list[Key]] = defaultdict(list)
        for key in self.definitions:
            if len(key) == 3 or key[0] in self.as_modules or key[0].startswith(BY_NAME):
                self.called[key[-1]].append(key)
            if len(key) == 3:
                self.parts[key[:2]].append(key)

    def _read(self, module: str, tree: ast.Module, modules: set[str]) -> None:
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").startswith("pipeline")):
                base = (node.module or "").removeprefix("pipeline").lstrip(".")
                base = ".".join(filter(None, (module.rpartition(".")[0], base))) if node.level else base
                for alias in node.names:
                    inner = f"{base}.{alias.name}".lstrip(".")
                    meant = (inner,) if inner in modules else (base, alias.name)
                    self.names[module][alias.asname or alias.name].add(meant)
                    self.as_modules |= set(meant) if len(meant) == 1 else set()
        for node in tree.body:
            if is_def(node):
                self._define(module, node)  # type: ignore[arg-type]
            elif isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for name in (n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)):
                    self.definitions[module, name] = [node.value]
            elif not isinstance(node, ast.Import | ast.ImportFrom):
                self.start.append((module, node))

    def _define(self, module: str, node: Definition) -> None:
        inner = [part for part in node.body if is_def(part)] if isinstance(node, ast.ClassDef) else []
        self.definitions[module, node.name] = [part for part in ast.iter_child_nodes(node) if part not in inner]
        if registers(node):
            self.start.append((module, ast.Name(node.name)))
        for part in inner:
            self.definitions[module, node.name, part.name] = [part]  # type: ignore[attr-defined]
        if isinstance(node, ast.ClassDef):
            bases = {getattr(base, "id", getattr(base, "attr", "")) for base in node.bases}
            own = set(self.names[module]) | {key[1] for key in self.definitions if key[0] == module}
            if bases - own - {"", "Protocol", "Enum", "StrEnum"}:
                self.foreign.add((module, node.name))


def words(text: str) -> Iterator[str]:
    return (match[0] for match in re.finditer(r"[A-Za-z]\w+", text))


class Reach:
    """All definitions that are reached."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.found: set[Key] = set()
        self.attributes: set[str] = set()
        self.waiting: list[tuple[str, ast.AST]] = []

    def from_start(self, keys: list[Key], attributes: set[str]) -> set[Key]:
        for name in attributes:
            self._attribute(name)
        for key in keys:
            self._add(key)
        self.waiting += self.source.start
        while self.waiting:
            module, node = self.waiting.pop()
            for part in ast.walk(node):
                self._use(module, part)
        return self.found

    def _use(self, module: str, node: ast.AST) -> None:
        if isinstance(node, ast.Name):
            self._add((module, node.id))
        elif isinstance(node, ast.Attribute):
            named = self.source.names[module].get(getattr(node.value, "id", ""), set())
            owners = [meant for meant in named if len(meant) == 1]
            for owner in owners:
                self._add((*owner, node.attr))
            if not owners:
                self._attribute(node.attr)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            for match in re.finditer(r"from pipeline\.([\w.]+) import (\w+)", node.value):
                self._add((match[1], match[2]))
            for word in words(node.value) if len(node.value) < LONGEST_NAME else ():
                self._attribute(word)

    def _attribute(self, name: str) -> None:
        if name in self.attributes:
            return
        self.attributes.add(name)
        for key in self.source.called[name]:
            if len(key) == 2 or key[:2] in self.found:
                self._add(key)

    def _add(self, key: Key) -> None:
        if key in self.found:
            return
        self.found.add(key)
        if key not in self.source.definitions:
            for meant in self.source.names[key[0]].get(key[-1], ()) if len(key) == 2 else ():
                self._add(meant)
            return
        self.waiting += [(key[0], node) for node in self.source.definitions[key]]
        for method in self.source.parts[key]:
            (node,) = self.source.definitions[method]
            called = method[2].startswith("__") or method[2] in self.attributes or key in self.source.foreign
            if called or registers(node):  # type: ignore[arg-type]
                self._add(method)


def unreached(texts: dict[str, str], keys: list[Key], attributes: set[str]) -> list[str]:
    source = Source(texts)
    found = Reach(source).from_start(keys, attributes)
    public = [
        key
        for key, nodes in source.definitions.items()
        if not any(part.startswith("_") for part in key[1:]) and (len(key) == 3 or not is_value(nodes))
    ]
    return sorted(".".join(key) for key in public if key not in found)


def is_value(nodes: list[ast.AST]) -> bool:
    """Whether a name stands for a value, not for a function or class."""
    return len(nodes) == 1 and isinstance(nodes[0], ast.expr)


@pytest.mark.slow
def test_nothing_public_is_there_for_tests_alone() -> None:
    texts = {name: path.read_text(encoding="utf-8") for name, path in FILES.items()}
    surface = [(module, name) for module, names in pipeline._PUBLIC.items() for name in names]
    offered = [key for key in Source(texts).definitions if key[:2] in surface]
    pages = {word for kind in ("*.j2", "*.toml") for path in PACKAGE.rglob(kind) for word in words(path.read_text())}
    commands = [("__main__", "run"), ("shell.cli", "COMMANDS"), ("shell.cli", "run"), ("shell.cli", "__getattr__")]
    assert unreached(texts, [*commands, *offered], pages) == []


def test_what_nobody_names_is_found() -> None:
    texts = {
        "a": "from pipeline.b import used, Thing\ndef run():\n    used()\n    Thing().asked()\n",
        "b": (
            "from pipeline import c\n"
            "def used():\n    return c.by_module()\n"
            "def forgotten():\n    return c.behind_it()\n"
            "class Thing:\n    def asked(self): ...\n    def never(self): ...\n"
        ),
        "c": "def by_module(): ...\ndef behind_it(): ...\ndef _private(): ...\n",
    }
    assert unreached(texts, [("a", "run")], set()) == ["b.Thing.never", "b.forgotten", "c.behind_it"]
    assert unreached(texts, [("a", "run")], {"never"}) == ["b.forgotten", "c.behind_it"]
