"""Names of the methods of the measured branch, which several modules go by."""

from __future__ import annotations

FIRST_CHANGE = "first change (6.2, 6.3)"
ONSET = "onset of motion"
MODEL = "model of the whole response"
MODEL_THIN = "model, thinned log"
BALANCE = "momentum balance (6.4)"
CORRECTED = "balance less viscous damping"
FRICTION = "balance with damping and friction"
LEAST_SQUARES = "balance, least squares"
SETTLE = "band about x₀ + F₀/K"
LARGEST = "largest reading"
WHOLE = "sum over the whole log"
COMPLETE = "bias taken off, tail added"
"""Methods, as the page names them."""

RECOMMENDED = frozenset({MODEL, SETTLE, LARGEST, COMPLETE})
"""What comparisons use where they can; it stands out in the figures."""


def nth(step: int, what: str) -> str:
    """Return words for one in so many rows or steps: every row, every 2nd row."""
    if step == 1:
        return f"every {what}"
    ending = {2: "nd", 3: "rd"}.get(step, "th")
    return f"every {step}{ending} {what}"
