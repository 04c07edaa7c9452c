"""Error and run time of every numerical method: records, and the file of a finished measurement."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from pipeline.base.disk import read_result, write_result
from pipeline.base.provenance import PACKAGE_FOLDER, __version__, digest, digest_all, schema_folder, sha256
from pipeline.records.findings import Record

OURS = "this package"
"""Name of the method of this package among the compared methods."""

WRONG = 1e-6
"""Smallest relative error of a result that counts as wrong. No plot, table or controller needs a smaller error."""

STORED = "accuracy"
"""Prefix of the name of the file below `processed/` with the last measurement."""


class Rung(Record):
    """A method at a setting: its largest error, and the shortest time [s] of repeated runs.

    ``error`` is None if the method returned no number (division by zero, no convergence). Rungs of methods for logs
    also have ``missing``, the share of trials without a value. Rungs of an experiment also have its number of
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
    """A method that was not measured, and the reason."""

    method: str
    quantities: str
    reason: str


class Sweep(Record):
    """Error of a method along a path towards the limits of double precision.

    ``starts`` is the first x at which the error exceeds `WRONG` or a verdict is wrong. It is None if there is no such
    x.
    """

    sweep: str
    method: str
    x: tuple[float, ...]
    error: tuple[float | None, ...]
    starts: float | None
    worst: float | None
    wrong_verdicts: int | None = None


class MeasuredAccuracy(Record):
    """Accuracy of estimators and costs from logs: errors relative to a simulated truth."""

    rungs: tuple[Rung, ...]
    seconds: float


class AccuracyReport(Record):
    """Results of `pipeline accuracy`. ``key`` identifies the code and the machine for which they are valid.

    ``rungs``, ``sweeps`` and their evaluation concern the methods for theory, and are empty if these were not measured.
    ``measured_branch`` is None if methods for logs were not measured.
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
    """Return the processor, the operating system and the versions, which affect run times."""
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
    except OSError:  # the system is not Linux
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
    """Return the stored measurement if it was made by this code on this machine, otherwise None."""
    data = read_result(processed, STORED, ".json")
    if data is None:
        return None
    try:
        report = AccuracyReport.model_validate_json(data)
    except ValueError:  # the file is damaged or from a different version, so measure again
        return None
    return report if report.key == key() else None


def own_rungs(report: AccuracyReport) -> tuple[Rung, ...]:
    """Return the results of this package, one for each quantity."""
    return tuple(r for r in report.rungs if r.method == OURS)
