"""Page of an identification: evidence, parameters, parts, walls, or why no device is identified."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from free_masses import MASS, T, written
from typer.testing import CliRunner

import pipeline
from pipeline.base.errors import ParameterError, UsageError
from pipeline.measured.identification.part_table import PARTS
from pipeline.measured.identification.recordings import Recording
from pipeline.measured.identification.replay import FreeRun, Replay
from pipeline.rendering.report.report_parts import take_apart
from pipeline.shell.cli import application
from pipeline.surface.free_run_residuals import Quartiles, Residuals, command_band, shown_replays, spectra_of

HOSTILE = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    random = np.random.default_rng(3)
    commands = (np.repeat(random.uniform(-4, 4, 8), 100) for _ in range(4))
    for number, command in enumerate(commands):
        written(folder / f"run{number}.csv", command, "# motion: translation\n", seed=number)
    return folder


@pytest.fixture(scope="module")
def found(logs):
    return pipeline.identify(logs)


@pytest.fixture(scope="module")
def page(found, tmp_path_factory):
    path = found.write_report(tmp_path_factory.mktemp("reports") / "deep" / "motor.html")
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def cells(page):
    return take_apart(page).cells


def test_parameters_have_value_interval_and_method(found, cells):
    mass = next(row for row in found.document["parameters"] if row["name"] == "mass")
    low, value, high = (float(cells[f"parameters/mass/{name}"]) for name in ("low", "value", "high"))
    assert low <= MASS <= high
    assert value == pytest.approx(mass["value"], rel=1e-3)
    assert "likelihood" in cells["parameters/mass/method"]


def test_every_part_has_a_decision_and_what_was_tried_its_gain(cells):
    decisions = {name: cells[f"parts/{name}/decision"] for name in ("friction", "stiffness", *PARTS)}
    assert decisions["stiffness"].startswith("rejected")
    assert decisions["load damping"] == "not tested: it requires a mode"
    for name in ("stiffness", "saturation", "gain by direction", "gain by size", "lag", "mode"):
        gain, required = (cells[f"parts/{name}/{column}"].replace("−", "-") for column in ("gain", "required"))
        assert float(gain) < float(required), name


def test_each_log_has_the_fit_of_a_device_without_it(found, cells):
    fits = {name: text for name, text in cells.items() if name.startswith("replay/") and name.endswith("/fit")}
    assert len(fits) == len(found.replay) == 4
    assert min(map(float, fits.values())) > 99


def test_the_page_shows_motion_residuals_spectrum_and_walls(page):
    assert page.count("<svg") == 3 + 4 + 1 + 1
    for words in ("smallest fit", "median fit", "largest fit", "by place", "by direction", "by command", "by time"):
        assert words in page
    text = page.replace("\N{NO-BREAK SPACE}", " ")
    assert "The middle 90 % of the power of the command is between" in text
    assert "Stable up to K =" in text


def test_the_page_is_one_file_without_scripts(page):
    assert "<script" not in page
    assert "http-equiv" in page
    assert page.count("url(") == page.count("url(#")


def test_a_parameter_that_is_not_identified_has_its_reason(tmp_path):
    log = written(tmp_path / "pushed.csv", np.full(400, 2.0))
    found = pipeline.identify(log)
    text = found.write_report(tmp_path / "page.html").read_text(encoding="utf-8")
    reasons = {row["reason"] for row in found.document["parameters"] if not row["told"]}
    assert reasons
    assert "No limit of walls is predicted" in text
    assert "Reasons for missing values" in text
    assert "not tested: the delay cannot be identified" in text


def test_logs_without_a_device_have_a_page_with_the_reason(tmp_path):
    log = written(tmp_path / "still.csv", np.zeros(400))
    page = tmp_path / "page.html"
    with pytest.raises(ParameterError, match="the command is 0"):
        pipeline.identify(log, report=page)
    text = page.read_text(encoding="utf-8")
    assert "No device identified" in text
    assert "The command is 0 in all rows" in text
    ended = CliRunner().invoke(application("identify"), ["identify", str(log), "--report", str(tmp_path / "cli.html")])
    assert isinstance(ended.exception, ParameterError)
    assert (tmp_path / "cli.html").read_text(encoding="utf-8") == text


def test_the_command_writes_page_and_document(logs, tmp_path):
    page = tmp_path / "motor.html"
    page.write_text("an earlier page", encoding="utf-8")
    result = CliRunner().invoke(application("identify"), ["identify", str(logs), "--report", str(page), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["trials"] == 4
    assert "Identification from" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("report", "more", "words"),
    [
        ("run0.csv", (), "ends with .html"),
        ("folder.html", (), "is a folder"),
        ("motor.html", ("--out", "motor.html"), "the device file of --out has the same name"),
    ],
)
def test_a_wrong_target_is_refused_before_the_work(logs, tmp_path, monkeypatch, report, more, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.html").mkdir()
    kept = written(tmp_path / "run0.csv", np.zeros(50)).read_bytes()
    result = CliRunner().invoke(application("identify"), ["identify", str(logs), "--report", report, *more])
    assert isinstance(result.exception, UsageError)
    assert words in str(result.exception)
    assert (tmp_path / "run0.csv").read_bytes() == kept
    assert not (tmp_path / "motor.html").exists()


def test_names_of_logs_are_text(found, tmp_path):
    document = found.document | {"refused": [{"path": HOSTILE, "reason": HOSTILE, "row": None}]}
    text = replace(found, document=document).write_report(tmp_path / "page.html").read_text(encoding="utf-8")
    assert "onerror=alert" in text
    assert HOSTILE not in text


def test_simulated_logs_are_marked(logs, page, tmp_path):
    log = (logs / "run0.csv").read_text(encoding="utf-8")
    (tmp_path / "log.csv").write_text("# origin: simulated\n" + log, encoding="utf-8")
    pipeline.identify(tmp_path / "log.csv", report=tmp_path / "page.html")
    assert "simulated" in (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "Logs are simulated" not in page


ROWS = 4096


def replayed(name, fit, residual=0.0, frequency=20.0):
    """A log of one free run: an oscillation of 1 m, of which the device misses the share ``residual``."""
    time = T * np.arange(ROWS)
    position = np.sin(2 * np.pi * frequency * time)
    run = FreeRun(time, np.sign(position), position, (1 - residual) * position)
    return Replay(name, fit, 0.0, 1, (run,))


def test_the_worst_the_median_and_the_best_log_are_shown():
    logs = [replayed(str(fit), fit) for fit in (70.0, 10.0, np.nan, 30.0, 90.0)]
    assert [each.log for each in shown_replays(logs)] == ["10.0", "30.0", "90.0"]
    assert [each.log for each in shown_replays(logs[:2])] == ["10.0", "70.0"]
    assert [each.log for each in shown_replays(logs[:1])] == ["70.0"]
    assert shown_replays([replayed("", np.nan)]) == []


def test_the_spectrum_contains_the_power_of_the_velocity_and_of_its_residual():
    spectra = spectra_of([replayed("a", 90.0, residual=0.1)])
    width = spectra.frequency[1] - spectra.frequency[0]
    power = (2 * np.pi * 20.0) ** 2 / 2
    assert spectra.velocity.sum() * width == pytest.approx(power, rel=0.02)
    assert spectra.residual.sum() * width == pytest.approx(0.01 * power, rel=0.02)
    assert spectra.frequency[np.argmax(spectra.velocity)] == pytest.approx(20.0, abs=width)


def test_free_runs_that_are_too_short_have_no_spectrum():
    short = FreeRun(*(np.arange(8.0) for _ in range(4)))
    assert spectra_of([Replay("short", 50.0, 0.0, 1, (short,))]) is None


def test_the_band_of_the_command_contains_ninety_percent_of_its_power():
    time = T * np.arange(ROWS)
    weights = {5.0: 1.0, 40.0: 3.0, 200.0: 1.0}
    command = 7.0 + sum(w * np.sin(2 * np.pi * f * time) for f, w in weights.items())
    low, high = command_band([Recording("a", time, command, time, T)])
    assert low == pytest.approx(5.0, abs=1.0)
    assert high == pytest.approx(200.0, abs=1.0)
    steady = Recording("a", time, np.full(ROWS, 7.0), time, T)
    assert command_band([steady]) is None


def test_groups_have_their_quartiles_and_small_groups_are_left_out():
    values = np.concatenate([np.arange(101.0), [1e6]])
    at = np.concatenate([np.zeros(101), [1.0]])
    groups = Quartiles.of(values, at, (0.0, 1.0))
    assert (groups.low, groups.median, groups.high) == (25.0, 50.0, 75.0)


def test_residuals_are_measured_less_simulated():
    residuals = Residuals.of([replayed("a", 90.0, residual=0.25)])
    assert residuals.residual == pytest.approx(0.25 * residuals.velocity)
    assert len(residuals.time) == ROWS - 2


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_each_screen_without_complaint_or_request(browser, found, tmp_path, scheme):
    paths = [found.write_report(tmp_path / "motor.html"), tmp_path / "refused.html"]
    with pytest.raises(ParameterError):
        pipeline.identify(written(tmp_path / f"{'long' * 20}.csv", np.zeros(400)), report=paths[1])
    for path in paths:
        for width in (1440, 390, 320):
            context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
            opened, complaints, requests = context.new_page(), [], []
            opened.on("console", lambda message, into=complaints: into.append(message.text))
            opened.on("pageerror", lambda error, into=complaints: into.append(str(error)))
            opened.on("request", lambda request, into=requests: into.append(request.url))
            opened.goto(path.as_uri())
            assert opened.evaluate("document.documentElement.scrollWidth") <= width
            assert (complaints, requests) == ([], [path.as_uri()])
            context.close()
