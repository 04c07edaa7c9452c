"""The split is that of an exhaustive search."""

from functools import cache

import numpy as np
import pytest

from pipeline.plan.next_wall import best_split


def exhaustive(edges, chance, width, price):
    total = np.concatenate([[0.0], np.cumsum(chance)])

    @cache
    def cost(i, j):
        if edges[j] - edges[i] <= width or j - i < 2:
            return 0.0
        return min(
            cost(i, k) + cost(k, j) + total[j] - total[k] + price * (total[k] - total[i]) for k in range(i + 1, j)
        )

    n = len(chance)
    return {k: cost(0, k) + cost(k, n) + total[n] - total[k] + price * (total[k] - total[0]) for k in range(1, n)}


@pytest.mark.parametrize("price", [1.0, 4.0])
@pytest.mark.parametrize("seed", range(5))
def test_no_other_place_is_cheaper(seed, price):
    random = np.random.default_rng(seed)
    edges, chance = np.cumsum(random.uniform(0.2, 2, 10)), random.uniform(0.01, 1, 9)
    costs = exhaustive(edges, chance, 1.5, price)
    assert costs[best_split(edges, chance, 1.5, price).place] == pytest.approx(min(costs.values()), rel=1e-12)


def test_dear_unstable_trials_are_approached_from_below():
    edges, chance = np.linspace(0, 10, 41), np.ones(40)
    plain, gentle = (best_split(edges, chance, 0.5, price) for price in (1.0, 6.0))
    assert gentle.place < plain.place
    assert gentle.unstable < plain.unstable


def test_a_narrow_range_is_done():
    assert best_split(np.array([0.0, 0.5, 1.0]), np.ones(2), 1.0) is None
