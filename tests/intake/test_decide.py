"""Each rule by which an ingest decides on a source, as a table of what is known and what becomes of it."""

from dataclasses import replace as changed
from pathlib import Path

import pytest

from pipeline.base.errors import LogError
from pipeline.intake.decide import Evidence, Twin, decide, decide_unread
from pipeline.intake.quarantine import QuarantineRecord
from pipeline.intake.sources import Source
from pipeline.intake.stored_sources import StoredSource
from pipeline.profiles.profile_files import shipped_profiles

NATIVE = next(profile for profile in shipped_profiles() if profile.name == "native")
NAMED = NATIVE.model_copy(update={"name": "native", "name_pattern": "K(?P<stiffness>[0-9]+)"})


def source(profile=NATIVE) -> Source:
    path = Path("/logs/K1.csv")
    return Source(path, str(path), (path,), 100, 5, profile)


def stored(of: Source, sha256: str = "a", devices: tuple[str, ...] = ("bench",), **more) -> StoredSource:
    assert of.profile_sha256 is not None
    base = StoredSource(sha256, of.profile_sha256, "native", of.size, of.mtime_ns, devices, ("trial",))
    return base._replace(**more)


def twin(of: Source, exists: bool = True, **more) -> Twin:
    return Twin("/logs/K2.csv", stored(of, **more), exists)


SEEN, NAMES = source(), source(profile=NAMED)
BENCH = ("bench",)

TABLE = [
    # evidence, rule, paths whose trials are dropped
    (Evidence(SEEN, "a", BENCH), "new", []),
    (Evidence(SEEN, "a", None, stored(SEEN)), "unchanged", []),
    (Evidence(SEEN, "a", None, None, twin(SEEN)), "copy", []),
    (Evidence(SEEN, "a", BENCH, None, twin(SEEN)), "copy", []),
    (Evidence(NAMES, "a", BENCH, None, twin(NAMES)), "renamed copy", []),
    (Evidence(SEEN, "a", None, stored(SEEN, "b"), twin(SEEN)), "copy", ["/logs/K1.csv"]),
    (Evidence(SEEN, "a", BENCH, None, twin(SEEN, profile_sha256="older")), "copy", []),
    (Evidence(SEEN, "a", BENCH, None, twin(SEEN, profile_sha256="older", exists=False)), "new", ["/logs/K2.csv"]),
    (Evidence(NAMES, "a", BENCH, None, None, ("/logs/K3.csv", stored(NAMES))), "renamed", ["/logs/K3.csv"]),
    (Evidence(SEEN, "a", BENCH, stored(SEEN, "b", mtime_ns=4)), "changed", ["/logs/K1.csv"]),
    (Evidence(SEEN, "a", BENCH, stored(SEEN, "a", profile_sha256="older")), "profile changed", ["/logs/K1.csv"]),
    (Evidence(SEEN, "a", BENCH, stored(SEEN, "a", whole=False)), "completed", []),
]


@pytest.mark.parametrize(("evidence", "rule", "dropped"), TABLE, ids=[f"{i}-{row[1]}" for i, row in enumerate(TABLE)])
def test_each_rule_decides_on_its_evidence(evidence: Evidence, rule: str, dropped: list[str]) -> None:
    decision = decide(evidence, replace=False)
    assert (decision.rule, [drop.path for drop in decision.drops]) == (rule, dropped)
    assert decision.stores == (rule not in ("unchanged", "copy", "renamed copy"))
    assert (decision.warning is not None) == (rule == "renamed copy")


@pytest.mark.parametrize("mtime_ns", [4, 5, 6])
def test_only_contents_older_than_the_file_are_dropped_late(mtime_ns: int) -> None:
    """A reader between both steps takes the newer content, and must find one of them."""
    decision = decide(Evidence(SEEN, "a", BENCH, stored(SEEN, "b", mtime_ns=mtime_ns)), replace=False)
    assert [drop.late for drop in decision.drops] == [mtime_ns < SEEN.mtime_ns]


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"devices": ("lwr",)}, "device 'lwr' by profile 'native'"),
        ({"profile": "lab"}, "device 'bench' by profile 'lab'"),
    ],
)
def test_trials_of_a_rival_are_replaced_only_on_request(other: dict[str, object], words: str) -> None:
    for evidence in (
        Evidence(SEEN, "a", BENCH, stored(SEEN, profile_sha256="other")._replace(**other)),
        Evidence(
            SEEN, "a", BENCH, None, Twin("/logs/K2.csv", stored(SEEN, profile_sha256="other")._replace(**other), True)
        ),
    ):
        with pytest.raises(LogError, match="now claims it for device 'bench'") as error:
            decide(evidence, replace=False)
        assert words in error.value.reason
        assert error.value.code == "profile-wrong"
        (drop,) = decide(evidence, replace=True).drops
        assert drop.outcome == f"1 trial of {words} was replaced"


@pytest.mark.parametrize(
    ("seen", "kept", "refused", "replace", "rule"),
    [
        (SEEN, stored(SEEN), False, False, "unchanged"),
        (changed(SEEN, mtime_ns=6), stored(SEEN), False, False, None),
        (changed(SEEN, size=101), stored(SEEN), False, False, None),
        (SEEN, stored(SEEN, profile_sha256="older"), False, False, None),
        (SEEN, stored(SEEN, whole=False), False, False, None),
        (SEEN, None, False, False, None),
        (SEEN, None, True, False, "refused before"),
        (SEEN, None, True, True, None),
        (changed(SEEN, mtime_ns=6), None, True, False, None),
        (SEEN, stored(SEEN), True, False, "refused before"),
    ],
)
def test_size_time_and_profile_decide_without_reading(seen, kept, refused, replace, rule) -> None:
    record = QuarantineRecord(
        path=SEEN.key,
        size=SEEN.size,
        mtime_ns=SEEN.mtime_ns,
        sha256="a",
        row=None,
        reason="why",
        code="damaged",
        profile="native",
        profile_sha256=SEEN.profile_sha256,
    )
    decision = decide_unread(seen, kept, record if refused else None, replace=replace)
    assert (None if decision is None else decision.rule) == rule


def test_a_source_that_could_not_be_read_is_tried_again() -> None:
    record = QuarantineRecord(
        path=SEEN.key,
        size=SEEN.size,
        mtime_ns=SEEN.mtime_ns,
        sha256=None,
        row=None,
        reason="unreadable",
        code="unreadable",
        profile="native",
        profile_sha256=SEEN.profile_sha256,
    )
    assert decide_unread(SEEN, None, record, replace=False) is None
    assert decide_unread(SEEN, None, record.model_copy(update={"sha256": "a"}), replace=False) is not None
