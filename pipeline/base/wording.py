"""Write numbers in prose, with plurals, percentages, minus signs and non-breaking spaces."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence

_MINUS = re.compile(r"(?<![\w.\-/])-(?=\d|\.\d)|(?<=\d[eE])-(?=\d)")
"""Pattern of a hyphen before a separate number or in an exponent, but not in a name, date or option."""

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
"""Superscript characters of an exponent."""

_NUMBER = re.compile(r"[+−-]?\d+(?:\.\d+)?(?:e[+−-]?\d+)?")

_PARTS = re.compile(
    r"<(script|style|svg|pre|code)\b.*?</\1>|<[^>]*>"  # elements without prose, and tags with their attributes
    r"|(?P<prose>[^<]+)",
    re.DOTALL,
)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun in the singular or plural, such as ``1 trial`` or ``0 trials``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def duration(seconds: float) -> str:
    """Return a time in a suitable unit, such as ``2.5 s`` or ``419 µs``."""
    for factor, unit in ((1.0, "s"), (1e3, "ms")):
        if seconds * factor >= 1:
            return f"{seconds * factor:.2g} {unit}" if seconds * factor < 100 else f"{seconds * factor:.0f} {unit}"
    return f"{seconds * 1e6:.2g} µs" if seconds < 1e-4 else f"{seconds * 1e6:.0f} µs"


def error_text(error: float | None) -> str:
    """Return an error rounded to one significant digit, such as ``3·10⁻⁹``."""
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
    """Return a power of ten, such as ``10⁻⁹``."""
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def listed(names: Sequence[str]) -> str:
    """Join names for a sentence, such as ``1``, ``1 and 2`` or ``1, 2 and 3``."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def commonest(reasons: Iterable[str]) -> str:
    """Return the most frequent reason that is not empty. If several reasons are equally frequent, return the first of
    them.

    >>> commonest(["", "b", "a", "a", "b"])
    'b'
    """
    return max(counts, key=counts.__getitem__) if (counts := Counter(filter(None, reasons))) else ""


def of_most(reasons: Iterable[str]) -> str:
    """Return the most frequent reason of the trials as the end of a sentence, or an empty text if there is no reason.

    >>> of_most(["", "too short"]), of_most([""])
    ('; most trials: too short', '')
    """
    reason = commonest(reasons)
    return f"; most trials: {reason}" if reason else ""


def first_clause(text: str) -> str:
    """Return the text before the first semicolon that is not in brackets.

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
    """Return a share as a percentage, such as ``5.6 %``, with the minus sign U+2212."""
    return true_minus(f"{100 * share:.{places}f} %")


def true_minus(text: str) -> str:
    """Replace the hyphens before numbers in a sentence by the minus sign U+2212.

    Do not use this function for machine-readable text, in which numbers keep the hyphen.
    """
    return _MINUS.sub("\N{MINUS SIGN}", text)


def unbroken(page: str) -> str:
    """Insert non-breaking spaces between numbers and units, and between symbols and values.

    Parameters
    ----------
    page : str
        HTML page. Its tags, attributes, scripts, styles, drawings and code are unchanged.
    """
    return _PARTS.sub(lambda part: _joined(part["prose"]) if part["prose"] else part[0], page)


def shared_notes(notes: Sequence[str]) -> dict[str, str]:
    """Merge notes that differ only in numbers.

    The numbers that differ are replaced by their range. For example, the notes on 0.2 % and on 0.4 % become one note on
    0.2 to 0.4 %. Notes with different ranges are not merged because a range of ranges is unreadable.

    Returns
    -------
    dict
        Maps each original note to its merged note.
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
    """Return the common text of notes that differ only in numbers, with the ranges of the numbers."""
    values = zip(*(_NUMBER.findall(note) for note in notes), strict=True)
    ends = [sorted(found, key=lambda text: float(text.replace("\N{MINUS SIGN}", "-"))) for found in values]
    ranges = iter(found[0] if found[0] == found[-1] else f"{found[0]} to {found[-1]}" for found in ends)
    return _NUMBER.sub(lambda _: next(ranges), notes[0])


def _joined(text: str) -> str:
    return _UNBROKEN.sub("\N{NO-BREAK SPACE}", text)
