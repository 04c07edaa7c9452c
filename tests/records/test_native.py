"""Native header: what is written is read back, and each fault is named with its key and line."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.base.errors import LogError, ParameterError
from pipeline.records.native import COLUMN_LINE, NativeHeader, format_header, parse_header

NAMES = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S")), min_size=1, max_size=30).filter(
    lambda name: not name.startswith("[")
)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)

EXAMPLE = """\
# device: lwr
# experiment: delay-2
# stiffness: 3200          [N/m, or Nm/rad for a rotational device]
# damping: 18              [Ns/m, Nms/rad]
# step: 15                 [N, Nm]: size of the external force step
# sampling_period_s: 0.001
# added_delay_samples: 0   optional
# grip: none               optional: none, comfortable, firm
# motion: rotation         optional: translation (default) or rotation; a known device brings its own
time_s,command,position
0,0,0
"""
HEADER = NativeHeader("lwr", "delay-2", 3200.0, 18.0, 15.0, 0.001, motion="rotation")


@pytest.mark.slow
@given(
    device=NAMES,
    experiment=NAMES,
    stiffness=NUMBERS,
    damping=NUMBERS,
    step=NUMBERS,
    period=st.floats(min_value=1e-12, max_value=1e6),
    delay=st.integers(0, 1000),
    grip=st.sampled_from(["none", "comfortable", "firm"]),
    motion=st.sampled_from(["translation", "rotation"]),
    simulated=st.booleans(),
    note=NAMES,
)
def test_what_is_written_is_read_back(
    device, experiment, stiffness, damping, step, period, delay, grip, motion, simulated, note
):
    header = NativeHeader(
        *(device, experiment, stiffness, damping, step, period),
        added_delay_samples=delay,
        grip=grip,
        motion=motion,
        simulated=simulated,
        extra={"recorded by": note},
    )
    text = format_header(header)
    assert text.endswith(f"{COLUMN_LINE}\n")
    assert parse_header(text.splitlines()) == header


def test_example_of_the_manual_with_all_its_notes():
    assert parse_header(EXAMPLE.splitlines()) == HEADER


@pytest.mark.parametrize("change", [("\n", "\r\n"), ("# device", "\ufeff# device"), ("# ", "  #   "), ("\n", "\n\n")])
def test_line_ends_mark_and_blanks_do_not_matter(change):
    assert parse_header(EXAMPLE.replace(*change).split("\n")) == HEADER


def test_reading_stops_at_the_columns():
    assert parse_header([*EXAMPLE.splitlines(), "# device: other"]) == HEADER


def test_unit_notes_follow_the_motion():
    assert "3200 [Nm/rad]" in format_header(HEADER)
    assert "3200 [N/m]" in format_header(replace(HEADER, motion=None))
    assert "# motion: rotation" in format_header(replace(HEADER, motion=None), "rotation")


@pytest.mark.parametrize("key", ["device", "experiment", "stiffness", "damping", "step", "sampling_period_s"])
def test_a_missing_key_is_named_with_the_line_to_add(key):
    lines = [line for line in EXAMPLE.splitlines() if not line.startswith(f"# {key}:")]
    with pytest.raises(LogError, match=f"has no '{key}'.*Add a line `# {key}: <value>`"):
        parse_header(lines)


@pytest.mark.parametrize(
    ("old", "new", "row", "words"),
    [
        ("3200 ", "nan ", 3, "stiffness must be a finite number.*'nan'"),
        ("3200 ", "3,2 ", 3, "decimal point, but the header has '3,2'"),
        ("3200 ", "3_200 ", 3, "stiffness must be a finite number"),
        ("3200          [N/m,", "3.2 [N/mm]: ", 3, "stated in N/mm.*by 1000"),
        ("18 ", "inf ", 4, "damping must be a finite number"),
        ("15 ", "nought ", 5, "step must be a finite number"),
        ("0.001", "0", 6, "sampling_period_s must be above 0"),
        ("0.001", "-1", 6, "sampling_period_s must be above 0"),
        (" 0   optional", " 1.5", 7, "integer number of samples"),
        (" 0   optional", " -1", 7, "integer number of samples"),
        ("none  ", "soft  ", 8, "grip must be one of none, comfortable, firm; found 'soft'"),
        ("rotation  ", "spin  ", 9, "motion must be one of translation, rotation, .*; found 'spin'"),
        ("# grip", "# device", 8, "'device' twice, first in line 1"),
        ("lwr", "[note only]", 1, "device must be a printable name"),
        ("lwr", "x" * 201, 1, "device must be a printable name"),
    ],
)
def test_a_wrong_value_is_refused_with_its_line(old, new, row, words):
    with pytest.raises(LogError, match=words) as error:
        parse_header(EXAMPLE.replace(old, new, 1).splitlines())
    assert error.value.row == row


@pytest.mark.parametrize(
    "change",
    [
        {"device": "two\nlines"},
        {"device": " blank"},
        {"experiment": "a [b]"},
        {"stiffness": float("nan")},
        {"grip": "soft"},
        {"extra": {"step": "15"}},
    ],
)
def test_what_could_not_be_read_back_is_not_written(change):
    with pytest.raises(ParameterError, match="cannot be written"):
        format_header(replace(HEADER, **change))


def test_contradicting_motions_are_not_written():
    with pytest.raises(ParameterError, match="cannot be written"):
        format_header(HEADER, "translation")


def test_repeated_remarks_are_kept():
    found = parse_header(["# note: a", "# note: b", "# free text", *EXAMPLE.splitlines()])
    assert found.extra == {"note": "a; b"}
