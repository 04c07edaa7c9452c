"""The record of a ladder and its runner: what is run at which setting, what counts as the error, what is missing."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.records.accuracy import Rung
from pipeline.studies.accuracy.ladder import Ladder, Method, grouped

EXACT = {"a": np.array([2.0, 4.0]), "b": np.array([5.0])}


def of(*methods: Method, quick: bool = False, **options: object) -> list[Rung]:
    return list(Ladder(EXACT, methods, **options).rungs(quick, 0.0))  # type: ignore[arg-type]


def test_a_rung_is_one_quantity_at_one_setting() -> None:
    def run(power: int) -> dict[str, np.ndarray]:
        return {"a": EXACT["a"] * (1 + 10.0**-power), "b": np.array([5.0, 5.0 + 10.0**-power])}

    rungs = of(Method("m", run, "{} digits", (1, 2, 3), (2,)), scale={"b": 1.0})
    assert [(r.quantity, r.setting) for r in rungs] == [(q, f"{n} digits") for n in (1, 2, 3) for q in "ab"]
    assert [r.error for r in rungs] == pytest.approx([0.1, 0.1, 0.01, 0.01, 1e-3, 1e-3])
    assert {r.setting for r in of(Method("m", run, "{} digits", (1, 2, 3), (2,)), quick=True)} == {"2 digits"}


def test_a_method_without_a_number_has_a_rung_without_an_error() -> None:
    def fails() -> dict[str, np.ndarray]:
        raise ZeroDivisionError

    rungs = of(Method("m", fails))
    assert [(r.quantity, r.error, r.setting) for r in rungs] == [("a", None, "one setting"), ("b", None, "one setting")]
    with pytest.raises(KeyError):  # any other error is a defect of this program
        of(Method("m", lambda: {"c": np.ones(1)}))


def test_missing_values_count_as_one() -> None:
    first, second = of(Method("m", lambda: {"a": np.array([np.nan, 4.4]), "b": np.array([5.5])}))
    assert (first.error, second.error) == (1.0, pytest.approx(0.1))


def test_a_library_that_is_not_installed_leaves_its_method_out() -> None:
    assert of(Method("m", dict, needs="no_such_library")) == []


def test_rungs_keep_the_order_in_which_their_groups_begin() -> None:
    rungs = [Rung(quantity=q, method=m, setting="", error=0.0, seconds=1.0) for q, m in ("bx", "ay", "by", "ax")]
    assert list(grouped(rungs, "quantity")) == ["b", "a"]
    assert [[r.quantity for r in found] for found in grouped(rungs, "method").values()] == [["b", "a"], ["a", "b"]]
