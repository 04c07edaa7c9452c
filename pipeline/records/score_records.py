"""How well theory predicts an experiment: finished scores, each with its unit (docs/definitions.md)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipeline.records.findings import Record
from pipeline.records.loop_parts import LoopParts


class TheoryParameters(Record):
    """Parameters of a theoretical curve or map: m [kg, kg m^2], b, k, T [s], d and where they come from.

    ``loop`` are the parts that leave the loop not ideal; mass, damping and stiffness are then the device's alone.
    """

    mass: float
    damping: float
    stiffness: float
    sampling_period_s: float
    delay_samples: float
    source: str
    loop: LoopParts = LoopParts()


class RegionScore(Record):
    """Measured and theoretical stable regions inside the tested window (areas in stiffness times damping).

    ``overlap`` is intersection over union, ``covered`` the part of the theoretical region that is measured as stable,
    ``area_ratio`` measured over theoretical area. ``low`` and ``high`` bound each of them by what the intervals of the
    measured limits leave open. At ``censored`` of ``dampings`` the window ends at the stiffest stable trial.
    """

    overlap: float
    overlap_low: float
    overlap_high: float
    covered: float
    covered_low: float
    covered_high: float
    area_ratio: float
    area_ratio_low: float
    area_ratio_high: float
    measured_area: float
    theory_area: float
    damping_low: float
    damping_high: float
    dampings: int
    censored: int


class DistanceScore(Record):
    """Signed distance of the measured boundary from theory at the tested dampings.

    ``median`` and ``largest`` are (K_measured - K_theory)/K_theory [1] over ``dampings``; ``rms`` [N/m, Nm/rad] is over
    those and the ``near_zero`` ones, where the theoretical limit is too small to divide by. ``lower_bounds`` of the
    dampings are censored with theory below the tested range: the distance is at least that large. ``open`` are
    censored ones with theory above it: nothing is known there, and they are left out. Of the dampings, ``bounded`` have
    a limit with bounds on both sides (or a lower one that theory is below): at ``agreeing`` of these theory meets the
    interval of the limit, or is nearer to it than 2 %, at ``above`` the limit lies above theory. ``largest`` is among
    the bounded ones, where there are any. The median is ``steady`` where no single limit decides it.
    """

    median: float
    largest: float
    largest_damping: float
    rms: float
    dampings: int
    near_zero: int
    lower_bounds: int
    open: int
    bounded: int
    agreeing: int
    above: int
    steady: bool = False


class VerdictScore(Record):
    """Verdicts of the trials against those of theory at the same (K, B), as numbers of trials.

    ``agreement`` is the share of both diagonal entries. Left out are ``undecided`` trials and those ``without_wall``
    (K <= 0), where stable has another meaning.
    """

    both_stable: int
    both_unstable: int
    only_theory_stable: int
    only_log_stable: int
    undecided: int
    without_wall: int
    agreement: float


class StiffnessScore(Record):
    """Largest stable stiffness [N/m, Nm/rad] measured and by theory, both over the tested dampings.

    ``anywhere`` is that of theory over all dampings. ``lower_bound`` says that the tested stiffnesses ended there.
    """

    measured: float
    measured_damping: float
    lower_bound: bool
    theory: float
    theory_damping: float
    anywhere: float
    anywhere_damping: float
    deviation_percent: float


class Scores(Record):
    """Scores of one experiment against one theory; what could not be had is None, with its reason in ``missing``."""

    parameters: TheoryParameters
    basis: Literal["device file", "estimates"]
    region: RegionScore | None = None
    distance: DistanceScore | None = None
    verdicts: VerdictScore | None = None
    stiffness: StiffnessScore | None = None
    missing: dict[str, str] = Field(default_factory=dict)
