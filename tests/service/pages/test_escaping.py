"""Elements in every field that a log, its name or a person fills: each stays text, on every page and in reports."""

import html
from html.parser import HTMLParser
from urllib.parse import quote, urlsplit

import pytest
from served import HTML, Browser, serving

from pipeline.intake.ingest import ingest
from pipeline.service.settings import Settings
from pipeline.store.names import folder_name
from pipeline.store.storage import read_trials

IN_HEADER = ("device", "experiment", "stiffness", "damping", "step", "sampling_period_s")
ADDED = ("added_delay_samples", "grip", "motion")
KEPT = ("device", "experiment", "value", "file", "label", "notes", "tags", "reason", "trial notes", "trial reason")
"""Fields whose marks stand in what is stored; those of the others are in refused logs alone."""

PROFILE = """
name = "lab"
format = "delimited"
files = ["*.csv"]
delimiter = ";"
decimal = "."
header = true
step_at = "command edge"
trial_column = "trial"
columns.time = {name = "t", unit = "s"}
columns.command = {name = "u", unit = "N", sign = 1}
columns.position = {name = "x", unit = "m", sign = 1}
constants = {device = "bench", experiment = "1", stiffness = 0.0, damping = 0.0, step = 1.0, sampling_period_s = 0.001}
"""


def mark(field):
    """Elements that a browser would make of a field, and ends of attributes that would let them in; and a way up."""
    return f"../%2e'><img src=x id='{field}'><script>{field}</script>"


class Elements(HTMLParser):
    """Elements that a page has and should not, and its text and links."""

    def __init__(self, page):
        super().__init__()
        self.wrong, self.links, self.text, self.inside = [], set(), [], ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.inside, found = tag, dict(attrs)
        drawn = tag == "img" and (found.get("src") or "").startswith("/api/v1/figures/")
        if (tag == "img" and not drawn) or found.get("src") == "x" or any(name.startswith("on") for name in found):
            self.wrong.append(self.get_starttag_text())
        if tag == "a" and (found.get("href") or "").startswith("/"):
            self.links.add(found["href"])

    def handle_data(self, data):
        self.text.append(data)
        if self.inside == "script" and data in (*IN_HEADER, *ADDED, *KEPT, "cell", "columns"):
            self.wrong.append(data)


def hostile(logs):
    """Logs that are stored under hostile names, and one for each line and cell that is refused."""
    (_, first), *_ = logs
    lines = first.decode().split("\n")
    columns = next(row for row, line in enumerate(lines) if line.startswith("time_s"))

    def line_of(text, field):
        row = next(row for row, line in enumerate(text) if line.startswith(f"# {field}:"))
        return [*text[:row], f"# {field}: {mark(field)}", *text[row + 1 :]]

    stored = []
    for name, data in logs:
        text = line_of(line_of(data.decode().split("\n"), "device"), "experiment")
        text[columns:columns] = [f"# firmware: {mark('value')}", f"# {mark('key')}: 1"]
        stored.append((f"{mark('file').replace('/', '')}{name}", "\n".join(text).encode()))
    refused = {field: line_of(lines, field) for field in IN_HEADER[2:]}
    for field in ADDED:
        kept = [line for line in lines if not line.startswith(f"# {field}:")]
        refused[field] = [*kept[:2], f"# {field}: {mark(field)}", *kept[2:]]
    refused["columns"] = [*lines[:columns], lines[columns] + f",{mark('columns')}", *lines[columns + 1 :]]
    refused["cell"] = [*lines[: columns + 9], f"0.1,{mark('cell')},0", *lines[columns + 10 :]]
    return stored, [
        (f"{mark(field).replace('/', '')}.csv", "\n".join(text).encode()) for field, text in refused.items()
    ]


@pytest.fixture(scope="module")
def attacked(logs, tmp_path_factory):
    folder = tmp_path_factory.mktemp("attacked")
    (folder / "lab.toml").write_text(PROFILE)
    labels = (mark("label"), "other")
    rows = [f"{label};{k * 0.001};{float(k > 3)};{k * k * 1e-6}" for label in labels for k in range(30)]
    (folder / "one.csv").write_text("\n".join(["trial;t;u;x", *rows]) + "\n")
    assert ingest([folder / "one.csv"], folder / "processed", profile=folder / "lab.toml").ingested == 1
    with serving(Settings(folder / "processed", folder / "reports", wait_s=240.0)) as client:
        yield client, *hostile(logs)


@pytest.mark.slow
def test_every_field_stays_text_on_every_page(attacked):
    client, stored, refused = attacked
    _, job = client.upload([*stored, *refused])
    assert (job["result"]["ingested"], len(job["result"]["quarantined"])) == (len(stored), len(refused))
    client.all_done()
    trials = client.get("trials?limit=100").content["items"]
    rows = read_trials(client.settings.processed, "bench", "1", ["label", "trial_id"]).to_pylist()
    labelled = next(row["trial_id"] for row in rows if row["label"] == mark("label"))
    trial, spare = [t["id"] for t in trials if t["device"] != "bench"][:2]
    device, experiment = mark("device"), mark("experiment")
    browser = Browser(client)
    names = [quote(folder_name(name), safe="") for name in (device, experiment)]
    pages = {"experiments/{}/{}": "/devices/{}/experiments/{}", f"trials/{trial}": f"/trials/{trial}"}
    for path, at in ((path.format(*names), at.format(*names)) for path, at in pages.items()):
        which = "notes" if path.startswith("experiments") else "trial notes"
        assert browser.do(at, "PUT", f"{path}/notes", text=mark(which)).status == 303
        assert browser.do(at, "PUT", f"{path}/tags", **{"tags,": mark("tags")}).status == 303
    for one, why in ((spare, "trial reason"), (labelled, "reason")):
        assert browser.do(f"/trials/{one}", "PUT", f"trials/{one}/exclusion", reason=mark(why)).status == 303
    for name in (names[0], "bench"):
        answer = browser.do(f"/devices/{name}", "POST", "comparisons", **{"criteria[]": "overshoot"})
        done = client.done(answer.headers["location"].rpartition("/")[2])
        assert (done["state"], done["problem"]) == ("done", None), name
    run = quote(f"{quote(device, safe='')}/{quote(experiment, safe='')}")
    plain = ("/", "/trials", "/jobs", "/quarantine", "/reports", "/upload")
    begin = (
        *(*plain, *(f"/trials/{one}" for one in (trial, spare, labelled)), f"/compare?runs={run}"),
        f"/trials?q={quote(mark('q'))}&device={quote(device)}",
        f"/compare?runs={quote(mark('runs'))}",
        f"/jobs/{quote(mark('job'), safe='')}",
    )
    told = ""
    for _ in range(2):  # the second time figures are drawn, and numbers computed
        told = walk(client, begin, {trial, spare, labelled})
        client.all_done()
    for field in KEPT:
        assert mark(field).replace("/", "") in told.replace("/", ""), field


def walk(client, begin, trials):
    """Follow all links, those of some trials among them; return the text of all pages."""
    left, seen, told = list(begin), set(), []
    while left:
        path = left.pop()
        if path in seen:
            continue
        seen.add(path)
        answer = client.get(path, **HTML)
        assert answer.status == 200 or (path in begin and answer.status < 500) or answer.status == 503, path
        if not answer.headers.get("content-type", "").startswith("text/html"):
            assert answer.headers.get("x-content-type-options") == "nosniff"
            continue
        page = Elements(answer.content.decode())
        assert page.wrong == [], path
        told.append("".join(page.text))
        for link in page.links:
            place = urlsplit(html.unescape(link)).path.split("/")
            of_other = place[1] == "trials" and len(place) == 3 and place[2] not in trials
            left += (
                []
                if of_other or (place[1] == "api" and place[-1] != "report")
                else [quote(link.partition("#")[0], safe="/?&=%:;")]
            )
    assert len(seen) > 20
    return "\n".join(told)
