"""Columns that a command line names: they become a profile, and the logs prove what it does not state."""

import json
import re

import numpy as np
import pyarrow.parquet as pq
import pytest
from wall_logs import wall_rows

from pipeline.base.errors import UsageError
from pipeline.profiles.column_text import ColumnText
from pipeline.profiles.profile_files import read_profile, shipped_profiles
from pipeline.profiles.profile_text import profile_toml
from pipeline.store.samples import load_trials
from pipeline.store.storage import read_trials

WALLS = [(1.0, 3.0), (1.5, 5.0), (2.5, 8.0), (3.0, 4.0)]
READ = ["--time", "t:ms", "--position", "s:mm", "--stiffness", "K:N/mm", "--damping", "B:Ns/m", "--device", "bench"]


def write_logs(folder, heading='t,"F soll, u",s', *, force=1.0, sign=1, walls=WALLS):
    folder.mkdir(exist_ok=True)
    for stiffness, damping in walls:
        lines = [
            f"{1e3 * t:.4g},{float(force * u)!r},{float(sign * x)!r}" for t, u, x in wall_rows(1e3 * stiffness, damping)
        ]
        name = f"run K{stiffness:g}_B{damping:g}.csv".replace("2.5", "2,5")
        (folder / name).write_text("\n".join([heading, *lines, ""]), encoding="utf-8")
    return folder


@pytest.fixture
def logs(tmp_path):
    return write_logs(tmp_path / "logs")


def stored(call, tmp_path):
    return sorted(read_trials(tmp_path / "processed").to_pylist(), key=lambda row: row["stiffness"])


def positions(tmp_path, stiffness):
    trials = load_trials(tmp_path / "processed", read_trials(tmp_path / "processed"))
    return next(trial.position for trial in trials if trial.stiffness == stiffness)


# texts


@pytest.mark.parametrize(
    ("text", "names", "expected"),
    [
        ("t:ms", ["t"], ("t", "ms", None)),
        ("t", ["t"], ("t", "", None)),
        ("-x:mm", ["x"], ("x", "mm", -1)),
        ("-x", ["-x", "x"], ("-x", "", None)),
        ("Dev1/ai0:V", ["Dev1/ai0"], ("Dev1/ai0", "V", None)),
        ("Dev1:ai0:V", ["Dev1:ai0"], ("Dev1:ai0", "V", None)),
        ("F:N", ["F:N"], ("F:N", "", None)),
        ('"F:N":mN', ["F:N", "F"], ("F:N", "mN", None)),
        ('"F soll, u":N', ["F soll, u"], ("F soll, u", "N", None)),
        ('"say ""F""":N', ['say "F"'], ('say "F"', "N", None)),
        ("F soll:N", ["F soll"], ("F soll", "N", None)),
        ("arm.q[0]:rad", ["/arm.q[0]"], ("/arm.q[0]", "rad", None)),
        ("3:mm", ["1", "2", "3"], ("3", "mm", None)),
        ("Weg:µm", ["Weg"], ("Weg", "µm", None)),
    ],
)
def test_a_text_names_a_column_with_its_unit(text, names, expected):
    found = ColumnText.among("--position", text, names)
    assert (found.column, found.unit, found.sign) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("y:mm", "--position y:mm: no column 'y'.* Columns of the file: t, Force, x"),
        ("force:N", "no column 'force'. Nearest: Force"),
        ("x:milimetre", "unit 'milimetre' is unknown. Write a unit such as N, V, mm"),
    ],
)
def test_a_text_that_names_no_column_is_refused_with_those_that_there_are(text, message):
    with pytest.raises(UsageError, match=message):
        ColumnText.among("--position", text, ["t", "Force", "x"])


@pytest.mark.parametrize(
    ("text", "expected"),
    [("4 N", (4.0, "N")), ("0,5N/mm", (0.5, "N/mm")), ("7", (7.0, "")), ("K", None), ("2nd:N", None)],
)
def test_a_number_with_or_without_its_unit_is_a_constant(text, expected):
    found = ColumnText.constant(text)
    assert (found and (found.value, found.unit)) == expected


@pytest.mark.parametrize("profile", shipped_profiles(), ids=lambda profile: profile.name)
def test_a_profile_that_is_written_reads_back_as_the_same(profile, tmp_path):
    (tmp_path / "a.toml").write_text(profile_toml(profile, ["a remark"]), encoding="utf-8")
    again = read_profile(tmp_path / "a.toml")
    assert again == profile
    assert again.digest == profile.digest


# ingest


def test_columns_and_file_names_are_stored_in_si(call, logs, tmp_path):
    options = [*READ, "--command", '"F soll, u":N', "--step", "8 N"]
    status, out, err = call("ingest", "logs", *options, "--json")
    assert (status, json.loads(out)["ingested"], err) == (0, 4, "")
    rows = stored(call, tmp_path)
    walls = [(row["stiffness"], row["damping"], row["step"], row["sampling_period_s"]) for row in rows]
    assert walls == [(1e3 * k, b, 8.0, 0.001) for k, b in WALLS]
    assert {(row["device"], row["experiment"], row["motion"]) for row in rows} == {("bench", "1", "translation")}
    assert np.allclose(positions(tmp_path, 1500.0), wall_rows(1500.0, 5.0)[:, 2] * 1e-3, rtol=1e-12, atol=0)
    status, _, err = call("ingest", "logs", *options)
    assert status == 0
    assert "stiffness is 'K' in the names of the files" in err
    assert "the sampling period is 0.001 s" in err


def test_a_saved_profile_reads_the_same_logs_as_known(call, logs, tmp_path):
    options = [*READ, "--command", '"F soll, u":N', "--step", "8 N", "--save-profile", "lab.toml"]
    assert call("ingest", "logs", *options)[0] == 0
    status, out, _ = call("ingest", "logs", "--profile", "lab.toml", "--rehash", "--json")
    assert (status, json.loads(out)["skipped"]) == (0, 4)
    status, _, err = call("ingest", "logs", *options)
    assert (status, "lab.toml: already exists" in err) == (2, True)


def test_a_position_that_falls_under_force_is_turned_round_by_the_wall_law(call, tmp_path):
    write_logs(tmp_path / "logs", sign=-1)
    force = ("--command", '"F soll, u":N', "--step", "8 N")
    status, _, err = call("ingest", "logs", *READ, *force)
    assert status == 0
    assert "sign of the position is -1, because a positive command reduces the position in all 4 logs" in err
    assert positions(tmp_path, 1500.0)[-1] > 0
    explicit = [word.replace("s:mm", "-s:mm") for word in READ]
    call("ingest", "logs", *explicit, "--command", '"F soll, u":N', "--step", "8 N", "--processed", "other")
    assert (
        "sign" not in call("ingest", "logs", *explicit, "--command", '"F soll, u":N', "--step", "8 N", "--dry-run")[2]
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("K:N/mm", "K:N/m", r"follows stiffness 1500, the options state 1.5 .*--stiffness 'K:N/mm'"),
        ("s:mm", "s:m", r"--position 's:mm'"),
        ("s:mm", "+s:mm", None),
        ("B:Ns/m", "B:Ns/mm", r"follows damping 5"),
        ("8 N", "4 N", r"follows step 8, the options state 4"),
        ("8 N", "-8 N", r"follows step 8, the options state -8"),
        ('"F soll, u":N', '"F soll, u":mN', r"--command 'F soll, u:N'|--command '\"F soll, u\":N'"),
    ],
)
def test_a_wrong_unit_or_step_is_stopped_with_the_option_to_correct(call, logs, old, new, message, tmp_path):
    options = [new if word == old else word for word in [*READ, "--command", '"F soll, u":N', "--step", "8 N"]]
    status, _, err = call("ingest", "logs", *options)
    if message is None:
        assert status == 0
        return
    assert status == 1
    assert re.search(message, err)
    assert not (tmp_path / "processed").exists()


@pytest.mark.parametrize(
    ("change", "status", "message"),
    [
        ({"--command": None}, 2, "--command is missing. Name the column and its unit"),
        ({"--command": "u:N"}, 2, "no column 'u'"),
        ({"--command": '"F soll, u"'}, 2, "no unit is stated"),
        ({"--device": None}, 2, "--device is missing"),
        ({"--damping": None}, 2, "--damping missing: a wall needs --stiffness, --damping and --step"),
        ({"--stiffness": "S:N/mm"}, 2, "no column 'S'.*run K|no column 'S'"),
        ({"--gain": "2 N/V"}, 1, "--gain: the command is in N, which needs no gain"),
        ({"--command": '"F soll, u":V'}, 1, "--gain '<number> N/V'"),
        ({"--period": "1 mm"}, 1, "--period: unit 'mm' measures length; expected time"),
        ({"--profile": "native"}, 2, "cannot be combined with --profile"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_their_own_words(call, logs, change, status, message, tmp_path):
    options = dict(zip(READ[::2], READ[1::2], strict=True)) | {"--command": '"F soll, u":N', "--step": "8 N"} | change
    words = [word for name, value in options.items() if value is not None for word in (name, value)]
    found, out, err = call("ingest", "logs", *words)
    assert (found, out) == (status, "")
    assert re.search(message, err), err
    assert not (tmp_path / "processed").exists()


def test_logs_of_several_periods_are_not_read_as_one(call, logs):
    fast = (logs / "run K1_B3.csv").read_text().splitlines()
    slow = [fast[0], *(f"{2 * float(line.split(',')[0]):g},{line.partition(',')[2]}" for line in fast[1:])]
    (logs / "run K9_B9.csv").write_text("\n".join([*slow, ""]))
    status, _, err = call("ingest", "logs", *READ, "--command", '"F soll, u":N', "--step", "8 N")
    assert status == 2
    assert "different sampling periods: 0.001 s in run K1.5_B5.csv, 0.002 s in run K9_B9.csv" in err


# other commands, and drives


@pytest.mark.slow
def test_identify_takes_columns_of_a_drive_and_counts_per_volt(call, tmp_path):
    write_logs(tmp_path / "logs", force=1 / 2.3)
    options = ["--time", "t:ms", "--command", '"F soll, u":V', "--position", "s:mm"]
    status, out, _ = call("identify", "logs", *options, "--json")
    assert status == 0
    document = json.loads(out)
    assert document["motion"] == "translation in V"
    number = {row["name"]: row for row in document["parameters"]}
    assert number["mass"]["unit"] == "Vs^2/m"
    assert number["damping"]["unit"] == "Vs/m"
    per_volt = number["mass"]["value"]
    assert per_volt == pytest.approx(0.5 / 2.3, rel=5e-3)
    status, out, _ = call("identify", "logs", *options, "--gain", "2.3 N/V", "--json")
    number = {row["name"]: row for row in json.loads(out)["parameters"]}
    assert number["mass"]["unit"] == "kg"
    assert number["mass"]["value"] == pytest.approx(2.3 * per_volt, rel=1e-2)


@pytest.mark.slow
def test_a_drive_is_labelled_wherever_its_numbers_are_shown(call, tmp_path):
    write_logs(tmp_path / "logs", force=1 / 2.3)
    options = [word.replace("N/mm", "V/mm").replace("Ns/m", "Vs/m") for word in READ]
    # the names are in N/mm: by the law they are no V/mm
    status, _, err = call("ingest", "logs", *options, "--command", '"F soll, u":V', "--step", "3.478 V")
    assert status == 1
    assert "follows stiffness 652.2, the options state 1500" in err
    walls = [(k * 2.3, b * 2.3) for k, b in WALLS]
    write_logs(tmp_path / "volts", force=1 / 2.3, walls=walls)
    for name in sorted((tmp_path / "volts").iterdir()):
        k, b = (float(part[1:]) for part in name.stem.replace(",", ".").removeprefix("run ").split("_"))
        name.rename(name.with_name(f"K{k / 2.3:.6g}_B{b / 2.3:.6g}.csv"))
    status, _, err = call("ingest", "volts", *options, "--command", '"F soll, u":V', "--step", "3.4782609 V")
    assert status == 0, err
    trials = read_trials(tmp_path / "processed")
    assert set(trials.column("motion").to_pylist()) == {"translation in V"}
    (file,) = (tmp_path / "processed" / "trials").rglob("*.parquet")
    schema = pq.read_schema(file)
    units = {name: schema.field(name).metadata[b"unit"].decode() for name in ("stiffness", "command", "force")}
    assert units == {"stiffness": "V/m", "command": "V", "force": "N"}
    status, out, _ = call("compare", "--device", "bench")
    assert status == 0
    assert "V/m" in out
    assert "N/m" not in out
    page = (tmp_path / "reports" / "bench.html").read_text(encoding="utf-8")
    assert "Vs²/m" in page
    assert "Ns/m" not in page


def test_the_time_between_rows_takes_the_place_of_stamps(call, tmp_path):
    folder = write_logs(tmp_path / "logs", heading="n,u,s")
    status, out, _ = call(
        "look", folder / "run K1_B3.csv", "--time", "0.5 ms", "--command", "u:N", "--position", "s:mm"
    )
    assert status == 0
    assert "in SI" in out
    status, out, _ = call("identify", "logs", "--time", "0.5 ms", "--command", "u:N", "--position", "s:mm", "--json")
    assert json.loads(out)["sampling_period_s"] == 0.0005


def test_a_mat_file_with_three_variables_needs_three_words(call, tmp_path):
    from scipy.io import savemat

    t, u, x = wall_rows(1000.0, 3.0).T
    savemat(tmp_path / "run.mat", {"t": t, "u": u / 2.3, "x": x})
    status, out, err = call("identify", "run.mat", "--time", "t", "--command", "u:V", "--position", "x:mm", "--json")
    assert status == 0, err
    assert json.loads(out)["motion"] == "translation in V"


def test_push_sends_the_profile_that_the_options_make(logs, monkeypatch, call):
    from pipeline.service import push

    sent = {}
    monkeypatch.setattr(push, "push", lambda folder, to, profile, token, advance: sent.update(profile=profile) or EMPTY)
    options = [*READ, "--command", '"F soll, u":N', "--step", "8 N", "--to", "http://127.0.0.1:1"]
    assert call("push", "logs", *options)[0] == 0
    assert sent["profile"].columns.command.name == "F soll, u"


EMPTY = {"found": 0, "ingested": 0, "skipped": 0, "quarantined": [], "warnings": [], "changed": [], "damaged": []}
