"""Who may, and attacks: each is refused with a problem document, and nothing of it stays."""

import errno
import io
import socket
import sys
import time
import zipfile
from contextlib import contextmanager
from http.client import HTTPConnection

import pytest
from served import form, serving

from pipeline.base.errors import UsageError
from pipeline.service.app import create_app
from pipeline.service.database import Database
from pipeline.service.settings import Settings

LOG = [("a.csv", b"time_s,command,position\n")]


def settings_of(folder, **options):
    return Settings(folder / "processed", folder / "reports", **options)


@contextmanager
def guarding(folder):
    settings = settings_of(folder, host="0.0.0.0", max_file=1000, max_request=5000, max_files=3, body_s=0.5)
    database = Database(settings.data)
    tokens = {role: database.create_token(role, "test") for role in ("viewer", "contributor", "admin")}
    with serving(settings) as client:
        client.tokens, client.database = tokens, database
        yield client


@pytest.fixture
def guarded(tmp_path):
    """A server for all addresses, with a token of each role."""
    with guarding(tmp_path) as client:
        yield client


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """Such a server for all tests that leave it as it was."""
    with guarding(tmp_path_factory.mktemp("steady")) as client:
        yield client


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """A server of this computer alone; all of its tests are refused, but for what one names `outside`."""
    with serving(settings_of(tmp_path_factory.mktemp("plain"))) as client:
        yield client


def bearer(client, role):
    return {"Authorization": f"Bearer {client.tokens[role]}"}


def stored(settings):
    return [path for path in (settings.data / "logs").rglob("*") if path.is_file()]


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:80", "", "[::1", "10.0.0.1"])
def test_a_foreign_host_is_refused(plain, host):
    answer = plain.ask("GET", "devices", headers={"Host": host})
    assert (answer.status, answer.content["where"]) == (403, "Host")


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:80", "[::1]:8000"])
def test_names_of_this_computer_are_taken(plain, host):
    assert plain.ask("GET", "devices", headers={"Host": host}).status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://localhost"])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_foreign_origin_is_refused(plain, origin, method):
    sent = form(LOG)
    sent["headers"]["Origin"] = origin
    answer = plain.ask(method, "logs", **sent)
    assert (answer.status, answer.content["where"]) == (403, "Origin")


def test_an_own_page_needs_the_token_of_a_form(plain):
    headers = {"Origin": f"http://127.0.0.1:{plain.port}"}
    asked = {"device": "x"}
    assert plain.ask("POST", "comparisons", document=asked, headers=headers).status == 403
    headers |= {"Cookie": "pipeline-form=mine", "X-CSRF-Token": "0" * 64}
    assert plain.ask("POST", "comparisons", document=asked, headers=headers).status == 403


def test_other_addresses_need_a_token_first(tmp_path):
    with pytest.raises(UsageError, match="pipeline token create"):
        create_app(settings_of(tmp_path, host="0.0.0.0"))


def test_without_a_token_nothing_is_told(steady):
    for headers in (
        {},
        {"Authorization": "Bearer hp_x"},
        {"Authorization": "Basic YTpi"},
        {"Cookie": "pipeline-session=x"},
    ):
        for path in ("devices", "openapi.json", "jobs", "/"):
            answer = steady.ask("GET", path, headers=headers)
            assert answer.status == 401
            assert answer.headers["www-authenticate"] == "Bearer"
    assert steady.get("health").status == 200


def test_roles(guarded):
    upload = form(LOG)
    for role, status in (("viewer", 403), ("contributor", 202), ("admin", 202)):
        assert guarded.ask("GET", "devices", headers=bearer(guarded, role)).status == 200
        answer = guarded.ask("POST", "logs", upload["body"], {**upload["headers"], **bearer(guarded, role)})
        assert answer.status == status
    job = answer.content["job"]
    # both tokens bear one name, and what one asked for the other may cancel; nobody else but an admin
    other = {"Authorization": f"Bearer {guarded.database.create_token('contributor', 'Bo')}"}
    assert guarded.ask("DELETE", f"jobs/{job}", headers=other).status == 403
    for path in ("devices/x", "experiments/x/1", "trials/x", "bin"):
        assert guarded.ask("DELETE", path, headers=other).status == 403
    assert guarded.ask("DELETE", f"jobs/{job}", headers=bearer(guarded, "admin")).status == 200


@pytest.mark.parametrize("name", ["token", "access_token", "api_key", "TOKEN"])
def test_a_token_in_an_address_is_refused(steady, name):
    answer = steady.ask("GET", f"devices?{name}={steady.tokens['admin']}", headers=bearer(steady, "admin"))
    assert (answer.status, answer.content["where"]) == (400, "query")


def test_a_token_is_stored_hashed_and_never_logged(guarded, caplog):
    caplog.set_level("INFO", "pipeline.service")
    guarded.ask("GET", "devices", headers=bearer(guarded, "admin"))
    data = b"".join(path.read_bytes() for path in guarded.settings.data.iterdir() if path.is_file())
    until = time.monotonic() + 10
    # a request is logged after its answer was sent
    while not any("/api/v1/devices" in record.getMessage() for record in caplog.records):
        assert time.monotonic() < until, "the request was not logged"
        time.sleep(0.01)
    for token in guarded.tokens.values():
        assert token.encode() not in data
        assert token not in caplog.text


def test_a_revoked_token_ends_its_logins(guarded):
    session = guarded.database.login(guarded.tokens["viewer"])
    headers = {"Cookie": f"pipeline-session={session}"}
    assert guarded.ask("GET", "devices", headers=headers).status == 200
    guarded.database.run("DELETE FROM tokens WHERE role = 'viewer'")
    assert guarded.ask("GET", "devices", headers=headers).status == 401


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no such modes")
def test_only_its_owner_reads_what_the_service_keeps(empty, logs):
    Database(empty.settings.data).create_token("viewer", "")
    _, job = empty.upload([*logs[:3], ("below/bad.csv", b"nonsense")])
    assert job["state"] == "done"
    empty.all_done()
    assert empty.get("experiments/falcon/1/causes").status in (200, 202)
    empty.all_done()
    found = [empty.settings.data, *empty.settings.data.rglob("*")]
    assert {path.name for path in found} >= {"service.sqlite", "logs", "documents", "bad.csv"}
    loose = {
        str(path): oct(path.stat().st_mode & 0o777) for path in found if path.exists() and path.stat().st_mode & 0o077
    }
    assert loose == {}


def test_a_folder_of_an_earlier_version_is_closed(tmp_path):
    settings = settings_of(tmp_path)
    Database(settings.data).close()
    settings.data.chmod(0o755)
    (settings.data / "service.sqlite").chmod(0o644)
    Database(settings.data)
    assert [path.stat().st_mode & 0o077 for path in (settings.data, settings.data / "service.sqlite")] == [0, 0]


def test_a_cookie_alone_changes_nothing(steady):
    session = steady.database.login(steady.tokens["admin"])
    sent = form(LOG)
    sent["headers"]["Cookie"] = f"pipeline-session={session}"
    assert steady.ask("POST", "logs", **sent).status == 403


def test_every_answer_has_the_headers(plain):
    for path in ("health", "nothing", "trials?limit=0", "/static/service.css"):
        headers = plain.get(path).headers
        assert "script-src 'self'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert len(headers["x-request-id"]) == 12


@pytest.mark.parametrize(
    ("files", "where"),
    [
        ([("a.csv", b"x" * 1001)], "a.csv"),
        ([(f"{i}.csv", b"x") for i in range(4)], None),
        ([(f"{i}.csv", b"x" * 900) for i in range(6)], None),
    ],
)
def test_limits_of_uploads(steady, files, where):
    sent = form(files)
    answer = steady.ask("POST", "logs", sent["body"], {**sent["headers"], **bearer(steady, "admin")})
    assert answer.status == 413
    assert answer.content.get("where") == where
    assert stored(steady.settings) == []


def raw(client, head, *parts):
    """The answer to bytes that no library sends."""
    with socket.create_connection((client.host, client.port), timeout=30) as connection:
        connection.sendall(head.replace("\n", "\r\n").encode() + b"\r\n\r\n")
        for part in parts:
            connection.sendall(part)
        answer = b""
        while data := connection.recv(65536):
            answer += data
            if b"\r\n\r\n" in answer and b"}" in answer:
                break
        return answer


def head_of(client, more):
    return (
        f"POST /api/v1/logs HTTP/1.1\nHost: x\nAuthorization: Bearer {client.tokens['admin']}\n"
        f"Content-Type: multipart/form-data; boundary=b\n{more}"
    )


def test_ten_gigabytes_are_refused_before_they_come(steady):
    began = time.monotonic()
    answer = raw(steady, head_of(steady, f"Content-Length: {10 << 30}"))
    assert b" 413 " in answer.splitlines()[0]
    assert b'"expected":"<= 5000"' in answer
    assert time.monotonic() - began < 60


def test_pieces_are_counted_where_no_length_is_told(steady):
    start = b'--b\r\nContent-Disposition: form-data; name="files"; filename="a.csv"\r\n\r\n'
    pieces = [b"1000\r\n" + text + b"\r\n" for text in (start.ljust(0x1000, b"x"), b"x" * 0x1000)]
    answer = raw(steady, head_of(steady, "Transfer-Encoding: chunked"), *pieces)
    assert b" 413 " in answer.splitlines()[0]


def test_a_silent_client_is_told(steady):
    answer = raw(steady, head_of(steady, "Content-Length: 100"), b"--b\r\n")
    assert b" 408 " in answer.splitlines()[0]
    assert stored(steady.settings) == []


OUTSIDE = ("../../../outside.csv", "/etc/outside.csv", "..\\..\\outside.csv", ".", "a/./../b.csv", "con", "x\x01.csv")


@pytest.mark.parametrize("name", OUTSIDE)
def test_no_name_leads_out_of_the_folder(plain, name):
    before, folder = stored(plain.settings), plain.settings.processed.parent
    answer, job = plain.upload([(name, f"nonsense {name!r}".encode())])
    files = [path for path in stored(plain.settings) if path not in before]
    assert len(files) == 1
    assert files[0].resolve().is_relative_to(plain.settings.data / "logs" / answer["job"])
    assert job["state"] == "done"
    assert [path for path in folder.rglob("outside.csv") if path not in (*files, *before)] == []


ELSEWHERE = ("/static/../app.py", "/static/%2e%2e/app.py", "/static/..%2fapp.py", "/api/v1/comparisons/..%2f..%2fx")


@pytest.mark.parametrize("path", ELSEWHERE)
def test_no_address_leads_to_other_files(plain, path):
    connection = HTTPConnection(plain.host, plain.port)
    connection.putrequest("GET", path, skip_accept_encoding=True)
    connection.endheaders()
    assert connection.getresponse().status in (404, 422)
    connection.close()


@pytest.mark.parametrize(
    ("body", "kind"),
    [
        (b"", "text/plain"),
        (b"", "multipart/form-data"),
        (b"--b\r\nnonsense", "multipart/form-data; boundary=b"),
        (b"--b--\r\n", "multipart/form-data; boundary=b"),
        (form(LOG)["body"][:-6], form(LOG)["headers"]["Content-Type"]),
        (form([("a.csv", b"1"), ("a.csv", b"2")])["body"], form(LOG)["headers"]["Content-Type"]),
        (form([("a" * 300, b"1")])["body"], form(LOG)["headers"]["Content-Type"]),
        (form(LOG, profile="../../x.toml")["body"], form(LOG)["headers"]["Content-Type"]),
    ],
)
def test_a_form_that_is_none_is_refused_whole(plain, body, kind):
    before = stored(plain.settings)
    answer = plain.ask("POST", "logs", body, {"Content-Type": kind})
    assert (answer.status, answer.content["status"]) == (422, 422)
    assert stored(plain.settings) == before


def test_a_read_only_server_changes_nothing(tmp_path):
    with serving(settings_of(tmp_path, read_only=True)) as client:
        answer = client.ask("POST", "logs", **form(LOG))
        assert (answer.status, "read-only" in answer.content["detail"]) == (403, True)
        assert client.get("jobs").content["items"] == []


@pytest.mark.sampled
@pytest.mark.parametrize("full", ["disk", "database"])
def test_a_full_disk_is_told_and_nothing_stays(empty, tmp_path, monkeypatch, full):
    def no_room(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def limited(database):
        database.run("PRAGMA max_page_count = 1")  # what is there already fits
        return add(database)

    add = Database.transaction
    with monkeypatch.context() as patch:
        if full == "disk":
            patch.setattr("pipeline.service.uploads.sync_file", no_room)
        else:
            patch.setattr(Database, "transaction", limited)
        sent = form([("a.csv", b"1"), *[(f"{'b' * 150}{i}.csv", f"{i}".encode()) for i in range(200)]])
        answer = empty.ask("POST", "logs", **sent)
        assert (answer.status, answer.content["title"]) == (507, "The disk is full")
        assert stored(settings_of(tmp_path)) == []
    assert empty.get("health").status == 200
    assert [job for job in empty.get("jobs").content["items"] if job["kind"] == "upload"] == []


@pytest.mark.slow
def test_bombs_are_refused_beside_what_is_good(empty, logs):
    """They claim or unpack to gigabytes; the others of the same request are stored."""
    h5py = pytest.importorskip("h5py")

    def claiming(*names):
        packed = io.BytesIO()
        with h5py.File(packed, "w") as file:
            for name in names:
                file.create_dataset(name, (1 << 33,), "f8", chunks=(1 << 20,), compression="gzip")
        return packed.getvalue()

    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.csv", bytes(200 << 20))
    bombs = [("bomb.h5", claiming("time_s", "command", "position")), ("bomb.zip", zipped.getvalue())]
    bombs.append(("bomb.mat", claiming("t", "u", "x")))
    assert all(len(data) < 1 << 20 for _, data in bombs)
    _, job = empty.upload([*bombs, *logs[:2]])
    assert (job["state"], job["result"]["ingested"]) == ("done", 2)
    assert sorted(refused["path"] for refused in job["result"]["quarantined"]) == sorted(name for name, _ in bombs)
    assert all(refused["reason"] for refused in job["result"]["quarantined"])
