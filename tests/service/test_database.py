"""Who is known to the service, and for how long: tokens, sessions; bodies that grow beyond what they said."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from pipeline.service.database import Database


@pytest.fixture
def later(monkeypatch):
    """A clock that a test sets forward [h]."""
    now, start = [0.0], time.time()
    monkeypatch.setattr("pipeline.service.database.time", SimpleNamespace(time=lambda: start + 3600.0 * now[0]))
    return now


def test_a_session_ends_after_twelve_hours_and_is_forgotten_with_the_next(tmp_path, later):
    known = Database(tmp_path)
    token = known.create_token("viewer", "Ada")
    session = known.login(token)
    for hours, holder in ((0.0, ("viewer", "Ada")), (11.9, ("viewer", "Ada")), (12.1, None)):
        later[0] = hours
        assert known.holder_of_session(session) == holder
    known.login(token)
    assert len(known.run("SELECT 1 FROM sessions")) == 1


def test_a_token_ends_with_its_days_and_its_sessions_with_it(tmp_path, later):
    known = Database(tmp_path)
    token, lasting = known.create_token("contributor", "Ada", days=0.25), known.create_token("viewer", "Bob")
    session = known.login(token)
    later[0] = 5.9
    assert known.holder_of(token) == known.holder_of_session(session) == ("contributor", "Ada")
    later[0] = 6.1
    assert known.holder_of(token) is known.holder_of_session(session) is known.login(token) is None
    later[0] = 1e5
    assert known.holder_of(lasting) == ("viewer", "Bob")
