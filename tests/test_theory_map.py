import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from simulated import spectral_radius

from pipeline.base.errors import ParameterError, PipelineError
from pipeline.theory import cases as theory
from pipeline.theory import stability, theory_map
from pipeline.theory.loop import Loop


@pytest.mark.parametrize("loop", [Loop(0, 0, 1), Loop(0.001, 0.02, 2), Loop(0.2, 0.1, 0.5)])
def test_bounding_box_is_that_of_the_stable_region(loop):
    """Cells of a larger grid that are stable fill the box up to a cell."""
    low_a, high_a, low_b, high_b = theory_map.bounding_box(loop)
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
    table = theory_map.map_table(loop, 21, names)
    assert table.column_names == ["alpha", "beta", "stable", *names]
    alpha, beta = table.column("alpha").to_numpy(), table.column("beta").to_numpy()
    low_a, high_a, low_b, high_b = theory_map.bounding_box(loop)
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
    found = theory.point_costs(theory.Cases(Path("cases.csv"), rows, tuple(range(len(rows)))))
    for name in names[:-1]:
        values = table.column(name).to_pylist()
        assert [values[i] for i in some] == pytest.approx([f[name] for f in found], rel=1e-12, abs=1e-12)
        assert all(values[i] is None for i in np.flatnonzero(~stable))
    assert [table.column("pole_radius")[int(i)].as_py() for i in some] == pytest.approx([radius[i] for i in some])


def test_map_survives_parquet_with_its_parameters(tmp_path):
    table = theory_map.map_table(Loop(0, 0.02, 1), 5, ("overshoot",))
    theory_map.write_map(tmp_path / "new" / "map.parquet", table)
    back = pq.read_table(tmp_path / "new" / "map.parquet")
    assert back.equals(table)
    assert back.schema.metadata[b"pipeline.delta"] == b"0.02"
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["map.parquet"]


def test_map_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    table = theory_map.map_table(Loop(0, 0, 1), 3, ("overshoot",))
    path = tmp_path / "map.parquet"
    path.write_bytes(b"old")

    def half(writer, data, **_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(pq.ParquetWriter, "write_table", half)
    with pytest.raises(PipelineError, match="No space left on device"):
        theory_map.write_map(path, table)
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
        theory_map.map_table(Loop(0, 0, 1), **arguments)


def test_map_gives_up_responses_that_move_too_long():
    loop = Loop(0, 0, 1)
    short = theory_map.map_table(loop, 11, ("settle_2pct",), longest=64)
    full = theory_map.map_table(loop, 11, ("settle_2pct",))
    pairs = list(zip(short.column("settle_2pct").to_pylist(), full.column("settle_2pct").to_pylist(), strict=True))
    assert any(s is None and f is not None for s, f in pairs)
    assert all(s is None or math.isclose(s, f, rel_tol=1e-12) for s, f in pairs)
