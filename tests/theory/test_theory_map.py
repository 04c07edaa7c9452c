import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from simulated import spectral_radius

from pipeline.base.errors import ParameterError, PipelineError
from pipeline.loop.loop import Loop
from pipeline.theory import cases as theory
from pipeline.theory import costs as map_file
from pipeline.theory import poles as stability
from pipeline.theory.costs import CostMap
from pipeline.theory.energy import energy_costs
from pipeline.theory.settling_overshoot import transient_costs


def map_table(*arguments, points=map_file.BLOCK, **options):
    """A map as one Arrow table."""
    cost_map = CostMap(*arguments, **options)
    schema = map_file.map_schema(cost_map)
    return pa.concat_tables([map_file.block_table(block, schema) for block in cost_map.blocks(points)])


@pytest.mark.parametrize("loop", [Loop(0, 0, 1), Loop(0.001, 0.02, 2), Loop(0.2, 0.1, 0.5)])
def test_bounding_box_is_that_of_the_stable_region(loop):
    """Cells of a larger grid that are stable fill the box up to a cell."""
    low_a, high_a, low_b, high_b = map_file.bounding_box(loop)
    size = 121
    a, b = np.meshgrid(np.linspace(low_a - 0.05, high_a + 0.05, size), np.linspace(low_b - 0.05, high_b + 0.05, size))
    stable = stability.spectral_radius(loop, a.ravel(), b.ravel()).reshape(a.shape) < 1
    cell_a, cell_b = a[0, 1] - a[0, 0], b[1, 0] - b[0, 0]
    assert -1e-9 <= a[stable].min() - low_a < cell_a
    assert -1e-9 <= high_a - a[stable].max() < cell_a
    # the region ends in points at its lowest and highest beta, so the nearest cell may be a few away
    assert -1e-9 <= b[stable].min() - low_b < 4 * cell_b
    assert -1e-9 <= high_b - b[stable].max() < 4 * cell_b


def test_map_holds_the_costs_of_its_points():
    loop = Loop(0, 0.02, 1)
    names = ("settle_2pct", "overshoot_discrete", "energy_step_w1", "energy_impulse_w0_discrete", "pole_radius")
    table = map_table(loop, 21, names)
    assert table.column_names == ["alpha", "beta", "stable", *names]
    alpha, beta = table.column("alpha").to_numpy(), table.column("beta").to_numpy()
    low_a, high_a, low_b, high_b = map_file.bounding_box(loop)
    assert sorted(set(alpha)) == pytest.approx(np.linspace(low_a, high_a, 21))
    assert sorted(set(beta)) == pytest.approx(np.linspace(low_b, high_b, 21))
    assert (alpha.max(), beta.max(), alpha.min(), beta.min()) == (high_a, high_b, low_a, low_b)
    stable = table.column("stable").to_numpy()
    radius = [spectral_radius(a, b, mass=1.0, b=0.02, delay=1, T=1.0) for a, b in zip(alpha, beta, strict=True)]
    # within 1e-6 of the boundary rounding decides, and alpha = 0 lies on it
    clear = (abs(np.array(radius) - 1) > 1e-6) & (alpha > 0)
    assert np.array_equal(stable[clear], np.array(radius)[clear] < 1)
    assert 100 < stable.sum() < 350
    some = np.flatnonzero(stable & clear)[::17]
    rows = np.array([(alpha[i], beta[i], 0, 0.02, 1) for i in some])
    found = theory.case_documents(theory.Cases(Path("cases.csv"), rows, tuple(range(len(rows)))))
    for name in names[:-1]:
        values = table.column(name).to_pylist()
        assert [values[i] for i in some] == pytest.approx([f[name] for f in found], rel=1e-12, abs=1e-12)
        assert all(values[i] is None for i in np.flatnonzero(~stable))
    assert [table.column("pole_radius")[int(i)].as_py() for i in some] == pytest.approx([radius[i] for i in some])


def test_map_survives_parquet_with_its_parameters(tmp_path):
    cost_map = CostMap(Loop(0, 0.02, 1), 5, ("overshoot",))
    done = []
    stable = map_file.write_map(tmp_path / "new" / "map.parquet", cost_map, lambda *counts: done.append(counts), 12)
    back = pq.read_table(tmp_path / "new" / "map.parquet")
    assert back.equals(map_table(Loop(0, 0.02, 1), 5, ("overshoot",)).combine_chunks())
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
        map_file.write_map(path, CostMap(Loop(0, 0, 1), 3, ("overshoot",)))
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"criteria": ("overshoot", "speed")}, "'speed' is unknown; expected some of settle_1pct"),
        ({"criteria": ("pole_radius_discrete",)}, "is unknown"),
        ({"criteria": ("",)}, "'' is unknown"),
        ({"size": 1}, "size = 1"),
        ({"size": 5000}, "size = 5000"),
        ({"longest": 0}, "longest = 0"),
    ],
)
def test_wrong_maps_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        map_table(Loop(0, 0, 1), **arguments)


def test_responses_that_move_longer_than_they_are_marched_have_the_same_costs():
    loop = Loop(0, 0, 1)
    short = map_table(loop, 11, ("settle_2pct",), longest=64)
    full = map_table(loop, 11, ("settle_2pct",))
    pairs = list(zip(short.column("settle_2pct").to_pylist(), full.column("settle_2pct").to_pylist(), strict=True))
    assert any(f is not None and f > 64 for _, f in pairs)
    assert all(s == f or math.isclose(s, f, rel_tol=1e-12) for s, f in pairs)


ENERGIES = ("energy_step_w0", "energy_step_w2", "energy_impulse_w1")


@pytest.mark.parametrize(
    ("loop", "names"),
    [(Loop(0, 0, 4), ("settle_2pct", "overshoot", "overshoot_discrete", *ENERGIES)), (Loop(0.01, 0.3, 1.5), ENERGIES)],
)
def test_blocks_of_any_size_give_the_same_map(loop, names):
    """Also against other methods at random points: doubled matrices, and the march of one sample after another."""
    whole = map_table(loop, 31, names)
    for points in (1, 400):
        blocks = map_table(loop, 31, names, points=points)
        for name in whole.column_names:
            values = (table.column(name).to_numpy().astype(float) for table in (whole, blocks))
            np.testing.assert_allclose(*values, rtol=1e-11, atol=1e-13, err_msg=name)
    columns = {name: whole.column(name).to_numpy() for name in whole.column_names}
    some = np.random.default_rng(13).choice(np.flatnonzero(columns["energy_step_w0"] > 0), 40, replace=False)
    alpha, beta = columns["alpha"][some], columns["beta"][some]
    expected = energy_costs(loop, alpha, beta, "step") | energy_costs(loop, alpha, beta, "impulse")
    expected |= transient_costs(loop, alpha, beta, (0.02,), longest=2000, quiet=1e-13)
    steady = np.isfinite(expected["settle_2pct"] + expected["overshoot"])  # the plain march gives up slow points
    assert steady.sum() > 25
    for name in names:
        found = columns[name][some][steady]
        np.testing.assert_allclose(found, expected[name][steady], rtol=1e-10, atol=1e-12, err_msg=name)
