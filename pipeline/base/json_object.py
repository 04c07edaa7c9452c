"""Type of a JSON object at the edge of the process."""

from __future__ import annotations

from typing import Any

JsonObject = dict[str, Any]
"""Object of a JSON document, or table of a TOML file, that is read or written at the edge of the process.

Its keys are texts. Its values are texts, numbers, Booleans, None, and lists and objects of these. It is the body of a
request or an answer, the content of a file, or a column of a database that stores JSON. Functions exchange records
instead.
"""
