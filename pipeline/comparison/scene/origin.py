"""Describe the origin of a report by hashes of logs, profiles, parameters, versions, and the command that repeats
it."""

from __future__ import annotations

import json
import os
import platform
import shlex
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version

from pipeline.base.paths import path_of_text
from pipeline.base.provenance import __version__, digest, sha256
from pipeline.comparison.scene.scene import StoredData
from pipeline.device_data.devices import digest_of
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.criteria import REPORTED
from pipeline.records.findings import ExcludedTrial
from pipeline.records.models import MOMENTUM_WINDOW_S
from pipeline.records.results import HeaderLine, LogList
from pipeline.rendering.labels import criterion_name, shortened
from pipeline.store.storage import natural_key

MOST_VALUES, LONGEST_VALUE = 4, 60
"""Largest number of listed values of a header line, and their largest length.

A recording time differs in each trial.
"""

_OWN_LINES, _OWN_KINDS = ("step_row", "integrated", "raw_count_decimals", "warnings"), ("provenance.", "stands_for.")
"""Texts that readers store with a trial for internal use."""

LIBRARIES = ("numpy", "pyarrow", "matplotlib")
"""Libraries whose version can affect a digit or a figure."""


def log_list(stages: ExperimentStages) -> LogList:
    """Return the logs of an experiment with their SHA-256, sorted by path, and a hash of the stored samples."""
    columns = ("source_path", "source_sha256")
    paths, hashes = (stages.trials.column(name).to_pylist() for name in columns)
    files = dict(sorted(zip(paths, hashes, strict=True)))
    folder = os.path.commonpath([os.path.dirname(path) for path in files])
    names = {os.path.relpath(path, folder): sha for path, sha in files.items()}
    return LogList(
        experiment=stages.experiment,
        folder=folder,
        files=names,
        sha256=joint_sha256(hashes),
        samples=stages.samples_digest,
    )


def header_lines(stages: ExperimentStages) -> tuple[HeaderLine, ...]:
    """Return the header lines of an experiment's logs that the pipeline does not use, sorted by name."""
    found: dict[str, Counter[str]] = {}
    for text in stages.trials.column("extra").to_pylist():
        for key, value in json.loads(text or "{}").items():
            if key not in _OWN_LINES and not key.startswith(_OWN_KINDS):
                found.setdefault(key, Counter())[shortened(str(value), LONGEST_VALUE)] += 1
    return tuple(
        HeaderLine(
            key=key,
            trials=values.total(),
            different=len(values),
            values=dict(sorted(values.items(), key=lambda item: (-item[1], natural_key(item[0])))[:MOST_VALUES]),
        )
        for key, values in sorted(found.items())
    )


def excluded_trials(data: StoredData) -> tuple[ExcludedTrial, ...]:
    """Return the manually excluded trials as they appear in a report."""
    return tuple(
        ExcludedTrial(
            experiment=one.experiment,
            trial_id=one.trial_id,
            log=path_of_text(one.source_path).name + (f", {one.label}" if one.label else ""),
            reason=one.exclusion_reason,
            since=one.excluded_since,
        )
        for one in data.excluded
    )


def joint_sha256(hashes: Sequence[str]) -> str:
    """Return a joint SHA-256 of logs, which does not depend on their names and order."""
    return sha256("\n".join(sorted(set(hashes))).encode())


def provenance(
    data: StoredData, lists: Sequence[LogList], processed: str, *, key: str, code: str, output: Sequence[str] = ()
) -> dict[str, str]:
    """Return the entries of a report's section on its origin.

    Parameters
    ----------
    data : StoredData
    lists : sequence of LogList
        Logs of each experiment.
    processed : str
        Folder or URL of the stored tables, as given by the user.
    key : str
        Hash of all inputs of the report.
    code : str
        Hash of the source code that made the report.
    output : sequence of str
        Additional words of the command.
    """
    columns = ("profile", "profile_sha256")
    pairs = {
        (name, sha)
        for e in data.experiments
        for name, sha in zip(*(e.trials.column(c).to_pylist() for c in columns), strict=True)
    }
    times = [t for e in data.experiments for t in e.trials.column("source_mtime_ns").to_pylist()]
    entries = {
        "key": key,
        "version": __version__,
        "code": code,
        "logs": digest(sorted(e.inputs_digest for e in data.experiments)),
        "profiles": ", ".join(f"{name} ({sha[:16]})" for name, sha in sorted(pairs)),
        "command": _command(data, processed, output),
        "parameters": "; ".join(map(criterion_name, data.scene.criteria)),
        "libraries": ", ".join([f"Python {platform.python_version()}", *(f"{n} {version(n)}" for n in LIBRARIES)]),
        "log files written": f"{_time(min(times))} to {_time(max(times))}",
    }
    for logs in lists:
        entries[f"logs of experiment {logs.experiment}"] = f"{len(logs.files)} files, joint SHA-256: {logs.sha256}"
        entries[f"samples of experiment {logs.experiment}"] = logs.samples
    return entries


def request(data: StoredData, lists: Sequence[LogList], processed: str, code: str) -> dict[str, object]:
    """Return request and inputs of the comparison, so that `verify` can repeat it."""
    logs = {e.experiment: {"files": len(e.files), "sha256": e.sha256, "samples": e.samples} for e in lists}
    excluded = [one.model_dump() for one in data.excluded]
    requested = {"processed": processed, "scene": data.scene.model_dump(mode="json")}
    truth = {name: one.model_dump(mode="json") for name, one in data.truth.items()}
    device = digest_of(data.device) if data.device else None
    return requested | {"logs": logs, "code": code, "excluded": excluded, "truth": truth, "device_file": device}


def _command(data: StoredData, processed: str, output: Sequence[str]) -> str:
    scene = data.scene
    words = ["pipeline", "compare", "--device", scene.device]
    words += [word for experiment in scene.experiments for word in ("--experiment", experiment)]
    words += [] if scene.criteria == REPORTED else ["--criteria", ",".join(scene.criteria)]
    chosen = scene.shown.measuring
    words += ["--final", chosen.final] if chosen.final != "expected" else []
    words += [] if chosen.momentum_delay is None else ["--momentum-delay", str(chosen.momentum_delay)]
    if chosen.momentum_window_s != MOMENTUM_WINDOW_S:
        words += ["--momentum-window", f"{chosen.momentum_window_s} s"]
    # Names come from logs and may contain any character.
    return shlex.join([*words, "--processed", processed, *output])


def _time(nanoseconds: int) -> str:
    return datetime.fromtimestamp(nanoseconds // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
