"""Foreign logs to SI: small files with the quirks of real ones; stored values are those that were put into them."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.intake.ingest import ingest
from pipeline.records.table_files import read_table
from pipeline.records.tables import SAMPLES
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

HEAD = """
name = "lab"
format = "delimited"
files = ["*.txt"]
decimal = "."
step_at = "command edge"
"""
EDGE = 'step_at = "command edge"\n'
CONSTANTS = """
[constants]
device = "bench"
experiment = "1"
stiffness = 300
damping = 2
step = 8
sampling_period_s = 0.001
"""
COLUMNS = """
[columns]
time = { name = "t", unit = "ms" }
command = { name = "F", unit = "N", sign = 1 }
position = { name = "x", unit = "mm", sign = 1 }
"""


class Lab:
    """A folder with logs, a profile, and what ingest made of them."""

    def __init__(self, folder: Path):
        self.logs, self.processed, self.profile = folder / "logs", folder / "processed", folder / "lab.toml"
        self.logs.mkdir()

    def ingest(self, toml: str, files: dict[str, str | bytes]):
        self.profile.write_text(toml, encoding="utf-8")
        for name, content in files.items():
            (self.logs / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return self.again()

    def again(self):
        report = ingest([self.logs], self.processed, profile=self.profile, jobs=1)
        assert report.found == report.ingested + report.skipped + len(report.quarantined)
        return report

    @property
    def trials(self) -> list[dict]:
        rows = read_trials(self.processed).to_pylist()
        for row in rows:
            row["time_quality"], row["extra"] = json.loads(row["time_quality"]), json.loads(row["extra"])
        return rows

    def samples(self, trial: dict) -> dict[str, list]:
        table = read_table(self.processed / trial["sample_file"]).slice(trial["sample_row"], 1)
        assert table.column("trial_id").to_pylist() == [trial["trial_id"]]
        found = {name: table.column(name).to_pylist()[0] for name in SAMPLES}
        return {name: [None] * trial["rows"] if values is None else values for name, values in found.items()}

    def one(self, toml: str, text: str | bytes, name: str = "run.txt"):
        """Ingest one file with one trial; return its row, its samples, and the warnings."""
        report = self.ingest(toml, {name: text})
        assert not report.quarantined, report.quarantined[0].reason
        (trial,) = self.trials
        # of a log of a few rows the check of its recording says that it is short
        return trial, self.samples(trial), [one.warning for one in report.warnings if one.code is None]

    def refused(self, toml: str, text: str | bytes, name: str = "run.txt"):
        (refusal,) = self.ingest(toml, {name: text}).quarantined
        assert self.trials == []
        return refusal.row, refusal.reason


@pytest.fixture
def lab(tmp_path):
    return Lab(tmp_path)


def close(found, expected):
    # one multiplication by a factor: a rounding or two
    np.testing.assert_allclose(np.array(found, dtype=float), expected, rtol=4e-16, atol=0)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_semicolons_decimal_commas_umlauts_and_a_trailing_delimiter(lab, encoding):
    toml = HEAD.replace('"."', '","') + COLUMNS.replace('"F"', '"Kraft für Größe"').replace(
        '"x", unit = "mm"', '"Weg [µm]", unit = "µm"'
    )
    layout = 'delimiter = ";"\ntrailing_delimiter = true\nunit_line = true\n'
    layout += f'encoding = "{encoding.removesuffix("-sig")}"\n'
    text = "Kraft für Größe;t;Weg [µm];\nN;ms;µm;\n0,5;0;-1,25;\n8,0;1;2;\n8,0;2,5;1e3;\n"
    trial, samples, warnings = lab.one(
        toml.replace("[columns]", layout + "[columns]") + CONSTANTS, text.encode(encoding)
    )
    close(samples["time_s"], [0, 0.001, 0.0025])
    close(samples["command"], [0.5, 8, 8])
    close(samples["position"], [-1.25e-6, 2e-6, 1e-3])
    assert samples["raw_time"] == [0, 1, 2.5]
    assert (trial["stiffness"], trial["device"], warnings) == (300, "bench", [])


def test_a_headerless_pair_with_swapped_columns_in_microseconds_and_counts(lab):
    toml = """
name = "lab"
format = "delimited"
files = ["*_enc.txt"]
header = false
delimiter = "blanks"
decimal = "."
step_at = "command edge"
partner = { replace = "_enc", by = "_cmd" }
[columns]
time = { column = 2, unit = "us" }
position = { column = 1, unit = "rev", counts_per_unit = 4096, sign = -1, provenance = "quadrature encoder" }
command = { column = 2, unit = "mNm", sign = 1, file = "partner" }
[constants]
device = "lever"
experiment = "1"
motion = "rotation"
stiffness = 1
damping = 0.1
step = 0.2
sampling_period_s = 0.0005
"""
    report = lab.ingest(toml, {"a_enc.txt": "0 1000\n-1024  1500\n 7 2000\n", "a_cmd.txt": "9 0\n9 200\n9 200\n"})
    assert (report.found, report.ingested) == (1, 1)
    (trial,) = lab.trials
    samples = lab.samples(trial)
    close(samples["time_s"], [1e-3, 1.5e-3, 2e-3])
    close(samples["position"], [0, np.pi / 2, -7 / 4096 * 2 * np.pi])
    close(samples["command"], [0, 0.2, 0.2])
    assert samples["raw_count"] == [1000, 1500, 2000]
    assert samples["raw_time"] == [None] * 3
    assert trial["extra"] == {"provenance.position": "quadrature encoder"}


def test_a_terminal_log_with_banner_labels_and_a_cut_last_line(lab):
    text = (
        "\x1b[2J=== MOTOR BENCH v1.2 ===\r\nPort: /dev/ttyUSB0\r\nGain: 3.2 N/mm\r\nDamp: 18\r\n\r\n"
        "time[ms], F, x\r\n0, 0, 0\r\n1, 8, 0\r\nWarning: hot\r\n2, 8, 0.5\r\n3, 8, 1.2"
    )
    toml = HEAD + 'labels = ":"\nheader_at = "^time"\n' + COLUMNS.replace('name = "t"', 'name = "time[ms]"') + CONSTANTS
    toml = toml.replace("stiffness = 300\ndamping = 2\n", "") + '[attributes]\nstiffness = "Gain"\ndamping = "Damp"\n'
    trial, samples, warnings = lab.one(toml, text)
    assert (trial["stiffness"], trial["damping"]) == (3200, 18)
    close(samples["position"], [0, 0, 0.5e-3, 1.2e-3])
    assert warnings == ["the last line (11) has no line end: its last value may be incomplete"]
    assert trial["extra"]["file.Port"] == "/dev/ttyUSB0"
    assert trial["extra"]["file.Warning"] == "hot"

    (lab.logs / "run.txt").unlink()
    report = lab.ingest(toml, {"cut.txt": text[:-6]})
    assert [w.warning for w in report.warnings if w.code is None] == [
        "the last row (line 11) is incomplete and was omitted: '3, '"
    ]
    trial = next(trial for trial in lab.trials if trial["rows"] == 3)
    assert trial["extra"]["file.cut_last_row"] == "3, "
    assert trial["extra"]["warnings"] == report.warnings[0].warning


def test_a_counter_in_milliseconds_with_gaps(lab):
    toml = HEAD + COLUMNS.replace('unit = "ms"', 'unit = "ms", kind = "counter"') + CONSTANTS
    text = "t,F,x\n4229182,0,0\n4229183,8,0\n4229187,8,1\n4229188,8,2\n"
    trial, samples, _ = lab.one(toml, text)
    close(samples["time_s"], [0, 1e-3, 5e-3, 6e-3])
    assert samples["raw_count"] == [4229182, 4229183, 4229187, 4229188]
    quality = trial["time_quality"]
    assert (quality["gaps"], quality["dropped"], quality["longest_step_s"]) == (1, 3, pytest.approx(4e-3))
    assert quality["dropped_fraction"] == pytest.approx(3 / 7)
    assert quality["jitter_max_s"] == pytest.approx(0, abs=1e-17)  # rounding of 6 ms


def test_a_wrap_of_32_bits_is_undone_where_it_is_declared(lab):
    text = "t,F,x\n4294967290,0,0\n4294967294,8,0\n2,8,1\n6,8,2\n"
    toml = HEAD + COLUMNS.replace('unit = "ms"', 'unit = "us", kind = "counter"') + CONSTANTS
    row, reason = lab.refused(toml, text)
    assert row == 4
    assert "run.txt, column 't' (columns.time): time runs backwards" in reason
    assert 'kind = "counter" and wrap = ' in reason
    trial, samples, _ = lab.one(toml.replace('"counter"', '"counter", wrap = 4294967296'), text)
    close(samples["time_s"], [0, 4e-6, 8e-6, 12e-6])
    assert samples["raw_count"] == [4294967290, 4294967294, 2, 6]
    assert trial["time_quality"]["wraps"] == 1


def test_stamps_that_are_printed_coarsely_need_a_word(lab):
    text = "t,F,x\n0,0,0\n0,8,1\n0,8,2\n3,8,3\n3,8,4\n3,8,5\n"  # 1 ms samples, a clock of 3 ms
    toml = HEAD + COLUMNS + CONSTANTS
    row, reason = lab.refused(toml, text)
    assert row == 3
    assert 'kind = "sampled"' in reason
    trial, samples, _ = lab.one(toml.replace('"ms"', '"ms", kind = "sampled"'), text)
    close(samples["time_s"], np.arange(6) * 1e-3)
    assert samples["raw_count"] == [0, 0, 0, 3, 3, 3]
    lab.ingest(toml.replace('"ms"', '"ms", duplicates = "keep first"'), {})
    (trial,) = lab.trials
    assert lab.samples(trial)["position"] == [0, 3e-3]
    assert trial["time_quality"]["duplicates"] == 4


SPARSE = "t,F,x\n2,8,\n0,0,\n1,,0.5\n3,8,\n4,,1.5\n5,8,2\n6,9,\n"


def test_sparse_columns_of_several_rates_with_rows_out_of_order(lab):
    toml = HEAD + COLUMNS + CONSTANTS
    row, reason = lab.refused(toml, SPARSE)
    assert row == 4
    assert "command has no value: column 'F' is blank" in reason
    assert '"hold" to repeat the preceding value' in reason
    held = toml.replace('"N"', '"N", blanks = "hold"').replace('"mm"', '"mm", blanks = "skip"')
    row, reason = lab.refused(held, SPARSE)
    assert row == 3
    assert 'order = "sort"' in reason
    trial, samples, _ = lab.one(held.replace('"ms"', '"ms", order = "sort"'), SPARSE)
    close(samples["time_s"], [1e-3, 4e-3, 5e-3])
    assert samples["command"] == [0, 8, 8], "the last command before the position, in order of time"
    close(samples["position"], [0.5e-3, 1.5e-3, 2e-3])
    quality = trial["time_quality"]
    assert {key: quality[key] for key in ("out_of_order", "skipped_position", "held_command")} == {
        "out_of_order": 2,
        "skipped_position": 4,
        "held_command": 2,
    }


def test_a_command_at_its_target_in_the_first_row_after_a_long_first_step(lab):
    toml = HEAD.replace("command edge", "first row") + COLUMNS + CONSTANTS.replace("0.001", "0.005")
    text = "t,F,x\n0,8,0\n23.5,8,0\n28.5,8,1\n33.5,8,2\n"
    trial, samples, _ = lab.one(toml, text)
    close(samples["time_s"], [0, 0.0235, 0.0285, 0.0335])
    assert trial["extra"]["step_row"] == "0"
    assert load_trials(lab.processed, read_trials(lab.processed)).step_row.tolist() == [0]
    assert (trial["time_quality"]["gaps"], trial["time_quality"]["dropped"]) == (1, 4)


def test_one_clean_step_and_then_disturbances_with_and_without_a_window(lab):
    text = "t,F,x\n" + "".join(f"{k / 10:.1f},{8 if k > 3 else 0},{k if k < 10 else -50}\n" for k in range(20))
    constants = CONSTANTS.replace("0.001", "0.0001")
    trial, samples, _ = lab.one(HEAD + COLUMNS + constants, text)
    assert trial["rows"] == 20
    assert samples["position"][-1] == -0.05
    for window in ("window = { to_s = 0.0009 }\n", "window = { from_row = 0, to_row = 9 }\n"):
        lab.ingest(HEAD + window + COLUMNS + constants, {})
        (trial,) = lab.trials
        close(lab.samples(trial)["position"], np.arange(10) * 1e-3)
        assert trial["time_quality"]["outside_window"] == 10
    lab.ingest(
        HEAD.replace(EDGE, "window = { from_s = 0.0002, to_s = 0.0009 }\nstep_row = 4\n") + COLUMNS + constants, {}
    )
    (trial,) = lab.trials
    assert (trial["rows"], trial["extra"]["step_row"]) == (8, "2"), "row 4 of the file is row 2 of the window"
    late = HEAD.replace(EDGE, "window = { to_s = 0.0009 }\nstep_row = 12\n")
    (refusal,) = lab.ingest(late + COLUMNS + constants, {}).quarantined
    assert "step_row = 12 is not among the samples, 10 from" in refusal.reason


def test_negated_degrees_and_a_sentinel(lab):
    columns = COLUMNS.replace('"mm", sign = 1', '"deg", sign = -1, sentinels = [-3276.8]').replace(
        'unit = "N"', 'unit = "Nm"'
    )
    toml = HEAD + columns + CONSTANTS + 'motion = "rotation"\n'
    text = "t,F,x\n0,0,0\n1,8,90\n2,8,-3276.8\n3,8,-45\n"
    row, reason = lab.refused(toml, text)
    assert row == 4
    assert "position has no value: column 'x' is -3276.8, a sentinel" in reason
    trial, samples, _ = lab.one(toml.replace("[-3276.8]", '[-3276.8], blanks = "skip"'), text)
    close(samples["position"], [0, -np.pi / 2, np.pi / 4])
    close(samples["time_s"], [0, 1e-3, 3e-3])
    assert trial["time_quality"]["skipped_position"] == 1
    assert trial["time_quality"]["gaps"] == 1


LONG = "run,K,t,F,x\n" + "".join(
    f"{run},{K},{t},{8 if t else 0},{t * K}\n" for t in range(3) for run, K in (("b", 2), ("a", 1), ("c", 3))
)
LONG_TOML = (
    HEAD + 'trial_column = "run"\nunits.stiffness = "N/mm"\ncondition_columns = { stiffness = "K" }\n' + COLUMNS
) + CONSTANTS.replace("stiffness = 300\n", "")


def test_many_trials_in_one_table_are_trials_of_their_own(lab):
    report = lab.ingest(LONG_TOML, {"long.txt": LONG})
    assert (report.found, report.ingested) == (1, 1)
    trials = {trial["label"]: trial for trial in lab.trials}
    assert {label: trial["stiffness"] for label, trial in trials.items()} == {"a": 1000, "b": 2000, "c": 3000}
    for label, scale in (("a", 1), ("b", 2), ("c", 3)):
        close(lab.samples(trials[label])["position"], np.arange(3) * scale * 1e-3)
    assert len({trial["trial_id"] for trial in trials.values()}) == 3
    assert {trial["source_trials"] for trial in trials.values()} == {3}
    report = lab.again()
    assert (report.found, report.skipped) == (1, 1)
    # other content, a profile that is changed, a copy
    lab.ingest(LONG_TOML, {"long.txt": LONG.replace("b,2", "b,5"), "copy.txt": LONG})
    assert sorted(trial["stiffness"] for trial in lab.trials) == [1000, 1000, 2000, 3000, 3000, 5000]
    lab.ingest(LONG_TOML.replace('"N/mm"', '"N/m"'), {})
    assert sorted(trial["stiffness"] for trial in lab.trials) == [1, 1, 2, 3, 3, 5]
    lab.ingest(LONG_TOML, {"copy.txt": LONG.replace("b,2", "b,5")})
    assert sorted(trial["stiffness"] for trial in lab.trials) == [1000, 3000, 5000]


def test_one_refused_trial_refuses_its_file(lab):
    row, reason = lab.refused(LONG_TOML, LONG.replace("c,3,1,8,3", "c,3,0,8,3"))
    assert row == 7
    assert "run.txt, trial 'c', column 't' (columns.time): time is 0 s in two rows" in reason
    row, reason = lab.refused(LONG_TOML, LONG.replace("c,3,1,8,3", "c,4,1,8,3"))
    assert row == 7
    assert "column 'K' states the stiffness, but changes from 3 to 4" in reason
    row, reason = lab.refused(LONG_TOML, LONG.replace("c,3,1,8,3", ",3,1,8,3"))
    assert row == 7
    assert "trial_column) is blank" in reason


def test_several_steps_in_one_file(lab):
    steps = """
[[steps]]
label = "up"
from_s = 0
to_s = 0.003
step_time_s = 0.002
[[steps]]
label = "down"
from_row = 5
to_row = 8
step = -8
step_at = "first row"
"""
    text = "t,F,x\n" + "".join(f"{k},{8 if 2 <= k < 5 else 0},{k}\n" for k in range(10))
    report = lab.ingest(HEAD + COLUMNS + CONSTANTS.replace("step = 8\n", "") + steps, {"a.txt": text})
    assert "does not state the step of this file" in report.quarantined[0].reason
    lab.ingest(HEAD + COLUMNS + CONSTANTS + steps, {"a.txt": text})
    up, down = sorted(lab.trials, key=lambda trial: -trial["step"])
    assert (up["label"], up["step"], up["extra"]["step_row"]) == ("up", 8, "2")
    assert (down["label"], down["step"], down["extra"]["step_row"]) == ("down", -8, "0")
    assert lab.samples(up)["raw_count"] == [0, 1, 2, 3]
    assert lab.samples(down)["raw_count"] == [5, 6, 7, 8]
    assert down["time_quality"]["outside_window"] == 6


def test_a_file_whose_step_nobody_declared_is_refused(lab):
    toml = HEAD.replace(EDGE, "") + COLUMNS + CONSTANTS + '[[file]]\nmatch = "a*"\nstep_row = 1\n'
    text = "t,F,x\n0,0,0\n1,8,0\n"
    report = lab.ingest(toml, {"a.txt": text, "b.txt": text + "2,8,1\n"})
    assert [trial["extra"]["step_row"] for trial in lab.trials] == ["1"]
    (refusal,) = report.quarantined
    assert refusal.path.endswith("b.txt")
    assert (
        "does not state the time of the step for this file. At the top, or in the matching [[file]]" in refusal.reason
    )
    # where none was commanded there is nothing to declare
    lab.ingest(toml.replace("step = 8", "step = 0").replace("step_row = 1", "step = 8\nstep_row = 1"), {})
    assert len(lab.trials) == 2


def test_conditions_come_from_the_most_special_place(lab):
    toml = (
        HEAD.replace('"."', '","').replace(EDGE, "")
        + 'name_pattern = "B(?P<damping>[0-9,]+)"\ndelimiter = ";"\n'
        + 'units = { damping = "Ns/mm", sampling_period_s = "ms" }\n'
        + COLUMNS
        + CONSTANTS.replace("sampling_period_s = 0.001", "sampling_period_s = 1").replace("step = 8\n", "")
        + '[[file]]\nmatch = "B2,5_*"\nstep = 8\nstiffness = 77\nstep_row = 1\n'
        + '[[file]]\nmatch = "B2,5_odd*"\nstep = 4\nstep_at = "first row"\n'
    )
    text = "t;F;x\n0;0;0\n1;8;0\n"
    report = lab.ingest(toml, {"B2,5_a.txt": text, "B2,5_odd.txt": text + "2;8;1\n", "B3_a.txt": text + "3;8;1\n"})
    (trial,) = lab.trials
    values = {key: trial[key] for key in ("stiffness", "damping", "step", "sampling_period_s")}
    assert values == {"stiffness": 77, "damping": 2500, "step": 8, "sampling_period_s": 0.001}
    assert trial["extra"]["step_row"] == "1"
    odd, other = (refusal.reason for refusal in report.quarantined)
    assert "matches 2 [[file]] entries" in odd
    assert 'help in the profile: [[file]]; match = "B3_a.txt"; step = <value>' in other


@pytest.mark.parametrize(
    ("gain", "words"),
    [
        ("32 Nm", "measures torque; expected stiffness"),
        ("much", "stiffness is 'much'; expected a number"),
        ("nan", "stiffness must be a finite number"),
        ("3 N/mm", "but units.stiffness is 'N/m'"),
    ],
)
def test_a_condition_that_cannot_be_read_is_refused(lab, gain, words):
    toml = HEAD + 'labels = ":"\nattributes.stiffness = "Gain"\nunits.stiffness = "N/m"\n' + COLUMNS + CONSTANTS
    assert words in lab.refused(toml, f"Gain: {gain}\nt,F,x\n0,0,0\n1,8,0\n")[1]
    assert "has no attribute 'Gain'" in lab.refused(toml, "Gian: 1\nt,F,x\n0,0,0\n1,8,0\n")[1]


def test_a_log_of_another_kind_says_what_its_units_stand_for(lab):
    columns = COLUMNS.replace('"N"', '"%", stands_for = "N"').replace('"mm"', '"degC", stands_for = "m"')
    trial, samples, _ = lab.one(HEAD + columns + CONSTANTS, "t,F,x\n0,0,22.5\n1,50,22.5\n")
    assert (samples["command"], samples["position"]) == ([0, 50], [22.5, 22.5])
    assert trial["extra"]["stands_for.position"] == "1 degC stands for 1 m"


def test_time_as_steps_from_row_to_row(lab):
    toml = HEAD + COLUMNS.replace('"ms"', '"us", kind = "steps"') + CONSTANTS
    _, samples, _ = lab.one(toml, "t,F,x\n17,0,0\n1000,8,0\n1001,8,1\n")
    close(samples["time_s"], [0, 1e-3, 2.001e-3])
    assert samples["raw_count"] == [17, 1000, 1001]
    assert "time runs backwards" in lab.ingest(toml, {"b.txt": "t,F,x\n17,0,0\n-1,8,0\n"}).quarantined[0].reason


def test_a_window_for_one_file_goes_before_that_of_the_profile(lab):
    toml = HEAD + "window = { to_row = 2 }\n" + COLUMNS + CONSTANTS
    toml += '[[file]]\nmatch = "b*"\nwindow = { from_row = 1 }\nstep_time_s = 0.002\n'
    text = "t,F,x\n0,0,{}\n1,0,0\n2,8,0\n3,8,1\n"
    lab.ingest(toml, {"a.txt": text.format(0), "b.txt": text.format(1)})
    rows = {Path(trial["source_path"]).name: (trial["rows"], trial["extra"].get("step_row")) for trial in lab.trials}
    assert rows == {"a.txt": (3, None), "b.txt": (3, "1")}
    reason = lab.ingest(toml.replace("0.002", "7"), {"b.txt": text.format(2)}).quarantined[0].reason
    assert "step_time_s = 7 is not among the samples" in reason


def test_a_partner_is_named_where_its_cell_is_wrong(lab):
    toml = HEAD.replace("*.txt", "*_a.txt") + 'partner = { replace = "_a", by = "_b" }\n'
    toml += COLUMNS.replace('unit = "N"', 'unit = "N", file = "partner"') + CONSTANTS
    report = lab.ingest(toml, {"1_a.txt": "t,x\n0,0\n1,1\n", "1_b.txt": "F\n0\nhigh\n"})
    (refusal,) = report.quarantined
    assert "1_b.txt: command must be a number" in refusal.reason
    assert refusal.row == 3
