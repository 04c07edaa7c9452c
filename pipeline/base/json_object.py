"""Type of a JSON object that is exchanged with the outside of the process."""

from __future__ import annotations

from typing import Any

JsonObject = dict[str, Any]
"""Object of a JSON document, or table of a TOML file, that is read from or written to the outside of the process.

Its keys are texts. Its values are texts, numbers, Booleans, None, and lists and objects of these. Examples are the body
of a request or an answer, the content of a file, and a column of a database that stores JSON. Functions exchange
records instead.
"""
