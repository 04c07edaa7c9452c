"""Results of a comparison: the document that `compare --json` prints, which is also the input of a report.

The last records in this module are differences between two experiments, devices or code versions, as second minus
first.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, Literal

from pydantic import Field, model_serializer, model_validator

from pipeline.base.json_object import JsonObject
from pipeline.device.loop import Loop
from pipeline.device.parts import LoopTable
from pipeline.records.findings import (
    BoundaryPoint,
    DampingRange,
    Estimate,
    ExcludedTrial,
    FindingCode,
    Limit,
    ModelCheck,
    Note,
    Optimum,
    Quantity,
    Record,
    Severity,
)
from pipeline.records.models import ComparisonRow, Measuring, Motion


class SourcedLoop(Record):
    """A loop with the source of its parameters.

    The JSON is flat: ``mass``, ``damping`` and all other parameters of the device, ``source``, and its parts in
    ``loop`` with the keys of a device file.
    """

    loop: Loop
    source: str

    @model_validator(mode="before")
    @classmethod
    def _from_flat(cls, given: Any) -> Any:
        if not isinstance(given, dict) or isinstance(given.get("loop"), Loop):
            return given
        numbers = {name: value for name, value in given.items() if name not in ("loop", "source")}
        parts = LoopTable.model_validate(given.get("loop", {}))
        return {"loop": Loop(**numbers, **dict(parts)), "source": given["source"]}

    @model_serializer
    def _flat(self) -> JsonObject:
        loop = self.loop
        numbers = {each.name: getattr(loop, each.name) for each in fields(loop)}
        parts = LoopTable(**{name: getattr(loop, name) for name in LoopTable.model_fields})
        numbers = {name: value for name, value in numbers.items() if name not in LoopTable.model_fields}
        numbers |= {"sensor": loop.sensor.model_dump(), "jitter_samples": list(loop.jitter_samples)}
        return {**numbers, "source": self.source, "loop": parts.model_dump(mode="json")}


class RegionScore(Record):
    """Measured and theoretical stable regions inside the tested window. Areas are in stiffness times damping.

    ``overlap`` is intersection over union, ``covered`` the share of the theoretical region that is measured as stable,
    ``area_ratio`` measured over theoretical area. ``low`` and ``high`` are bounds that follow from the intervals of the
    measured limits. At ``censored`` of the ``dampings``, the tested range ends below the limit, and the window ends at
    the stiffest stable trial.
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


class DampingSpan(Record):
    """Range of damping [Ns/m, Nms/rad]. An end is None if the range extends to the end of the tested dampings."""

    low: float | None = None
    high: float | None = None


class DistanceScore(Record):
    """Signed distance of the measured boundary from theory at the tested dampings.

    ``median`` and ``largest`` are (K_measured - K_theory)/K_theory [1] over ``dampings``. ``rms`` [N/m, Nm/rad] also
    includes the ``near_zero`` dampings, at which the theoretical limit is too small as a denominator. ``lower_bounds``
    is the number of censored dampings at which theory is below the end of the tested range. The distance at these
    dampings is a lower bound. ``open`` is the number of censored dampings at which theory is above this end. These
    dampings are left out, because the distance is unknown. ``bounded`` is the number of dampings whose limit has bounds
    on both sides, or a lower bound above theory. At ``agreeing`` of these, theory lies in the interval of the limit, or
    outside the interval by at most 2 % of the theoretical limit. At ``above`` of these, the limit lies above theory.
    ``largest`` is taken over the bounded dampings if there are any. The median is ``steady`` if it does not depend on
    any single limit. ``apart`` contains the dampings at which most bounded limits disagree with theory, as in
    `Prediction`.
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
    apart: DampingSpan | None = None


class VerdictScore(Record):
    """Numbers of trials by their measured verdict and by the theoretical verdict at the same (K, B).

    ``agreement`` is the share of trials with equal verdicts. It does not include ``undecided`` trials and trials
    ``without_wall`` (K <= 0), for which "stable" has a different meaning.
    """

    both_stable: int
    both_unstable: int
    only_theory_stable: int
    only_log_stable: int
    undecided: int
    without_wall: int
    agreement: float


class StiffnessScore(Record):
    """Largest stable stiffness [N/m, Nm/rad], measured and theoretical, both over the tested dampings.

    ``anywhere`` is the theoretical value over all dampings. ``lower_bound`` is true if the measured value is the
    largest tested stiffness.
    """

    measured: float
    measured_damping: float
    lower_bound: bool
    theory: float
    theory_damping: float
    anywhere: float
    anywhere_damping: float
    deviation_percent: float


class DampingScore(Record):
    """Largest damping [Ns/m, Nms/rad] with a stable trial, and theory's largest damping with any stiffness (6.2.3).

    ``lower_bound`` is true if no wall that is as soft as a stable one there is unstable at a larger damping.
    """

    measured: float
    lower_bound: bool
    theory: float
    deviation_percent: float


ScoreBasis = Literal["device file", "estimates", "measured damping"]
"""Source of the parameters of a theory: the device file, the logs, or the device file with the damping from the
logs."""


class Scores(Record):
    """Scores of the theoretical predictions for an experiment. A missing score is None, and ``missing`` has the reason.

    The ``basis`` "measured damping" occurs as a second entry if the damping from the logs differs from that of the
    device file.
    """

    parameters: SourcedLoop
    basis: ScoreBasis
    region: RegionScore | None = None
    distance: DistanceScore | None = None
    verdicts: VerdictScore | None = None
    stiffness: StiffnessScore | None = None
    damping: DampingScore | None = None
    missing: dict[str, str] = Field(default_factory=dict)


CauseCode = Literal[
    "other_gains",
    "coulomb_friction",
    "velocity_filter",
    "position_filter",
    "adaptive_velocity",
    "decimated_rows",
    "actuator_lag",
    "vibration_mode",
    "operator",
    "saturation",
    "rate_limit",
    "unilateral_wall",
    "delay_jitter",
    "fractional_delay",
    "constant_force",
    "missing_rows",
    "repeated_rows",
    "command_shifted",
    "scattered_stamps",
    "coarse_sensor",
    "step_not_a_step",
    "several_steps",
    "force_gain",
    "sampling_period",
    "parameter_range",
    "no_stable_trial",
    "no_unstable_trial",
    "few_trials",
]


LIMITS_WITHIN = 5.0
"""Largest error of the predicted limits of an adequate loop [%]. Campaigns bracket limits to within 4 %."""

VERDICTS_RIGHT = 0.95
"""Smallest share of the verdicts that an adequate device must predict."""


class LoopResult(Record):
    """Loop used for theory and for all conclusions about an experiment, and its adequacy.

    ``mass``, ``damping``, ``stiffness`` and ``mode`` are the effective values at the wall, including the operator, per
    unit of command. ``delay_samples`` is not rounded. ``velocity``, ``mode`` and ``operator`` contain parameters by
    name. ``explained`` is the share of the logs that the fitted model explains, or None without a fit.
    """

    source: Literal["device file", "estimated"]
    adequate: bool
    reason: str
    explained: float | None = None
    mass: Quantity | None = None
    damping: Quantity | None = None
    stiffness: Quantity | None = None
    delay_samples: Quantity | None = None
    actuator_lag_s: Quantity | None = None
    velocity: dict[str, Quantity] | None = None
    mode: dict[str, Quantity] | None = None
    operator: dict[str, Quantity] | None = None
    friction: Quantity | None = None


class ReplayResiduals(Record):
    """Residuals of a replay at the stable walls, each shape (n,): K [N/m, Nm/rad], B [Ns/m, Nms/rad], residual [%].

    The residual is the norm of the difference between logged and predicted position, relative to the norm of the logged
    position about its mean.
    """

    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    percent: tuple[float, ...]


class WallReplay(Record):
    """Prediction by the identified device, with friction and scatter, of tested walls that were not used for the fit.

    ``fit_percent`` is the median fit of the position at stable walls. ``verdicts_same`` is the share of equal decided
    verdicts. ``limits_off_percent`` and ``costs_off_percent`` are the median errors of limits and settling times. The
    median half-width of the intervals of measured limits is ``limits_known_percent``. 95 % of the predicted limits are
    at most ``limits_error_percent`` outside of these intervals. A value is None if there is nothing to compare.
    ``trials`` is the number of compared verdicts. For a device with jitter, only verdicts on which several runs agree
    are compared. ``residuals`` are those of the individual walls.
    """

    fit_percent: float | None
    verdicts_same: float | None
    limits_off_percent: float | None
    costs_off_percent: float | None
    trials: int
    limits_known_percent: float | None = None
    limits_error_percent: float | None = None
    residuals: ReplayResiduals | None = None

    @property
    def limits_open(self) -> bool:
        """True if the tested walls bracket the limits too widely to judge the predicted limits."""
        return (self.limits_known_percent or 0.0) > max(self.limits_off_percent or 0.0, LIMITS_WITHIN)

    @property
    def is_right(self) -> bool:
        """True if the predicted limits are within 5 % of the measured intervals, and 95 % of the verdicts are
        correct."""
        limits = (self.limits_off_percent or 0.0) <= LIMITS_WITHIN + (self.limits_known_percent or 0.0)
        if self.verdicts_same is None:
            return False
        # With few trials, a single error may be due to chance.
        return limits and round((1 - self.verdicts_same) * self.trials) <= max((1 - VERDICTS_RIGHT) * self.trials, 1)


class PassiveWall(Record):
    """Stiffest wall that is passive and stable over the whole 95 % range of a loop."""

    stiffness: float
    damping: float


class ImpliedDelay(Record):
    """Pure delay [samples] implied by a measured boundary: from its slope near the origin (3.25), and from all limits.
    This is the delay of an ideal loop with the mass and damping estimated from the logs. If it exceeds the delay
    estimated from the logs, a lag or a velocity filter causes the difference. If the delay near the origin is less than
    the delay from all limits, the delay jitters, or friction keeps soft walls stable.
    """

    origin: Quantity
    whole: Quantity


class StraightBound(Record):
    """Line K <= stiffness + slope B through the measured limits, starting at the stiffest wall (6.5), in SI.

    ``limits`` is the number of limits, from ``damping_first`` to ``damping_last``. A parabola through them has the
    ``curvature``. The curvature of the theoretical limits is ``curvature_theory``, or null if theory has a stable wall
    at fewer than four of these dampings. Otherwise, both curvatures use only dampings with a stable wall in theory, the
    largest of which is ``curvature_last``.
    """

    stiffness: float
    slope: float
    slope_low: float
    slope_high: float
    damping_first: float
    damping_last: float
    limits: int
    curvature: float | None = None
    curvature_low: float | None = None
    curvature_high: float | None = None
    curvature_theory: float | None = None
    curvature_last: float | None = None

    @property
    def is_straight(self) -> bool | None:
        """True if the interval of the measured curvature includes zero, or None if the curvature is unknown."""
        if self.curvature_low is None or self.curvature_high is None:
            return None
        return self.curvature_low <= 0 <= self.curvature_high

    @property
    def excludes_theory(self) -> bool | None:
        """True if the theoretical curvature is outside the interval of the measured curvature, or None if one of them
        is unknown."""
        ends = self.curvature_low, self.curvature_high
        if self.curvature_theory is None or ends[0] is None or ends[1] is None:
            return None
        return not ends[0] <= self.curvature_theory <= ends[1]


ChangeCode = Literal[
    "delay",
    "mass",
    "damping",
    "spring",
    "operator",
    "velocity_filter",
    "actuator_lag",
    "vibration_mode",
    "friction",
    "delay_jitter",
]
"""Parameter or part of a loop that is changed to determine its effect."""


class LoopChange(Record):
    """Changed parameter or part of a loop, and the resulting change in a result, in percent."""

    code: ChangeCode
    percent: float


class RegionCauses(Record):
    """Changes in the area of the theoretical stable region due to parameters and parts estimated from the logs, in
    percent (6.2.3). Each of the ``changes`` replaces one parameter or part of the device file that differs from the
    logs. ``together_percent`` is the change for the device identified from the logs, with friction and jitter.
    """

    changes: tuple[LoopChange, ...]
    together_percent: float


class Cause(Record):
    """Cause of a deviation of an experiment from the ideal loop: a code, a sentence, and the evidence."""

    code: CauseCode | FindingCode
    sentence: str
    evidence: str


class RecordingFault(Record):
    """Fault of the recordings of an experiment: number of trials, evidence of the first trial, and remedy.

    ``logs`` contains the names of the first logs with the fault.
    """

    code: FindingCode
    severity: Severity
    trials: int
    of: int
    sentence: str
    remedy: str
    logs: tuple[str, ...]

    @property
    def is_unsafe(self) -> bool:
        """True if these trials cannot be used for a delay or a limit."""
        return self.severity == "unsafe"


class LoopFindings(Record):
    """Loop, limits, passive wall and causes of an experiment. A missing result is None, with a reason.

    ``loop`` is None if no requested result needs a device. ``optimum`` states for each optimum whether its wall is
    passive. ``sensitivities`` are changes in the largest stable stiffness: for one sample less of delay, and without
    each part of the loop. ``region_causes`` is None without a device file or an adequate loop.
    """

    loop: LoopResult | None = None
    optimum: dict[str, Optimum] = Field(default_factory=dict)
    loop_boundary: tuple[Limit, ...] | None = None
    passive: PassiveWall | None = None
    passive_reason: str | None = None
    implied_delay: ImpliedDelay | None = None
    straight_bound: StraightBound | None = None
    replay: WallReplay | None = None
    sensitivities: tuple[LoopChange, ...] = ()
    region_causes: RegionCauses | None = None
    causes: tuple[Cause, ...] = ()


class Truth(Record):
    """Ground truth of a simulated experiment: its loop, jitter [samples] and constant force [N, Nm].

    The delay of ``loop`` is the mean delay of the applied command, and ``jitter_samples`` its standard deviation.
    ``limit_reason`` states why the limits of the loop are unknown.
    """

    loop: SourcedLoop
    jitter_samples: float
    constant_force: float
    limit_reason: str | None = None

    @property
    def values(self) -> dict[str, float | None]:
        """True values by the names of estimates, as effective values at the wall, per unit of command.

        With an actuator lag, there is no true delay, because logs show only the sum of delay and lag.
        """
        device = self.loop.loop.apparent()
        return {
            "delay_samples": None if device.actuator_lag_s else device.delay_samples,
            "mass": device.mass,
            "damping": device.damping,
            "jitter_samples": self.jitter_samples,
            "friction": device.value("friction.coulomb") or 0.0,
            "device_stiffness": device.stiffness,
            "constant_force": self.constant_force / self.loop.loop.force_gain,
        }


class TruthHeld(Record):
    """Number of 95 % intervals with a known truth (in simulations), and number of those that contain it."""

    estimates: int
    estimates_held: int
    limits: int
    limits_held: int


class CostRange(Record):
    """Median, smallest and largest cost of the ``trials`` that have a cost."""

    median: float
    low: float
    high: float
    trials: int


STIFFEST = "stiffness"
"""Selection of walls if no cost is available: the stiffest walls that are far from the limit."""


class UsePoint(Record):
    """Recommended tested wall of a region, with the costs of its trial and the ratio of the limit to its stiffness.

    ``damping_range`` contains the dampings at which this stiffness is stable.
    ``margin_large_motion`` is the ratio for large motions, if friction was found. ``better`` names the trial of the
    least cost, and why it is not among the recommended walls. It is empty if one of these has the least cost.
    """

    stiffness: float
    damping: float
    trial_id: str
    costs: dict[str, float]
    margin: float
    damping_range: DampingRange | None = None
    margin_large_motion: float | None = None
    better: str = ""


class UseRegion(Record):
    """Recommended walls: a rectangle of stiffness [N/m, Nm/rad] and damping [Ns/m, Nms/rad] with only stable trials.

    ``costs`` are the costs of its ``trials``, keyed by criterion. The cost of a further trial in the region is between
    ``low`` and ``high`` with probability (n - 1)/(n + 1), for n trials with this cost. ``margin`` is the lower end of
    the measured limit divided by the largest stiffness of the region, minimised over its dampings. It is a lower bound
    if ``bound`` is true. ``criterion`` is the criterion of the choice, or `STIFFEST` if no cost is available. ``point``
    is the recommended wall.
    """

    criterion: str
    stiffness_low: float
    stiffness_high: float
    damping_low: float
    damping_high: float
    trials: int
    costs: dict[str, CostRange]
    margin: float
    bound: bool
    point: UsePoint


class AnswerEstimate(Quantity):
    """Quantity of the first screen with its 95 % interval. An end is null if it is unbounded.

    The value is null for friction that was not found. In this case, ``high`` is the largest value compatible with the
    logs. If ``high`` is also unknown, ``reason`` states the cause and the recordings that would help. ``large_motion``
    is the linear limit of a device with friction. Above it, a larger step is unstable. For the replay, the value is the
    share of correct verdicts at walls that were not used for the fit, and ``limits_off_percent`` is the median error of
    its limits. If measured limits are less accurate, ``limits_known_percent`` is the half-width of their intervals.
    ``damping`` is the damping of the largest limit. ``at_last_damping`` is true if this is the largest tested damping,
    so a larger limit may exist beyond it. ``bracketed`` is true if the ends of the interval are a stable and an
    unstable trial.
    """

    name: Literal["delay_samples", "mass", "damping", "friction", "stiffness_max", "replay"]
    large_motion: float | None = None
    limits_off_percent: float | None = None
    limits_known_percent: float | None = None
    damping: float | None = None
    at_last_damping: bool = False
    bracketed: bool = False


class ReachableCost(Record):
    """Best settling time (2 %) that the delay allows, and the best settling time of the tested walls [samples].

    ``best`` follows from the delay by a rule. ``optimum`` is the exact theoretical optimum for this loop, or null if it
    was not computed. ``delay_samples`` is the total delay from command to force, including an actuator lag.
    ``per_sample`` is the reduction of the settling time for one sample less of delay. ``within`` is the largest
    relative error of the rule for a device without damping. Damping only reduces the settling time. ``reached`` is null
    if no tested wall has a settling time.

    Source: Hulin 2017, eqs. 5.19 and 5.20, Table 5.1.
    """

    delay_samples: float
    best: float
    reached: float | None
    per_sample: float
    within: float
    optimum: float | None = None


REACHED = 0.9
"""Smallest ratio of the largest tested damping to the largest stable damping of theory for which the tests cover the
region. Beyond nine tenths, theory's limit has fallen to a quarter of its maximum."""


class Prediction(Record):
    """Agreement of theory with the device: distance of the measured limits, and of the costs at tested walls.

    ``percent`` is the median distance over ``limits`` limits. It is null if it depends on single limits
    (`scores.agreement`). Limits near K = 0 are left out, so that there are fewer limits than ``dampings`` with trials.
    ``percent_with_friction`` is the distance from the device with its friction, null if limits lie on both sides of it.
    Of ``bounded`` limits with an interval, ``above`` and ``below`` deviate from theory by more than this interval.
    ``safe`` is true if all walls that are stable in theory are stable. ``reason`` states why the agreement is unknown,
    if ``code`` is "unknown". ``costs`` is the number of compared costs, and ``costs_experiments`` that of their
    experiments. ``delay_samples`` is the delay of the theory to which the limits are compared, and
    ``of_file`` is true if its parameters are those of the device file instead of estimates from the logs.
    ``apart`` contains the dampings at which most limits deviate by more than their interval, if they are neighbours. It
    is null if the deviating limits are scattered, or if there are none. With both ends null, all limits deviate.
    ``tested_up_to`` is the largest tested damping if theory has stable walls far beyond it, up to ``stable_up_to``
    [Ns/m, Nms/rad]. Both are null if the tests reach nearly as far as theory.

    ``boundary`` and ``optimal_costs`` are judged separately (6.3). The boundary is predicted if at most one limit in
    twenty deviates by more than its interval. Otherwise, it is partly predicted if the regions overlap well. Costs are
    predicted if their median deviation is at most 10 %, and partly predicted up to 30 %.
    """

    code: Literal["yes", "with_friction", "no", "unknown"]
    boundary: Literal["yes", "partly", "no"] | None = None
    optimal_costs: Literal["yes", "partly", "no"] | None = None
    percent: float | None = None
    percent_with_friction: float | None = None
    limits: int = 0
    dampings: int = 0
    bounded: int = 0
    above: int = 0
    below: int = 0
    overlap_percent: float | None = None
    safe: bool = False
    costs: int = 0
    costs_percent: float | None = None
    costs_experiments: int = 0
    delay_samples: float | None = None
    of_file: bool = False
    apart: DampingSpan | None = None
    tested_up_to: float | None = None
    stable_up_to: float | None = None
    reason: str = ""


class NextWall(Record):
    """Next wall that the planner recommends, the reason, and the command that continues the plan."""

    stiffness: float
    damping: float
    why: str
    command: str


class TestedWall(Record):
    """Tested wall, and decay rate of its motion."""

    stiffness: float
    damping: float
    decay_per_s: float


class Answer(Record):
    """First screen: recommended wall, its certainty, its prediction by theory, reasons for deviations, and the next
    step.

    ``experiment`` is the experiment described. The wall was chosen from ``wall_trials`` neighbouring good trials, or by
    itself for the reason in ``wall_reason``. ``wall_costs`` are the costs of these trials by ``wall_criterion``, the
    criterion of the choice. They are null if no cost decided, or if there is a single trial. If no wall is recommended,
    ``safest`` is the stable tested wall whose motion decays fastest. ``spacing_percent`` is the spacing of the tested
    walls if theory's optimum lies between them. If ``next`` is null without ``next_reason``, verdicts bracket the
    limits at ``limits_told`` of the ``limits_wanted`` dampings, and cannot bracket the others.
    """

    experiment: str
    wall: UsePoint | None
    wall_reason: str = ""
    wall_trials: int = 0
    wall_criterion: str = ""
    wall_costs: CostRange | None = None
    safest: TestedWall | None = None
    spacing_percent: float | None = None
    estimates: tuple[AnswerEstimate, ...] = ()
    estimates_reason: str = ""
    predicts: Prediction
    reachable: ReachableCost | None = None
    causes: tuple[Cause, ...] = ()
    next: NextWall | None = None
    next_reason: str = ""
    limits_told: int = 0
    limits_wanted: int = 0


class HeaderLine(Record):
    """Header line that the pipeline does not use, such as firmware or grease: number of trials, and values.

    ``values`` contains the most frequent values with their numbers of trials. ``different`` is the number of different
    values.
    """

    key: str
    trials: int
    different: int
    values: dict[str, int]


class MeasuredExperiment(Record):
    """Results of an experiment from its logs: verdicts, estimates, boundary, optima and faults of the recordings.

    ``sampling_period_s`` is null if the trials have different periods.
    """

    experiment: str
    configuration: str
    grip: str
    simulated: bool
    trials: int
    verdicts: dict[str, int]
    outcomes: dict[str, int] = Field(default_factory=dict)
    model_check: ModelCheck | None = None
    estimates: dict[str, Estimate]
    boundary: tuple[BoundaryPoint, ...]
    optimum: dict[str, Optimum] = Field(default_factory=dict)
    missing: dict[str, str] = Field(default_factory=dict)
    recording: tuple[RecordingFault, ...] = ()
    header: tuple[HeaderLine, ...] = ()
    sampling_period_s: float | None = None

    @property
    def stiffest(self) -> BoundaryPoint | None:
        """Damping with the largest limit, or None if no limit is known."""
        known = [(limit.stiffness, point) for point in self.boundary if (limit := point.limit)]
        return max(known, key=lambda pair: (pair[0], pair[1].damping))[1] if known else None

    @property
    def largest_limit(self) -> Limit | None:
        """Largest limit over the tested dampings, with its 95 % interval, or None if no limit is known.

        Each limit bounds the largest limit from below. It therefore lies between the largest lower end and the largest
        upper end of the limits, at whichever damping it is. If any limit is censored, there is no upper end.
        """
        point, known = self.stiffest, [limit for each in self.boundary if (limit := each.limit)]
        if point is None or (largest := point.limit) is None:
            return None
        return Limit(
            damping=point.damping,
            stiffness=largest.stiffness,
            low=max(limit.low for limit in known),
            high=max(limit.high for limit in known),
            censored=any(limit.censored for limit in known),
            stiffness_large_motion=point.stiffness_large_motion,
        )


MassSource = Literal["device file", "weighed"]
"""Source of a stated mass."""


class MassDeviation(Record):
    """Stated mass or inertia [kg, kg m^2], and the deviations of the masses estimated from the logs, in percent.

    The stated mass is the apparent mass of the device file, or a weighed mass from ``section`` of the publication.
    ``percent`` is the deviation of the estimate, with its 95 % interval. ``momentum_percent`` is the deviation of the
    momentum balance (6.4).
    """

    source: MassSource
    section: str = ""
    stated: float
    percent: float | None = None
    low: float | None = None
    high: float | None = None
    momentum_percent: float | None = None
    momentum_low: float | None = None
    momentum_high: float | None = None

    @property
    def differs(self) -> bool:
        """True if the interval of the estimate excludes the stated mass."""
        return self.low is not None and self.high is not None and not self.low <= 0 <= self.high


class ExperimentNumbers(MeasuredExperiment, LoopFindings):
    """All results for an experiment, except the first screen.

    ``use_reason`` states why no wall is recommended, or how the wall was chosen if it was not selected by the costs of
    its region.
    """

    theory: SourcedLoop | None = None
    scores: tuple[Scores, ...] = ()
    use: UseRegion | None = None
    use_reason: str | None = None
    masses: tuple[MassDeviation, ...] = ()
    truth: Truth | None = None
    truth_held: TruthHeld | None = None

    @property
    def delay(self) -> Estimate:
        """Delay from the logs: the fitted delay unless walls contradict the loop, otherwise the integer factor
        (6.3)."""
        return delay_with(self.estimates["delay_samples"], self)


def delay_with(factor: Estimate, findings: LoopFindings) -> Estimate:
    """Return the delay from the logs (6.3), given the integer factor and the findings on the loop."""
    if findings.loop is None:
        return factor
    return delay_of_logs(
        factor,
        adequate=findings.loop.adequate,
        judged=findings.replay is not None and findings.replay.verdicts_same is not None,
        doubted=any(doubt.code == "not_adequate" for doubt in factor.doubts),
    )


def delay_of_logs(factor: Estimate, *, adequate: bool, judged: bool, doubted: bool) -> Estimate:
    """Return the fitted delay, or the integer factor (6.3) if walls contradict the loop or the fitted delay is doubted.

    Parameters
    ----------
    factor : Estimate
        Integer factor, with the fitted delay by the method "model".
    adequate : bool
        True if the loop is adequate.
    judged : bool
        True if the loop was compared with verdicts.
    doubted : bool
        True if the intervals of a loop that is not adequate may be too narrow.
    """
    fitted = factor.by_method.get("model")
    if fitted is None or fitted.value is None:
        return factor
    return fitted if adequate or not (judged or doubted) else factor


class ExperimentResult(ExperimentNumbers):
    """All results for an experiment."""

    answer: Answer | None = None


class LogList(Record):
    """Logs of an experiment.

    ``files`` has the SHA-256 of each log, keyed by its path below ``folder``. ``sha256`` is the hash of all these
    hashes (sorted, one per line). ``samples`` is a hash of the stored samples of these logs.
    """

    experiment: str
    folder: str
    files: dict[str, str]
    sha256: str
    samples: str


class ComparisonResult(Record):
    """Document that `pipeline compare --json` prints."""

    device: str
    title: str
    motion: Motion
    known_device: bool
    simulated: bool
    criteria: tuple[str, ...]
    measuring: Measuring = Measuring()
    experiments: tuple[ExperimentResult, ...]
    tables: tuple[ComparisonRow, ...]
    answer: Answer | None = None
    summary: tuple[str, ...]
    warnings: tuple[str, ...]
    excluded: tuple[ExcludedTrial, ...] = ()
    notes: tuple[Note, ...] = ()
    report: str | None = None
    provenance: dict[str, str]
    logs: tuple[LogList, ...] = ()

    @property
    def featured(self) -> ExperimentResult | None:
        """Experiment to which the answer of the document applies. A report shows this experiment unfolded."""
        name = self.answer.experiment if self.answer else None
        return next((each for each in self.experiments if each.experiment == name), None)

    def numbers(self) -> JsonObject:
        """Return the document as JSON values, without its information on files and runs."""
        return self.model_dump(mode="json", exclude={"provenance", "logs", "report"})


Plane = Literal["physical", "normalised"]


class Side(Record):
    """One of the two sides of a comparison: device, experiment, version and hash of the code, excluded trials,
    notes."""

    device: str
    experiment: str
    version: str
    code: str
    excluded: tuple[ExcludedTrial, ...] = ()
    notes: tuple[Note, ...] = ()
    simulated: bool = False

    @property
    def label(self) -> str:
        """Name in figures and sentences."""
        return f"{self.device} {self.experiment}"


class ValueDifference(Record):
    """Quantity with its 95 % intervals on both sides.

    ``difference`` is second minus first, with its interval. ``significant`` is true if this interval excludes zero. It
    is None, with a ``reason``, if the difference or its interval is unknown.
    """

    part: Literal["estimates", "optima", "scores"]
    name: str
    unit: str
    first: float | None
    second: float | None
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    significant: bool | None = None
    reason: str | None = None


class LimitDifference(Record):
    """Stability limit at a damping: stiffness of both sides, in the plane of the comparison."""

    damping: float
    first: float
    second: float
    percent: float
    significant: bool | None


class BoundaryDifference(Record):
    """Two boundaries, compared over their common range of damping.

    ``interpolated`` is true if the second experiment has different dampings.

    ``median_percent`` and ``largest_percent`` are (second - first)/first. ``judged`` is the number of dampings with
    intervals on both sides. The limits differ significantly at ``significant`` of these dampings.
    """

    median_percent: float
    largest_percent: float
    largest_damping: float
    judged: int
    significant: int
    interpolated: bool
    points: tuple[LimitDifference, ...]


class CostDifference(Record):
    """Costs of the trials at the same (K, B): median of second over first with its 95 % interval, and number of points.

    For the overshoot, which may be zero, ``median`` is the difference instead of the ratio (see ``kind``).
    """

    criterion: str
    kind: Literal["ratio", "difference"]
    points: int
    median: float | None = None
    low: float | None = None
    high: float | None = None
    significant: bool | None = None
    reason: str | None = None


def pair_labels(first: Side, second: Side) -> tuple[str, str]:
    """Return the names of both sides. The names differ even if both sides are the same experiment at two times."""
    a, b = first.label, second.label
    return (a, b) if a != b else (f"{a} before", f"{a} now")


class PairDifference(Record):
    """Differences between two experiments."""

    first: Side
    second: Side
    plane: Plane
    estimates: tuple[ValueDifference, ...]
    boundary: BoundaryDifference | None
    boundary_reason: str | None = None
    optima: tuple[ValueDifference, ...]
    scores: tuple[ValueDifference, ...] = ()
    costs: tuple[CostDifference, ...]
    sentences: tuple[str, ...]

    @property
    def labels(self) -> tuple[str, str]:
        """Names of both sides. They differ even if both sides are the same experiment at two times."""
        return pair_labels(self.first, self.second)

    @property
    def simulated(self) -> bool:
        """True if the logs of either side are simulated."""
        return self.first.simulated or self.second.simulated


class AgainstResult(Record):
    """Document that `pipeline compare --against ... --json` prints, with an entry for each pair of experiments."""

    title: str
    pairs: tuple[PairDifference, ...]
    only_first: tuple[str, ...] = ()
    only_second: tuple[str, ...] = ()
    report: str | None = None
