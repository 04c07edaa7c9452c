"""Parts of a report, and scene files (TOML): reading with a list of all mistakes by line and key, and drafting."""

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
    "trials": "trials to look into",
}

REPORT_TABLES = {
    "scores": "measured against theory",
    "use": "walls to use",
    "optima": "trials with the least cost",
    "boundary": "stability limits over damping",
    "experiments": "trials, verdicts, estimates",
    "methods": "estimates by method",
    "header": "header lines that only the lab knows",
    "trend": "limits and estimates by header lines that differ",
    "model": "does the model explain the logs?",
    "outcomes": "what the logs show",
}
"""Tables of a report in addition to those of optima, with their contents."""


def plan_parts(data: StoredData) -> list[PlannedStage]:
    """Return the action for each figure and table of the report, and its reason."""
    shown = data.scene.shown
    plan = []
    for kind, name in FIGURE_NAMES.items():
        if not shown.has_figure(kind):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "the scene does not ask for it"))
        elif kind == "delay" and not any(table.kind == "delay" for table in layouts(data)):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "no experiment has added delay"))
        elif (kind == "plane" and len(data.experiments) < 2) or (kind == "trend" and len(data.experiments) < 2):
            plan.append(PlannedStage(f"figure: {name}", LEAVE_OUT, "there is one experiment only"))
        else:
            plan.append(PlannedStage(f"figure: {name}", RUN, "with the report, where there is data for it"))
    for table in layouts(data):
        asked = shown.has_table(table.name)
        reason = "; ".join(map(criterion_name, table.criteria)) if asked else "the scene does not ask for it"
        plan.append(PlannedStage(f"table: {table.name}", RUN if asked else LEAVE_OUT, reason))
    return plan


def read_scene(path: Path) -> SceneFile:
    """Read a scene file.

    Raises
    ------
    SceneError
        If the file is missing or invalid; the message names every mistake with its line and key.
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
        raise SceneError(f"{path}: is no TOML: {error}. Correct that line.") from error
    mistakes = find_mistakes(values, text)
    if mistakes:
        raise SceneError("\n".join(f"{path}:{mistake.line}: {mistake.text}" for mistake in mistakes))
    return SceneFile.model_validate(values)


def find_mistakes(values: Mapping[str, Any], text: str) -> list[Mistake]:
    """Return all mistakes of a scene file in the order of their lines; empty without any.

    Parameters
    ----------
    values : mapping
        The parsed TOML.
    text : str
        Its text, for the line numbers.
    """
    try:
        SceneFile.model_validate(values)
    except ValidationError as error:
        lines = key_lines(text)
        found: dict[Place, str] = {}
        for entry in error.errors():
            place = tuple(entry["loc"])
            found.setdefault(place, _words(place, dict(entry)))
        # report the wrong entries of a list, and not the list as empty
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
        return f"key {key!r}: not known; {expected} Correct or remove it."
    if error["type"] == "missing":
        return f"key {key!r}: missing. Add it."
    message = "a list" if error["type"] == "tuple_type" else str(error["msg"]).removeprefix("Input should be ")
    near = []
    if error["type"] == "literal_error" and isinstance(error["input"], str):
        near = get_close_matches(error["input"], str(error["ctx"]["expected"]).replace("'", "").split(", "), 1)
    meant = f" Did you mean {near[0]!r}?" if near else ""
    return f"key {key!r}: expected {message}, found {error['input']!r}.{meant}"


def _line(lines: Mapping[Place, int], place: Place) -> int:
    """Return the line of a key, or of the table that contains it."""
    while place not in lines:
        place = place[:-1]
    return lines[place]


def draft_scene(device: str, processed: Path) -> str:
    """Return a scene file for all stored data of a device: every key with its choices, ready to be shortened.

    Raises
    ------
    DeviceError, StoreError
        If nothing is stored of the device; see `scene.open_scene`.
    """
    data = open_scene(device, processed, None, None)
    trials = {e.experiment: e.trials.num_rows for e in data.experiments}
    lines = [
        f"# Scene of device {_comment(device)}: what one report shows. Used by: pipeline compare --scene FILE",
        "# A missing key means all that there is data for; only what is requested is computed.",
        f"device = {_quoted(device)}",
        f"experiments = {_list(trials)}  # {', '.join(f'{_comment(e)}: {n} trials' for e, n in trials.items())}",
        "",
        "# settle stands for the settling times of the bands [%] below",
        f"criteria = {_list(['settle', *(c for c in REPORTED if c not in SETTLING_BANDS)])}",
        "bands = [1, 2, 5]",
        "",
        "# figures: " + "; ".join(f"{kind}: {name}" for kind, name in FIGURE_NAMES.items()),
        f"figures = {_list(FIGURE_NAMES)}",
        "",
        "# overlays of the boundaries: theory, the identified loop with its interval (band), the linear condition, the",
        "# passive region, with friction the limit for a harder push; robust: stable with every spring",
        'overlays = ["theory", "estimates", "band", "linear", "passive", "friction"]',
        "",
        "# delay factors of the theoretical curves, in place of those of the device file",
        "# delays = [3, 4, 5]",
        "",
        "# tables: " + "; ".join(f"{name}: {words}" for name, words in REPORT_TABLES.items()),
        f"tables = {_list([*(t.name for t in layouts(data)), *REPORT_TABLES])}",
        "",
        f"report = {_quoted(report_of(Path('reports'), device).as_posix())}",
        "",
        "# costs about the expected (x_0 + F_0/K) or the measured final position; window of the momentum balance (6.4)",
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
