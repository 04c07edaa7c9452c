"""Write ``docs/nomenclature.md``, the numbers of a loop, from `pipeline.device.parameters`; run by ``make docs``."""

from __future__ import annotations

from pathlib import Path

from pipeline.device.parameters import PARAMETERS, Parameter

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
    "friction": "from f_s at rest linearly to f_c at v_s, f_c above",
    "sensor": "x = q round((position + noise)/q)",
}
"""Equation or source of a number, or of all numbers of its part; those in brackets are of Hulin 2017."""

HEAD = """\
# Nomenclature

Every number of a loop, in SI. Names are the same in Python (`loop.mode.mass`), JSON and [device files](devices.md);
only there `force_limit` is `limits.force` and `constant_force` is `simulation.constant_force`. Equations in brackets
are of Hulin 2017. What is measured and computed is in [definitions.md](definitions.md). This page is made from
`pipeline.device.parameters` by `make docs`.

u is the delayed command, f the force on the motor, x its position, v the velocity that the wall takes, F(z) the
velocity filter.

| symbol | name | unit | meaning | equation or source |
|---|---|---|---|---|
"""


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
    return HEAD + "".join(map(row, PARAMETERS.values()))


def main() -> None:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
