"""Comparisons with theory, computed from stored logs or read from the JSON document of a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
from pydantic import ValidationError

from pipeline.base.errors import UsageError
from pipeline.base.paths import check_output
from pipeline.comparison.compare import run, write_report
from pipeline.comparison.plan import ComparisonSelection, ReportOptions, plan_comparison
from pipeline.device_data.devices import read_device
from pipeline.records.results import ComparisonResult
from pipeline.rendering.frames import boundary_frame, estimates_frame, frames, optima_frame
from pipeline.rendering.labels import UNITS
from pipeline.surface.logs import PathLike
from pipeline.surface.stored import folder_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = ("experiment", "quantity", "value", "low", "high", "unit", "reason")


class Comparison:
    """Results of a comparison with theory. The tables are those of the report, as data frames.

    Parameters
    ----------
    result : ComparisonResult
        The document that `pipeline compare --json` prints. ``result.model_dump()`` returns it as plain Python values.
    compute : callable, optional
        Function that repeats the comparison and writes its report to a path. None for a comparison that was loaded from
        a document.
    """

    def __init__(self, result: ComparisonResult, compute: Callable[[Path], ComparisonResult] | None = None) -> None:
        self.result = result
        self._compute = compute

    def __repr__(self) -> str:
        names = ", ".join(experiment.experiment for experiment in self.result.experiments)
        return f"<Comparison of {self.result.device} with theory: experiments {names}>"

    def __str__(self) -> str:
        """Return the summary, warnings and recommended estimates as lines of text."""
        lines = [self.result.title, *self.summary, *(f"Warning: {text}" for text in self.warnings)]
        return "\n".join([*lines, self.estimates[list(_SHOWN)].to_string(index=False, na_rep="–")])

    def plot_boundary(self, ax: Axes, experiment: str | None = None) -> Axes:
        """Draw the measured limits of one or all experiments with their 95 % intervals, and return the axes.

        Parameters
        ----------
        ax : matplotlib.axes.Axes
            Stiffness [N/m, Nm/rad] is the abscissa, damping [Ns/m, Nms/rad] the ordinate.
        experiment : str, optional

        Raises
        ------
        UsageError
            If the comparison has no experiment of this name.
        """
        known = [each.experiment for each in self.result.experiments]
        if experiment is not None and experiment not in known:
            raise UsageError(f"experiment {experiment!r}: expected one of {', '.join(known)}.")
        limits = self.boundary
        for name in known if experiment is None else [experiment]:
            own = limits[(limits["experiment"] == name) & limits["stiffness"].notna()]
            wide = own[["low", "high"]].sub(own["stiffness"], axis=0).abs().fillna(0.0).to_numpy().T
            ax.errorbar(own["stiffness"], own["damping"], xerr=wide, marker="o", ms=3, label=f"experiment {name}")
        units = UNITS[self.result.motion]
        ax.set(xlabel=f"stiffness K [{units.stiffness}]", ylabel=f"damping B [{units.damping}]")
        return ax

    def _repr_html_(self) -> str:
        """Return a summary for notebooks: sentences, warnings, and the recommended estimates."""
        lines = [*self.summary, *(f"Warning: {text}" for text in self.warnings)]
        shown = self.estimates[list(_SHOWN)].to_html(index=False, border=0, na_rep="–")
        items = "".join(f"<li>{escape(line)}</li>" for line in lines)
        return f"<div><h4>{escape(self.result.title)}</h4><ul>{items}</ul>{shown}</div>"

    @property
    def summary(self) -> tuple[str, ...]:
        """Conclusions of the comparison, one sentence each."""
        return self.result.summary

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the results, one sentence each."""
        return self.result.warnings

    @property
    def tables(self) -> pd.DataFrame:
        """Measured, theoretical and published optima, arranged like Tables D.1 to D.6.

        ``table``, ``criterion``, ``condition``, ``delay_samples``, ``stiffness`` [N/m, Nm/rad], ``damping`` [Ns/m,
        Nms/rad], ``cost`` (``cost_s`` [s] for costs in samples), ``published_stiffness``, ``published_damping``,
        ``published_cost``, ``deviation_percent`` (of the experimental cost from discrete theory), ``range``,
        ``grid``, ``model``, ``selection``, ``model_low``, ``model_high`` [%] (components of the deviation),
        ``censored``, ``note``, ``experiment``, ``trial_id``.
        """
        return frames(self.result)["tables"]

    @property
    def estimates(self) -> pd.DataFrame:
        """Estimates of all experiments, with the columns of `pipeline.estimates`."""
        return estimates_frame(self.result.experiments)

    @property
    def boundary(self) -> pd.DataFrame:
        """Measured stability boundaries, with the columns of `pipeline.boundary`."""
        return boundary_frame(self.result.experiments, self.result.motion)

    @property
    def optima(self) -> pd.DataFrame:
        """Best trials, with the columns of `pipeline.optima`."""
        return optima_frame(self.result.experiments, self.result.motion)

    @property
    def scores(self) -> pd.DataFrame:
        """Scores of the theoretical predictions for the experiments; ``docs/definitions.md`` defines each number.

        ``experiment``, ``basis`` (parameters used by theory: device file or estimates), ``score`` (``region``,
        ``distance``, ``verdicts``, ``stiffness``), ``quantity``, ``value``, ``low``, ``high`` (ends of the interval, if
        any), ``reason`` (why a score is missing). The table has one row for each number.
        """
        return frames(self.result)["scores"]

    def write(self, path: PathLike) -> Path:
        """Write the HTML report and, next to it, the JSON document. Return the path of the report.

        The report is computed from the data that are stored when this method is called. If the stored data have changed
        since the comparison, the results in this object are updated.

        Raises
        ------
        UsageError
            If the comparison was loaded from a document, or the path is a folder or ends in .json.
        PipelineError
            If the file cannot be written.
        """
        target = Path(path)
        check_output(target, "", document_beside=True)
        result = None if self._compute is None else self._compute(target)
        if result is None:
            raise UsageError(
                f"{target}: this comparison was loaded from a document, which does not contain the samples for the "
                f"figures. Compare again: pipeline.compare({self.result.device!r}).write(...)."
            )
        self.result = result
        return target


def compare(
    device: str,
    processed: PathLike = "processed",
    *,
    experiments: Sequence[str] | None = None,
    criteria: Sequence[str] | None = None,
    full: bool = False,
) -> Comparison:
    """Compare the stored experiments of a device with theory, as `pipeline compare` does.

    Parameters
    ----------
    device : str
        Device name as in the logs. The device need not have a device file. A path of a device file (.toml) is also
        accepted.
    processed : path
        Folder that `ingest` filled. Results of stages are stored there and reused.
    experiments, criteria : sequence of str, optional
        Experiments and criteria to compare. By default, all stored experiments and all criteria are compared.
    full : bool
        True if the report should include the response of every trial, even if the file becomes large.

    Returns
    -------
    Comparison

    Raises
    ------
    DeviceError
        If the device or an experiment has no trials.
    UsageError
        If a criterion is unknown.
    StoreError
        If the folder is missing, a stored file is damaged, or stored trials are inconsistent.
    """
    for name, words in (("experiments", experiments), ("criteria", criteria)):
        if isinstance(words, str):
            raise UsageError(f"{name} = {words!r}: expected a list of names, such as [{words!r}].")
    known = read_device(Path(device)) if device.endswith(".toml") else device
    selection = ComparisonSelection(known, folder_of(processed), experiments=experiments, criteria=criteria)

    def written(path: Path) -> ComparisonResult:
        finished = run(plan_comparison(selection, ReportOptions(path, full=full)))
        write_report(finished)
        return finished.document

    return Comparison(run(plan_comparison(selection)).document, written)


def load(report: PathLike) -> Comparison:
    """Read a comparison from the JSON document of a report. The path of the HTML report is also accepted.

    Raises
    ------
    UsageError
        If the file is missing or is not the document of a comparison.
    """
    path = Path(report)
    document = path.with_suffix(".json") if path.suffix.lower() in (".html", ".htm") else path
    try:
        return Comparison(ComparisonResult.model_validate_json(document.read_bytes()))
    except OSError as error:
        raise UsageError(
            f"{document}: cannot be read ({error.strerror or error}). Name the JSON document that `pipeline compare` "
            "writes next to its report."
        ) from error
    except ValidationError as error:
        (first, *_) = error.errors(include_url=False)
        place = ".".join(map(str, first["loc"])) or "document"
        raise UsageError(
            f"{document}: is not a comparison document of this version ({place}: {first['msg']}). Name the JSON "
            "document that `pipeline compare` writes next to its report, or compare again."
        ) from error
