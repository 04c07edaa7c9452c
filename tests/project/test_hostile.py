"""Hostile logs: their names, links and metadata, files that are none, and files that ask for more than they hold."""

import contextlib
import gzip
import json
import os
import re
import subprocess
import sys
import tarfile
import time
import zipfile
from io import BytesIO
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from foreign_files import read_frame
from native_logs import FAULTS, GOOD, log_text
from places import ROOT

from pipeline.base.errors import CURES, LogError, ProfileError, UsageError
from pipeline.base.paths import open_regular, path_of_text, path_text, storable
from pipeline.intake.ingest import ingest
from pipeline.intake.quarantine import list_quarantine
from pipeline.intake.sources import Notices, find_sources
from pipeline.profiles.profile_files import load_profile
from pipeline.readers import mapping
from pipeline.readers.formats import native, refuse_other_kind
from pipeline.readers.isolation import read_file
from pipeline.store.samples import load_trials
from pipeline.store.storage import list_devices, read_trials

LOGS_PAGE = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")

PROFILE = """
name = "lab"
format = "delimited"
files = ["*.csv", "*.gz"]
decimal = "."
step_at = "command edge"
columns.time = { name = "t", unit = "ms" }
columns.command = { name = "F", unit = "N", sign = 1 }
columns.position = { name = "x", unit = "mm", sign = 1 }
[constants]
device = "bench"
experiment = "1"
stiffness = 1
damping = 1
step = 1
sampling_period_s = 0.001
"""
TABLE = "t,F,x\n0,0,0\n1,1,0\n2,1,1\n"


@pytest.fixture
def lab(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(PROFILE)
    return path


@pytest.fixture
def store(processed):
    def store(*paths, **options):
        report = ingest(paths, processed, jobs=1, **options)
        assert report.found == report.ingested + report.skipped + len(report.quarantined)
        for file in processed.rglob("*.parquet"):
            pq.read_table(file).validate(full=True)
        return report

    return store


def refusals(report):
    return {Path(refusal.path).name: refusal for refusal in report.quarantined}


def test_the_page_explains_every_code():
    _, _, section = LOGS_PAGE.partition("## Codes of refusals\n")
    explained = re.findall(r"^\| `([a-z-]+)` \|", section.partition("\n## ")[0], flags=re.MULTILINE)
    assert sorted(explained) == sorted(CURES)


NAMES = [
    b"newline\nin it.csv",
    b"undecodable \xff\xfe.csv",
    b"escape \x1b[2J\x07.csv",
    "emoji 😀 ü.csv".encode(),
    b"quote \" ' $(touch owned) `id`.csv",
    b"-rf.csv",
    b"=cmd|' 'C'!A0.csv",
    "😀".encode() * 60 + b".csv",
    b"x" * 251 + b".csv",
    b"back\\slash %2F %FF.csv",
]


@pytest.mark.skipif(sys.platform == "win32", reason="such names are legal where names are bytes")
@pytest.mark.parametrize("name", NAMES, ids=lambda name: name.decode("latin-1")[:12].encode("unicode_escape").decode())
def test_names_of_any_bytes_are_stored_told_and_found_again(logs, processed, store, call, name):
    path = Path(os.fsdecode(os.fsencode(logs) + b"/" + name))
    path.write_text(FAULTS["text cell"][0])
    report = store(logs)
    (refusal,) = report.quarantined
    refusal.path.encode()
    assert path_of_text(refusal.path) == path
    status, out, _ = call("ingest", logs, "--processed", processed, "--json")
    assert status == 3
    assert json.loads(out)["quarantined"][0]["path"] == refusal.path
    for arguments in ((), ("--json",), (refusal.path,), (refusal.path, "--json")):
        status, out, _ = call("quarantine", *arguments, "--processed", processed)
        assert status == 0
        assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", out), "no command reaches the terminal"
    assert len(list(processed.glob("quarantine/*/*"))) == 1
    path.write_text(GOOD)
    status, out, _ = call("ingest", logs, "--processed", processed, "--json")
    assert (status, json.loads(out)["ingested"]) == (0, 1)
    assert not list(processed.glob("quarantine/*"))
    (stored,) = read_trials(processed).column("source_path").to_pylist()
    assert path_of_text(stored) == path
    assert store(logs).skipped == 1
    assert not Path("owned").exists()


def test_paths_become_text_and_paths_again():
    for path in ("/a/b.csv", "relative/b.csv", "/a/100 %.csv", "/a/\udcff#?.csv", "/a/%FF.csv", "/a\udc80/b\n.csv"):
        text = path_text(path)
        text.encode()
        assert path_of_text(text) == Path(path)
    assert storable("a\ud800b\udcff") == "a\\ud800b\\udcff"


def test_links_pipes_and_devices(logs, store, tmp_path):
    outside = tmp_path / "elsewhere"
    outside.mkdir()
    (outside / "far.csv").write_text(log_text(7.0))
    (outside / "linked.csv").write_text(log_text(8.0))
    (logs / "a.csv").write_text(GOOD)
    (logs / "self").symlink_to(logs)
    (logs / "up").symlink_to("..")
    (logs / "folder").symlink_to(outside)
    (logs / "round.csv").symlink_to("round.csv")
    (logs / "gone.csv").symlink_to("nowhere")
    (logs / "link.csv").symlink_to(outside / "linked.csv")
    (logs / "zero.csv").symlink_to("/dev/zero")
    (logs / "terminal.csv").symlink_to("/dev/tty")
    (logs / "folder.csv").mkdir()
    os.mkfifo(logs / "pipe.csv")
    report = store(logs)
    assert (report.found, report.ingested) == (7, 2)
    found = {name: refusal.code for name, refusal in refusals(report).items()}
    devices = dict.fromkeys(("zero.csv", "terminal.csv", "pipe.csv"), "not-regular")
    assert found == {"gone.csv": "unreadable", "round.csv": "unreadable", **devices}
    assert {Path(warning.path).name for warning in report.warnings} == {"self", "up", "folder"}
    assert all("link to a folder" in warning.warning for warning in report.warnings)
    # a link that is named is followed
    assert store(logs / "folder").ingested == 1
    assert (outside / "linked.csv").read_text() == log_text(8.0)


def test_what_is_no_regular_file_is_never_opened_for_reading(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(OSError, match=r"no regular file|Is a directory"):
            open_regular(path)
    (tmp_path / "file").write_bytes(b"x")
    with open_regular(tmp_path / "file") as stream:
        assert stream.read() == b"x"


def test_metadata_of_a_bag_that_is_a_pipe_is_not_waited_for(logs, store):
    (logs / "bag").mkdir()
    os.mkfifo(logs / "bag" / "metadata.yaml")
    (logs / "bag" / "bag_0.mcap").write_bytes(b"x")
    assert {refusal.code for refusal in store(logs).quarantined} == {"no-profile"}


def test_metadata_of_a_bag_names_no_files_elsewhere(tmp_path, logs, store):
    (tmp_path / "secret.mcap").write_bytes(b"x")
    (logs / "bag").mkdir()
    names = ["../../secret.mcap", "/dev/zero", "..", "x" * 300]
    text = "rosbag2_bagfile_information:\n  relative_file_paths:\n" + "".join(f"    - {name}\n" for name in names)
    (logs / "bag" / "metadata.yaml").write_text(text)
    (refusal,) = store(logs).quarantined
    assert refusal.code == "partner-missing"
    assert str(tmp_path / "secret.mcap") not in refusal.reason


def test_a_folder_that_cannot_be_listed_is_told(logs, monkeypatch):
    (logs / "shut").mkdir()
    (logs / "a.csv").write_text(GOOD)
    scandir = os.scandir

    def scan(path):
        if Path(path).name == "shut":
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", scan)
    told = Notices()
    assert len(find_sources([logs], (), None, told)) == 1
    assert [(folder.name, text) for folder, text in told.folders] == [
        ("shut", "folder cannot be read (Permission denied). Correct the permissions of the folder.")
    ]


def test_a_path_that_may_not_be_looked_at_is_a_usage_error(logs):
    with pytest.raises(UsageError, match="cannot be read"):
        find_sources([logs / ("x" * 300)], ())


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "..", ".", "/etc/cron.d/x", "a/../../b", "C:\\x", "~", "%2e%2e%2f", "con"]
)
def test_no_name_in_a_log_leads_out_of_processed(tmp_path, logs, store, processed, name):
    before = {path for path in tmp_path.rglob("*") if processed not in path.parents}
    text = GOOD.replace("# device: bench", f"# device: {name}").replace("# experiment: 1", f"# experiment: {name}")
    (logs / "a.csv").write_text(text)
    (logs / "b.csv").write_text(text.replace("0.001,", "0.001x,", 1))
    assert (len(store(logs).quarantined), list_devices(processed)) == (1, [name])
    after = {path for path in tmp_path.rglob("*") if processed not in path.parents}
    assert after - before == {processed, logs / "a.csv", logs / "b.csv"}
    for path in processed.rglob("*"):
        assert path.resolve().is_relative_to(processed.resolve())
    assert len(load_trials(processed, read_trials(processed, name))) == 1


@pytest.mark.parametrize("by", ["../secret", "/etc/passwd", "a\\\\b", "\\u0000"])
def test_the_partner_of_a_log_lies_beside_it(tmp_path, by):
    (tmp_path / "lab.toml").write_text(
        PROFILE.replace("[constants]", f'[partner]\nreplace = "_q"\nby = "{by}"\n[constants]')
    )
    with pytest.raises(ProfileError, match=r"partner\.by.*part of a file name"):
        load_profile(tmp_path / "lab.toml")


def zipped(*names: str) -> bytes:
    buffer = BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in names:
            archive.writestr(name, "t,F,x\n")
    return buffer.getvalue()


def tarred() -> bytes:
    buffer = BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("run.csv"), BytesIO())
    return buffer.getvalue()


def parquet() -> bytes:
    buffer = BytesIO()
    pq.write_table(pa.table({"t": [0.0, 1.0]}), buffer)
    return buffer.getvalue()


KINDS = {
    "a ZIP archive": zipped("run.csv"),
    "an Excel workbook": zipped("[Content_Types].xml", "xl/workbook.xml"),
    "a Word document": zipped("word/document.xml"),
    "an OpenDocument file": zipped("content.xml"),
    "a packed archive .*TAR": tarred(),
    "a document .*old Excel or Word": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600),
    "a document .PDF": b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n",
    "a picture .PNG": b"\x89PNG\r\n\x1a\n" + bytes(30),
    "a picture .*JPEG": b"\xff\xd8\xff\xe0" + bytes(30),
    "markup .HTML, XML.": b"\xef\xbb\xbf\n<!DOCTYPE html>\n<html><body>Sign in</body></html>",
    "a packed archive .*RAR": b"Rar!\x1a\x07\x01\x00",
    "a file of format 'parquet'": parquet(),
    "a file of format 'hdf5'": b"\x89HDF\r\n\x1a\n" + bytes(600),
    "a file of format 'rosbag'": b"SQLite format 3\0" + bytes(100),
}


@pytest.mark.parametrize("what", KINDS)
def test_a_file_of_another_kind_is_named(logs, store, lab, what):
    (logs / "run.csv").write_bytes(KINDS[what])
    for profile in (None, lab):
        (refusal,) = store(logs, profile=profile, rehash=True).quarantined
        assert re.search(what, refusal.reason), refusal.reason
        assert refusal.code == "unsupported"
    if "format" in what:
        assert refusal.profile_line in (f"format = {what.split()[-1]}".replace("'", '"'),)


def test_binary_formats_are_not_taken_for_another_kind():
    refuse_other_kind("log", "hdf5", b"\x89HDF\r\n\x1a\n")
    refuse_other_kind("log", "delimited", b"")
    for data in (b"Zeit;Weg\n", b"\x1f\x8b\x08", b"PKW;Weg\n1;2\n", b"BZh 1,2\n"):
        refuse_other_kind("log", "delimited", data)


def read_text(lab, data, name="run.csv"):
    return read_file(load_profile(lab), (name,), (data,), ("t", "F", "x")).frame()


def test_a_file_that_is_too_large_is_not_read(logs, store, monkeypatch):
    with (logs / "huge.csv").open("wb") as stream:
        stream.truncate(10**12)
    (refusal,) = store(logs).quarantined
    assert (refusal.code, "1000000000000 bytes" in refusal.reason) == ("too-large", True)
    assert (list_quarantine(logs.parent / "processed")[0].sha256) is None


def test_limits_of_text(lab):
    frame = read_text(lab, (TABLE + "3,1,1\n" * 5000).encode() + b"9" * (2 << 20))
    assert (len(frame), "is incomplete and was omitted" in frame.warnings[0]) == (5003, True)
    with pytest.raises(LogError, match="wants column 'x'") as error:
        read_text(lab, ("t,F,x" + "y" * 200_000 + TABLE[5:]).encode())
    assert (error.value.code, error.value.row) == ("column-missing", 1)
    assert len(error.value.reason) < 3000


def test_limits_of_native_logs():
    profile = load_profile("native")

    def refusal(text):
        ((outcome),) = native.read(profile, [native.RawLog(("log.csv",), (text.encode(),))])
        return outcome.code, outcome.row

    assert refusal("# remark: " + "x" * 100_000 + "\n" + GOOD)[0] == "header-missing"
    assert refusal(GOOD + "1,0," + "0" * (2 << 20) + "x\n") == ("not-a-number", 41)
    # the row at fault is found behind the first block that is searched
    lines = [f"{k}.0000000,0,0\n" for k in range(1, 200_000)]
    lines[150_000] = "1,2\n"
    assert refusal(GOOD + "".join(lines)) == ("row-length", 41 + 150_000)
    lines[150_000] = "+150001,0,0\n"
    (((log,),)) = native.read(profile, [native.RawLog(("log.csv",), ((GOOD + "".join(lines)).encode(),))])
    assert log.time[[30, 150_030, -1]].tolist() == [1, 150_001, 199_999]


def test_limits_of_json():
    for text in ("[" * 100_000, '{"a":' * 100_000):
        with pytest.raises(LogError, match=r"recursion|is no JSON") as error:
            read_frame("json", "log", text.encode())
        assert error.value.code == "damaged"
    with pytest.raises(LogError, match="has more than"):
        read_frame("json", "log", json.dumps([{f"a{k}": k for k in range(20_000)}]).encode())


@pytest.mark.parametrize("run", [" ", "\t", " \t", "9", "_", "a "])
def test_long_runs_of_one_sign_take_no_time(lab, run):
    """Patterns that can take a run in several ways need its length squared: for these runs hours."""
    long = run * (1_000_000 // len(run))
    began = time.process_time()
    profile = load_profile(lab)
    layouts = [
        {"delimiter": "blanks"},
        {"delimiter": "\t", "trailing_delimiter": True},
        {"delimiter": ";", "trailing_delimiter": True, "labels": ":", "skip_rows": 1},
    ]
    for layout in layouts:
        text = f"t{long}x\n1;{long};\n1\t{long}2\n{long}\n"
        with contextlib.suppress(LogError):
            read_file(profile.model_copy(update=layout), ("log",), (text.encode(),))
    header = run * (10_000 // len(run))
    for text in (f"{GOOD}1,{long}x,0\n", f"# stiffness{header}x\n{GOOD}", GOOD.replace("none", f"none{header}x")):
        ((outcome),) = native.read(load_profile("native"), [native.RawLog(("log",), (text.encode(),))])
        assert outcome
    header_of = f"1{header}("
    with contextlib.suppress(LogError):
        mapping._in_si(profile, "log", "stiffness", header_of)
    # measured 0.1 to 0.4 s; length squared takes hours
    assert time.process_time() - began < 5


@pytest.mark.parametrize("packing", ["gzip", "zstd"])
def test_packed_text_stops_at_the_limit(lab, packing):
    def pack(data: bytes) -> bytes:
        return gzip.compress(data) if packing == "gzip" else bytes(pa.Codec(packing).compress(data))

    assert len(read_text(lab, pack(TABLE.encode()))) == 3
    with pytest.raises(LogError, match=r"unpacks to more than|takes more memory") as error:
        read_text(lab, pack(bytes(300 << 20)))
    assert error.value.code == "unpacks-too-large"


def test_digits_of_other_scripts_are_no_numbers(logs, store, lab):
    (logs / "a.csv").write_text(GOOD.replace("\n0.001", "\n0.00\u0661", 1).replace("0,0,", "0,0,"))
    (logs / "b.csv").write_text(GOOD.replace("# stiffness: 300", "# stiffness: \u0663"))
    codes = {refusal.code for refusal in store(logs).quarantined}
    assert codes == {"not-a-number", "condition-wrong"}
    (logs / "a.csv").write_text(TABLE.replace("2,1,1", "2,1,\u22121"))
    (logs / "b.csv").unlink()
    (refusal,) = store(logs, profile=lab).quarantined
    assert refusal.code == "not-a-number"


def test_a_quotation_mark_that_is_not_closed_is_found(lab):
    for place, row in ((2, 2), (4, 4)):
        lines = [*TABLE.splitlines(), "3,1,1", "4,1,1"]
        lines[place - 1] = lines[place - 1][:-1] + '"0'
        with pytest.raises(LogError, match="quotation mark") as error:
            read_text(lab, "\n".join(lines).encode() + b"\n")
        assert error.value.row == row
    assert read_text(lab, TABLE.replace("1,1,0", '"1","1","0"').encode()).columns["t"].tolist() == [0, 1, 2]


def test_lone_surrogates_in_json_are_stored_escaped(tmp_path, logs, store, processed):
    profile = tmp_path / "json.toml"
    text = PROFILE.replace('"delimited"', '"json"').replace("*.csv", "*.json").replace('decimal = "."\n', "")
    profile.write_text(
        text.replace("[constants]", 'trial_column = "run"\n[constants]').replace(
            "columns.time", 'records = "rows"\ncolumns.time'
        )
    )
    rows = [{"t": k, "F": k, "x": k, "run": "\ud800"} for k in range(3)]
    (logs / "a.json").write_text(json.dumps({"remark \udfff": "\ud83d", "rows": rows}))
    assert store(logs, profile=profile).ingested == 1
    (trial,) = read_trials(processed).to_pylist()
    assert trial["label"] == "\\ud800"
    assert json.loads(trial["extra"])["file.remark \\udfff"] == "\\ud83d"
    rows[1]["x"] = "\ud800"
    (logs / "a.json").write_text(json.dumps({"rows": rows}))
    (refusal,) = store(logs, profile=profile).quarantined
    refusal.reason.encode()


def test_the_record_names_code_place_and_remedy(logs, processed, store, lab, call):
    (logs / "a.csv").write_text("t,F,x\r\n0,0,0\r\n1,1,--\r\n2,1,\x1b[2J1\r\n")
    store(logs, profile=lab)
    (folder,) = (processed / "quarantine").iterdir()
    (file,) = folder.glob("reason-*.json")
    record = json.loads(file.read_text())
    assert (record["code"], record["row"]) == ("not-a-number", 3)
    assert record["profile_line"] == 'missing = ["--"]'
    _, out, _ = call("quarantine", "--processed", processed)
    assert "[not-a-number]" in out
    assert 'profile: missing = ["--"]' in out
    _, out, _ = call("quarantine", logs / "a.csv", "--processed", processed)
    assert '\n    missing = ["--"]\n' in out
    for arguments in ((), (logs / "a.csv",)):
        _, out, _ = call("quarantine", *arguments, "--processed", processed, "--json")
        document = json.loads(out)
        shown = document[0] if isinstance(document, list) else document
        assert shown | record == shown


CLAIMS = ROOT / "tests" / "support" / "false_claims.py"


@pytest.mark.slow
def test_memory_never_follows_what_a_file_claims():
    """Each format in a process of its own, whose address space ends where it would follow."""
    done = subprocess.run([sys.executable, str(CLAIMS)], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    assert min(found["claims"].values()) >= 1
    # beside the libraries and the files: 64 MiB unpacked, its parts before they are joined, columns of it
    assert found["peak_mib"] < found["made_mib"] + 200, found
    assert found["worker_peak_mib"] < found["made_mib"] + 300, found
