"""Shares of long work: parts within parts, searches of unknown length, and who listens."""

import pytest

from pipeline.base.progress import Names, approach, heard_by, part_of_work, report


@pytest.fixture
def heard():
    told = []
    with heard_by(lambda name, share: told.append((name, round(share, 6)))):
        yield told


def test_a_part_covers_a_range_of_the_part_around_it(heard):
    with part_of_work("fit", 0.2, 0.8):
        with part_of_work("", 0.0, 0.5):
            report(0.5)
        report(0.75)
    assert heard == [("fit", 0.2), ("fit", 0.2), ("fit", 0.35), ("fit", 0.65)]


def test_a_search_of_unknown_length_goes_on_from_what_is_done(heard):
    with part_of_work("search", 0.0, 1.0):
        report(0.5)
        approach(0.5)
        with part_of_work("", 0.75, 0.9):
            pass
        approach(0.5)
    assert [share for _, share in heard] == [0.0, 0.5, 0.75, 0.75, 0.95]


def test_shares_stay_between_none_and_all(heard):
    report(-1.0)
    report(7.0)
    assert [share for _, share in heard] == [0.0, 1.0]


def test_nothing_happens_where_nobody_listens():
    with part_of_work("fit", 0.0, 1.0):
        report(0.5)
        approach(0.5)
    told = []
    with heard_by(lambda name, share: told.append(share)):
        approach(0.5)
    assert told == [0.5]  # what was reported before counts for nobody


def test_a_name_is_handed_on_once():
    told = []
    with heard_by(Names(told.append)):
        with part_of_work("read", 0.0, 0.5):
            report(0.5)
        with part_of_work("write", 0.5, 1.0):
            report(0.5)
    assert told == ["read", "write"]


def test_an_error_leaves_the_part_around():
    told = []
    with heard_by(lambda name, share: told.append(share)):
        with pytest.raises(ZeroDivisionError), part_of_work("", 0.0, 0.5):
            raise ZeroDivisionError
        report(0.9)
    assert told == [0.0, 0.9]


def test_a_fit_reports_forwards_and_ends_near_the_whole(tmp_path):
    from native_logs import log_text

    from pipeline.surface.identify import identify

    paths = [tmp_path / f"{k}.csv" for k in (200, 300)]
    for path in paths:
        path.write_text(log_text(float(path.stem), rows=300))
    told = []
    with heard_by(lambda name, share: told.append((name, share))):
        identify(paths)
    shares = [share for _, share in told]
    assert {name for name, _ in told} == {"fit"}
    assert len(told) > 20
    assert 0.05 <= shares[0] <= 0.2
    assert shares[-1] > 0.85
