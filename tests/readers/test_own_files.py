"""A lab's own files, as a new user brings them: what the draft proposes, what check says, what gets in."""

import tomllib
import warnings

import numpy as np
import pandas as pd
import pytest
from foreign_files import list_columns, read_frame
from scipy.io import savemat
from typer.testing import CliRunner
from wall_logs import wall_rows

from pipeline.base.errors import LogError, ProfileError
from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.readers.formats import format_of
from pipeline.shell.cli import application
from pipeline.shell.profile.draft import draft_profile
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

ROWS = 400
TIME = np.arange(ROWS) * 0.001


def write(path, header, *columns):
    rows = "\n".join(",".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text(f"{header}\n{rows}\n")
    return path


def pipeline(*words):
    return CliRunner().invoke(application(), list(map(str, words)))


MOTOR = """
name = "motor"
format = "delimited"
files = ["*.csv"]
decimal = "."
COMMON
columns.time = { name = "t", unit = "s" }
columns.command = COMMAND
columns.position = { name = "x", unit = "POSITION", sign = 1INTEGRATE }
constants = { device = "motor", experiment = "1", stiffness = 0, damping = 0, step = 6, sampling_period_s = 0.001 }
"""


def profile(path, **parts):
    text = MOTOR
    defaults = {"COMMON": 'step_at = "command edge"', "POSITION": "m", "INTEGRATE": ""}
    for key, value in {**defaults, **parts}.items():
        text = text.replace(key, value)
    path.write_text(text)
    return path


@pytest.mark.parametrize("start", ["from_row = 100", "from_s = 0.1"])
def test_a_command_that_no_column_holds_is_stated(tmp_path, start):
    position = np.maximum(TIME - 0.1, 0) ** 2
    log = write(tmp_path / "run.csv", "t,x", TIME, position)
    lab = profile(tmp_path / "lab.toml", COMMAND=f'{{ value = 6.0, {start}, unit = "N", sign = 1 }}')
    done = pipeline("profile", "check", lab, log)
    assert (done.exit_code, "step                 row 100" in done.output) == (0, True), done.output
    assert ingest([log], tmp_path / "processed", lab).ingested == 1
    trials = read_trials(tmp_path / "processed")
    (trial,) = load_trials(tmp_path / "processed", trials)
    np.testing.assert_array_equal(trial.command, 6.0 * (np.arange(ROWS) >= 100))


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ('{ value = 6.0, unit = "N", sign = 1 }', "from_row"),
        ('{ from_row = 3, unit = "N", sign = 1 }', "value"),
        ('{ value = 6.0, from_row = 3, name = "t", unit = "N", sign = 1 }', "together with the column"),
        ('{ unit = "N", sign = 1 }', "value with from_row"),
    ],
)
def test_half_a_statement_is_none(tmp_path, command, said):
    lab = profile(tmp_path / "lab.toml", COMMAND=command)
    with pytest.raises(ProfileError, match=said):
        read_profile(lab)


def test_a_velocity_alone_is_offered_to_be_integrated(tmp_path):
    log = write(tmp_path / "run.csv", "t,F,v_mm_s", TIME, 6.0 * (TIME >= 0.1), 1000 * np.maximum(TIME - 0.1, 0))
    text = draft_profile(log)
    assert "'v_mm_s' is a velocity" in text
    assert '# integrate = "difference"' in text
    assert '\nunit = "mm/s" # the file states' in text


@pytest.mark.parametrize("unit", ["mm/s", "cm/s"])
def test_a_velocity_as_position_is_refused_with_the_line_that_cures_it(tmp_path, unit):
    command = '{ name = "F", unit = "N", sign = 1 }'
    with pytest.raises(ProfileError, match='integrate = "difference"'):
        read_profile(profile(tmp_path / "lab.toml", COMMAND=command, POSITION=unit))
    read_profile(profile(tmp_path / "lab.toml", COMMAND=command, POSITION=unit, INTEGRATE=', integrate = "difference"'))


def test_an_index_is_no_unit(tmp_path):
    savemat(tmp_path / "run.mat", {"data": np.stack([TIME, 6.0 * (TIME >= 0.1), TIME**2], axis=1)})
    text = draft_profile(tmp_path / "run.mat")
    assert "data[0]" in text
    assert "'0'" not in text


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("K300_B-0.8.csv", {"stiffness": 300.0, "damping": -0.8}),
        ("K-300_B-0.8.csv", {"stiffness": 300.0, "damping": 0.8}),
        ("K=300_B=0.8.csv", {"stiffness": 300.0, "damping": 0.8}),
    ],
)
def test_the_pattern_of_names_keeps_signs(tmp_path, name, found):
    text = draft_profile(write(tmp_path / name, "t,F,x", TIME, 6.0 * (TIME >= 0.1), TIME**2))
    (line,) = [line for line in text.splitlines() if line.startswith("name_pattern")]
    lab = profile(
        tmp_path / "lab.toml",
        COMMAND='{ name = "F", unit = "N", sign = 1 }',
        COMMON=line + '\nstep_at = "command edge"',
    )
    lab.write_text(lab.read_text().replace("stiffness = 0, damping = 0, ", ""))
    assert ingest([tmp_path / name], tmp_path / "processed", lab).quarantined == ()
    trials = read_trials(tmp_path / "processed")
    assert {key: trials.column(key)[0].as_py() for key in found} == found


FOUR = 6.0 * (TIME >= 0.05) + 6.0 * (TIME >= 0.15) - 6.0 * (TIME >= 0.25) - 6.0 * (TIME >= 0.35)


def test_a_piecewise_constant_command_is_parted_at_its_changes(tmp_path):
    log = write(tmp_path / "run.csv", "t,F,x", TIME, FOUR, np.cumsum(FOUR) * 1e-5)
    lab = profile(tmp_path / "lab.toml", COMMAND='{ name = "F", unit = "N", sign = 1 }')
    assert ingest([log], tmp_path / "processed", lab).ingested == 1
    trials = read_trials(tmp_path / "processed").sort_by("label")
    assert trials.column("step").to_pylist() == [6, 6, -6, -6]
    for i, (start, end) in enumerate(((0, 150), (50, 250), (150, 350), (250, 400))):
        (trial,) = load_trials(tmp_path / "processed", trials.slice(i, 1))
        np.testing.assert_array_equal(trial.command, FOUR[start:end])
    done = pipeline("profile", "check", lab, log)
    assert "4 trials would be stored" in done.output
    assert "step 3 of 4 found in the command: -6 in row 250" in done.output


@pytest.mark.parametrize("command", ["relay", "sweep"])
def test_any_command_gets_in_as_one_log(tmp_path, command):
    values = 6.0 * np.sign(np.sin(TIME * 500)) if command == "relay" else 6.0 * np.sin(300 * TIME**2)
    log = write(tmp_path / "run.csv", "t,F,x", TIME, values, np.cumsum(np.cumsum(values)) * 1e-7)
    lab = profile(tmp_path / "lab.toml", COMMAND='{ name = "F", unit = "N", sign = 1 }')
    report = ingest([log], tmp_path / "processed", lab)
    assert (report.ingested, report.quarantined) == (1, ())
    assert any("not split into steps" in str(warning) for warning in report.warnings)
    assert len(read_trials(tmp_path / "processed")) == 1


def test_a_log_without_wall_and_step_states_none_of_them(tmp_path):
    lab = profile(tmp_path / "lab.toml", COMMAND='{ name = "F", unit = "N", sign = 1 }', COMMON="")
    log = write(tmp_path / "run.csv", "t,F,x", TIME, FOUR, np.cumsum(FOUR) * 1e-5)
    text = lab.read_text()
    lab.write_text(text.replace("stiffness = 0, damping = 0, step = 6, ", ""))
    assert ingest([log], tmp_path / "processed", lab).ingested == 1
    lab.write_text(text.replace("stiffness = 0, damping = 0, step = 6, ", "stiffness = 0, "))
    with pytest.raises(ProfileError, match=r"constants\.damping"):
        read_profile(lab)
    native = "# device: motor\n# experiment: 2\n# sampling_period_s: 0.001\n# motion: translation\n"
    rows = "".join(f"{t:.3f},{f},{x:.9g}\n" for t, f, x in zip(TIME, FOUR, np.cumsum(FOUR) * 1e-5, strict=True))
    (tmp_path / "free.csv").write_text(f"{native}time_s,command,position\n{rows}")
    assert ingest([tmp_path / "free.csv"], tmp_path / "processed").ingested == 1
    trials = read_trials(tmp_path / "processed")
    assert trials.column("stiffness").to_pylist() == trials.column("step").to_pylist() == [0, 0]
    (tmp_path / "half.csv").write_text(f"# stiffness: 3\n{native}time_s,command,position\n{rows}")
    (refusal,) = ingest([tmp_path / "half.csv"], tmp_path / "processed").quarantined
    assert "has no 'damping' and no 'step'" in refusal.reason


@pytest.mark.parametrize("mirrored", [1, -1])
def test_a_draft_of_own_files_asks_only_what_the_command_does_not_tell(tmp_path, mirrored):
    files = []
    for number, text in enumerate(("0.5", "2")):
        samples = wall_rows(1000 * float(text), 12.0)
        rows = "".join(f"{1e3 * t:.1f};{f:.6f};{mirrored * x:.6f}\n" for t, f, x in samples)
        files.append(tmp_path / f"K{text}_B12_{number}.csv")
        files[-1].write_text("Zeit;Kraft;Weg\n" + rows.replace(".", ","))
    text = draft_profile(*files)
    asked = {".".join(map(str, question.place)) for question in find_questions(text)}
    assert asked == {"columns.command.unit", "columns.position.unit"}
    text = text.replace("\n# unit = ", "\nunit = ")
    assert f"sign = {mirrored}" in text
    (tmp_path / "lab.toml").write_text(text)
    done = pipeline("profile", "check", tmp_path / "lab.toml", *files)
    assert done.exit_code == 0, done.output
    assert "stiffness            500 N/m" in done.output
    (tmp_path / "wrong.toml").write_text(text.replace('stiffness = "N/mm"', ""))
    done = pipeline("profile", "check", tmp_path / "wrong.toml", *files)
    assert (done.exit_code, '[units] stiffness = "N/mm"' in done.output) == (1, True)


def test_a_damping_that_makes_no_part_of_the_command_tells_no_unit(tmp_path):
    time, command, position = wall_rows(3000.0, 0.02).T
    text = draft_profile(write(tmp_path / "K3_B0.02.csv", "t,F,x", time, command, 1e-3 * position))
    assert '[units]\nstiffness = "N/mm"' in text
    assert "\ndamping = " not in text


def series(values):
    """A timeseries as MATLAB saves it: equidistant times are not stored, but start, increment and length."""
    opaque = pytest.importorskip("matio.utils.matclass").MatlabOpaque
    empty, one = np.zeros((0, 0)), lambda value: np.array([[float(value)]])
    info = {"Start_": one(0), "Increment_": one(0.001), "Length": one(len(values)), "Time_": empty, "Units": "seconds"}
    parts = {"Data_": values[:, None], "Time_": empty, "TimeInfo": opaque(info, "tsdata.timemetadata"), "Name": "x"}
    return opaque(parts, "timeseries")


@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_timeseries_and_timetables_of_matlab_are_read(tmp_path, version):
    matio = pytest.importorskip("matio")
    frame = pd.DataFrame({"x": TIME**2}, index=pd.to_timedelta(np.arange(ROWS), unit="ms").astype("timedelta64[ns]"))
    contents = {"F": series(FOUR), "x": series(TIME**2), "log": frame, "K": np.array([[300.0]])}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        matio.save_to_mat(tmp_path / "run.mat", contents, version=version)
    data = (tmp_path / "run.mat").read_bytes()
    read = read_frame("matlab", "run.mat", data, ["F.Time", "F.Data", "x.Data"])
    np.testing.assert_allclose(read.columns["F.Time"], TIME, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(read.columns["F.Data"], FOUR)
    np.testing.assert_array_equal(read.columns["x.Data"], TIME**2)
    assert read.attributes["K"] == 300
    table = read_frame("matlab", "run.mat", data, ["log.Time", "log.x"])
    assert table.columns["log.Time"].tolist() == list(range(0, ROWS * 10**6, 10**6))
    assert table.units["log.Time"] == "ns"
    np.testing.assert_array_equal(table.columns["log.x"], TIME**2)


def test_mdf_channels_are_read_with_their_time(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        signals = [
            asammdf.Signal(values, TIME, name=name, unit=unit)
            for name, values, unit in (("F", FOUR, "N"), ("x", TIME**2, "mm"))
        ]
        file.append(signals)
        file.append([asammdf.Signal(TIME[:7], TIME[:7], name="F", unit="V")])
        path = file.save(tmp_path / "run.mf4", overwrite=True)
    data = path.read_bytes()
    read = read_frame("mdf", "run.mf4", data, ["0/@time", "0/F", "0/x"])
    np.testing.assert_array_equal(read.columns["0/@time"], TIME)
    np.testing.assert_array_equal(read.columns["0/F"], FOUR)
    infos = {info.name: info for info in list_columns("mdf", "run.mf4", data)}
    assert (infos["0/x"].hint, infos["0/F"].rows, infos["1/F"].rows) == ("mm", ROWS, 7)
    with pytest.raises(LogError, match="different lengths"):
        read_frame("mdf", "run.mf4", data, ["0/@time", "1/F"])
    assert format_of("run.mf4", data) == "mdf"
    with pytest.raises(LogError, match="cannot be read as an MDF file"):
        read_frame("mdf", "run.mf4", data[:400], ["0/F"])


def test_objects_of_matlab_are_named_with_their_export(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.mat", "w", userblock_size=512) as file:
        item = file.create_dataset("ts", data=np.arange(6, dtype=np.uint32))
        item.attrs["MATLAB_class"] = np.bytes_("timeseries")
        item.attrs["MATLAB_object_decode"] = np.int32(3)
        file["#sigstream#/0/#data#"] = TIME
    data = (tmp_path / "run.mat").read_bytes()
    (tmp_path / "run.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + data[128:])
    with pytest.raises(ProfileError) as caught:
        draft_profile(tmp_path / "run.mat")
    assert "class timeseries" in str(caught.value)
    assert "s = struct('time', ts.Time, 'data', ts.Data)" in str(caught.value)
    assert "sigstream" not in str(caught.value)
    with h5py.File(tmp_path / "run.mat", "a") as file:
        for name, values in (("t", TIME), ("f", 6.0 * (TIME > 0.1)), ("x", TIME**2)):
            file[name] = values[None]
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
    text = draft_profile(tmp_path / "run.mat")
    assert "# Not read: ts is a MATLAB object of class timeseries" in text
    assert "sigstream" not in text


def test_other_samples_are_held_against_the_first(tmp_path):
    columns = TIME, 6.0 * (TIME >= 0.1), TIME**2
    files = [write(tmp_path / f"K{k}_B1.csv", "t,F,x", *columns) for k in (100, 200)]
    files.append(write(tmp_path / "K300_B1.csv", "t,F,x,note", *columns, TIME))
    semicolons = tmp_path / "K400_B1.csv"
    semicolons.write_text(files[0].read_text().replace(",", ";").replace(".", ","))
    done = pipeline("profile", "draft", *files, semicolons)
    assert done.exit_code == 0
    assert "# K200_B1.csv" not in done.output
    assert '# K300_B1.csv has a different layout: columns = ["t", "F", "x", "note"]' in done.output
    assert "# K400_B1.csv has a different layout: " in done.output
    assert 'delimiter = ";"' in done.output


def test_rows_that_end_with_a_sign_and_names_in_remarks_give_columns_by_number(tmp_path):
    rows = [f"{57 * k}.0,{0.25 * (k > 2)},{-0.5 + 0.01 * k * k:.4f},{0.02 * k:.2f};" for k in range(40)]
    (tmp_path / "run1.csv").write_text("\n".join(["%Date:,2021", "", "%t,u,x,v", "%[ms],[V],[m],[m/s]", *rows, ""]))
    text = draft_profile(tmp_path / "run1.csv")
    for line in ('row_end = ";"', "header = false", "skip_rows = 4", "column = 1"):
        assert line in text
    layout = tomllib.loads(text)
    settings = {key: layout[key] for key in ("delimiter", "decimal", "header", "skip_rows", "row_end")}
    columns = read_frame("delimited", "run1.csv", (tmp_path / "run1.csv").read_bytes(), **settings).columns
    assert [*columns] == ["1", "2", "3", "4"]
    assert columns["1"][:2].tolist() == [0.0, 57.0]
    assert columns["4"][-1] == 0.78


def test_a_blank_line_above_the_first_row_is_no_row(tmp_path):
    text = b"% remark\n\n0.000,0,0.1\n0.001,1,0.1\n0.002,1,0.2\n"
    read = read_frame("delimited", "a.csv", text, decimal=".", header=False, comment="%", blank_lines="skip")
    assert read.columns["1"].tolist() == [0.0, 0.001, 0.002]


@pytest.mark.parametrize(
    "stamp", ["2026-03-29T10:00:00.{:03d}Z", "29.03.2026 10:00:00,{:03d}", "2026-03-29 12:00:00.{:03d}+02:00"]
)
def test_dates_are_stamps_in_nanoseconds(tmp_path, stamp):
    rows = "".join(f"{stamp.format(k)};{k % 3};{k * k}\n" for k in range(9))
    read = read_frame("delimited", "a.csv", f"t;F;x\n{rows}".encode(), decimal=",", delimiter=";")
    assert read.units["t"] == "ns"
    assert read.columns["t"][0] == 1774778400 * 10**9
    assert np.diff(read.columns["t"]).tolist() == [10**6] * 8


@pytest.mark.parametrize("sign", [" ", "\u00a0", "\u202f", "'"])
@pytest.mark.parametrize("encoding", ["utf-8", "cp1252"])
def test_blanks_and_apostrophes_part_thousands(tmp_path, sign, encoding):
    """French and Swiss numbers: 1 500,50 and 1'500,50."""
    if sign == "\u202f" and encoding != "utf-8":
        pytest.skip("cp1252 has no such blank")

    def written(value):
        return f"{value:,.2f}".replace(",", sign).replace(".", ",")

    rows = [(k, 1500.5 * (k >= 10), -12345.25 * max(k - 11, 0)) for k in range(60)]
    text = "\n".join(["Temps (ms);Force (mN);Position (µm)", *(";".join(map(written, row)) for row in rows), ""])
    (tmp_path / "a.csv").write_text(text, encoding=encoding)
    draft = draft_profile(tmp_path / "a.csv")
    assert find_questions(draft) == []
    layout = tomllib.loads(draft)
    assert (layout["delimiter"], layout["decimal"]) == (";", ",")
    read = read_frame("delimited", "a.csv", text.encode(), delimiter=";", decimal=",")
    assert read.columns["Force (mN)"][-1] == 1500.5
    assert read.columns["Position (µm)"][-1] == -12345.25 * 48


def test_a_blank_between_other_digits_is_no_number():
    text = b"t;x\n0;1 50\n1;1 500\n2;3\n"
    assert read_frame("delimited", "a.csv", text, delimiter=";", decimal=".").columns["x"].dtype.kind == "U"
    text = text.replace(b"1 50\n", b"1 050\n")
    read = read_frame("delimited", "a.csv", text, delimiter=";", decimal=".")
    assert read.columns["x"].tolist() == [1050, 1500, 3]
