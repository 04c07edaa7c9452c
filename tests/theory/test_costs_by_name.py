"""Maps of costs, their files, and costs of many points: against single points, plain sums and whole responses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import simulated

from pipeline.base.errors import ParameterError, PipelineError
from pipeline.device.loop import Loop
from pipeline.loop.normalised_loop import NormalisedLoop
from pipeline.records.criteria import REPORTED
from pipeline.rendering import map_file
from pipeline.theory import cases as theory
from pipeline.theory import energy, modes
from pipeline.theory.boundary import boundary
from pipeline.theory.costs import CostMap, bounding_box, cost_maps, point_costs_by_name
from pipeline.theory.energy import energy_costs
from pipeline.theory.poles import is_stable, spectral_radius
from pipeline.theory.settling_overshoot import transient_costs

LOOP = NormalisedLoop.of(Loop(0.58, 4.0, 1e-3, 4))


@pytest.fixture(scope="module")
def grid():
    border = boundary(LOOP)
    return np.linspace(0, 1.05 * border.alpha_max, 14), np.linspace(-0.02, 1.05 * border.beta_max, 15)


@pytest.fixture(scope="module")
def maps(grid):
    return cost_maps(LOOP, *grid, REPORTED)


def point_wise(grid):
    """Every grid point on its own, with the settings of the functions for single points."""
    alpha, beta = grid
    costs = {c: np.full((len(beta), len(alpha)), np.nan) for c in REPORTED}
    for j, b in enumerate(beta):
        for i, a in enumerate(alpha):
            if a <= 0 or not is_stable(LOOP, [a], [b])[0]:
                continue
            found = energy_costs(LOOP, [a], [b]) | transient_costs(LOOP, [a], [b], continuous=False)
            for c in REPORTED:
                costs[c][j, i] = found[f"{c}_discrete"][0]
    return costs


@pytest.fixture(scope="module")
def expected(grid):
    return point_wise(grid)


@pytest.fixture(scope="module")
def fast(grid):
    """Points whose motion is over within the samples of a map: 0.99^1000 = 4e-5."""
    alpha, beta = np.meshgrid(*grid)
    return (spectral_radius(LOOP, alpha.ravel(), beta.ravel()) < 0.99).reshape(alpha.shape)


def test_maps_equal_the_costs_of_single_points(maps, expected, fast):
    for criterion in REPORTED:
        found, single = maps[criterion], expected[criterion]
        assert found.shape == (15, 14)
        assert np.isfinite(found).sum() > 60
        if criterion.startswith("settle"):
            known = np.isfinite(found)
            np.testing.assert_array_equal(found[known], single[known])
            np.testing.assert_array_equal(known[fast], np.isfinite(single[fast]))
        else:
            np.testing.assert_allclose(found[fast], single[fast], rtol=1e-9, atol=2e-9)
            # elsewhere a beat may add to an overshoot after the end of a map, less than a contour line shows
            np.testing.assert_allclose(found, single, rtol=1e-9, atol=2e-3)


def test_a_slow_overshoot_does_not_empty_the_map_of_settling(grid, maps):
    alone = cost_maps(LOOP, *grid, ["settle_5pct"])["settle_5pct"]
    together = cost_maps(LOOP, *grid, ["settle_5pct", "overshoot"])["settle_5pct"]
    np.testing.assert_array_equal(together, alone)
    assert np.isfinite(alone).sum() >= np.isfinite(maps["settle_5pct"]).sum()


def test_a_spring_of_the_device_moves_the_edge_of_the_map():
    loop = NormalisedLoop.ideal(0.004, 0.007, 2.0)
    alpha = np.array([-0.005, -0.004, -0.002, 0.0])
    found = cost_maps(loop, alpha, np.array([0.05]), ["energy_step_w0"])["energy_step_w0"][0]
    assert np.isnan(found[:2]).all()
    assert np.isfinite(found[2:]).all()


def map_table(*arguments, points=map_file.BLOCK, **options):
    """A map as one Arrow table."""
    cost_map = CostMap(*arguments, **options)
    schema = map_file.map_schema(cost_map)
    return pa.concat_tables([map_file.block_table(block, schema) for block in cost_map.blocks(points)])


@pytest.mark.parametrize(
    "loop", [NormalisedLoop.ideal(0, 0, 1), NormalisedLoop.ideal(0.001, 0.02, 2), NormalisedLoop.ideal(0.2, 0.1, 0.5)]
)
def test_bounding_box_is_that_of_the_stable_region(loop):
    """Cells of a larger grid that are stable fill the box up to a cell."""
    low_a, high_a, low_b, high_b = bounding_box(loop)
    size = 121
    a, b = np.meshgrid(np.linspace(low_a - 0.05, high_a + 0.05, size), np.linspace(low_b - 0.05, high_b + 0.05, size))
    stable = spectral_radius(loop, a.ravel(), b.ravel()).reshape(a.shape) < 1
    cell_a, cell_b = a[0, 1] - a[0, 0], b[1, 0] - b[0, 0]
    assert -1e-9 <= a[stable].min() - low_a < cell_a
    assert -1e-9 <= high_a - a[stable].max() < cell_a
    # the region ends in points at its lowest and highest beta, so the nearest cell may be a few away
    assert -1e-9 <= b[stable].min() - low_b < 4 * cell_b
    assert -1e-9 <= high_b - b[stable].max() < 4 * cell_b


def test_map_holds_the_costs_of_its_points():
    loop = NormalisedLoop.ideal(0, 0.02, 1)
    names = ("settle_2pct", "overshoot_discrete", "energy_step_w1", "energy_impulse_w0_discrete", "pole_radius")
    table = map_table(loop, 21, names)
    assert table.column_names == ["alpha", "beta", "stable", *names]
    alpha, beta = table.column("alpha").to_numpy(), table.column("beta").to_numpy()
    low_a, high_a, low_b, high_b = bounding_box(loop)
    assert sorted(set(alpha)) == pytest.approx(np.linspace(low_a, high_a, 21))
    assert sorted(set(beta)) == pytest.approx(np.linspace(low_b, high_b, 21))
    assert (alpha.max(), beta.max(), alpha.min(), beta.min()) == (high_a, high_b, low_a, low_b)
    stable = table.column("stable").to_numpy()
    radius = [
        simulated.spectral_radius(a, b, mass=1.0, b=0.02, delay=1, T=1.0) for a, b in zip(alpha, beta, strict=True)
    ]
    # within 1e-6 of the boundary rounding decides, and alpha = 0 lies on it
    clear = (abs(np.array(radius) - 1) > 1e-6) & (alpha > 0)
    assert np.array_equal(stable[clear], np.array(radius)[clear] < 1)
    assert 100 < stable.sum() < 350
    some = np.flatnonzero(stable & clear)[::17]
    rows = np.array([(alpha[i], beta[i], 0, 0.02, 1) for i in some])
    found = theory.costs_of_cases(theory.Cases(Path("cases.csv"), rows, tuple(range(len(rows))))).to_json()
    for name in names[:-1]:
        values = table.column(name).to_pylist()
        assert [values[i] for i in some] == pytest.approx([f[name] for f in found], rel=1e-12, abs=1e-12)
        assert all(values[i] is None for i in np.flatnonzero(~stable))
    assert [table.column("pole_radius")[int(i)].as_py() for i in some] == pytest.approx([radius[i] for i in some])


def test_map_survives_parquet_with_its_parameters(tmp_path):
    cost_map = CostMap(NormalisedLoop.ideal(0, 0.02, 1), 5, ("overshoot",))
    done = []
    stable = map_file.write_map(tmp_path / "new" / "map.parquet", cost_map, lambda *counts: done.append(counts), 12)
    back = pq.read_table(tmp_path / "new" / "map.parquet")
    assert back.equals(map_table(NormalisedLoop.ideal(0, 0.02, 1), 5, ("overshoot",)).combine_chunks())
    assert back.schema.metadata == map_file.map_schema(cost_map).metadata
    assert stable == sum(back.column("stable").to_pylist())
    assert done == [(10, 25), (20, 25), (25, 25)]
    assert pq.ParquetFile(tmp_path / "new" / "map.parquet").num_row_groups == 3
    assert back.schema.metadata[b"pipeline.delta"] == b"0.02"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["map.parquet"]


def test_map_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "map.parquet"
    path.write_bytes(b"old")

    def half(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", half)
    with pytest.raises(PipelineError, match="No space left on device"):
        map_file.write_map(path, CostMap(NormalisedLoop.ideal(0, 0, 1), 3, ("overshoot",)))
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"criteria": ("overshoot", "speed")}, "'speed' is unknown; expected names from settle_1pct"),
        ({"criteria": ("pole_radius_discrete",)}, "is unknown"),
        ({"criteria": ("",)}, "'' is unknown"),
        ({"size": 1}, "size = 1"),
        ({"size": 5000}, "size = 5000"),
        ({"longest": 0}, "longest = 0"),
    ],
)
def test_wrong_maps_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        map_table(NormalisedLoop.ideal(0, 0, 1), **arguments)


ENERGIES = ("energy_step_w0", "energy_step_w2", "energy_impulse_w1")


@pytest.mark.parametrize(
    ("loop", "names"),
    [
        (NormalisedLoop.ideal(0, 0, 4), ("settle_2pct", "overshoot", "overshoot_discrete", *ENERGIES)),
        (NormalisedLoop.ideal(0.01, 0.3, 1.5), ENERGIES),
    ],
)
def test_blocks_of_any_size_give_the_same_map(loop, names):
    whole = map_table(loop, 31, names)
    for points in (1, 400):
        blocks = map_table(loop, 31, names, points=points)
        for name in whole.column_names:
            values = (table.column(name).to_numpy().astype(float) for table in (whole, blocks))
            np.testing.assert_allclose(*values, rtol=1e-11, atol=1e-13, err_msg=name)


LOOPS = [*(NormalisedLoop.ideal(0, 0, delay) for delay in (0, 1, 4, 8)), NormalisedLoop.ideal(0.01, 0.05, 2)]


def stable_points(loop, count, seed, nearest=1e-4):
    """Random points of the bounding box, and some close to its soft corner."""
    rng = np.random.default_rng(seed)
    box = bounding_box(loop)
    alpha = np.append(rng.uniform(*box[:2], count), -loop.gamma + 10 ** rng.uniform(-7, -3, count // 4))
    beta = np.append(rng.uniform(*box[2:], count), 10 ** rng.uniform(-3, -1, count // 4))
    radius = spectral_radius(loop, alpha, beta)
    chosen = (radius < 1 - nearest) & (alpha + loop.gamma > 0)
    return alpha[chosen], beta[chosen], radius[chosen]


@pytest.mark.parametrize("loop", LOOPS, ids=str)
def test_energies_are_plain_sums_over_samples(loop):
    alpha, beta, _ = stable_points(loop, 120, 2, nearest=0.03)
    found = energy.energy_costs(loop, alpha, beta, "step")
    z = loop.starts(alpha, "step")
    matrix, before = loop.matrix(alpha, beta), z[:, 0]
    sums = np.zeros((3, len(alpha)))
    for k in range(1500):
        density = z[:, 0] ** 2 + (z[:, 0] - before) ** 2 / (alpha + loop.gamma)
        sums += np.array([1.0, k, k * k])[:, None] * density
        before, z = z[:, 0], np.einsum("nij,nj->ni", matrix, z)
    for w in range(3):
        np.testing.assert_allclose(found[f"energy_step_w{w}_discrete"], sums[w], rtol=1e-10)


def test_overshoot_long_after_settling_is_found(monkeypatch):
    """Points where a pair slowly overtakes a real mode: overshoot of 1e-11 to 1e-2 hundreds of samples later."""
    loop = NormalisedLoop.ideal(0, 0, 4)
    grid = np.meshgrid(np.linspace(0.0015, 0.009, 25), np.linspace(0.2, 0.308, 24))
    steady = spectral_radius(loop, grid[0].ravel(), grid[1].ravel()) < 0.9995
    alpha, beta = (g.ravel()[steady] for g in grid)
    found = transient_costs(loop, alpha, beta, (0.02,), longest=1 << 14, quiet=1e-13)
    monkeypatch.setattr(modes, "STILL_REPRODUCED", -1.0)
    plain = transient_costs(loop, alpha, beta, (0.02,), longest=1 << 14, quiet=1e-13)
    late = (plain["overshoot"] > 0) & (plain["overshoot"] < 1e-3)
    assert late.sum() > 50
    for name, values in plain.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-11, atol=1e-12, err_msg=name)


def test_a_later_sample_may_exceed_the_samples_so_far():
    """The motion's largest excess comes first, 0.94355; no sample meets it, and the 93rd comes closest."""
    loop, beta = NormalisedLoop.ideal(0, 0, 1), 0.2041052336331193
    alpha = 0.10468793422177697 * np.linspace(1, 0.999, 300)
    state, matrix = loop.starts(alpha, "step"), loop.matrix(alpha, np.full(300, beta))
    largest = np.zeros(300)
    for _ in range(20000):
        state = (matrix @ state[..., None])[..., 0]
        largest = np.maximum(largest, state[:, 0])
    name = "overshoot_discrete"
    found = point_costs_by_name(loop, alpha, np.full(300, beta), ["settle_2pct", name], 1 << 16)[name]
    assert largest[0] == pytest.approx(0.9432529, abs=1e-7)
    np.testing.assert_allclose(found, largest, rtol=1e-10)
