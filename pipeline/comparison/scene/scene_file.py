"""Scene files (TOML): parts of a report, reading with a list of all mistakes by line and key, and drafts."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.base.errors import SceneError
from pipeline.comparison.scene.scene import LEAVE_OUT, RUN, PlannedStage, StoredData, layouts, open_scene
from pipeline.profiles.profile_files import Mistake, Place, key_lines
from pipeline.records.criteria import REPORTED, SETTLING_BANDS
from pipeline.records.models import MOMENTUM_WINDOW_S, FigureKind, SceneFile
from pipeline.rendering.labels import criterion_name
from pipeline.store.names import report_of

FIGURE_NAMES: dict[FigureKind, str] = {
    "response": "first response",
    "boundaries": "stability boundaries",
    "plane": "boundaries in the normalised plane",
    "maps": "cost maps",
    "residuals": "measured minus theory",
    "delay": "costs over delay",
    "trend": "limits and estimates over experiments",
    "trials": "trials to inspect",
}

REPORT_TABLES = {
    "scores": "measured against theory",
    "use": "walls to use",
    "optima": "trials with the least cost",
    "boundary": "stability limits over damping",
    "experiments": "trials, verdicts, estimates",
    "methods": "estimates by method",
    "header": "header lines without a meaning for the pipeline",
    "trend": "limits and estimates by header lines that differ",
    "model": "does the model explain the logs?",
    "outcomes": "what the logs show",
}
"""Tables of a report in addition to those of optima, with their contents."""


def plan_parts(data: StoredData) -> list[PlannedStage]:
    """Return the action for each figure and table of the report, with its reason."""
    shown = data.scene.shown
    plan = []
    for kind, name in FIGURE_NAMES.items():
        if not shown.has_figure(kind):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "the scene does not request it"))
        elif kind == "delay" and not any(table.kind == "delay" for table in layouts(data)):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "no experiment has added delay"))
        elif (kind == "plane" and len(data.experiments) < 2) or (kind == "trend" and len(data.experiments) < 2):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "there is only one experiment"))
        else:
            plan.append(PlannedStage(f"figure: {name}", RUN, "with the report, if there are data for it"))
    for table in layouts(data):
        requested = shown.has_table(table.name)
        reason = "; ".join(map(criterion_name, table.criteria)) if requested else "the scene does not request it"
        plan.append(PlannedStage(f"table: {table.name}", RUN if requested else LEAVE_OUT, reason))
    return plan


def read_scene(path: Path) -> SceneFile:
    """Read a scene file.

    Raises
    ------
    SceneError
        If the file is missing or invalid. The message lists every mistake with its line and key.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"{path}: cannot be read ({error}). Give a scene file (TOML); `pipeline compare --save-scene` writes one."
        ) from error
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"{path}: is not TOML: {error}. Correct this line.") from error
    mistakes = find_mistakes(values, text)
    if mistakes:
        raise SceneError("\n".join(f"{path}:{mistake.line}: {mistake.text}" for mistake in mistakes))
    return SceneFile.model_validate(values)


def find_mistakes(values: Mapping[str, Any], text: str) -> list[Mistake]:
    """Return all mistakes of a scene file in the order of their lines. The list is empty if there are none.

    Parameters
    ----------
    values : mapping
        The parsed TOML.
    text : str
        Text of the file, which gives the line numbers.
    """
    try:
        SceneFile.model_validate(values)
    except ValidationError as error:
        lines = key_lines(text)
        found: dict[Place, str] = {}
        for entry in error.errors():
            place = tuple(entry["loc"])
            found.setdefault(place, _words(place, dict(entry)))
        # Report the wrong entries of a list, instead of an empty list.
        held = {place[:length] for place in found for length in range(len(place))}
        mistakes = [Mistake(_line(lines, place), place, words) for place, words in found.items() if place not in held]
        return sorted(mistakes, key=lambda mistake: (mistake.line, str(mistake.place)))
    return []


def _words(place: Place, error: Mapping[str, Any]) -> str:
    key = ".".join(str(part) for part in place)
    if error["type"] == "extra_forbidden":
        known = sorted(SceneFile.model_fields)
        near = get_close_matches(key, known, 1)
        expected = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}."
        return f"key {key!r}: unknown; {expected} Correct or remove it."
    if error["type"] == "missing":
        return f"key {key!r}: missing. Add it."
    message = "a list" if error["type"] == "tuple_type" else str(error["msg"]).removeprefix("Input should be ")
    near = []
    if error["type"] == "literal_error" and isinstance(error["input"], str):
        near = get_close_matches(error["input"], str(error["ctx"]["expected"]).replace("'", "").split(", "), 1)
    meant = f" Did you mean {near[0]!r}?" if near else ""
    return f"key {key!r}: expected {message}, found {error['input']!r}.{meant}"


def _line(lines: Mapping[Place, int], place: Place) -> int:
    """Return the line of a key, or of the table that should contain it."""
    while place not in lines:
        place = place[:-1]
    return lines[place]


def draft_scene(device: str, processed: Path) -> str:
    """Return a scene file for all stored data of a device. It contains every key with its choices and may be shortened.

    Raises
    ------
    DeviceError, StoreError
        If nothing is stored for the device. See `scene.open_scene`.
    """
    data = open_scene(device, processed, None, None)
    trials = {e.experiment: e.trials.num_rows for e in data.experiments}
    lines = [
        f"# Scene of device {_comment(device)}: contents of a report. Used by: pipeline compare --scene FILE",
        "# A missing key includes everything with available data. Only requested results are computed.",
        f"device = {_quoted(device)}",
        f"experiments = {_list(trials)}  # {', '.join(f'{_comment(e)}: {n} trials' for e, n in trials.items())}",
        "",
        "# settle means the settling times for the bands [%] below",
        f"criteria = {_list(['settle', *(c for c in REPORTED if c not in SETTLING_BANDS)])}",
        "bands = [1, 2, 5]",
        "",
        "# figures: " + "; ".join(f"{kind}: {name}" for kind, name in FIGURE_NAMES.items()),
        f"figures = {_list(FIGURE_NAMES)}",
        "",
        "# overlays of the boundaries: theory, the identified loop with its interval (band), the linear condition, the",
        "# passive region, with friction the limit for a larger step; robust: stable with any spring",
        'overlays = ["theory", "estimates", "band", "linear", "passive", "friction"]',
        "",
        "# delay factors of the theoretical curves, which replace those of the device file",
        "# delays = [3, 4, 5]",
        "",
        "# tables: " + "; ".join(f"{name}: {words}" for name, words in REPORT_TABLES.items()),
        f"tables = {_list([*(t.name for t in layouts(data)), *REPORT_TABLES])}",
        "",
        f"report = {_quoted(report_of(Path('reports'), device).as_posix())}",
        "",
        "# final position for costs: expected (x_0 + F_0/K) or measured; window of the momentum balance (6.4)",
        "[measuring]",
        'final = "expected"',
        f"momentum_window_s = {MOMENTUM_WINDOW_S}",
    ]
    return "\n".join(lines) + "\n"


def _list(words: Any) -> str:
    return f"[{', '.join(_quoted(word) for word in words)}]"


def _quoted(text: str) -> str:
    """Return a text as a basic string of TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08X}" for c in escaped) + '"'


def _comment(text: str) -> str:
    """Return a text without characters that are not allowed in a comment."""
    return "".join(c if c.isprintable() else "?" for c in text)
