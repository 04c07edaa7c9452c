"""Who asks too often waits as long as he is told, and nobody else does."""

import pytest
from served import serving

from pipeline.service.database import Database
from pipeline.service.security import BURST_S, MOST_KNOWN, Rates
from pipeline.service.settings import Settings


def test_a_sender_gets_what_the_rate_allows():
    """Against a count: asking as fast as told, N seconds give the burst and N times the rate."""
    now = [0.0]
    rates = Rates(120, lambda: now[0])
    taken = 0
    while now[0] < 300.0:
        wait_s = rates.wait_s("one")
        taken += wait_s == 0.0
        now[0] += wait_s
    assert taken == pytest.approx(2.0 * (BURST_S + 300.0), abs=2)


def test_no_limit():
    rates = Rates(0)
    assert {rates.wait_s("one") for _ in range(10_000)} == {0.0}


def test_senders_who_may_ask_freely_are_forgotten():
    now = [0.0]
    rates = Rates(60, lambda: now[0])
    while not rates.wait_s("busy"):
        pass
    for number in range(2 * MOST_KNOWN):
        now[0] += BURST_S / MOST_KNOWN / 4
        rates.wait_s(f"{number}")
    assert len(rates._left) <= MOST_KNOWN
    assert "busy" in rates._left


@pytest.fixture
def limited(tmp_path):
    """A server for all addresses that takes 30 requests a minute of each sender, and two tokens."""
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0", rate=30)
    tokens = [Database(settings.data).create_token("viewer", name) for name in ("one", "other")]
    with serving(settings) as client:
        yield client, *tokens


def test_a_token_or_address_that_asks_too_often_is_told(limited):
    client, one, other = limited
    answers = [client.get("devices", Authorization=f"Bearer {one}") for _ in range(8)]
    assert [answer.status for answer in answers][:5] == [200] * 5
    assert answers[-1].status == 429
    assert answers[-1].content["title"] == "Too many requests"
    assert 1 <= int(answers[-1].headers["retry-after"]) <= 2
    assert client.get("devices", Authorization=f"Bearer {other}").status == 200
    # each guess is another token, and of the same address
    guesses = [client.get("devices", Authorization=f"Bearer hp_{i}").status for i in range(8)]
    assert (guesses[0], guesses[-1]) == (401, 429)


@pytest.mark.parametrize(
    "words", [{"Cookie": "pipeline-session={}"}, {"Authorization": "Bearer {}"}, {"Authorization": "bearer {}"}]
)
@pytest.mark.parametrize("path", ["devices", "/login"])
def test_invented_words_do_not_pass_the_rate(limited, words, path):
    client = limited[0]
    answers = [client.get(path, **{name: word.format(i) for name, word in words.items()}) for i in range(8)]
    assert answers[-1].status == 429


def test_one_token_is_one_sender_however_it_is_written(limited):
    client, token, _ = limited
    spelled = ("Bearer", "bearer", "BEARER", "BeAreR", "bEARER", "BEarer", "bearER", "bEaReR")
    assert [client.get("devices", Authorization=f"{word} {token}").status for word in spelled][-1] == 429


@pytest.mark.parametrize(
    ("options", "expected"), [({}, 0), ({"host": "0.0.0.0"}, 3000), ({"rate": 5}, 5), ({"host": "::", "rate": 0}, 0)]
)
def test_the_usual_rate(tmp_path, options, expected):
    assert Settings(tmp_path / "processed", tmp_path / "reports", **options).per_minute == expected
