"""What monitors read is what was asked for."""

import re

from prometheus_client.parser import text_string_to_metric_families
from served import form, serving

from pipeline.service.database import Database
from pipeline.service.settings import Settings


def numbers(text):
    """Samples by name and labels, as another program reads them."""
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def told(client, expected):
    """Numbers, once the last request was counted: that is done behind its answer."""
    while True:
        found = numbers(client.get("/metrics").content.decode())
        if expected in found:
            return found


def test_requests_uploads_and_jobs_are_counted(empty, logs):
    for trial in ("none", "neither", "%3Cscript%3E"):
        assert empty.get(f"trials/{trial}").status == 404
    empty.upload(logs[:3])
    empty.upload(logs[:1])
    empty.all_done()
    labels = (("method", "GET"), ("route", "/api/v1/trials/{trial}"), ("status", "404"))
    found = told(empty, ("pipeline_requests_total", *labels))
    assert found["pipeline_requests_total", *labels] == 3
    assert found["pipeline_request_seconds_count", labels[1]] == 3
    assert found["pipeline_uploaded_files_total", ("state", "queued")] == 3
    assert found["pipeline_uploaded_files_total", ("state", "skipped")] == 1
    assert found["pipeline_uploaded_bytes_total",] == sum(len(data) for _, data in (*logs[:3], logs[0]))
    assert found["pipeline_trials",] == 3
    assert found["pipeline_jobs", ("state", "done")] >= 2
    assert not re.search("neither|script", str(found))


def test_odd_methods_make_no_number_of_their_own(empty):
    for method in ("BREW", "WHEN"):
        assert empty.ask(method, "devices").status == 405
    key = ("pipeline_requests_total", ("method", "other"), ("route", "/api/v1/devices"), ("status", "405"))
    assert told(empty, key)[key] == 2


def test_who_may_not_read_reads_no_numbers(tmp_path):
    settings = Settings(tmp_path / "processed", tmp_path / "reports", host="0.0.0.0")
    token = Database(settings.data).create_token("viewer", "monitor")
    with serving(settings) as client:
        assert client.get("/metrics").status == 401
        assert client.get("/metrics", Authorization=f"Bearer {token}").status == 200
        assert client.ask("POST", "logs", **form([("a.csv", b"1")])).status == 401
