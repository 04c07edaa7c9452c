"""Index of all stored trials in SQLite, for lists, facets, sorting and searches. The index also contains stored
verdicts and costs. The Parquet files are authoritative. They are checked when something may have changed, and
experiments with changed files are read again. The index can be deleted at any time and is then rebuilt. This module
computes no results.
"""

from __future__ import annotations

import json
import os
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar, cast

import pyarrow as pa

from pipeline.base.errors import StoreError
from pipeline.base.provenance import digest
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.measured.stages.stage_needs import cost_column
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import REPORTED
from pipeline.records.findings import Motion, Record, stored_findings
from pipeline.records.tables import LOCATION
from pipeline.service.database import Database, connected
from pipeline.store.names import name_of_folder
from pipeline.store.storage import (
    Correction,
    corrections_files,
    natural_key,
    read_corrections,
    read_exclusions,
    read_trials,
    split_trials,
    stage_file,
    trials_files,
)

LOOK_S = 0.5
"""Longest delay before a change made on the command line becomes visible [s]."""

KEPT = 64
"""Number of cached answers per state. The cache helps because readers turn pages back and forth, and request the same
data again."""

EXCLUDED = "excluded"
"""Text shown instead of the verdict for a trial that is excluded manually. No result uses such a trial."""

WORDS = ("device", "experiment", "verdict", "outcome")
_STORED = ("trial_id", "device", "experiment", "motion", "grip", "stiffness", "damping")
_READ = (
    *_STORED,
    "time_quality",
    "source_path",
    "source_mtime_ns",
    "source_sha256",
    "profile_sha256",
    "label",
    *LOCATION,
)
COSTS = {
    f"{c}{end}": (cost_column(c)[0], f"{cost_column(c)[1]}{end}") for c in REPORTED for end in ("", "_low", "_high")
}
NEEDS = ("response", "outcome", *sorted({stage for stage, _ in COSTS.values()}))
SORTS = ("id", *WORDS, "stiffness", "damping", "recorded", "uploader", *REPORTED)
SORTED = (*SORTS, *(f"-{name}" for name in SORTS))
"""Sort orders of trials: ascending and descending."""

_PLAIN = ("id", *_STORED[1:], "verdict", "outcome", "excluded", "source", "recorded", "uploader", "findings")
COLUMNS = (*_PLAIN, *LOCATION, *COSTS)
_TEXTS = {"id", *WORDS, "motion", "grip", "excluded", "source", "uploader", "findings", "sample_file"}

_SCHEMA = f"""
CREATE TABLE trials ({", ".join(f"{c} {'TEXT' if c in _TEXTS else 'REAL'}" for c in COLUMNS)}, said TEXT,
  PRIMARY KEY (id));
CREATE TABLE parts (device TEXT, experiment TEXT, sign TEXT, damaged TEXT, PRIMARY KEY (device, experiment));
"""

_INDEX = f"""
CREATE INDEX IF NOT EXISTS by_place ON trials (device, experiment, verdict, outcome);
CREATE INDEX IF NOT EXISTS by_said ON trials (said);
{"".join(f"CREATE INDEX IF NOT EXISTS by_{c} ON trials ({c}, id);" for c in SORTS[1:])}
"""
"""Index created after all trials of a new file are inserted. Updating it after each trial would take five times as
long."""

_SEARCHED = ("id", "device", "experiment", "source", "uploader")
"""Columns of a trial that are searched, in addition to its notes and tags."""

_EXPERIMENTS = """
SELECT device, experiment, max(motion) AS motion, sum(n) AS trials, json_group_object(verdict, n) AS verdicts,
  max(last) AS last
FROM (SELECT device, experiment, ifnull(verdict, 'none yet') AS verdict, count(*) AS n, max(recorded) AS last,
    max(motion) AS motion FROM trials GROUP BY device, experiment, trials.verdict ORDER BY trials.verdict)
GROUP BY device, experiment
"""

_DONE = "SELECT count(*), total(changed), (SELECT max(number) FROM audit) FROM jobs WHERE state = 'done'"

Kept = TypeVar("Kept")


class Device(Record):
    """A device that has trials."""

    device: str
    experiments: int
    trials: int


class Experiment(Record):
    """An experiment, with the number of trials for each verdict, and the time of the last log."""

    device: str
    experiment: str
    motion: Motion
    trials: int
    verdicts: dict[str, int]
    last: float


class Cost(Record):
    """A cost with its 95 % interval."""

    value: float
    low: float | None
    high: float | None


class RecordingFinding(Record):
    """A fault of the recording of a trial: kind, place, evidence, remedy, and the sentence shown on pages."""

    code: str
    first_row: int | None
    rows: int
    evidence: str
    remedy: str
    severity: str
    sentence: str


class Trial(Record):
    """A trial, with stiffness and damping in SI. If the trial is excluded manually, ``excluded`` has the reason, and
    the verdict is "excluded"."""

    id: str
    device: str
    experiment: str
    verdict: str | None
    outcome: str | None
    motion: Motion
    grip: str | None
    excluded: str | None
    stiffness: float | None
    damping: float | None
    costs: dict[str, Cost]
    source: str
    recorded: float
    uploader: str | None
    findings: list[RecordingFinding]
    tags: list[str]

    def number_or_word(self, name: str) -> float | str | None:
        """Return the value of one of `SORTS` in SI, or None if it is missing."""
        if name in REPORTED:
            return self.costs[name].value if name in self.costs else None
        value: float | str | None = getattr(self, name)
        return value


@dataclass(frozen=True)
class Selection:
    """Selection of trials: values of `WORDS`, limits of ranges (``stiffness_min``, ...), and a search text."""

    words: Mapping[str, str | None]
    ranges: Mapping[str, float]
    text: str = ""

    def where(self, said: Sequence[tuple[list[str], str]]) -> tuple[str, list[object]]:
        """Return the selection as an SQL condition with its values.

        ``said`` contains notes and tags with their owners.
        """
        parts, values = ["1"], list[object]()
        for name, word in self.words.items():
            parts.append(f"{name} IS ?")
            values.append(word)
        for name, limit in self.ranges.items():
            parts.append(f"{name[:-4]} {'>=' if name.endswith('_min') else '<='} ?")
            values.append(limit)
        for word in self.text.casefold().split():
            places = [of for of, text in said if word in text]
            own = json.dumps([of[1] for of in places if of[0] == "trial"])
            whole = json.dumps([of[1:] for of in places if of[0] == "experiment"])
            parts.append(
                "(rowid IN (SELECT rowid FROM trials WHERE said LIKE ? ESCAPE '!') OR id IN (SELECT value FROM "
                "json_each(?)) OR (device, experiment) IN (SELECT value ->> 0, value ->> 1 FROM json_each(?)))"
            )
            values += ["%" + re.sub("([%_!])", r"!\1", word) + "%", own, whole]
        return " AND ".join(parts), values


class Catalogue:
    """Present state of a store. It is read again when files change.

    Parameters
    ----------
    processed : Path
    database : Database
        Database of notes, tags and uploaders. Its file is in the folder of the catalogue.
    """

    def __init__(self, processed: Path, database: Database) -> None:
        self.processed, self.database = processed, database
        self.file = database.file.with_name("catalogue.sqlite")
        self._local, self._lock = threading.local(), threading.Lock()
        self._looked, self._done, self._state = float("-inf"), tuple[Any, ...](), ""
        self._kept: dict[str, object] = {}
        layout = int(digest(_SCHEMA)[:7], 16)
        try:
            known = self._run("PRAGMA user_version")[0][0]
        except sqlite3.DatabaseError:
            known = -1
        if known != layout:
            self._connection.close()
            del self._local.connection
            for file in self.file.parent.glob(f"{self.file.name}*"):
                file.unlink()
            os.close(os.open(self.file, os.O_RDWR | os.O_CREAT, 0o600))
            self._connection.executescript(f"PRAGMA journal_mode = WAL; {_SCHEMA} PRAGMA user_version = {layout};")

    @property
    def _connection(self) -> sqlite3.Connection:
        return connected(self._local, self.file, "OFF")

    def _run(self, statement: str, values: Sequence[object] = ()) -> list[sqlite3.Row]:
        return self._connection.execute(statement, values).fetchall()

    def run(self, statement: str, values: Sequence[object] = ()) -> list[sqlite3.Row]:
        """Return rows of the current state, which is at most `LOOK_S` old and always includes changes by this
        service."""
        with self._lock:
            done = tuple(self.database.run(_DONE)[0])
            if done != self._done or time.monotonic() - self._looked > LOOK_S:
                self._refresh()
                self._looked, self._done = time.monotonic(), done
        return self._run(statement, values)

    def once(self, key: str, make: Callable[[], Kept]) -> Kept:
        """Return a result that depends only on the current state, from the cache if possible. Recent results are
        cached."""
        self.run("SELECT 1")
        key = f"{self._state} {key}"
        if key not in self._kept:
            found = make()
            if len(self._kept) >= KEPT:
                self._kept = {}
            self._kept[key] = found
            return found
        return cast("Kept", self._kept[key])

    def _chosen(self, chosen: Selection) -> tuple[str, list[object]]:
        said = []
        for _, of, value in self.database.all_words() if chosen.text else ():
            said.append((of, "\n".join([value] if isinstance(value, str) else value).casefold()))
        return chosen.where(said)

    @property
    def rows(self) -> int:
        """Number of stored trials."""
        count: int = self.run("SELECT count(*) FROM trials")[0][0]
        return count

    @property
    def damaged(self) -> dict[str, str]:
        """Experiments that could not be read, with the reasons."""
        rows = self.run("SELECT * FROM parts WHERE damaged != ''")
        return {f"{row['device']}/{row['experiment']}": row["damaged"] for row in rows}

    @property
    def experiments(self) -> list[Experiment]:
        """All experiments in natural order, with the number of trials for each verdict and the time of the last log."""

        def made() -> list[Experiment]:
            rows = self._run(_EXPERIMENTS)
            found = [Experiment.model_validate({**row, "verdicts": json.loads(row["verdicts"])}) for row in rows]
            return sorted(found, key=lambda e: (natural_key(e.device), natural_key(e.experiment)))

        return self.once("experiments", made)

    @property
    def devices(self) -> list[Device]:
        """All devices, with the numbers of experiments and trials."""
        own = groupby(self.experiments, key=lambda e: e.device)
        found = ((device, list(each)) for device, each in own)
        return [Device(device=d, experiments=len(e), trials=sum(one.trials for one in e)) for d, e in found]

    def trial(self, trial: str) -> Trial | None:
        """Return a trial as the API shows it, or None if it does not exist."""
        rows = self._shown(self.run("SELECT * FROM trials WHERE id = ?", (trial,)))
        return rows[0] if rows else None

    def stored_at(self, trial: str) -> tuple[str, int]:
        """Return the file that contained a trial at the last refresh, and its row."""
        row = self._run("SELECT sample_file, sample_row FROM trials WHERE id = ?", (trial,))[0]
        return row["sample_file"], int(row["sample_row"])

    def selected(self, chosen: Selection) -> tuple[int, dict[str, dict[str, int]]]:
        """Return the number of selected trials, and the number of them that have each value of `WORDS`."""

        def made() -> tuple[int, dict[str, dict[str, int]]]:
            where, values = self._chosen(chosen)
            found: dict[str, dict[str, int]] = {name: {} for name in WORDS}
            for *words, n in self._run(
                f"SELECT {', '.join(WORDS)}, count(*) FROM trials WHERE {where} GROUP BY {', '.join(WORDS)}", values
            ):
                for name, word in zip(WORDS, words, strict=True):
                    found[name][word or "none yet"] = found[name].get(word or "none yet", 0) + n
            total = sum(found["device"].values())
            return total, {name: dict(sorted(each.items())) for name, each in found.items()}

        return self.once(f"selected {chosen}", made)

    def page(self, chosen: Selection, sort: str, limit: int, after: tuple[Any, str] | None) -> tuple[list[Trial], bool]:
        """Return trials in order, starting after a given value and trial, and True if more trials follow.

        A page depends only on this value and trial, so the page is not shifted by trials added in the meantime. Missing
        values come last.
        """
        name, way = sort.lstrip("-"), "DESC" if sort.startswith("-") else "ASC"
        where, values = self._chosen(chosen)
        if after is not None:
            value, trial = after
            sign = "<" if way == "DESC" else ">"
            if name == "id":
                where, values = f"{where} AND id {sign} ?", [*values, trial]
            elif value is None:
                where, values = f"{where} AND {name} IS NULL AND id > ?", [*values, trial]
            else:
                where += f" AND ({name} {sign} ? OR ({name} = ? AND id > ?) OR {name} IS NULL)"
                values = [*values, value, value, trial]
        order = f"id {way}" if name == "id" else f"{name} {way} NULLS LAST, id"
        rows = self.run(f"SELECT * FROM trials WHERE {where} ORDER BY {order} LIMIT ?", [*values, limit + 1])
        return self._shown(rows[:limit]), len(rows) > limit

    def _shown(self, rows: Sequence[sqlite3.Row]) -> list[Trial]:
        """Return trials as the API shows them."""
        tags = {of[1]: tags for kind, of, tags in self.database.all_words() if (kind, of[0]) == ("tags", "trial")}
        found = []
        for row in rows:
            ends = {c: (row[c], row[f"{c}_low"], row[f"{c}_high"]) for c in REPORTED if row[c] is not None}
            costs = {c: Cost(value=value, low=low, high=high) for c, (value, low, high) in ends.items()}
            columns = {name: row[name] for name in _PLAIN}
            columns["findings"] = json.loads(columns["findings"])
            found.append(Trial(**columns, costs=costs, tags=tags.get(row["id"], [])))
        return found

    def _refresh(self) -> None:
        """Read changed data again.

        Changed experiments are detected by their files and corrections. Changed notes and tags are detected by their
        time stamps.
        """
        corrections, whole = self._corrections()
        places: dict[tuple[str, str], list[Path]] = {one.place: [] for one in corrections if one.changes_place}
        for file in trials_files(self.processed):
            device, experiment = (name_of_folder(part) for part in file.parts[-3:-1])
            places.setdefault((device, experiment), []).append(file)
        concerned: dict[tuple[str, str], list[object]] = {}
        for one in corrections:
            for place in {one.place, (one.device, one.experiment)}:
                concerned.setdefault(place, []).append(one.model_dump())
        signs = {}
        for place, own in places.items():
            files = [*own, *(stage_file(self.processed, *place, stage) for stage in NEEDS)]
            signs[place] = digest([[_sign(file) for file in files if file], concerned.get(place), whole])
        known = {(row["device"], row["experiment"]): row["sign"] for row in self._run("SELECT * FROM parts")}
        state = digest([sorted(signs.items()), self.database.all_words()])
        if state == self._state and known == signs:
            return
        for place in known.keys() - signs.keys():
            self._replace(place, None, [], "")
        for place in [place for place, sign in signs.items() if known.get(place) != sign]:
            self._replace(place, signs[place], *self._read(*place))
        self._connection.executescript(_INDEX)
        self._state, self._kept = state, {}

    def _corrections(self) -> tuple[list[Correction], bool]:
        """Return the manual corrections, and True if they could be read. If not, each experiment reports the error."""
        with suppress(StoreError):
            files = corrections_files(self.processed)
            return (list(read_corrections(self.processed).values()) if files else []), True
        return [], False

    def _replace(self, place: tuple[str, str], sign: str | None, rows: Sequence[Sequence[Any]], damaged: str) -> None:
        connection = self._connection
        connection.execute("BEGIN IMMEDIATE")
        for table in ("trials", "parts"):
            connection.execute(f"DELETE FROM {table} WHERE device = ? AND experiment = ?", place)
        if sign is not None:
            connection.execute("INSERT INTO parts VALUES (?, ?, ?, ?)", (*place, sign, damaged))
        marks = ", ".join("?" * (len(COLUMNS) + 1))
        # a moved trial may still be listed at its old place
        connection.executemany(f"INSERT OR REPLACE INTO trials VALUES ({marks})", rows)
        connection.execute("COMMIT")

    def _read(self, device: str, experiment: str) -> tuple[list[tuple[Any, ...]], str]:
        """Return the trials of an experiment with stored verdicts and costs, or the reason why they are missing."""
        try:
            stored = read_trials(self.processed, device, experiment, list(_READ))
            spring = declared_spring(known_devices().get(device), experiment)
            used, excluded = split_trials(stored, read_exclusions(self.processed))
            stages = ExperimentStages(self.processed, device, experiment, used, excluded, spring)
            found = {stage: stages.table(stage) for stage in NEEDS if stages.is_stored(stage)}
        except StoreError as error:
            return [], str(error)
        ids, paths = (stored.column(name).to_pylist() for name in ("trial_id", "source_path"))
        why = {one.trial_id: one.exclusion_reason for one in excluded}
        came = self.database.uploaded()
        verdicts = _joined(ids, found.get("response"), "verdict")
        columns = {
            **{name: stored.column(name).to_pylist() for name in (*_STORED, *LOCATION)},
            "id": ids,
            "verdict": [EXCLUDED if trial in why else verdict for trial, verdict in zip(ids, verdicts, strict=True)],
            "outcome": _joined(ids, found.get("outcome"), "outcome"),
            "excluded": [why.get(trial) for trial in ids],
            "source": [came[path][0] if path in came else path for path in paths],
            "recorded": [1e-9 * at for at in stored.column("source_mtime_ns").to_pylist()],
            "uploader": [came[path][1] if path in came else None for path in paths],
            "findings": [_findings(text) for text in stored.column("time_quality").to_pylist()],
            **{name: _joined(ids, found.get(stage), column) for name, (stage, column) in COSTS.items()},
        }
        searched = zip(*(columns[name] for name in _SEARCHED), strict=True)
        said = ["\n".join(filter(None, words)).casefold() for words in searched]
        return list(zip(*(columns[name] for name in COLUMNS), said, strict=True)), ""


def _findings(time_quality: str) -> str:
    """Return the findings of a recording as JSON, each with its sentence."""
    return json.dumps([each.document for each in stored_findings(time_quality)])


def _joined(ids: Sequence[str], stage: pa.Table | None, column: str) -> list[Any]:
    """Return a column of a stage in the order of the trials. A trial without a row or a value has None."""
    if stage is None:
        return [None] * len(ids)
    known = dict(zip(stage.column("trial_id").to_pylist(), stage.column(column).to_pylist(), strict=True))
    return [None if value != value else value for value in map(known.get, ids)]


def _sign(file: Path) -> tuple[int, int] | None:
    try:
        status = os.stat(file)
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns
