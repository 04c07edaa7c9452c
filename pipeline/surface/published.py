"""Published values that a user computes with, as data frames."""

from __future__ import annotations

import pandas as pd

from pipeline.device_data import human_arm as published
from pipeline.surface.frames import units_of


def human_arms() -> pd.DataFrame:
    """Return published parameters of human arms; a row's numbers are what `Loop` takes as ``operator``.

    Returns
    -------
    pandas.DataFrame
        ``source``, ``mass`` [kg], ``stiffness`` [N/m], ``damping`` [Ns/m].

    Source: Hulin 2017, Table 3.2.
    """
    frame = pd.DataFrame(
        [arm.model_dump() for arm in published.human_arms()], columns=list(published.HumanArm.model_fields)
    )
    frame.attrs["units"] = {"mass": "kg"} | units_of(("stiffness", "damping"), {"translation"})
    return frame
