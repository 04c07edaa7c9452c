"""Commands of the service, and the project without its extra."""

import json
import subprocess
import sys

import pytest
from stored import stored_rows

from pipeline.service.database import Database
from pipeline.service.settings import Settings


def run(*arguments, code=None, **options):
    command = [sys.executable, "-c", code] if code else [sys.executable, "-m", "pipeline"]
    return subprocess.run([*command, *map(str, arguments)], capture_output=True, text=True, check=False, **options)


def test_without_the_extra_the_message_says_what_to_install(tmp_path):
    hidden = (
        "import sys\n"
        "class Hidden:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('fastapi', 'starlette', 'uvicorn', 'python_multipart'):\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Hidden())\n"
        "import importlib.util as u\n"
        "find = u.find_spec\n"
        "extra = ('fastapi', 'uvicorn', 'python_multipart')\n"
        "u.find_spec = lambda name, *more: None if name in extra else find(name, *more)\n"
        "from pipeline.shell.cli import run\n"
        "run(sys.argv[1:])\n"
    )
    done = run("serve", code=hidden, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "pip install '.[serve]'" in done.stderr
    assert run("--help", code=hidden).returncode == 0
    assert run("status", "--processed", tmp_path, code=hidden).returncode == 0


def test_tokens_are_made_listed_and_revoked(tmp_path):
    place = ("--processed", tmp_path / "processed")
    token = run("token", "create", "--role", "viewer", "--name", "Ada", *place).stdout.strip()
    database = Database(Settings(tmp_path / "processed", tmp_path).data)
    assert database.holder_of(token) == ("viewer", "Ada")
    (listed,) = json.loads(run("token", "list", "--json", *place).stdout)
    assert (listed["role"], listed["name"]) == ("viewer", "Ada")
    assert run("token", "revoke", listed["id"], *place).returncode == 0
    assert database.holder_of(token) is None
    short = run("token", "create", "--role", "viewer", "--days", "0", *place).stdout.strip()
    assert database.holder_of(short) is None
    assert run("token", "revoke", listed["id"], *place).returncode == 2
    assert run("token", "create", "--role", "king", *place).returncode == 2


def test_push_uploads_a_folder_and_resumes(empty, logs, tmp_path):
    folder = tmp_path / "raw" / "below"
    folder.mkdir(parents=True)
    for name, data in logs:
        (folder / name).write_bytes(data)
    (folder / "bad.csv").write_bytes(logs[0][1].replace(b"\n0.01", b"\nzero", 1))
    (folder / ".hidden").write_bytes(b"x")
    to = ("--to", f"http://127.0.0.1:{empty.port}", "--json")
    done = run("push", tmp_path / "raw", *to)
    report = json.loads(done.stdout)
    assert (done.returncode, report["found"], report["ingested"]) == (3, len(logs) + 1, len(logs))
    (refused,) = report["quarantined"]
    assert refused["path"] == "below/bad.csv"
    again = run("push", tmp_path / "raw", *to)
    # what was refused is refused again, with its reason
    assert (again.returncode, json.loads(again.stdout)["skipped"]) == (3, len(logs))
    assert [one["path"] for one in json.loads(again.stdout)["quarantined"]] == ["below/bad.csv"]
    assert stored_rows(tmp_path / "processed").total() == len(logs)


@pytest.mark.slow
@pytest.mark.parametrize("to", ["http://127.0.0.1:9", "nowhere", "ftp://127.0.0.1"])
def test_push_to_nowhere_is_an_error(tmp_path, to):
    (tmp_path / "a.csv").write_text("x")
    done = run("push", tmp_path, "--to", to)
    assert done.returncode == 2
    assert to in done.stderr
