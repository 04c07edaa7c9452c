"""Theory figures: numbers against a second method, the drawing read back from the SVG, the page and the command."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from independent import radius_by_polynomial, simulate
from places import SHARED
from typer.testing import CliRunner

from pipeline.base.errors import ParameterError, UsageError
from pipeline.device_data.human_arm import human_arms
from pipeline.loop.loop import Loop
from pipeline.shell.cli import app
from pipeline.studies import drawing
from pipeline.studies.figure import Note, Panel, TheoryFigure, Trace
from pipeline.studies.thesis import figures, jumps
from pipeline.studies.thesis import page as page_of
from pipeline.studies.thesis.curves import cost_grid, plain_loop
from pipeline.studies.thesis.jumps import first_settling_jump, largest_overshoot_jump
from pipeline.studies.thesis.outline import outline, outline_in
from pipeline.studies.thesis.responses import extrema, response
from pipeline.theory.stability.stability import is_stable

QUICK = ("3.5", "3.6", "3.7", "3.8", "3.9", "3.10", "3.11", "4.1", "4.2", "4.3", "5.1", "5.2", "5.11")
"""Figures that take less than half a second or so each; together they use all kinds of content."""

THESIS = {f"3.{n}" for n in range(5, 12)} | {f"4.{n}" for n in range(1, 6)} | {f"5.{n}" for n in range(1, 17)}


@pytest.fixture(scope="module")
def quick() -> dict[str, TheoryFigure]:
    return {figure.number: figure for figure in figures.compute(QUICK)}


def parts(figure: TheoryFigure) -> list[Panel]:
    return [part for panel in figure.panels for part in (panel, panel.below) if part is not None]


def test_every_data_figure_of_the_thesis_is_there_in_order() -> None:
    assert set(figures.NUMBERS) == THESIS
    assert figures.NUMBERS.index("3.10") == figures.NUMBERS.index("3.9") + 1


def test_unknown_number_is_refused_before_anything_is_computed() -> None:
    with pytest.raises(UsageError, match=r"3\.4.*expected one of 3\.5"):
        figures.compute(["3.6", "3.4"])


def test_human_arm_is_that_of_the_table() -> None:
    table = SHARED / "reference" / "tables" / "3_2_human_arm.csv"
    if not table.exists():
        pytest.skip("needs the reference tables beside the repository")
    rows = [line.split(",")[1:] for line in table.read_text(encoding="utf-8").splitlines()[1:]]
    assert [(a.source, a.mass, a.stiffness, a.damping) for a in human_arms()] == [
        (name, *map(float, numbers)) for name, *numbers in rows
    ]


def test_limits_of_the_human_arm_hold_for_all_but_the_hand() -> None:
    inside = [a.stiffness / a.mass <= 710 and a.damping / a.mass <= 14.6 for a in human_arms()]
    assert [a.source for a, good in zip(human_arms(), inside, strict=True) if not good] == ["Kuchenbecker et al."]


RNG = np.random.default_rng(3)
CASES = [
    (
        float(RNG.choice([0.0, 0.001, 0.3])),
        float(RNG.choice([0.0, 0.02, 0.4])),
        *((0, 1), (1, 4), (1, 2), (1, 1), (5, 2))[i % 5],
        float(RNG.uniform(-0.1, 0.9)),
        float(RNG.uniform(-0.3, 1.2)),
        ("step", "impulse")[i % 2],
    )
    for i in range(24)
]


@pytest.mark.parametrize(("gamma", "delta", "p", "q", "alpha", "beta", "signal"), CASES)
def test_response_equals_the_finer_stepped_loop(
    gamma: float, delta: float, p: int, q: int, alpha: float, beta: float, signal: str
) -> None:
    """Stable or not, with fractional delay or not; the second method steps by matrix exponentials."""
    loop, samples = Loop(gamma, delta, p / q), 12
    found = response(loop, alpha, beta, signal, samples, 8)
    motion = simulate(alpha, beta, delay=(p, q), samples=samples, gamma=gamma, delta=delta, signal=signal, fine=16)
    scale = np.abs(motion.x).max()
    assert found.samples == pytest.approx(motion.x[:: motion.every], abs=1e-10 * scale)
    steps = found.time * motion.every
    assert steps == pytest.approx(np.round(steps), abs=1e-9), "an eighth of each part is a whole number of fine steps"
    assert found.position == pytest.approx(motion.x[np.round(steps).astype(int)], abs=1e-10 * scale)


@pytest.mark.parametrize("delay", [0.0, 1.0, 2.5])
def test_response_without_stiffness_creeps_on_and_an_impulse_decays(delay: float) -> None:
    """With alpha = gamma = 0 the momentum balance alone tells: force = damping times speed in the end."""
    beta = 0.5 / (delay + 1)
    step = response(Loop(0.0, 0.0, delay), 0.0, beta, "step", 400, 1)
    assert np.diff(step.samples)[-1] == pytest.approx(1 / beta, rel=1e-9)
    impulse = response(Loop(0.0, 0.0, delay), 0.0, beta, "impulse", 400, 1)
    assert impulse.samples[-1] == pytest.approx(1 / beta, rel=1e-9)


def test_response_refuses_wrong_arguments() -> None:
    for signal, samples, fine in (("ramp", 10, 1), ("step", 0, 1), ("step", 10, 0), ("step", 1 << 20, 16)):
        with pytest.raises(ParameterError, match="expected"):
            response(plain_loop(0.0), 0.1, 0.3, signal, samples, fine)


@pytest.mark.parametrize(("gamma", "delta", "delay"), [(0.0, 0.0, 0.0), (0.001, 0.02, 0.25), (0.001, 0.0, 4.0)])
def test_outline_has_a_pole_on_the_circle_everywhere(gamma: float, delta: float, delay: float) -> None:
    alpha, beta = outline(Loop(gamma, delta, delay), 24)
    for a, b in zip(alpha[2:-2:4], beta[2:-2:4], strict=True):
        assert radius_by_polynomial(gamma, delta, delay, a, b) == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize("gamma", [0.5, 3.0, 9.0, 9.869])
@pytest.mark.parametrize("delay", [0.0, 0.5, 2.0])
def test_outline_in_a_window_separates_stable_from_unstable(gamma: float, delay: float) -> None:
    """On a grid, verdicts of neighbours differ where a line passes between them, and hardly anywhere else."""
    loop, window, n = Loop(gamma, 0.02, delay), (-1.0, 1.0, -1.0, 1.0), 41
    alpha, beta = outline_in(loop, window, 20000)
    axis = np.linspace(-0.98, 0.98, n)
    a, b = (g.ravel() for g in np.meshgrid(axis, axis))
    stable = is_stable(loop, a, b).reshape(n, n)
    known = np.isfinite(alpha)
    cell = axis[1] - axis[0]
    for row, column in zip(*np.nonzero(stable[:, 1:] != stable[:, :-1]), strict=True):
        near = np.abs(beta[known] - axis[row]) <= cell
        between = near & (alpha[known] >= axis[column] - cell) & (alpha[known] <= axis[column + 1] + cell)
        assert between.any(), "a change of verdict without a line"
    assert known.any() or stable.all() or not stable.any()
    # points of the outline bound the region: beside them there are both verdicts
    x, y = alpha[known][::97], beta[known][::97]
    around = [is_stable(loop, x + 1e-5 * np.cos(t), y + 1e-5 * np.sin(t)) for t in np.linspace(0, 2 * np.pi, 33)]
    share = np.any(around, axis=0) & ~np.all(around, axis=0)
    assert not len(x) or share.mean() > 0.97


def test_settling_jump_touches_the_band_on_both_sides() -> None:
    """Fig. 5.6: before it the second minimum, behind it the third one, by the independent simulation."""
    jump = first_settling_jump(plain_loop(0.0))
    assert jump.alpha == pytest.approx(0.30403, rel=2e-3)  # the thesis's grid
    for beta, which in ((jump.beta_before, 1), (jump.beta_behind, 2)):
        motion = simulate(jump.alpha, beta, delay=(0, 1), samples=30, fine=64)
        minima = np.flatnonzero((motion.x[1:-1] < motion.x[:-2]) & (motion.x[1:-1] <= motion.x[2:])) + 1
        assert motion.x[minima[which]] * jump.alpha == pytest.approx(0.98, abs=1e-5)


def test_overshoot_is_equal_on_both_sides_of_its_jump() -> None:
    jump = largest_overshoot_jump(plain_loop(0.0))
    assert (jump.alpha, *sorted((jump.beta_before, jump.beta_behind))) == pytest.approx(
        (0.3044, 0.995, 1.168), rel=2e-3
    )
    tops = [
        simulate(jump.alpha, beta, delay=(0, 1), samples=40, fine=64).x.max() * jump.alpha - 1
        for beta in (jump.beta_before, jump.beta_behind)
    ]
    assert tops[0] == pytest.approx(tops[1], abs=2e-5)


def test_a_curve_without_jumps_says_so() -> None:
    with pytest.raises(ParameterError, match="does not jump"):
        jumps.jump(plain_loop(0.0), "energy_step_w0", largest=True)


def test_map_agrees_with_the_independent_radius() -> None:
    alpha, beta, cost = cost_grid(plain_loop(1.0), "pole_radius")
    rows, columns = np.nonzero(np.isfinite(cost))
    for i in np.random.default_rng(1).choice(len(rows), 12, replace=False):
        row, column = rows[i], columns[i]
        expected = radius_by_polynomial(0.0, 0.0, 1.0, float(alpha[column]), float(beta[row]))
        assert cost[row, column] == pytest.approx(expected, abs=1e-6)


def test_numbers_of_the_text_can_be_read_off(quick: dict[str, TheoryFigure]) -> None:
    """Values that the thesis states beside its figures."""
    stiffness = quick["3.9"].panels[0].traces[0]
    assert stiffness.y[stiffness.x == 1][0] / stiffness.y[0] == pytest.approx(0.2105, abs=1e-4)
    passive = quick["4.2"].panels[0].traces[0]
    assert passive.y[passive.x == 1][0] / passive.y[0] == pytest.approx(0.41, abs=5e-3)
    front = quick["5.2"].panels[0].below
    assert front is not None
    assert front.traces[0].y.min() == pytest.approx(0.587, abs=0.01)
    assert front.traces[1].y[0] == pytest.approx(0.5874, abs=1e-4)


def test_every_panel_shows_something_inside_its_axes(quick: dict[str, TheoryFigure]) -> None:
    for figure in quick.values():
        assert len(figure.caption) > 60
        for panel in parts(figure):
            (left, right), (bottom, top) = panel.x_range, panel.y_range
            assert left < right
            assert bottom < top
            for trace in panel.traces:
                assert trace.x.shape == trace.y.shape
            shown = [((t.x >= left) & (t.x <= right) & (t.y >= bottom) & (t.y <= top)).any() for t in panel.traces]
            assert np.mean(shown) > 0.9, (figure.number, panel.title)


def test_svgs_are_well_formed_named_and_unique(quick: dict[str, TheoryFigure]) -> None:
    drawn = {number: drawing.draw(figure) for number, figure in quick.items()}
    page = "".join(svg for svgs in drawn.values() for svg in svgs)
    assert drawn["5.11"] == drawing.draw(quick["5.11"]), "deterministic"
    defined = re.findall(r'\bid="([^"]+)"', page)
    assert len(defined) == len(set(defined))
    used = re.findall(r"url\(#([^)]+)\)", page) + re.findall(r'href="#([^"]+)"', page)
    assert used
    assert set(used) <= set(defined)
    for number, figure in quick.items():
        for svg, panel in zip(drawn[number], figure.panels, strict=True):
            root = ElementTree.fromstring(svg)
            assert root.get("role") == "img"
            words = {"".join(e.itertext()) for e in root.iter("text")}
            assert {t.label for t in panel.traces if t.label} <= words
            assert {n.text for n in panel.notes} <= words
    left = re.sub(r"var\([^)]*\)", "", page).lower()
    assert not re.search(r"#0{6}|#f{6}", left), "black or white would vanish in one of the colour schemes"


def test_points_are_drawn_where_they_lie_and_far_ones_are_left_out() -> None:
    x = np.concatenate([np.linspace(0.0, 1.0, 11), np.linspace(5.0, 50.0, 400)])
    line, mark = Trace(x, x), Trace(np.array([0.25, 0.75]), np.array([0.5, 0.5]), "blue", "none", "m", "o")
    notes = (Note(0.5, 0.5, "<b>"),)
    panel = Panel("t", "x", "y", (0.0, 1.0), (0.0, 1.0), (line, mark), notes=notes)
    svg = drawing.draw(TheoryFigure("9.9", "t", "c", (panel,), 2))[0]
    short = replace(panel, traces=(Trace(x[:12], x[:12]), mark))
    assert len(svg) - len(drawing.draw(TheoryFigure("9.9", "t", "c", (short,), 2))[0]) < 100
    places = [int(x) / 10 for x in re.findall(r"M(\d+) \d+m-\d+ 0a", svg)]  # circles, in tenths of a pixel
    # axes from pixel 56 to 440 - 16, then the legend's own mark
    assert places[:2] == pytest.approx([56 + 0.25 * 368, 56 + 0.75 * 368], abs=0.05)
    assert "<b>" not in svg


def test_extrema_are_those_of_a_known_curve() -> None:
    found = response(Loop(0.0, 0.0, 0.0), 0.2, 0.3, "step", 40, 64)
    time, position = extrema(found)
    motion = simulate(0.2, 0.3, delay=(0, 1), samples=40, fine=64)
    assert position.max() == pytest.approx(motion.x.max(), rel=1e-4)
    assert len(time) > 5
    assert (np.diff(np.sign(position * 0.2 - 1)) != 0).all(), "maxima and minima in turn"


def test_page_is_self_contained_and_the_command_writes_it(tmp_path: Path) -> None:
    out = tmp_path / "new" / "theory.html"
    command = ["theory", "figures", "--figure", "4.2", "--figure", "3.6", "--out", str(out), "--json"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout) == {"file": str(out), "figures": ["3.6", "4.2"]}
    page = out.read_text(encoding="utf-8")
    assert page.index('id="figure-3.6"') < page.index('id="figure-4.2"')
    assert not re.search(r"https?://|<script|<link", page)
    assert len(re.findall(r"<svg", page)) == 3
    first = page
    assert CliRunner().invoke(app, command).exit_code == 0
    assert out.read_text(encoding="utf-8") == first


def test_command_names_the_figures_it_knows() -> None:
    result = CliRunner().invoke(app, ["theory", "figures", "--figure", "7.1"])
    assert isinstance(result.exception, UsageError)


@pytest.mark.slow
def test_whole_page_is_small_enough(tmp_path: Path) -> None:
    out = tmp_path / "theory.html"
    page_of.write(list(figures.compute()), out)
    assert out.stat().st_size < 3_000_000
    page = out.read_text(encoding="utf-8")
    assert all(f'id="figure-{number}"' in page for number in THESIS)
