"""Which files came to rest, and how long to wait: by hand-made states and clocks, and by real files."""

import os

import pytest
from native_logs import short_log

from pipeline.intake.ingest import ingest
from pipeline.intake.sources import find_sources
from pipeline.profiles.profile_files import shipped_profiles
from pipeline.shell.watch.watch_files import LONGEST_WAIT, LOOK_SHARE, SHORTEST_WAIT_S, Arrivals, look_at, wait_after

A, B = (10, 1, 1), (20, 2, 2)


def test_a_file_is_ready_when_it_was_the_same_for_the_time_asked_for():
    arrivals = Arrivals(settle_s=2.0)
    assert arrivals.update({"a": A}, 100.0)
    assert not arrivals.ready(101.9)
    assert arrivals.restless(101.9) == {"a": 102.0}
    assert not arrivals.update({"a": A}, 102.0)
    assert arrivals.ready(102.0)
    assert arrivals.restless(102.0) == {}
    arrivals.take(102.0)
    assert not arrivals.ready(200.0)


def test_a_file_that_grows_is_not_ready_and_keeps_no_other_from_being_so():
    arrivals = Arrivals(settle_s=2.0)
    for second in range(10):
        arrivals.update({"grows": (second, second, second), "rests": A}, float(second))
        assert arrivals.ready(float(second)) == (second >= 2)
        assert "grows" in arrivals.restless(float(second))
    arrivals.take(9.0)
    assert not arrivals.ready(9.0)
    arrivals.update({"grows": (9, 9, 9), "rests": A}, 11.0)
    assert arrivals.ready(11.0)


@pytest.mark.parametrize("changed", [(11, 1, 1), (10, 2, 1), (10, 1, 2)], ids=["size", "content", "permissions"])
def test_each_change_makes_a_file_new(changed):
    arrivals = Arrivals(settle_s=0.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.take(0.0)
    assert arrivals.update({"a": changed}, 1.0)
    assert arrivals.ready(1.0)


def test_a_change_while_a_pass_runs_is_seen_to_by_the_next():
    arrivals = Arrivals(settle_s=1.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.update({"a": A}, 1.0)
    arrivals.take(1.0)
    arrivals.update({"a": B}, 40.0)
    assert not arrivals.ready(40.5)
    arrivals.update({"a": B}, 41.0)
    assert arrivals.ready(41.0)


def test_what_is_not_at_rest_is_not_taken():
    arrivals = Arrivals(settle_s=1.0)
    arrivals.update({"a": A}, 0.0)
    arrivals.take(0.5)
    assert arrivals.ready(1.0)


def test_waits_stay_within_their_bounds():
    for look_s in (0.0, 0.005, 0.02, 1.0):
        for quiet_s in (0.0, 30.0, 1e6):
            for until_s in (None, -1.0, 0.0, 0.7, 1e6):
                wait = wait_after(look_s, 2.0, quiet_s, until_s)
                # looking takes at most half a percent, whatever else is asked for
                assert look_s <= wait / LOOK_SHARE * (1 + 1e-12)
                assert wait >= SHORTEST_WAIT_S
                if look_s <= 0.01:
                    assert wait <= 2.0 * LONGEST_WAIT
    assert wait_after(0.001, 2.0, 1e6, 0.7) == 0.7


def test_a_look_sees_the_files_that_an_ingest_would_find(tmp_path):
    logs = tmp_path / "logs"
    processed = logs / "processed"
    elsewhere = tmp_path / "elsewhere"
    for folder in (logs, logs / "deep" / "deeper", logs / ".hidden", processed, elsewhere):
        folder.mkdir(parents=True)
    for number, folder in enumerate((logs, logs / "deep" / "deeper", logs / ".hidden", processed, elsewhere)):
        (folder / f"{number}.csv").write_text(short_log(float(number)))
    (logs / ".partial.csv").write_text("x")
    (logs / "linked.csv").symlink_to(elsewhere / "4.csv")
    (logs / "inside.csv").symlink_to("0.csv")
    (logs / "dangling").symlink_to(elsewhere / "none.csv")
    (logs / "linked-folder").symlink_to(elsewhere)
    look = look_at([logs], exclude=[processed])
    sources = find_sources([logs], shipped_profiles(), processed)
    found = {source.key for source in sources if source.problem is None}
    assert len(found) == 3
    # a link that leads out is seen, and refused
    assert found == {path for path in look.states if path.endswith(".csv")} - {str(logs / "linked.csv")}
    assert look.troubles == {}
    for path, (size, mtime_ns, _) in look.states.items():
        status = os.stat(path)
        assert (status.st_size, status.st_mtime_ns) == (size, mtime_ns)


def test_single_files_and_what_is_not_there(tmp_path):
    (tmp_path / "scene.toml").write_text("x")
    look = look_at([tmp_path / "gone"], [tmp_path / "scene.toml", tmp_path / "none.toml"])
    assert list(look.states) == [str(tmp_path / "scene.toml")]
    assert list(look.troubles) == [str(tmp_path / "gone")]


def test_an_ingest_leaves_alone_what_somebody_saw_grow(tmp_path):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text(short_log(float(ord(name[0]))))
        os.utime(tmp_path / name, (1e9, 1e9))  # a copy that brought its time along
    growing = str(tmp_path / "b.csv")
    report = ingest([tmp_path], tmp_path / "processed", growing=[growing], settle_s=5)
    assert (report.found, report.ingested, report.waiting) == (1, 1, (growing,))
    report = ingest([tmp_path], tmp_path / "processed", settle_s=5)
    assert (report.found, report.ingested, report.skipped, report.waiting) == (2, 1, 1, ())
