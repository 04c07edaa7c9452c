"""A trial that is excluded by hand is kept, enters no number, and is named wherever numbers are shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from labs import Lab, compare, make_lab
from native_logs import log_text
from stored import merge_all
from typer.testing import CliRunner

import pipeline
from pipeline.base import disk
from pipeline.base.errors import EXIT_USAGE, DeviceError, StoreError, UsageError
from pipeline.comparison.against import against_document, against_experiments, read_document
from pipeline.device_data.devices import load_device
from pipeline.intake.check import check
from pipeline.intake.ingest import ingest
from pipeline.measured.stages.stage_tables import ExperimentStages
from pipeline.rendering.report.report_against import render
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell.cli import application
from pipeline.shell.verify import verify
from pipeline.store.corrections import delete, empty_bin, exclude, in_bin, move, restore, use_again
from pipeline.store.storage import read_exclusions, read_trials

pytestmark = pytest.mark.usefixtures("one_process")

WHY = "gripper slipped"
CRITERIA = ("settle_2pct", "overshoot")


@pytest.fixture
def store(tmp_path) -> Path:
    """Four trials of two experiments: 0 and 2 of "9", 1 and 3 of "10"."""
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(4):
        (logs / f"{number}.csv").write_text(log_text(float(number), experiment=f"{9 + number % 2}"))
    ingest([logs], tmp_path / "processed", jobs=1)
    return tmp_path / "processed"


def ids(processed: Path) -> dict[str, str]:
    """Id of each trial by the name of its log."""
    columns = (read_trials(processed).column(name).to_pylist() for name in ("source_path", "trial_id"))
    return {Path(path).name: trial for path, trial in zip(*columns, strict=True)}


def run(*words: str):
    """The command line, as it is typed; messages do not matter here."""
    return CliRunner().invoke(application(words[0]), list(words))


def used(processed: Path, experiment: str) -> list[str]:
    return sorted(ExperimentStages.stored(processed, "bench", experiment).trials.column("trial_id").to_pylist())


def excluded(processed: Path) -> list[str]:
    return [one.trial_id for one in read_exclusions(processed).values()]


@pytest.mark.parametrize("way", ["id", "prefix", "path"])
def test_a_trial_is_kept_and_not_used(store, way):
    trial = ids(store)["2.csv"]
    words = {"id": trial, "prefix": trial[:9], "path": str(store.parent / "logs" / "2.csv")}[way]
    (found,) = exclude(store, words, "  gripper\n slipped ")
    assert (found.trial_id, found.exclusion_reason, found.experiment) == (trial, WHY, "9")
    assert read_trials(store).num_rows == 4
    table = pipeline.trials(store)
    assert table.loc[table["exclusion_reason"] == WHY, "trial_id"].tolist() == [trial]
    assert used(store, "9") == [ids(store)["0.csv"]]
    assert len(used(store, "10")) == 2
    assert [one.trial_id for one in use_again(store, words)] == [trial]
    assert len(used(store, "9")) == 2
    assert read_exclusions(store) == {}


def test_it_stays_excluded_through_all_that_rewrites_the_store(store):
    """Ingest of everything again, of a renamed log, merges and repair."""
    trial = ids(store)["2.csv"]
    exclude(store, trial, WHY)
    logs = store.parent / "logs"
    ingest([logs], store, jobs=1, rehash=True)
    (logs / "4.csv").write_text(log_text(4.0, experiment="9"))
    (logs / "2.csv").rename(logs / "renamed.csv")
    ingest([logs], store, jobs=1)
    merge_all(store)
    file = next((store / "trials" / "bench" / "9").glob("*.parquet"))
    data = bytearray(file.read_bytes())
    data[20] ^= 0xFF
    file.write_bytes(data)
    (damage,) = check(store, repair=True).damage
    assert [Path(one["source_path"]).name for one in damage.lost] == ["2.csv"], "its log bears another name"
    ingest([logs], store, jobs=1)
    assert excluded(store) == [trial]
    stages = ExperimentStages.stored(store, "bench", "9")
    assert (stages.trials.num_rows, [one.trial_id for one in stages.excluded]) == (2, [trial])


def test_a_log_with_other_content_is_another_trial(store):
    log = store.parent / "logs" / "2.csv"
    exclude(store, ids(store)["2.csv"], WHY)
    log.write_text(log_text(2.0, experiment="9", rows=31))
    ingest([log.parent], store, jobs=1)
    assert len(used(store, "9")) == 2
    (one,) = read_exclusions(store).values()
    assert one.exclusion_reason == WHY
    use_again(store, one.trial_id)
    assert read_exclusions(store) == {}


def test_unknown_and_ambiguous_words(store):
    trial = ids(store)["2.csv"]
    wrong = trial[:-1] + ("0" if trial[-1] != "0" else "1")
    with pytest.raises(UsageError, match=r"not found\. No id.*4 trials are stored"):
        exclude(store, wrong, WHY)
    with pytest.raises(UsageError, match=r"22\.csv: not found\. No id.*stored trials"):
        exclude(store, str(store.parent / "logs" / "22.csv"), WHY)
    with pytest.raises(UsageError, match=r"not found\. No id.*excluded trials"):
        use_again(store, trial)
    with pytest.raises(UsageError, match=r"not found\. No id.*stored trials"):
        exclude(store, "", WHY)
    with pytest.raises(UsageError, match="--reason"):
        exclude(store, trial, " \n ")
    several = next(one for one in "0123456789abcdef" if sum(t.startswith(one) for t in ids(store).values()) != 1)
    if any(t.startswith(several) for t in ids(store).values()):
        with pytest.raises(UsageError, match=r"matches \d stored trials.*Give one id"):
            exclude(store, several, WHY)
    assert read_exclusions(store) == {}


def test_a_log_of_several_trials_is_no_name_of_one(tmp_path):
    profile = tmp_path / "lab.toml"
    profile.write_text(LONG_FORM)
    rows = [f"{name},{k * 0.001},{float(k > 3)},{k * k * 1e-6}" for name in ("a", "b") for k in range(30)]
    (tmp_path / "both.csv").write_text("\n".join(["trial,t,u,x", *rows]) + "\n")
    assert ingest([tmp_path / "both.csv"], tmp_path / "processed", profile=profile).ingested == 1
    with pytest.raises(UsageError, match=r"matches 2 stored trials: .*\(both.csv, a\).*\(both.csv, b\)"):
        exclude(tmp_path / "processed", str(tmp_path / "both.csv"), WHY)
    trials = read_trials(tmp_path / "processed")
    labels = dict(zip(*(trials.column(name).to_pylist() for name in ("label", "trial_id")), strict=True))
    exclude(tmp_path / "processed", labels["a"], WHY)
    assert used(tmp_path / "processed", "1") == [labels["b"]]


LONG_FORM = """
name = "lab"
format = "delimited"
files = ["*.csv"]
delimiter = ","
decimal = "."
header = true
step_at = "command edge"
trial_column = "trial"
columns.time = {name = "t", unit = "s"}
columns.command = {name = "u", unit = "N", sign = 1}
columns.position = {name = "x", unit = "m", sign = 1}
constants = {device = "bench", experiment = "1", stiffness = 0.0, damping = 0.0, step = 1.0, sampling_period_s = 0.001}
"""


def test_what_is_deleted_doubles_no_other_trial(store):
    trials = read_trials(store)
    device, experiment, trial = (trials.column(name)[0].as_py() for name in ("device", "experiment", "trial_id"))
    before = set(read_trials(store, device, experiment).column("trial_id").to_pylist())
    delete(store, trial)
    for place in ((device, experiment), (device,), ()):
        found = read_trials(store, *place).column("trial_id").to_pylist()
        assert (len(found), before - set(found)) == (len(set(found)), {trial})


def test_one_writer_at_a_time(store):
    with disk.writing(store), pytest.raises(StoreError, match="is writing there"):
        exclude(store, ids(store)["2.csv"], WHY, wait_s=0)
    assert read_exclusions(store) == {}


def test_a_damaged_file_is_set_aside_and_never_ignored(store):
    """What is excluded is not known then: nothing is computed as if nothing were."""
    exclude(store, ids(store)["2.csv"], WHY)
    (file,) = (store / "corrections").iterdir()
    whole, known = file.read_bytes(), read_exclusions(store)
    for at in range(0, len(whole), max(len(whole) // 40, 1)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 0x5A]) + whole[at + 1 :])
        with pytest.raises(StoreError, match="pipeline check --repair"):
            ExperimentStages.stored(store, "bench", "9")
    (found,) = check(store, repair=True).damage
    assert (found.remedy, file.exists()) == ("set aside", False)
    (kept,) = (store / "damaged").rglob("*.damaged")
    assert kept.name == f"{file.name}.damaged"
    assert read_exclusions(store) == {}
    exclude(store, ids(store)["2.csv"], WHY)
    assert set(read_exclusions(store)) == set(known)


def test_the_command(store):
    trial = ids(store)["2.csv"]
    where = ("--processed", str(store))
    done = run("exclude", trial[:8], "--reason", WHY, *where, "--json")
    assert json.loads(done.stdout)["excluded"] is True
    assert [one["trial_id"] for one in json.loads(done.stdout)["trials"]] == [trial]
    told = run("status", *where).stdout
    assert trial in told
    assert WHY in told
    assert json.loads(run("status", *where, "--json").stdout)["excluded"][0]["exclusion_reason"] == WHY
    assert run("exclude", trial, *where).exception.exit_status == EXIT_USAGE
    assert run("exclude", trial, "--reason", "a", "--undo", *where).exception.exit_status == EXIT_USAGE
    assert "used again" in run("exclude", trial, "--undo", *where).stdout
    assert run("exclude", trial, "--undo", *where).exception.exit_status == EXIT_USAGE


def places(processed: Path) -> set[tuple[str, str, int]]:
    columns = (read_trials(processed).column(name).to_pylist() for name in ("device", "experiment", "stiffness"))
    return {(device, experiment, int(k)) for device, experiment, k in zip(*columns, strict=True)}


BEFORE = {("bench", "9", 0), ("bench", "9", 2), ("bench", "10", 1), ("bench", "10", 3)}


@pytest.mark.parametrize(
    ("wanted", "to", "after"),
    [
        ("bench", "a/b", None),
        ("bench", "rig", {("rig", e, k) for _, e, k in BEFORE}),
        ("bench/9", "bench/10", {("bench", "10", k) for _, _, k in BEFORE}),
        ("bench/9", "new%2Frig/1", {("new/rig", "1", 0), ("new/rig", "1", 2), ("bench", "10", 1), ("bench", "10", 3)}),
        ("2.csv", "bench/10", {("bench", "9", 0), *(("bench", "10", k) for k in (1, 2, 3))}),
    ],
)
def test_what_is_moved_stays_there_and_can_be_moved_back(store, wanted, to, after):
    wanted = str(store.parent / "logs" / wanted) if wanted.endswith("csv") else wanted
    after = after or {("a", "b", k) for _, _, k in BEFORE}
    count = move(store, wanted, to)
    assert count == len(after - BEFORE)
    assert places(store) == after
    ingest([store.parent / "logs"], store, jobs=1, rehash=True)
    merge_all(store)
    assert places(store) == after
    for name, trial in ids(store).items():
        move(store, trial, "bench/10" if name in ("1.csv", "3.csv") else "bench/9")
    assert places(store) == BEFORE


def test_loops_that_differ_are_not_moved_together(store, tmp_path):
    slow = log_text(9.0, experiment="slow").replace("period_s: 0.001", "period_s: 0.002")
    (tmp_path / "logs" / "slow.csv").write_text(slow.replace("motion: translation", "motion: rotation"))
    ingest([tmp_path / "logs"], store, jobs=1)
    for wanted, to in (("bench/slow", "bench/9"), ("bench", "bench/9"), ("bench/9", ""), ("bench/9", "a/b/c")):
        with pytest.raises(UsageError):
            move(store, wanted, to)
    assert ("bench", "slow", 9) in places(store)


def test_what_is_deleted_lies_in_a_bin_until_that_is_emptied(store):
    logs = store.parent / "logs"
    assert delete(store, "bench/9") == 2
    assert places(store) == {one for one in BEFORE if one[1] == "10"}
    assert ingest([logs], store, jobs=1, rehash=True).skipped == 4
    assert [one.experiment for one in in_bin(store)] == ["9", "9"]
    assert restore(store, "bench/9") == 2
    assert places(store) == BEFORE
    trial = ids(store)["2.csv"]
    delete(store, trial)
    assert empty_bin(store) == 1
    assert in_bin(store) == []
    assert check(store).damage == ()
    again = ingest([logs], store, jobs=1)
    assert again.ingested == 1
    assert "deleted manually" in again.warnings[0].warning
    assert [one.trial_id for one in in_bin(store)] == [trial]
    assert ("bench", "9", 2) not in places(store)
    assert empty_bin(store) == 1
    assert restore(store, trial) == 1
    ingest([logs], store, jobs=1)
    assert places(store) == BEFORE


def test_the_commands_that_move_and_delete(store):
    where = ("--processed", str(store))
    assert "trials now bench/11: 2" in run("move", "bench/9", "bench/11", *where).stdout
    assert json.loads(run("delete", "bench/11", *where, "--json").stdout) == {"trials": 2}
    assert len(json.loads(run("delete", *where, "--json").stdout)["bin"]) == 2
    assert "trials restored: 2" in run("delete", "bench/11", "--undo", *where).stdout
    run("delete", "bench/11", *where)
    assert "trials removed from the store: 2" in run("delete", "--empty", *where).stdout
    for words in (("delete", "--undo"), ("delete", "bench", "--empty"), ("delete", "bench/11"), ("move", "x", "y")):
        assert run(*words, *where).exception.exit_status == EXIT_USAGE


@pytest.fixture(scope="module")
def course(tmp_path_factory) -> Lab:
    """Two small experiments of one device."""
    device = load_device("falcon")
    return make_lab(tmp_path_factory.mktemp("course"), device, ("1", "2"), ideal=True, coarsen=8)


@pytest.fixture
def lab(course, tmp_path) -> Lab:
    shutil.copytree(course.processed, tmp_path / "processed")
    return Lab(course.device, course.courses, course.raw, tmp_path / "processed")


@pytest.mark.slow
def test_the_best_trial_is_excluded_and_every_number_follows(lab, tmp_path):
    page = tmp_path / "falcon.html"

    def compared():
        result = lab.compare(criteria=CRITERIA, report=page, experiments=["1"]).result
        return result, result.experiments[0], take_apart(page.read_text(encoding="utf-8")).cells

    before, first, _ = compared()
    shutil.copy(page.with_suffix(".json"), tmp_path / "before.json")
    best = str(first.optimum["settle_2pct"].trial_id)
    exclude(lab.processed, best, WHY)
    after, second, shown = compared()
    assert second.trials == first.trials - 1
    assert sum(second.verdicts.values()) == second.trials
    assert second.optimum["settle_2pct"].trial_id != best
    assert second.optimum["settle_2pct"].cost >= first.optimum["settle_2pct"].cost
    assert [(one.experiment, one.trial_id, one.reason) for one in after.excluded] == [("1", best, WHY)]
    assert {shown[f"excluded/{best}/{name}"] for name in ("trial_id", "reason")} == {best, WHY}
    assert any("1 trial of " in line and "excluded by hand" in line for line in after.warnings)
    assert not any("excluded" in line for line in before.warnings)
    assert f"{best}" not in json.dumps(after.model_dump(mode="json")["tables"])
    # the page about both versions names what the second leaves out
    assert WHY in render(against_document(after, read_document(tmp_path / "before.json", "falcon")))
    other = against_experiments(lab.processed, ("falcon", "1"), ("falcon", "2"), criteria=CRITERIA)
    assert WHY in render(other)
    use_again(lab.processed, best)
    assert compared()[0].numbers() == before.numbers()


def test_an_experiment_without_a_used_trial_is_left_out_and_named(store):
    for name in ("0.csv", "2.csv"):
        exclude(store, ids(store)[name], WHY)
    with pytest.raises(DeviceError, match=r"experiment '9': all of its trials are excluded"):
        compare("bench", store, experiments=["9"])
    result = compare("bench", store, criteria=("overshoot",)).result
    assert [e.experiment for e in result.experiments] == ["10"]
    assert sorted(one.trial_id for one in result.excluded) == sorted(ids(store)[n] for n in ("0.csv", "2.csv"))


@pytest.mark.slow
def test_verify_covers_exclusions(lab, tmp_path):
    page = tmp_path / "falcon.html"
    columns = ("trial_id", "source_path")
    trials = list(zip(*(read_trials(lab.processed, "falcon", "1").column(c).to_pylist() for c in columns), strict=True))
    (one, _), (two, path) = trials[0], trials[1]
    exclude(lab.processed, one, WHY)
    lab.compare(criteria=CRITERIA, report=page, experiments=["1"])
    found = verify(page, lab.processed)
    assert found.equal, found
    text = page.read_text(encoding="utf-8")
    assert text.count(WHY) >= 2
    exclude(lab.processed, two, "later")
    found = verify(page, lab.processed)
    assert not found.equal
    assert [(p.path, p.expected, p.found) for p in found.logs] == [(path, "no exclusion", "later")]
    assert found.differences == ()
    use_again(lab.processed, two)
    # the words of the table changed by hand, then those of the request with them
    forged = text.replace(f">{WHY}<", ">nothing to see<")
    assert forged != text
    page.write_text(forged, encoding="utf-8")
    assert any("excluded" in d.name for d in verify(page, lab.processed).differences)
    page.write_text(text.replace(WHY, "nothing to see"), encoding="utf-8")
    found = verify(page, lab.processed)
    assert [(p.expected, p.found) for p in found.logs] == [("nothing to see", WHY)]
    page.write_text(text, encoding="utf-8")
    use_again(lab.processed, one)
    assert [(p.expected, p.found) for p in verify(page, lab.processed).logs] == [(WHY, "no exclusion")]
