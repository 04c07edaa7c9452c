"""Faults of the recordings of an experiment, and whether they exclude any delay or limit."""

from __future__ import annotations

from pathlib import PurePath

from pipeline.base.wording import counted
from pipeline.measured.stages.stage_device import recording_findings
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.records.findings import Finding, are_unsafe, stored_findings
from pipeline.records.results import Cause, RecordingFault

NAMED = 10
"""Largest number of logs listed for a fault."""


def recording_faults(stages: ExperimentStages) -> tuple[RecordingFault, ...]:
    """Return the faults of an experiment's recordings by code. Unsafe faults come first, followed by the most frequent
    ones.

    The sentence is that of the first log with the fault. Findings from reading the log, such as repairs, are stored
    with the trial.
    """
    columns = (stages.trials.column(name).to_pylist() for name in ("trial_id", "source_path", "time_quality"))
    trials = {trial: (PurePath(path).name, quality) for trial, path, quality in zip(*columns, strict=True)}
    logs = [trials[trial][0] for trial in stages.texts("response", "trial_id")]
    found: dict[str, list[tuple[str, Finding]]] = {}
    for trial, findings in zip(stages.texts("response", "trial_id"), stages.once(recording_findings), strict=True):
        log, quality = trials[trial]
        for finding in (*findings, *(each for each in stored_findings(quality) if each.is_by_reading)):
            found.setdefault(finding.code, []).append((log, finding))
    faults = [
        RecordingFault(
            code=some[0][1].code,
            severity=some[0][1].severity,
            trials=len(some),
            of=len(logs),
            sentence=some[0][1].sentence,
            remedy=some[0][1].remedy,
            logs=tuple(log for log, _ in some[:NAMED]),
        )
        for some in found.values()
    ]
    return tuple(sorted(faults, key=lambda fault: (not fault.is_unsafe, -fault.trials)))


def unsafe_recording(stages: ExperimentStages) -> RecordingFault | None:
    """Return the fault that excludes any delay and limit of an experiment, because too many logs have it, or None."""
    if not are_unsafe(stages.once(recording_findings)):
        return None
    return next(fault for fault in stages.once(recording_faults) if fault.is_unsafe)


def words_of(fault: RecordingFault) -> str:
    """Return a fault as a reason, with its evidence and the number of logs that have it."""
    evidence = fault.sentence.removesuffix(fault.remedy).strip().rstrip(".")
    return f"{evidence[0].lower()}{evidence[1:]} ({fault.trials} of {counted(fault.of, 'log')})"


def cause_of(fault: RecordingFault) -> Cause:
    """Return a fault as a cause."""
    more = f", and {fault.trials - len(fault.logs)} more" if fault.trials > len(fault.logs) else ""
    return Cause(
        code=fault.code,
        sentence=fault.sentence,
        evidence=f"{fault.trials} of {counted(fault.of, 'log')}: {', '.join(fault.logs)}{more}",
    )
