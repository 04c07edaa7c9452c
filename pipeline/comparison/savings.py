"""How many trials of a finished course could have been saved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.comparison.scene.scene import SceneData
from pipeline.measured.stages.stages import ExperimentStages
from pipeline.plan.replay import saving_of
from pipeline.plan.verdicts import Tried
from pipeline.records.results import ExperimentResult


def with_saving(data: SceneData, results: Sequence[ExperimentResult]) -> list[ExperimentResult]:
    """Return the results with the saving of the first experiment whose course is finished: a replay takes a second."""
    found = list(results)
    for i, (result, stages) in enumerate(zip(results, data.experiments, strict=True)):
        K, B, growth = (stages.column("response", name) for name in ("stiffness", "damping", "growth_per_s"))
        tried = Tried(K, B, stages.verdicts.verdict, growth)
        saving = saving_of(tried.select((K > 0) & (B >= 0)), stages.sampling_period_s, trial_s(stages))
        if saving is not None:
            found[i] = result.model_copy(update={"saving": saving})
            break
    return found


def trial_s(stages: ExperimentStages) -> float:
    """Return how long a log usually is [s]."""
    return float(np.median(stages.trials.column("rows").to_numpy())) * stages.sampling_period_s
