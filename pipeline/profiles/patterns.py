"""Patterns of profiles, found in time that grows with the length of the text alone.

Python's own engine tries every way to divide a text: ``^(a+)+$`` takes years for a file name of sixty letters, and
no bound on names helps. RE2 goes through a text once. It has no lookaheads, lookbehinds and backreferences.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import re2


@cache
def _compiled(pattern: str) -> Any:
    options = re2.Options()
    options.log_errors = False  # they are raised, too
    return re2.compile(pattern, options)


def find_groups(pattern: str, text: str) -> dict[str, str] | None:
    """Return what the named groups of a pattern take out of the first place where it fits, None where it fits nowhere.

    Groups that take no part are left out. Lone surrogates are no text: give what `file_names.storable` returns.
    """
    match = _compiled(pattern).search(text)
    return None if match is None else {key: value for key, value in match.groupdict().items() if value is not None}


def group_names(pattern: str) -> frozenset[str]:
    """Return the names of the groups of a pattern."""
    return frozenset(_compiled(pattern).groupindex)


def pattern_problem(pattern: str | None) -> str | None:
    """Return why a text is no pattern and what to do, or None where it is one."""
    try:
        _compiled(pattern or "")
    except re2.error as error:
        found = error.args[0].decode() if isinstance(error.args[0], bytes) else error.args[0]
        return (
            f"no regular expression: {found}. A pattern is found in one pass, which has no lookahead, lookbehind or "
            "backreference. Write out what stands there, or give the condition by [[file]]"
        )
    return None
