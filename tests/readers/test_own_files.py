"""A lab's own files, as a new user brings them: what the draft proposes, what check says, what gets in."""

import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

from pipeline.base.errors import ProfileError
from pipeline.intake.ingest import ingest
from pipeline.profiles.profile_files import read_profile
from pipeline.shell.cli import application
from pipeline.shell.profile.profile_draft import draft_profile
from pipeline.store.samples import load_batch
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
    batch = load_batch(tmp_path / "processed", trials)
    np.testing.assert_array_equal(batch.command[0], 6.0 * (np.arange(ROWS) >= 100))


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ('{ value = 6.0, unit = "N", sign = 1 }', "from_row"),
        ('{ from_row = 3, unit = "N", sign = 1 }', "value"),
        ('{ value = 6.0, from_row = 3, name = "t", unit = "N", sign = 1 }', "beside the column"),
        ('{ unit = "N", sign = 1 }', "value and from_row"),
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
    assert '# unit = "mm/s"' in text


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
    (line,) = [line for line in text.splitlines() if line.startswith("# name_pattern")]
    lab = profile(
        tmp_path / "lab.toml",
        COMMAND='{ name = "F", unit = "N", sign = 1 }',
        COMMON=line[2:] + '\nstep_at = "command edge"',
    )
    lab.write_text(lab.read_text().replace("stiffness = 0, damping = 0, ", ""))
    assert ingest([tmp_path / name], tmp_path / "processed", lab).quarantined == ()
    trials = read_trials(tmp_path / "processed")
    assert {key: trials.column(key)[0].as_py() for key in found} == found


def test_check_says_that_a_file_has_several_steps(tmp_path):
    command = 6.0 * (TIME >= 0.05) + 6.0 * (TIME >= 0.15) - 6.0 * (TIME >= 0.25) - 6.0 * (TIME >= 0.35)
    log = write(tmp_path / "run.csv", "t,F,x", TIME, command, np.cumsum(command) * 1e-5)
    lab = profile(tmp_path / "lab.toml", COMMAND='{ name = "F", unit = "N", sign = 1 }')
    done = pipeline("profile", "check", lab, log)
    assert "[[steps]]" in done.output


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
    assert '# K300_B1.csv is laid out otherwise: columns ["t", "F", "x", "note"]' in done.output
    assert "# K400_B1.csv is laid out otherwise: " in done.output
    assert 'delimiter = ";"' in done.output
