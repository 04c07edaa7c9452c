"""Many trials in one file, numpy archives and sheets with samples: found by the draft, read by what options say."""

import io
import json

import numpy as np
import pytest
from packed_sheets import ods, xlsx
from wall_logs import wall_log

from pipeline.base.errors import ProfileError
from pipeline.profiles.profile_files import find_questions, read_profile
from pipeline.readers.formats import format_of
from pipeline.shell.profile.draft import draft_profile
from pipeline.store.storage import read_trials

WALLS = [(1000.0, 3.0), (1500.0, 5.0), (2500.0, 8.0)]
OPTIONS = ("--stiffness", "K:N/m", "--damping", "B:Ns/m", "--step", "8 N", "--device", "bench")


def samples(stiffness, damping):
    rows = [line.split(";") for line in wall_log(stiffness, damping).splitlines()[1:]]
    return dict(zip(("t", "F", "x"), np.array(rows, float).T, strict=True))


def tdms(path):
    from nptdms import ChannelObject, GroupObject, TdmsWriter

    with TdmsWriter(path) as writer:
        for number, (k, b) in enumerate(WALLS, start=1):
            group = f"Trial {number}"
            channels = [
                ChannelObject(group, name, values, properties={"wf_increment": 0.001, "wf_start_offset": 0.0})
                for name, values in samples(k, b).items()
                if name != "t"
            ]
            writer.write_segment([GroupObject(group, properties={"K": k, "B": b}), *channels])


def structs(path):
    from scipy.io import savemat

    runs = np.zeros(3, dtype=[(name, "O") for name in ("K", "B", "t", "F", "x")])
    for number, (k, b) in enumerate(WALLS):
        runs[number] = (k, b, *samples(k, b).values())
    savemat(path, {"runs": runs})


def records(path):
    runs = [{"K": k, "B": b, **{n: v.tolist() for n, v in samples(k, b).items()}} for k, b in WALLS]
    path.write_text(json.dumps({"lab": "A", "runs": runs}))


def hdf5(path):
    import h5py

    with h5py.File(path, "w") as file:
        for number, (k, b) in enumerate(WALLS):
            group = file.create_group(f"run_{number}")
            group.attrs.update({"K": k, "B": b})
            for name, values in samples(k, b).items():
                group[name] = values


WRITERS = {"a.tdms": tdms, "a.mat": structs, "a.json": records, "a.h5": hdf5}


@pytest.mark.parametrize("name", WRITERS)
def test_each_group_of_a_file_is_a_trial(name, call, tmp_path):
    (tmp_path / "logs").mkdir()
    WRITERS[name](tmp_path / "logs" / name)
    time = "@time:s" if name == "a.tdms" else "t:s"
    columns = ("--time", time, "--command", "F:N", "--position", "x:mm")
    status, _, err = call("ingest", "logs", *columns, *OPTIONS, "--save-profile", "lab.toml")
    assert status == 0, err
    rows = read_trials(tmp_path / "processed").to_pylist()
    assert sorted((row["stiffness"], row["damping"]) for row in rows) == WALLS
    assert len({row["label"] for row in rows}) == 3
    assert 'trials = "each group"' in (tmp_path / "lab.toml").read_text()
    # the draft finds it, too, and asks two units at most
    text = draft_profile(tmp_path / "logs" / name)
    assert 'trials = "each group"' in text
    assert len(find_questions(text)) <= 2


def test_fifty_groups_are_fifty_trials(call, tmp_path):
    runs = [{"t": [0, 1, 2, 3], "u": [0, 1, 1, 1 + i / 100], "x": [0, 0, i / 1e3, 2 * i / 1e3]} for i in range(50)]
    (tmp_path / "all.json").write_text(json.dumps(runs))
    columns = ("--time", "t:ms", "--command", "u:N", "--position", "x:mm", "--device", "bench")
    assert call("ingest", "all.json", *columns)[0] == 0
    assert read_trials(tmp_path / "processed").num_rows == 50


def test_a_group_without_a_column_is_no_trial_and_none_is_refused(call, tmp_path):
    records(tmp_path / "a.json")
    whole = json.loads((tmp_path / "a.json").read_text())
    del whole["runs"][1]["x"]
    (tmp_path / "a.json").write_text(json.dumps(whole))
    (tmp_path / "lab.toml").write_text(
        'name = "lab"\nformat = "json"\nfiles = ["*.json"]\ntrials = "each group"\n'
        'columns.time = { name = "t", unit = "s" }\ncolumns.command = { name = "F", unit = "N", sign = 1 }\n'
        'columns.position = { name = "x", unit = "mm", sign = 1 }\n'
        '[constants]\ndevice = "bench"\nexperiment = "1"\nsampling_period_s = 0.001\n'
    )
    status, out, _ = call("profile", "check", "lab.toml", "a.json", "--json")
    labels = [trial["label"] for trial in json.loads(out)["samples"][0]["trials"]]
    assert (status, labels) == (0, ["runs[0]", "runs[2]"])
    text = (tmp_path / "lab.toml").read_text()
    (tmp_path / "lab.toml").write_text(text.replace('name = "x"', 'name = "y"'))
    status, out, _ = call("profile", "check", "lab.toml", "a.json")
    assert (status, "no group has the columns 't', 'F', 'y'. Columns of the file: runs[0].t" in out) == (3, True)


def test_groups_are_of_formats_that_have_some(tmp_path):
    (tmp_path / "lab.toml").write_text(
        'name = "lab"\nformat = "delimited"\nfiles = ["*.csv"]\ndecimal = "."\ntrials = "each group"\n'
    )
    with pytest.raises(ProfileError, match=r"'trials': for formats \(json, matlab, hdf5, tdms, mdf\)"):
        read_profile(tmp_path / "lab.toml")


def npz(path):
    np.savez(path, K=1500.0, B=5.0, **samples(1500.0, 5.0))


def table(write):
    def write_sheet(path):
        columns = samples(1500.0, 5.0)
        rows = [["K", 1500.0], ["B", 5.0], [], ["t", "F", "x"], ["s", "N", "mm"]]
        path.write_bytes(write([*rows, *np.stack([*columns.values()], axis=1).tolist()]))

    return write_sheet


@pytest.mark.parametrize(("name", "write"), [("a.npz", npz), ("a.xlsx", table(xlsx)), ("a.ods", table(ods))])
def test_archives_and_sheets_hold_samples(name, write, call, tmp_path):
    if name != "a.npz":
        pytest.importorskip("python_calamine")
    write(tmp_path / name)
    assert format_of(name, (tmp_path / name).read_bytes()) == ("npz" if name == "a.npz" else "sheet")
    text = draft_profile(tmp_path / name)
    assert len(find_questions(text)) == (2 if name == "a.npz" else 0)
    status, _, err = call("ingest", name, "--time", "t:s", "--command", "F:N", "--position", "x:mm", *OPTIONS)
    assert status == 0, err
    (row,) = read_trials(tmp_path / "processed").to_pylist()
    assert (row["stiffness"], row["damping"], row["rows"]) == (1500.0, 5.0, 400)


def test_an_archive_with_objects_runs_no_code(call, tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "made"), "w"))

    stream = io.BytesIO()
    np.savez(stream, t=np.arange(4.0), evil=np.array([Evil()], dtype=object))
    (tmp_path / "a.npz").write_bytes(stream.getvalue())
    call("look", "a.npz")
    assert not (tmp_path / "made").exists()


def test_columns_of_different_length_name_the_cure(call, tmp_path):
    np.savez(tmp_path / "a.npz", t=np.arange(9.0), u=np.ones(10), x=np.arange(10.0))
    status, _, err = call("identify", "a.npz", "--time", "t:s", "--command", "u:N", "--position", "x:mm")
    assert status == 1
    assert "different lengths" in err
    assert "sampled" in err
