"""Records of stages: their fields are the stored columns, and those of costs follow from the criteria."""

from dataclasses import fields

import pytest

from pipeline.measured.stages.stage_needs import NEEDS
from pipeline.records.criteria import FAMILIES, members
from pipeline.records.findings import BoundaryPoint
from pipeline.records.stage_records import BOUNDARY, ROWS, columns_of
from pipeline.records.tables import COLUMNS, TABLES


def test_every_stage_has_a_record_and_every_field_a_column():
    assert {*ROWS, "boundary"} == set(NEEDS)
    assert {*BOUNDARY, "stiffness_large_motion", "truth"} == set(BoundaryPoint.model_fields)
    for stage, row in ROWS.items():
        names = [field.name for field in fields(row)]
        assert list(TABLES[stage])[-len(names) :] == names
        assert set(names) <= set(COLUMNS)


@pytest.mark.parametrize("family", FAMILIES)
def test_record_of_a_cost_has_each_criterion_with_its_interval(family):
    expected = {f"{c.column}{end}" for c in members(FAMILIES[family]) for end in ("", "_low", "_high")}
    others = {"overshoot": 1, "energy": 7}.get(family, 0)  # floor; bias and tail of three weights, and the horizon
    assert expected <= set(columns_of(family))
    assert len(fields(ROWS[family])) == len(expected) + others + 1
