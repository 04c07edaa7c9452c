"""Error versus run time of every method: the records, and the file of a finished measurement."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.base.disk import read_result, write_result
from pipeline.base.provenance import PACKAGE_FOLDER, __version__, digest, digest_all, schema_folder, sha256
from pipeline.records.findings import Record

OURS = "this package"
"""Name of this package's method among the others."""

WRONG = 1e-6
"""Smallest relative error of a result that counts as wrong: more than any plot, table or controller would need."""

STORED = "accuracy"
"""Prefix of the name of the file below `processed/` that contains the last measurement."""


class Rung(Record):
    """One method at one setting: its largest error, and the shortest time [s] of repeated runs.

    ``error`` is None if the method gave no number at all (division by zero, no convergence). Rungs of the measured
    branch also have ``missing``, the share of trials without a value, and those of an experiment the number of its
    ``trials``.
    """

    quantity: str
    method: str
    setting: str
    error: float | None
    seconds: float
    missing: float | None = None
    trials: int | None = None


class LeftOut(Record):
    """Method that was not measured, and the reason."""

    method: str
    quantities: str
    reason: str


class Sweep(Record):
    """Error of one method along a path towards the limits of double precision.

    ``starts`` is the first x at which the error exceeds `WRONG`, or a verdict is wrong; None if there is none.
    """

    sweep: str
    method: str
    x: tuple[float, ...]
    error: tuple[float | None, ...]
    starts: float | None
    worst: float | None
    wrong_verdicts: int | None = None


class MeasuredAccuracy(Record):
    """Accuracy of the measured branch: errors of estimators and costs on simulated truth."""

    rungs: tuple[Rung, ...]
    seconds: float


class AccuracyReport(Record):
    """Results of `pipeline accuracy`; ``key`` identifies the code and the machine for which they are valid.

    ``rungs``, ``sweeps`` and their evaluation belong to the theory, and are empty if it was left out;
    ``measured_branch`` is None if that was left out.
    """

    key: str
    quick: bool
    measured: str
    machine: dict[str, str]
    rungs: tuple[Rung, ...] = ()
    sweeps: tuple[Sweep, ...] = ()
    left_out: tuple[LeftOut, ...] = ()
    seconds: float = 0.0
    measured_branch: MeasuredAccuracy | None = None


def machine() -> dict[str, str]:
    """Return processor, operating system and versions, on which run times depend."""
    found = {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "system": platform.system(),
        "python": platform.python_version(),
        "pipeline": __version__,
    }
    for name in ("numpy", "scipy", "control"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def key() -> str:
    """Return a hash of code, reference values, machine and versions for which a measurement is valid."""
    code = digest_all(sha256(path.read_bytes()) for path in sorted(PACKAGE_FOLDER.rglob("*.py")))
    values = sha256(reference_file().read_bytes())
    return digest({"code": code, "values": values, **machine()})


def reference_file() -> Path:
    """Return the file of high-precision reference values for errors (docs/make_reference.py)."""
    return schema_folder() / "reference" / "accuracy.json"


def store(report: AccuracyReport, processed: Path) -> None:
    """Store a measurement for the reports of comparisons."""
    write_result(processed, STORED, ".json", (report.model_dump_json() + "\n").encode())


def stored(processed: Path) -> AccuracyReport | None:
    """Return the stored measurement if it was made by this code on this machine, else None."""
    data = read_result(processed, STORED, ".json")
    if data is None:
        return None
    try:
        report = AccuracyReport.model_validate_json(data)
    except ValueError:  # damaged, or of another version: measure again
        return None
    return report if report.key == key() else None


def own_rungs(report: AccuracyReport) -> tuple[Rung, ...]:
    """Return the results of this package, one per quantity."""
    return tuple(r for r in report.rungs if r.method == OURS)
