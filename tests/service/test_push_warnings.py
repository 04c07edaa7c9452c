"""`push` prints the warnings of `ingest`: the same sentences about the same logs, on stderr, and in its JSON."""

import json
import subprocess
import sys

import pytest
from native_logs import log_text
from served import form, serving
from wall_logs import profile_text, wall_log

from pipeline.service.settings import Settings


def run(*arguments):
    command = [sys.executable, "-m", "pipeline", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.fixture
def raw(tmp_path):
    """Logs in front of other walls than stated, of another period, with another name, and a link to a folder."""
    folder = tmp_path / "raw"
    (folder / "below").mkdir(parents=True)
    (folder / "K2_B4.txt").write_text(wall_log(900.0, 4.0))
    (folder / "below" / "K1,5_B0,1.txt").write_text(wall_log(1500.0, 9.0))
    (folder / "K1.5_B6.txt").write_text(wall_log(1500.0, 6.0))
    (folder / "below" / "K1.50_B6.0.txt").write_text(wall_log(1500.0, 6.0))
    (folder / "link").symlink_to(tmp_path)
    return folder


def test_push_prints_the_warnings_of_ingest(raw, tmp_path):
    (tmp_path / "lab.toml").write_text(profile_text())
    wanted = run("ingest", raw, "--profile", tmp_path / "lab.toml", "--processed", tmp_path / "other")
    assert wanted.returncode == 0, wanted.stderr
    lines = {line.replace(f"{raw}/", "") for line in wanted.stdout.splitlines() if line.startswith("warning: ")}
    assert len(lines) == 4
    assert sum("the command follows" in line for line in lines) == 2
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", renew=False)) as client:
        to = ("--to", f"http://127.0.0.1:{client.port}", "--profile", tmp_path / "lab.toml")
        done = run("push", raw, *to)
        assert done.returncode == 0, done.stderr
        pushed = {line.replace(f"{raw}/", "") for line in done.stderr.splitlines() if line.startswith("warning: ")}
        assert pushed == lines
        assert "warning" not in done.stdout
        assert str(tmp_path / "processed") not in done.stderr


def test_push_has_the_warnings_of_ingest_in_its_json(raw, tmp_path):
    (raw / "K1.5_B6.csv").write_text(log_text(seed=1))
    (raw / "K2.5_B6.csv").write_text(log_text(seed=2).replace("sampling_period_s: 0.001", "sampling_period_s: 0.002"))
    wanted = json.loads(run("ingest", raw, "--processed", tmp_path / "other", "--json").stdout)
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", renew=False)) as client:
        done = run("push", raw, "--to", f"http://127.0.0.1:{client.port}", "--json")
        assert "warning:" not in done.stderr
        pushed = json.loads(done.stdout)

    def plain(warnings):
        return sorted((one["path"].removeprefix(f"{raw}/"), one["warning"]) for one in warnings)

    assert len(wanted["warnings"]) >= 2
    assert plain(pushed["warnings"]) == plain(wanted["warnings"])


@pytest.mark.slow
def test_a_sheet_is_read_where_it_lies_and_never_by_the_server(tmp_path):
    """Its path would be that of any file of the server, so a profile that names one is refused there."""
    folder = tmp_path / "raw"
    folder.mkdir()
    (folder / "a.txt").write_text(wall_log(1500.0, 6.0))
    (folder / "runs.csv").write_text("Datei;K [N/mm];B [Ns/m];F0 [N]\na.txt;1,5;6;8\n")
    text = profile_text().replace("name_pattern", "# name_pattern").replace("step = 8.0\n", "")
    (tmp_path / "lab.toml").write_text(text + '[sheet]\nfile = "raw/runs.csv"\n')
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", renew=False)) as client:
        done = run("push", folder, "--to", f"http://127.0.0.1:{client.port}", "--profile", tmp_path / "lab.toml")
        assert done.returncode == 0, done.stderr
        (trial,) = client.get("trials").content["items"]
        assert (trial["stiffness"], trial["damping"]) == (1500.0, 6.0)
        kept = client.get("profiles/lab").content["profile"]
        assert "[sheet]" not in kept
        assert "[[file]]" in kept
        (tmp_path / "secret.csv").write_text("Datei;K [N/mm]\nsecret;42\n")
        for place in (str(tmp_path / "secret.csv"), "/etc/passwd", "../../secret.csv"):
            wrong = f'{text}[sheet]\nfile = "{place}"\n'
            drafted = client.ask("POST", "profiles/draft", **form([("a.txt", wall_log(1500.0, 6.0).encode())])).content
            for answer in (
                client.ask("PUT", "profiles/other", document={"profile": wrong}),
                client.ask("POST", "profiles/preview", document={"sample": drafted["sample"], "profile": wrong}),
            ):
                assert answer.status == 422
                assert "cannot name a sheet" in json.dumps(answer.content)
                assert "secret" not in json.dumps(answer.content).replace(place, "")
