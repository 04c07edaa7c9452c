"""Gathers two experiments, devices or documents, compares them, and writes the page about it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline import __version__
from pipeline.base.errors import UsageError
from pipeline.base.provenance import code_digest
from pipeline.comparison.against import Trials, compare_pair
from pipeline.comparison.compare_experiment import estimated_theories, experiment_result, motion_of, nominal_theories
from pipeline.comparison.figures.boundary_curves import measured_curve
from pipeline.comparison.figures.figure_boundaries import plane_figure
from pipeline.comparison.scene.origin import excluded_trials
from pipeline.comparison.scene.scene import SceneData, open_scene
from pipeline.records.against_records import AgainstResult, PairDifference, Side
from pipeline.records.figure_records import Figure, Limits
from pipeline.records.findings import BoundaryPoint, Estimate, ExcludedTrial, Note, Optimum, Record
from pipeline.records.results import ComparisonResult, ExperimentResult
from pipeline.rendering.report.report_against import AgainstPage
from pipeline.theory.predictions import Theory


def against_experiments(
    processed: Path,
    first: tuple[str, str],
    second: tuple[str, str],
    criteria: Sequence[str] | None = None,
    progress: Callable[[str], None] | None = None,
    notes: tuple[Sequence[Note], Sequence[Note]] = ((), ()),
) -> AgainstPage:
    """Compare two stored experiments, of one device or of two; those of two in the plane of alpha and beta.

    Parameters
    ----------
    processed : Path
    first, second : (device, experiment)
    criteria : sequence of str, optional
        By default all.
    progress : callable, optional
        Gets the name of each step when it begins.
    notes : (sequence of Note, sequence of Note)
        What people wrote on each side, which the page repeats.

    Raises
    ------
    UsageError
        If both are the same, or the plane of alpha and beta needs a mass that cannot be had.
    DeviceError
        If one is not stored.
    """
    if first == second:
        raise UsageError(
            f"device {first[0]!r}, experiment {first[1]!r}: is to be compared against itself. Give another."
        )
    say = progress or (lambda _: None)
    found = []
    for device, experiment in (first, second):
        say(f"device {device}, experiment {experiment}: estimates and costs")
        found.append(_gather(open_scene(device, processed, [experiment], criteria)))
    (a, a_theory, a_data), (b, b_theory, b_data) = found
    code = code_digest("report")
    one, other = (
        Side(
            device=d,
            experiment=e,
            version=__version__,
            code=code,
            excluded=excluded_trials(data),
            notes=tuple(said),
            simulated=data.simulated,
        )
        for (d, e), data, said in ((first, a_data, notes[0]), (second, b_data, notes[1]))
    )
    motions = (motion_of(a_data), motion_of(b_data))
    scales = None
    if first[0] != second[0]:
        if a_theory is None or b_theory is None:
            missing = first if a_theory is None else second
            raise UsageError(
                f"device {missing[0]!r}, experiment {missing[1]!r}: two devices are compared in the plane of alpha and "
                "beta, which needs a mass: there is no device file, and the logs give no estimate."
            )
        scales = (_units(a_theory), _units(b_theory))
    trials = (_trials(a_data), _trials(b_data))
    pair = compare_pair(one, other, (a, b), trials, motions, scales)
    labels = [one.label, other.label]
    if a_theory is not None and b_theory is not None and scales is not None:
        figure = plane_figure([(labels[0], a, a_theory), (labels[1], b, b_theory)])
    else:
        figure = _overlay(labels, (a, b))
    title = f"{labels[0]} against {labels[1]}"
    return AgainstPage(AgainstResult(title=title, pairs=(pair,)), (figure,), motions[0])


def against_document(new: ComparisonResult, old: Document) -> AgainstPage:
    """Compare a result with the document of an earlier one of its device, such as by another version of the code."""
    before = old.experiments
    after = {e.experiment: e for e in new.experiments}
    pairs: list[PairDifference] = []
    figures: list[Figure[Limits]] = []
    for name in (n for n in before if n in after):
        sides = (_side(old, before[name]), _side(new, after[name]))
        pairs.append(compare_pair(*sides, (before[name], after[name]), None, (new.motion, new.motion)))
        figures.append(_overlay([f"{name}, before", f"{name}, now"], (before[name], after[name]), f"-{len(figures)}"))
    return AgainstPage(
        AgainstResult(
            title=f"{new.device}: {_version(old.provenance)} against {_version(new.provenance)}",
            pairs=tuple(pairs),
            only_first=tuple(n for n in before if n not in after),
            only_second=tuple(n for n in after if n not in before),
        ),
        tuple(figures),
        new.motion,
    )


@dataclass(frozen=True)
class Document:
    """What an earlier document has that is compared; its other fields may be those of another version."""

    device: str
    experiments: dict[str, ExperimentResult]
    provenance: Mapping[str, str]
    excluded: tuple[ExcludedTrial, ...]


def read_document(path: Path, device: str) -> Document:
    """Read the document of an earlier result of a device.

    Raises
    ------
    UsageError
        If the file is no document by `compare`, or of another device.
    """
    try:
        values = json.loads(path.read_bytes())
        found = [_experiment(e) for e in values["experiments"]]
        excluded = tuple(ExcludedTrial(**_known(ExcludedTrial, one)) for one in values.get("excluded", ()))
        experiments = {e.experiment: e for e in found}
        old = Document(str(values["device"]), experiments, values.get("provenance", {}), excluded)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error}). Give the JSON document beside a report.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f"{path}: is no result of `pipeline compare` ({type(error).__name__}: {str(error)[:200]}). Give the JSON "
            "document beside a report."
        ) from error
    if old.device != device:
        raise UsageError(f"{path}: is of device {old.device!r}; expected one of {device!r}.")
    return old


def _experiment(values: Mapping[str, Any]) -> ExperimentResult:
    return ExperimentResult(
        experiment=values["experiment"],
        configuration="",
        grip="none",
        simulated=values.get("simulated", False),
        trials=values.get("trials", 0),
        verdicts={},
        estimates={name: _estimate(e) for name, e in values["estimates"].items()},
        boundary=tuple(BoundaryPoint(**_known(BoundaryPoint, p)) for p in values["boundary"]),
        optimum={name: Optimum(**_known(Optimum, o)) for name, o in values["optimum"].items()},
    )


def _estimate(values: Mapping[str, Any]) -> Estimate:
    fields = _known(Estimate, values)
    methods = {name: _estimate(e) for name, e in fields.pop("by_method", {}).items()}
    # what is not compared may have had another form
    plain = {name: fields[name] for name in ("value", "low", "high", "unit", "method", "reason") if name in fields}
    return Estimate(**plain, by_method=methods)


def _known(record: type[Record], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that this version knows."""
    return {name: value for name, value in values.items() if name in record.model_fields}


def _side(of: Document | ComparisonResult, result: ExperimentResult) -> Side:
    return Side(
        device=of.device,
        experiment=result.experiment,
        version=of.provenance.get("version", "?"),
        code=of.provenance.get("code", of.provenance.get("key", "?")),
        excluded=tuple(one for one in of.excluded if one.experiment == result.experiment),
        simulated=result.simulated,
    )


def _version(origin: Mapping[str, str]) -> str:
    return f"version {origin.get('version', '?')} ({origin.get('code', origin.get('key', '?'))})"


def _gather(data: SceneData) -> tuple[ExperimentResult, Theory | None, SceneData]:
    stages = data.experiments[0]
    theory = nominal_theories(data).get(stages.experiment)
    result = experiment_result(data, stages, theory)
    if theory is None:
        theory = estimated_theories([result], data).get(stages.experiment)
    return result, theory, data


def _units(theory: Theory) -> tuple[float, float]:
    return theory.units.stiffness, theory.units.damping


def _trials(data: SceneData) -> Trials:
    """Costs of the trials of the one experiment of a scene."""
    stages = data.experiments[0]
    k, b = stages.column("response", "stiffness"), stages.column("response", "damping")
    return {criterion: (k, b, stages.cost(criterion)[0]) for criterion in data.scene.criteria}


def _overlay(
    labels: Sequence[str], results: tuple[ExperimentResult, ExperimentResult], suffix: str = ""
) -> Figure[Limits]:
    curves = tuple(measured_curve(r, label) for r, label in zip(results, labels, strict=True))
    return Figure(
        "boundaries",
        f"boundaries-against{suffix}",
        f"Boundaries of {labels[0]} and {labels[1]}",
        "Last stable stiffness at each damping.",
        (("", curves),),
    )


def names_of(words: str, device: str, experiments: Sequence[str]) -> tuple[str, str]:
    """Return device and experiment that ``--against`` means: ``EXPERIMENT``, or ``DEVICE:EXPERIMENT``.

    Parameters
    ----------
    words : str
    device : str
        Device of the first experiment.
    experiments : sequence of str
        Experiments that are stored of the first device; their names may hold a colon.
    """
    if words in experiments or ":" not in words:
        return device, words
    other, _, experiment = words.partition(":")
    return other, experiment
