"""Write ``docs/nomenclature.md``: numbers of a loop, criteria, stored columns and terms; run by ``make docs``."""

from __future__ import annotations

from pathlib import Path

from pipeline.device.parameters import PARAMETERS, Parameter
from pipeline.records.criteria import CRITERIA, Criterion
from pipeline.records.tables import COLUMNS, TABLES, Column

PAGE = Path(__file__).with_name("nomenclature.md")

EQUATIONS = {
    "mass": "m x'' + b x' + k x = f + f_0 (3.3)",
    "damping": "m x'' + b x' + k x = f + f_0 (3.3)",
    "stiffness": "m x'' + b x' + k x = f + f_0 (3.3)",
    "sampling_period_s": "Table 3.1",
    "delay_samples": "d = t_d/T, Table 3.1",
    "jitter_samples": "s_d^2 = mean of (d_i - d)^2",
    "force_gain": "tau f' + f = g u",
    "actuator_lag_s": "tau f' + f = g u",
    "constant_force": "m x'' + b x' + k x = f + f_0 (3.3)",
    "force_limit": "u = max(-F_max, min(F_max, command))",
    "velocity": "v = F(z) (x_k - x_{k-1})/T",
    "velocity.samples": "v = (x_k - x_{k-N})/(N T)",
    "velocity.acceleration": "Kalata 1984 (`kalman`), Levant 1998 (`levant`)",
    "velocity.noise": "Kalata 1984 (`kalman`)",
    "velocity.bound": "Janabi-Sharifi 2000 (`foaw`)",
    "velocity.longest": "Janabi-Sharifi 2000 (`foaw`)",
    "mode": "c = M (2 pi f_v)^2, d = 4 pi zeta_v f_v M, M = m_l (m - m_l)/m",
    "operator": "m + m_h, b + b_h, k + k_h on the motor",
    "friction": "falls linearly from f_s at rest to f_c at v_s, and is f_c above",
    "sensor": "x = q round((position + noise)/q)",
}
"""Equation or source of a number, or of all numbers of its part; numbers in brackets refer to Hulin 2017."""

HEAD = """\
# Nomenclature

This page lists the [numbers of a loop](#numbers-of-a-loop), the [criteria](#criteria), the
[stored columns](#stored-columns) and the [terms](#terms). `make docs` writes it from the code. Numbers of equations in
brackets refer to Hulin 2017. The page [definitions.md](definitions.md) states how each number is computed.

## Numbers of a loop

All numbers are in SI units. Python (`loop.mode.mass`), JSON and [device files](devices.md) use the same names, with
two exceptions: in a device file, `force_limit` is `limits.force` and `constant_force` is `simulation.constant_force`.

In the equations, u is the delayed command, f is the force on the motor, x is the position of the motor, v is the
velocity in the wall law, and F(z) is the velocity filter.

| symbol | name | unit | meaning | equation or source |
|---|---|---|---|---|
"""


CRITERIA_HEAD = """
## Criteria

Commands, files, tables and JSON use these names. A name that ends with `_discrete` refers to the sampled response.

| name | label | unit | measured column |
|---|---|---|---|
"""

COLUMNS_HEAD = """
## Stored columns

These are the columns of the files below `processed/`, by table. The second unit is that of a rotation. The list does
not contain the conditions, the identity and the hashes of a trial.

| column | unit | meaning | table |
|---|---|---|---|
"""

CONDITIONS = ("trials", "corrections")
"""Tables of conditions, identity and hashes."""

TERMS = {
    "adequate": "property of a loop that predicts 95 % of the verdicts of walls outside its fit, and limits within 5 %",
    "bracket": "the stiffest stable and the softest unstable trial at a damping, between which the limit lies",
    "censored": "property of a number that is only a lower bound, because the tested range ended too early",
    "command edge": "the row of a log in which the command makes the step",
    "cross-validation": "test of a model with trials that were left out of its fit",
    "delay of the applied command": "age of the newest command that has arrived; its mean is the delay of the loop",
    "experiment": "trials of one device in one configuration, with different walls",
    "identifiable": "property of a number whose value can be estimated from the logs",
    "island": "a range of stable walls that is separated from the softer stable ones by unstable walls",
    "jitter": "standard deviation of the delay of the applied command",
    "limit": "largest stable stiffness at a damping; the limits at all dampings form the boundary",
    "limit cycle": "an oscillation of constant amplitude; it is stable if as small as the sensor resolution",
    "linear condition": "B + b >= K (d + 1/2) T, the straight part of the boundary near the origin (3.25)",
    "operator": "a hand or arm that is rigidly attached to the motor",
    "passive wall": "a wall that is stable with every passive operator (ch. 4)",
    "profile": "a TOML file that describes how the logs of a lab are read",
    "quarantine": "the folder of refused logs, each with the reason and a remedy",
    "replay": "simulation of tested walls with the identified device",
    "scene": "the content of one comparison: a device with its experiments, criteria, delays and operator",
    "sensor resolution": "smallest step of the position sensor (LSB), q",
    "stage": "one step of the evaluation; its results are stored and reused until its inputs change",
    "trial": "one step response with one wall; a log is a file with one trial or several",
    "verdict": "one of stable, unstable and undecided, from the growth of the motion in a log",
    "virtual wall": "the rendered spring and damper, with the stiffness K and the damping B",
    "wall law": "u_k = F_0 - K (x_k - x_0) - B v_k, the equation of the command of a virtual wall",
    "w = 0, 1, 2": "exponent of time in the energy costs (5.13); a larger exponent gives later motion more weight",
}

TERMS_HEAD = """
## Terms

| term | meaning |
|---|---|
"""


def criterion_row(criterion: Criterion) -> str:
    """Return the row of a criterion."""
    column = f"`{criterion.column}`" if criterion.column else "none"
    return f"| `{criterion.name}` | {criterion.label} | {criterion.family.unit} | {column} |\n"


def column_row(name: str, column: Column, table: str) -> str:
    """Return the row of a stored column."""
    units = dict.fromkeys((column.unit, column.unit_rotation))
    return f"| `{name}` | {'; '.join(unit or '–' for unit in units)} | {column.meaning} | {table} |\n"


def column_rows() -> str:
    """Return the rows of the stored columns, each once, in the first table that has it."""
    skipped = {name for table in CONDITIONS for name in TABLES[table]}
    rows = {}
    for table, columns in TABLES.items():
        if table not in CONDITIONS:
            rows |= {n: column_row(n, COLUMNS[n], table) for n in columns if n not in skipped and n not in rows}
    return "".join(rows.values())


def unit(parameter: Parameter) -> str:
    """Return the unit for translation and, where it is another one, for rotation."""
    units = dict.fromkeys((parameter.unit("translation"), parameter.unit("rotation")))
    return "; ".join(name or "1" for name in units)


def row(parameter: Parameter) -> str:
    """Return the row of a parameter."""
    source = EQUATIONS.get(parameter.name) or EQUATIONS.get(parameter.part, "[definitions.md](definitions.md)")
    bound = ", above 0" if parameter.positive else ", of any sign" if parameter.lower < 0 else ""
    return f"| {parameter.symbol} | `{parameter.name}` | {unit(parameter)} | {parameter.meaning}{bound} | {source} |\n"


def page() -> str:
    """Return the text of the page."""
    terms = "".join(f"| {term} | {meaning} |\n" for term, meaning in TERMS.items())
    criteria = "".join(map(criterion_row, CRITERIA.values()))
    numbers = "".join(map(row, PARAMETERS.values()))
    return f"{HEAD}{numbers}{CRITERIA_HEAD}{criteria}{COLUMNS_HEAD}{column_rows()}{TERMS_HEAD}{terms}"


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
