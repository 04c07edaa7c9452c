"""Numbers in sentences for readers: plurals, percent, the minus sign, non-breaking spaces."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence

_MINUS = re.compile(r"(?<![\w.\-/])-(?=\d|\.\d)|(?<=\d[eE])-(?=\d)")
"""A hyphen before a separate number or in an exponent, but not inside names, dates and options."""

_UNITS = r"%|N/m|Nm/rad|Ns/m|Nms/rad|kg|kN/m|samples?|trials?|percentage points|points|ms|mm|s|m|N|Nm|Hz|s⁻¹|rad"

_UNBROKEN = re.compile(
    rf"(?<=[\d∞]) (?=(?:{_UNITS})(?![\w/]))"  # number and unit
    r"|(?<=\bkg) (?=m²)"
    r"|(?<=\b[\w*]) (?=[=≤≥] [\d−+])|(?<=\b[\w*] [=≤≥]) (?=[\d−+])"  # symbol and value
    r"|(?<=\b[KB]) (?=[−+]\d)"
    r"|(?<=\b[αβγδ]) (?== )|(?<=\b[αβγδ] =) (?=\w)|(?<=\b[KkBb]) (?=T[²/])"  # normalised quantities
    r"|(?<=\bFig\.) (?=\d)|(?<=\bFigs\.) (?=\d)|(?<=\bTable) (?=[A-D5]\.)"
)

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""Digits of an exponent."""

_NUMBER = re.compile(r"[+−-]?\d+(?:\.\d+)?(?:e[+−-]?\d+)?")

_PARTS = re.compile(
    r"<(script|style|svg|pre|code)\b.*?</\1>|<[^>]*>"  # elements without prose, and tags with their attributes
    r"|(?P<prose>[^<]+)",
    re.DOTALL,
)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is one: ``1 trial``, ``0 trials``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def duration(seconds: float) -> str:
    """Return a time with a suitable unit: ``2.5 s``, ``419 µs``."""
    for factor, unit in ((1.0, "s"), (1e3, "ms")):
        if seconds * factor >= 1:
            return f"{seconds * factor:.2g} {unit}" if seconds * factor < 100 else f"{seconds * factor:.0f} {unit}"
    return f"{seconds * 1e6:.2g} µs" if seconds < 1e-4 else f"{seconds * 1e6:.0f} µs"


def error_text(error: float | None) -> str:
    """Return an error with its order of magnitude, as ``3·10⁻⁹``."""
    if error is None:
        return "no number"
    if error == 0:
        return "0"
    digits, exponent = f"{error:.0e}".split("e")
    if exponent == "+00":
        return digits
    lead = "" if digits == "1" else f"{digits}·"
    return f"{lead}{power_of_ten(int(exponent))}"


def power_of_ten(exponent: int) -> str:
    """Return 10 with its exponent: ``10⁻⁹``."""
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def listed(names: Sequence[str]) -> str:
    """Return names as in a sentence: ``1``, ``1 and 2``, ``1, 2 and 3``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def commonest(reasons: Iterable[str]) -> str:
    """Return the most frequent reason, the first of equally frequent ones; empty if there is none.

    >>> commonest(["", "b", "a", "a", "b"])
    'b'
    """
    return max(counts, key=counts.__getitem__) if (counts := Counter(filter(None, reasons))) else ""


def of_most(reasons: Iterable[str]) -> str:
    """Return the reason of most trials as the end of a sentence; empty if there is none.

    >>> of_most(["", "too short"]), of_most([""])
    ('; most trials: too short', '')
    """
    reason = commonest(reasons)
    return f"; most trials: {reason}" if reason else ""


def first_clause(text: str) -> str:
    """Return the text before the first semicolon outside brackets.

    >>> first_clause("it is clipped (43 of 61 logs; at 8 N); more")
    'it is clipped (43 of 61 logs; at 8 N)'
    """
    depth = 0
    for place, sign in enumerate(text):
        depth += (sign == "(") - (sign == ")")
        if sign == ";" and depth == 0:
            return text[:place]
    return text


def percent(share: float, places: int = 0) -> str:
    """Return a share as a percentage: ``5.6 %``, with a true minus sign."""
    return true_minus(f"{100 * share:.{places}f} %")


def true_minus(text: str) -> str:
    """Return a sentence in which negative numbers have the minus sign U+2212.

    Not for machine-readable text, where numbers keep the hyphen.
    """
    return _MINUS.sub("\N{MINUS SIGN}", text)


def unbroken(page: str) -> str:
    """Return a page in which no line breaks between number and unit, or symbol and value.

    Parameters
    ----------
    page : str
        HTML. Tags with their attributes, scripts, styles, drawings and code stay as they are.
    """
    return _PARTS.sub(lambda part: _joined(part["prose"]) if part["prose"] else part[0], page)


def shared_notes(notes: Sequence[str]) -> dict[str, str]:
    """Map each note to a common note of all notes that differ only in numbers.

    Different numbers are replaced by their range: notes on 0.2 % and on 0.4 % share one on 0.2 to 0.4 %. Notes with
    different ranges are not merged, since a range of ranges is unreadable.
    """
    alike: dict[str, list[str]] = {}
    for note in dict.fromkeys(notes):
        alike.setdefault(_NUMBER.sub("#", note), []).append(note)
    shared: dict[str, str] = {}
    for pattern, group in alike.items():
        apart = len(group) == 1 or "# to #" in pattern
        shared |= {note: note if apart else _with_ranges(group) for note in group}
    return shared


def _with_ranges(notes: Sequence[str]) -> str:
    """Return the common text of notes with the same count of numbers, with ranges in place of the numbers."""
    values = zip(*(_NUMBER.findall(note) for note in notes), strict=True)
    ends = [sorted(found, key=lambda text: float(text.replace("\N{MINUS SIGN}", "-"))) for found in values]
    ranges = iter(found[0] if found[0] == found[-1] else f"{found[0]} to {found[-1]}" for found in ends)
    return _NUMBER.sub(lambda _: next(ranges), notes[0])


def _joined(text: str) -> str:
    return _UNBROKEN.sub("\N{NO-BREAK SPACE}", text)
