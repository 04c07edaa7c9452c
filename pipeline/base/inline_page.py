"""Content-Security-Policy and embedded JSON of web pages that load no external resources."""

from __future__ import annotations

import base64
import hashlib
import json
from typing import Any


def policy(inline: tuple[str, ...]) -> str:
    """Return the Content-Security-Policy of a page that permits only the given inline scripts.

    Inline styles are permitted because the plot library sets positions and colours by style attributes.
    """
    hashes = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
    allowed = " ".join(f"'sha256-{each}'" for each in hashes) or "'none'"
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def json_text(content: Any) -> str:
    """Serialise to JSON that is safe in a ``<script>`` element: ``<``, ``>`` and ``&`` are escaped."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
