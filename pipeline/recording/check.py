"""Check a log for all faults of the recording, before the log is used in a computation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from pipeline.recording.causality import moves_before_command
from pipeline.recording.ramps import interpolated_command
from pipeline.recording.rows import frozen_position, interpolated_position, repeated_rows
from pipeline.recording.samples import Samples
from pipeline.recording.screen import ANYTHING, REPEATED_ROWS, TRAVEL_STOP, screened
from pipeline.recording.signals import coarse_sensor, unusable_signal, wrong_sign
from pipeline.recording.timing import missing_rows, sampling_period
from pipeline.recording.travel import travel_stop
from pipeline.recording.wrapping import wrapped_position
from pipeline.records.findings import Finding
from pipeline.records.trials import Trial

CHECKS: tuple[Callable[[Samples], Finding | None], ...] = (
    sampling_period,
    missing_rows,
    wrapped_position,
    repeated_rows,
    frozen_position,
    interpolated_position,
    travel_stop,
    interpolated_command,
    moves_before_command,
    wrong_sign,
    coarse_sensor,
)
"""Checks of a log that contains motion, in the order in which their findings are shown."""

SCREENED = {REPEATED_ROWS: repeated_rows, TRAVEL_STOP: travel_stop}
"""Checks that remain for a log if the screen has excluded the findings of all other checks, in the same order."""


def check_recording(samples: Samples) -> tuple[Finding, ...]:
    """Return the recording faults of a log. The result is empty for a log without faults.

    Parameters
    ----------
    samples : Samples

    Notes
    -----
    If a log has no motion or is too short for any model, no other fault is reported except for its sampling period. A
    position that is interpolated linearly between fewer readings also seems to move before its command and to change
    its speed abruptly. These effects are not reported as separate findings.
    """
    nothing = unusable_signal(samples)
    if nothing is None:
        return tuple(_found(samples))
    period = sampling_period(samples)
    return (nothing,) if period is None else (nothing, period)


def check_recordings(logs: Sequence[Samples]) -> list[tuple[Finding, ...]]:
    """Return the same findings as `check_recording` for each log. For hundreds of logs, this function is ten times as
    fast.

    Parameters
    ----------
    logs : sequence of Samples
    """
    found = list[tuple[Finding, ...]]()
    for samples, what in zip(logs, screened(logs), strict=True):
        if what == ANYTHING:
            found.append(check_recording(samples))
        else:
            checks = (check for code, check in SCREENED.items() if code & what)
            found.append(tuple(finding for check in checks if (finding := check(samples)) is not None))
    return found


def check_trial(trial: Trial) -> tuple[Finding, ...]:
    """Return the recording faults of a trial, like `check_recording`."""
    return check_recording(
        Samples(
            *(trial.time, trial.command, trial.position, trial.sampling_period_s),
            *(trial.stiffness, trial.damping, trial.step, trial.step_row),
            motion=trial.motion,
        )
    )


def _found(samples: Samples) -> Iterator[Finding]:
    codes = set[str]()
    for check in CHECKS:
        if "interpolated_rows" in codes and check in (travel_stop, moves_before_command):
            continue
        finding = check(samples)
        if finding is not None:
            codes.add(finding.code)
            yield finding
            if finding.severity == "cut" and finding.first_row is not None:
                samples = samples.before(finding.first_row)
                if samples.range == 0:
                    return
