"""All stored trials in memory, with verdicts and costs where these are stored: what lists, facets and sorts read.

Parquet is the truth: files are looked at again when something may have changed, and experiments read again whose files
did. Nothing is computed here.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.base.errors import StoreError
from pipeline.device_data.devices import declared_spring, known_devices
from pipeline.measured.stages.stages import ExperimentStages, cost_column
from pipeline.records.batch import Floats, Integers
from pipeline.records.criteria import REPORTED
from pipeline.records.tables import LOCATION
from pipeline.service.database import Database
from pipeline.store.corrections import (
    Correction,
    Key,
    corrections_files,
    read_corrections,
    read_exclusions,
    split_trials,
)
from pipeline.store.names import name_of_folder
from pipeline.store.storage import natural_key, read_trials, stage_file, trials_files

LOOK_S = 0.5
"""Longest time after which a change by the command line is seen [s]."""

KEPT = 64
"""Answers that are kept of a state: readers turn pages, and look at the same."""

Kept = TypeVar("Kept")

TEXTS = ("trial_id", "device", "experiment", "verdict", "outcome", "motion", "grip", "excluded", "source_path")
_STORED = ("trial_id", "device", "experiment", "motion", "grip", "source_path", "stiffness", "damping")
_KEYED = ("source_sha256", "profile_sha256", "label", *LOCATION)
EXCLUDED = "excluded"
"""What stands in place of the verdict of a trial that is excluded by hand: no number rests on it."""

COSTS = {
    f"{c}{end}": (cost_column(c)[0], f"{cost_column(c)[1]}{end}") for c in REPORTED for end in ("", "_low", "_high")
}
NUMBERS = ("stiffness", "damping", *COSTS)
SORTS = ("id", "device", "experiment", "verdict", "outcome", "stiffness", "damping", *REPORTED)
SORTED = (*SORTS, *(f"-{name}" for name in SORTS))
"""Orders of trials: rising, and falling."""

STAGES = ("response", "outcome", *sorted({stage for stage, _ in COSTS.values()}))


@dataclass(frozen=True)
class Texts:
    """A column of words: the different ones, sorted, and which of them each row has."""

    words: list[str]
    codes: Integers

    def code(self, word: str) -> float:
        """Return where a word stands among them, between two where it is none of them."""
        place = int(np.searchsorted(np.array(self.words, dtype=object), word)) if self.words else 0
        return place if place < len(self.words) and self.words[place] == word else place - 0.5


class Trials:
    """A state of the store.

    Parameters
    ----------
    table : pyarrow.Table
        `TEXTS` and `NUMBERS` of all trials.
    damaged : dict of str to str
        Experiments that could not be read, and why.
    """

    def __init__(self, table: pa.Table, damaged: dict[str, str]) -> None:
        self.damaged, self.rows = damaged, table.num_rows
        self.ids: list[str] = table.column("trial_id").to_pylist()
        self.texts = {name: _texts(table.column(name)) for name in TEXTS[1:-1]}
        self.numbers = {name: table.column(name).to_numpy() for name in NUMBERS}
        self.sources = table.column("source_path").combine_chunks()
        self._places = tuple(table.column(name).combine_chunks() for name in LOCATION)
        # ignoring case while searching takes ten times as long
        self._searched = [pc.utf8_lower(table.column(name)) for name in ("trial_id", "source_path")]
        self._orders: dict[str, Integers] = {}
        self._kept: dict[str, object] = {}
        self._sorted, self._rank = np.unique(np.array(self.ids, dtype="U"), return_inverse=True)

    @cached_property
    def place(self) -> dict[str, int]:
        """Row of each trial."""
        return {name: row for row, name in enumerate(self.ids)}

    def stored_at(self, row: int) -> tuple[str, int]:
        """Return the file that held a trial when it was looked at, and the row there."""
        file, number = (column[row].as_py() for column in self._places)
        return file, number

    def is_of(self, trial: str, device: str, experiment: str) -> bool:
        """Return whether a trial is stored, and belongs to an experiment."""
        row = self.place.get(trial)
        if row is None:
            return False
        own = (self.texts[name].words[self.texts[name].codes[row]] for name in ("device", "experiment"))
        return tuple(own) == (device, experiment)

    @cached_property
    def experiments(self) -> list[dict[str, Any]]:
        """All experiments, with numbers of trials by verdict, as people sort them."""
        device, experiment, verdict = (self.texts[name] for name in ("device", "experiment", "verdict"))
        pairs = device.codes * len(experiment.words) + experiment.codes
        found = []
        for pair in np.unique(pairs).tolist():
            own = np.flatnonzero(pairs == pair)
            counts = np.bincount(verdict.codes[own], minlength=len(verdict.words))
            found.append(
                {
                    "device": device.words[pair // len(experiment.words)],
                    "experiment": experiment.words[pair % len(experiment.words)],
                    "motion": self.texts["motion"].words[self.texts["motion"].codes[own[0]]],
                    "trials": len(own),
                    "verdicts": {w or "none yet": int(n) for w, n in zip(verdict.words, counts, strict=True) if n},
                }
            )
        return sorted(found, key=lambda e: (natural_key(e["device"]), natural_key(e["experiment"])))

    @cached_property
    def devices(self) -> list[dict[str, Any]]:
        """All devices, with numbers of experiments and trials."""
        found: dict[str, dict[str, Any]] = {}
        for e in self.experiments:
            one = found.setdefault(e["device"], {"device": e["device"], "experiments": 0, "trials": 0})
            one["experiments"] += 1
            one["trials"] += e["trials"]
        return list(found.values())

    def items(self, rows: Sequence[int]) -> list[dict[str, Any]]:
        """Return trials as the API shows them."""
        place = np.array(rows, dtype=np.int64)
        words = {n: [t.words[code] or None for code in t.codes[place].tolist()] for n, t in self.texts.items()}
        value = {n: [None if x != x else x for x in v[place].tolist()] for n, v in self.numbers.items()}
        sources = self.sources.take(pa.array(place)).to_pylist()
        return [
            {
                "id": self.ids[row],
                **{name: column[i] for name, column in words.items()},
                "stiffness": value["stiffness"][i],
                "damping": value["damping"][i],
                "costs": {
                    c: {"value": value[c][i], "low": value[f"{c}_low"][i], "high": value[f"{c}_high"][i]}
                    for c in REPORTED
                    if value[c][i] is not None
                },
                "source": sources[i],
            }
            for i, row in enumerate(rows)
        ]

    def once(self, key: str, make: Callable[[], Kept]) -> Kept:
        """Return what rests on this state alone; answers to what was asked a moment ago are kept."""
        found = cast("Kept | None", self._kept.get(key))
        if found is None:
            found = make()
            if len(self._kept) >= KEPT:
                self._kept.clear()  # another thread may do so at any time, too
            self._kept[key] = found
        return found

    def selected(
        self, asked: dict[str, str], ranges: dict[str, float], text: str = ""
    ) -> tuple[np.ndarray, dict[str, dict[str, int]]]:
        """Return the rows of `select` with their facets."""

        def both() -> tuple[np.ndarray, dict[str, dict[str, int]]]:
            mask = self.select(asked, ranges, text)
            return mask, self.facets(mask)

        return self.once(json.dumps([asked, ranges, text]), both)

    def select(self, asked: dict[str, str], ranges: dict[str, float], text: str = "") -> np.ndarray:
        """Return which rows have words, lie in ranges (``stiffness_min``, ...), and hold a text in id or source."""
        mask = np.ones(self.rows, dtype=np.bool_)
        for name, word in asked.items():
            mask &= self.texts[name].codes == self.texts[name].code(word)
        for name, limit in ranges.items():
            values = self.numbers[name[:-4]]
            mask &= values >= limit if name.endswith("_min") else values <= limit
        if text:
            near = [pc.match_substring(column, text.lower()) for column in self._searched]
            mask &= pc.or_(*near).to_numpy(zero_copy_only=False)
        return mask

    def facets(self, mask: np.ndarray) -> dict[str, dict[str, int]]:
        """Return how many of some rows have each word of device, experiment, verdict and outcome."""
        found = {}
        for name in ("device", "experiment", "verdict", "outcome"):
            texts = self.texts[name]
            counts = np.bincount(texts.codes[mask], minlength=len(texts.words)).tolist()
            found[name] = {word or "none yet": n for word, n in zip(texts.words, counts, strict=True) if n}
        return found

    def page(self, mask: np.ndarray, sort: str, limit: int, after: tuple[Any, str] | None) -> tuple[list[int], bool]:
        """Return rows in order, from the one behind a value and trial on, and whether more follow.

        A page depends on these alone, so that trials which come meanwhile shift none.
        """
        name, sign = sort.lstrip("-"), -1.0 if sort.startswith("-") else 1.0
        order = self._order(sort)
        first = 0
        if after is not None:
            value, trial = after
            passed = int(np.searchsorted(self._sorted, trial, "right"))
            if name == "id":
                first = passed if sign > 0 else self.rows - int(np.searchsorted(self._sorted, trial))
            else:
                known = self.texts[name].code(value) if name in self.texts else value
                keys, key = self._keys(name, sign)[order], np.inf if value is None else sign * known
                low, high = (int(np.searchsorted(keys, key, side)) for side in ("left", "right"))
                first = low + int(np.searchsorted(self._rank[order[low:high]], passed))
        rows = order[first:]
        found = rows[mask[rows]][: limit + 1].tolist()
        return found[:limit], len(found) > limit

    def value(self, row: int, name: str) -> Any:
        """Return what a row is sorted by."""
        if name == "id":
            return None
        return (
            self.texts[name].words[self.texts[name].codes[row]]
            if name in self.texts
            else _number(self.numbers[name][row])
        )

    def _order(self, sort: str) -> Integers:
        if sort not in self._orders:
            name, sign = sort.lstrip("-"), -1.0 if sort.startswith("-") else 1.0
            self._orders[sort] = np.lexsort((self._rank, self._keys(name, sign)))
        return self._orders[sort]

    def _keys(self, name: str, sign: float) -> Floats:
        if name == "id":
            return np.asarray(sign * self._rank, dtype=np.float64)
        values = self.texts[name].codes if name in self.texts else self.numbers[name]
        return np.asarray(np.where(np.isnan(values), np.inf, sign * values), dtype=np.float64)


class Catalogue:
    """The present state of a store, read again where files changed."""

    def __init__(self, processed: Path, database: Database) -> None:
        self.processed, self.database = processed, database
        self._lock = threading.Lock()
        self._parts: dict[tuple[str, str], tuple[object, pa.Table | None, str]] = {}
        self._looked, self._version = -np.inf, -1
        self._corrected: tuple[object, dict[Key, Correction]] = ([], {})
        self._trials = Trials(_empty(), {})

    def trials(self) -> Trials:
        """Return all trials; at most `LOOK_S` late, and never behind a job that is done."""
        with self._lock:
            version = self.database.run("SELECT count(*) FROM jobs WHERE state = 'done'")[0][0]
            if version != self._version or time.monotonic() - self._looked > LOOK_S:
                self._refresh()
                self._looked, self._version = time.monotonic(), version
            return self._trials

    def _refresh(self) -> None:
        corrections = self._corrections().values()
        files: dict[tuple[str, str], list[Path]] = {one.place: [] for one in corrections if one.changes_place}
        for file in trials_files(self.processed):
            device, experiment = (name_of_folder(part) for part in file.parts[-3:-1])
            files.setdefault((device, experiment), []).append(file)
        parts = {}
        for place, own in files.items():
            stages = [stage_file(self.processed, *place, stage) for stage in STAGES]
            concern = [one for one in corrections if place in (one.place, (one.device, one.experiment))]
            sign = [[_sign(file) for file in (*own, *stages) if file is not None], concern]
            former = self._parts.get(place)
            parts[place] = former if former and former[0] == sign else (sign, *self._read(*place))
        if parts != self._parts:
            tables = [table for _, table, _ in parts.values() if table is not None]
            damaged = {"/".join(place): why for place, (_, _, why) in parts.items() if why}
            self._trials = Trials(pa.concat_tables(tables) if tables else _empty(), damaged)
            self._parts = parts

    def _corrections(self) -> dict[Key, Correction]:
        """Return what was corrected by hand; nothing new where that cannot be read, as experiments then say."""
        sign = [_sign(file) for file in corrections_files(self.processed)]
        if sign != self._corrected[0]:
            with suppress(StoreError):
                self._corrected = sign, read_corrections(self.processed)
        return self._corrected[1]

    def _read(self, device: str, experiment: str) -> tuple[pa.Table | None, str]:
        """Return the trials of an experiment with what is stored of their verdicts and costs, or why not."""
        try:
            stored = read_trials(self.processed, device, experiment, [*_STORED, *_KEYED])
            spring = declared_spring(known_devices().get(device), experiment)
            used, excluded = split_trials(stored, read_exclusions(self.processed))
            stages = ExperimentStages(self.processed, device, experiment, used, excluded, spring)
            found = {stage: stages.table(stage) for stage in STAGES if stages.is_stored(stage)}
        except StoreError as error:
            return None, str(error)
        columns = {name: stored.column(name) for name in (*_STORED, *LOCATION)}
        wanted = {"verdict": ("response", "verdict"), "outcome": ("outcome", "outcome"), **COSTS}
        for name, (stage, column) in wanted.items():
            texts = name not in COSTS
            columns[name] = _joined(stored, found.get(stage), column, texts)
        why = {one.trial_id: one.exclusion_reason for one in excluded}
        columns[EXCLUDED] = pa.array([why.get(name, "") for name in stored.column("trial_id").to_pylist()])
        if why:
            out = pc.not_equal(columns[EXCLUDED], "")
            columns["verdict"] = pc.if_else(out, EXCLUDED, columns["verdict"])
        return pa.table({name: columns[name] for name in (*TEXTS, *NUMBERS, *LOCATION)}), ""


def _joined(trials: pa.Table, stage: pa.Table | None, column: str, texts: bool) -> pa.Array:
    """Return a column of a stage in the order of the trials; empty or NaN where it has no row."""
    missing = "" if texts else np.nan
    if stage is None:
        values = [missing] * trials.num_rows
    else:
        known = dict(zip(stage.column("trial_id").to_pylist(), stage.column(column).to_pylist(), strict=True))
        found = (known.get(name) for name in trials.column("trial_id").to_pylist())
        values = [missing if value is None else value for value in found]
    return pa.array(values, pa.string() if texts else pa.float64())


def _empty() -> pa.Table:
    types = dict.fromkeys((*TEXTS, "sample_file"), pa.string()) | {"sample_row": pa.int64()}
    return pa.table({name: pa.array([], types.get(name, pa.float64())) for name in (*TEXTS, *NUMBERS, *LOCATION)})


def _texts(column: pa.ChunkedArray) -> Texts:
    words, codes = np.unique(np.array(column.to_pylist(), dtype=object), return_inverse=True)
    return Texts(words.tolist(), codes)


def _number(value: Any) -> float | None:
    return None if np.isnan(value) else float(value)


def _sign(file: Path) -> tuple[int, int] | None:
    try:
        status = os.stat(file)
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns


def page_of(items: Sequence[dict[str, Any]], names: tuple[str, ...], limit: int, after: list[str] | None) -> Any:
    """Return a part of a sorted list behind names, and the names of its last item where more follow."""
    keys = [tuple(natural_key(item[name]) for name in names) for item in items]
    behind = None if after is None else tuple(natural_key(name) for name in after)
    left = [item for item, key in zip(items, keys, strict=True) if behind is None or key > behind]
    last = [left[limit - 1][name] for name in names] if len(left) > limit else None
    return left[:limit], last
