"""The columns of a stage with one row a trial: those that every stage has, and forms of the others."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pyarrow as pa

from pipeline.measured.stages.stage_groups import Columns, Given, TrialGroup
from pipeline.records.tables import TABLES, to_arrow


def conditions(of: TrialGroup) -> Columns:
    """Return the columns by which trials are known."""
    return {
        "trial_id": list(of.batch.trial_id),
        "samples_sha256": list(of.logged.digests),
        "stiffness": of.batch.stiffness,
        "damping": of.batch.damping,
    }


def joined_texts(*reasons: Iterable[str]) -> list[str | None]:
    """Return the reasons of each trial, joined; None where there is none."""
    return ["; ".join(dict.fromkeys(text for text in texts if text)) or None for texts in zip(*reasons, strict=True)]


def hull(made: Columns, other: Columns, names: Iterable[str]) -> Columns:
    """Return columns whose intervals ``<name>_low`` and ``<name>_high`` hold those of other ones, too."""
    ends = {f"{name}_low": np.fmin for name in names} | {f"{name}_high": np.fmax for name in names}
    return made | {end: widest(made[end], other[end]) for end, widest in ends.items()}


def row_column(values: np.ndarray) -> pa.Array:
    """Return rows or counts of which a negative one stands for none."""
    return pa.array(values, mask=values < 0)


def stage_rows(
    of: TrialGroup, stage: str, columns: Callable[[TrialGroup, Given], Columns], given: Given, *, rotation: bool
) -> pa.Table:
    """Return the rows of a stage for some trials; nulls and the reason where the experiment lacks what it needs."""
    if "missing" in given:
        nothing: Columns = dict.fromkeys(TABLES[stage], [None] * len(of.batch))
        found = nothing | conditions(of) | {"reason": [given["missing"]] * len(of.batch)}
    else:
        found = columns(of, given)
    return to_arrow(stage, found, rotation=rotation)
