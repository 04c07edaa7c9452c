"""The report in a real browser: it needs no network, works by mouse and keyboard, prints, and is accessible.

Needs Chromium (`apt-get install chromium`) and Playwright (`pip install -e '.[dev]'`); skipped where one is missing.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from labs import Outcome
from report_data import HOSTILE, report_data
from trial_pages import trial_page

from pipeline.comparison.against import against_experiments
from pipeline.rendering.report import report, report_against
from pipeline.shell.report_index import write_index
from pipeline.surface.log_picture import look

pytestmark = [pytest.mark.slow, pytest.mark.browser]
WIDTHS = (1440, 390, 320)
SCHEMES = ("light", "dark")
OPEN_ALL = "document.querySelectorAll('details').forEach((part) => { part.open = true; })"
DRAWN = "document.querySelector('#trial-plot canvas') !== null"


@pytest.fixture(scope="module")
def measured(lwr_outcome: Outcome) -> Path:
    """Report of a simulated course: two delays, some 200 trials."""
    assert lwr_outcome.report is not None
    return lwr_outcome.report


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Report in which every name tries to be markup."""
    path: Path = tmp_path_factory.mktemp("hostile") / "hostile.html"
    data = report_data(full=False, hostile=True)
    data = replace(data, trials=trial_page((HOSTILE, '"><img src=x onerror=alert(1)>'), HOSTILE))
    report.write(data, path)
    return path


class Opened:
    """A page in the browser, with all that it reported and asked for."""

    def __init__(self, browser: Any, path: Path, *, width: int = 1440, wait: bool = True, **options: Any) -> None:
        self.context = browser.new_context(viewport={"width": width, "height": 900}, **options)
        self.page = self.context.new_page()
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda message: self.complaints.append(f"{message.type}: {message.text}"))
        self.page.on("pageerror", lambda error: self.complaints.append(f"error: {error}"))
        self.page.on("dialog", lambda dialog: (self.complaints.append(dialog.message), dialog.dismiss()))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        if wait:
            until(self.page, DRAWN)

    def __enter__(self) -> Any:
        return self.page

    def __exit__(self, *_: object) -> None:
        self.context.close()


@pytest.fixture
def page(browser: Any, measured: Path) -> Iterator[Any]:
    """The report, opened on a wide screen."""
    with Opened(browser, measured) as opened:
        yield opened


def until(page: Any, expression: str) -> None:
    """Wait until an expression is true: Playwright's own waiting evaluates text, which the page's policy forbids."""
    for _ in range(500):
        if page.evaluate(expression):
            return
        page.wait_for_timeout(20)
    raise AssertionError(f"not within 10 s: {expression}")


def title(page: Any) -> str:
    return str(page.locator("#trial-title").inner_text())


def status(page: Any) -> str:
    return str(page.locator("#plane-status").inner_text())


@pytest.mark.parametrize("width", WIDTHS)
def test_the_index_has_a_margin_and_sorts(browser: Any, tmp_path: Path, width: int) -> None:
    for name in "bac":
        data = report_data(full=False)
        data = replace(data, result=data.result.model_copy(update={"device": name, "title": name}))
        report.write(data, tmp_path / f"{name}.html")
        (tmp_path / f"{name}.json").write_text(data.result.model_dump_json())
    path = write_index(tmp_path)
    assert path is not None
    with Opened(browser, path, width=width, wait=False) as page:
        assert page.evaluate("document.querySelector('table').getBoundingClientRect().left") >= 16
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        if width == WIDTHS[0]:
            head = page.locator("button.sort").first
            head.click()
            head.click()
            assert page.locator("tbody th a").all_inner_texts() == ["c", "b", "a"]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_opens_without_complaint_and_without_any_request(browser: Any, measured: Path, scheme: str) -> None:
    opened = Opened(browser, measured, color_scheme=scheme)
    with opened as page:
        page.mouse.wheel(0, 20_000)
        page.emulate_media(media="print")
        assert opened.complaints == []
        assert opened.requests == [measured.as_uri()]


def test_hostile_names_are_shown_and_not_obeyed(browser: Any, hostile: Path) -> None:
    opened = Opened(browser, hostile)
    with opened as page:
        assert HOSTILE in title(page)
        assert HOSTILE in page.locator("#trial-facts").inner_text()
        page.locator("#choose-experiment").select_option("1")
        until(page, "document.getElementById('trial-title').textContent.includes('onerror')")
        assert page.locator("img").count() == 0
        assert opened.complaints == []
        assert opened.requests == [hostile.as_uri()]


def test_policy_stops_a_script_that_is_not_the_pages_own(browser: Any, hostile: Path) -> None:
    with Opened(browser, hostile) as page:
        page.evaluate(
            "() => { const s = document.createElement('script');"
            " s.textContent = 'window.owned = 1'; document.body.append(s);"
            " const i = document.createElement('div'); i.setAttribute('onclick', 'window.owned = 2');"
            " document.body.append(i); i.click(); }"
        )
        assert page.evaluate("window.owned") is None


def test_pointing_tells_of_a_trial_and_clicking_shows_its_response(page: Any) -> None:
    plane = page.locator("#plane")
    plane.scroll_into_view_if_needed()
    spot = page.evaluate("""() => {
        const plane = explorer.plane, row = [...explorer.shown.byRow.keys()][3];
        const box = plane.canvas.getBoundingClientRect(), { k, b } = explorer.shown;
        return { x: plane.x(k[row]), y: plane.y(b[row]), k: k[row], b: b[row] };
    }""")
    plane.hover(position={"x": spot["x"], "y": spot["y"]})
    assert status(page).startswith(f"K = {spot['k']:g} Nm/rad, B = {spot['b']:g} Nms/rad: ")
    assert "settling time, 2 % band [samples]" in status(page)
    before = title(page)
    plane.click(position={"x": spot["x"], "y": spot["y"]})
    assert title(page) != before
    assert f"K = {spot['k']:g} Nm/rad" in title(page)
    assert page.locator("#trial-plot canvas").bounding_box()["height"] > 200
    facts = page.locator("#trial-facts").inner_text()
    for name in ("verdict and outcome", "evidence", "fitted model", "m = ", "energy cost, w = 2"):
        assert name in facts
    assert re.search(r"#trial-0-\d+$", page.url)


def test_choosing_criterion_and_experiment_changes_plane_key_and_response(browser: Any, measured: Path) -> None:
    picture = "document.getElementById('plane').toDataURL()"
    with Opened(browser, measured) as page:
        first = page.evaluate(picture)
        page.locator("#choose-criterion").select_option("verdict")
        assert "undecided" in page.locator("#plane-key").inner_text()
        second = page.evaluate(picture)
        before = title(page)
        page.locator("#choose-experiment").select_option("1")
        until(page, f"document.getElementById('trial-title').textContent !== {before!r}")
        assert "delay-4" in title(page)
        assert len({first, second, page.evaluate(picture)}) == 3


def test_figures_of_the_scripts_follow_the_colour_scheme(browser: Any, measured: Path) -> None:
    pictures = "[...document.querySelectorAll('#explorer canvas')].map((canvas) => canvas.toDataURL())"
    with Opened(browser, measured) as page:
        assert page.evaluate(f"(window.light = {pictures}).length") == 2
        page.emulate_media(color_scheme="dark")
        until(page, f"{pictures}.every((picture, index) => picture !== window.light[index])")


def test_keyboard_reaches_every_control_and_moves_in_the_plane(page: Any) -> None:
    stops = "a[href], button, select, input, summary, [tabindex='0']"
    wanted = page.evaluate(
        "(stops) => [...document.querySelectorAll(stops)].filter((e) => e.checkVisibility())"
        ".map((e, n) => { e.dataset.stop = n; return n; })",
        stops,
    )
    reached = set()
    for _ in range(len(wanted) + 5):
        page.keyboard.press("Tab")
        stop = page.evaluate("document.activeElement.dataset.stop")
        if stop is not None:
            reached.add(int(stop))
    assert sorted(set(wanted) - reached) == []
    page.locator("#plane").focus()
    told = [status(page)]
    for key in ("ArrowRight", "ArrowDown", "ArrowDown", "End", "Home"):
        page.keyboard.press(key)
        told.append(status(page))
    assert len(set(told)) >= 5
    before = title(page)
    page.keyboard.press("End")
    page.keyboard.press("Enter")
    assert title(page) != before
    assert status(page).split(":")[0] in title(page)


def test_skip_link_comes_first_and_leads_past_the_navigation(page: Any) -> None:
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.evaluate("document.activeElement.getBoundingClientRect().left") >= 0
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('main') !== null")


def test_keyboard_reaches_the_trials_within_ten_stops(page: Any) -> None:
    """The second link of the page leads to them; every control of the explorer and the search follow."""
    for _ in range(2):
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.textContent") == "Skip to the trials"
    page.keyboard.press("Enter")
    reached = []
    for _ in range(8):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id"))
    assert {"choose-experiment", "choose-criterion", "plane", "trial-range", "runs-search"} <= set(reached), reached


def test_pointing_at_a_figure_tells_what_the_drawing_shows(page: Any, measured: Path) -> None:
    svg = page.locator("#boundaries-answer svg")
    place = page.evaluate("""async () => {
        const [{ axes: [{ box, x, y, series }] }] = (await numbersOfFigures())["boundaries-answer"];
        const [label, k, b] = series.find(([label]) => label === "measured limit");
        const at = (value, ends, from, to) => from + (value - ends[0]) / (ends[1] - ends[0]) * (to - from);
        const middle = Math.floor(k.length / 2), view = document.querySelector("#boundaries-answer svg");
        const factor = view.getBoundingClientRect().width / view.viewBox.baseVal.width;
        return { k: k[middle], b: b[middle], x: factor * at(k[middle], x, box[0], box[2]),
                 y: factor * at(b[middle], y, box[3], box[1]) };
    }""")
    svg.hover(position={"x": place["x"], "y": place["y"]})
    until(page, "!document.querySelector('.tip').hidden")
    told = page.locator(".tip").inner_text()
    assert told.endswith(f"K = {place['k']:g} Nm/rad, B = {place['b']:g} Nms/rad")
    page.mouse.move(5, 5)
    until(page, "document.querySelector('.tip').hidden")


def test_a_figure_is_saved_as_csv_with_its_trials_and_as_svg_of_its_own(page: Any) -> None:
    figure = page.locator(".viewer figure:visible")
    saved = {}
    for name in ("CSV", "SVG"):
        with page.expect_download() as download:
            figure.locator(".tools button", has_text=name).click()
        saved[name] = Path(download.value.path()).read_text(encoding="utf-8")
    rows = list(csv.DictReader(io.StringIO(saved["CSV"])))
    trials = [row for row in rows if row["series"].startswith("trial: ")]
    assert len(trials) > 50
    assert {"least cost", "optimum"} <= {row["series"] for row in rows}
    drawing = ElementTree.fromstring(saved["SVG"])
    assert drawing.tag == "{http://www.w3.org/2000/svg}svg"
    assert "var(" not in saved["SVG"]


def test_number_in_a_table_leads_to_its_trial(page: Any) -> None:
    link = page.locator("[data-row='optima/delay-4/overshoot'] [data-cell='stiffness'] a")
    page.evaluate(OPEN_ALL)
    stiffness = link.inner_text()
    link.click()
    until(page, "document.activeElement.id === 'trial-title'")
    assert title(page).startswith(f"Experiment delay-4: K = {stiffness} Nm/rad")
    page.go_back()
    until(page, "!location.hash.includes('trial')")


def test_plane_opens_on_the_first_tables_criterion_and_takes_that_of_a_number(browser: Any, measured: Path) -> None:
    chosen = "document.getElementById('choose-criterion').selectedOptions[0].textContent.replaceAll('\u00a0', ' ')"
    with Opened(browser, measured) as page:
        assert page.evaluate(chosen).startswith("settling time, 2 %")
        page.evaluate(OPEN_ALL)
        page.locator("[data-row='optima/delay-4/overshoot'] [data-cell='stiffness'] a").click()
        until(page, f"{chosen}.startsWith('overshoot')")
        assert "overshoot" in status(page)


def test_search_takes_numbers_as_numbers(page: Any) -> None:

    def found(text: str) -> list[list[str]]:
        page.fill("#runs-search", text)
        return [row.split("\t") for row in page.locator("#runs-table tbody tr").all_inner_texts()]

    stiffness, damping = found("stable")[20][1:3]
    some = found(f"K={stiffness}")
    assert {row[1] for row in some} == {stiffness}
    assert [damping] == [row[2] for row in found(f"k = {stiffness} B={damping}")][:1]
    assert all(stiffness in row[1:3] for row in found(stiffness))
    assert all(row[1] == stiffness[:-1] for row in found(f"K={stiffness[:-1]}")), "no part of a number"
    assert {row[3] for row in found("unstable")} == {"unstable"}


def test_address_of_a_trial_opens_it_and_a_wrong_one_does_no_harm(page: Any, measured: Path, tmp_path: Path) -> None:
    page.goto(measured.as_uri() + "#trial-1-5")
    page.reload()
    until(page, DRAWN)
    assert "delay-4" in title(page)
    for wrong in ("#trial-9-0", "#trial-0-99999", "#trial-x"):
        page.evaluate(f"location.hash = '{wrong}'")
        page.wait_for_timeout(50)
    assert "K = " in title(page)


def test_trial_without_response_says_how_to_get_it(browser: Any, hostile: Path) -> None:
    with Opened(browser, hostile) as page:
        page.evaluate("location.hash = '#trial-0-1'")
        until(page, "document.getElementById('trial-alternative').textContent.includes('not in this page')")
        assert "--full" in page.locator("#sec-trials").inner_text()
        assert page.locator("#trial-plot canvas").count() == 0


def test_tables_sort_by_number_with_missing_values_last_and_back(page: Any) -> None:
    page.evaluate(OPEN_ALL)
    cells = "[data-row^='boundary/delay-2/'] [data-cell='unstable']"
    heads = page.locator(f"table:has({cells}) thead tr:last-child th")
    texts = page.locator(cells)

    def column() -> list[str]:
        return [text.strip() for text in texts.all_inner_texts()]

    original = column()
    button = heads.nth(2).locator("button")
    button.focus()
    page.keyboard.press("Enter")
    assert heads.nth(2).get_attribute("aria-sort") == "ascending"
    rising = [text for text in column() if not text.startswith("–")]
    assert [float(text) for text in rising] == sorted(float(text) for text in rising)
    assert rising == column()[: len(rising)]
    button.click()
    assert heads.nth(2).get_attribute("aria-sort") == "descending"
    assert column()[: len(rising)] == rising[::-1] != rising
    button.click()
    assert heads.nth(2).get_attribute("aria-sort") is None
    assert column() == original


def test_long_table_filters_and_says_how_many_rows_are_left(page: Any) -> None:
    page.evaluate(OPEN_ALL)
    table = page.locator("table:has([data-row^='stages/'])")
    filter_ = page.locator(".scroll:has([data-row^='stages/'])").locator("xpath=preceding-sibling::*[1]")
    rows = table.locator("tbody tr:not(.blockhead):visible")
    everything = rows.count()
    filter_.locator("input").fill("delay-4: overshoot")
    assert rows.count() == 1
    assert filter_.locator("[role=status]").inner_text() == f"1 of {everything} rows"
    filter_.locator("input").fill("")
    assert rows.count() == everything


def test_without_scripts_all_results_are_there(browser: Any, measured: Path) -> None:
    with Opened(browser, measured, wait=False, java_script_enabled=False) as page:
        assert page.locator("#explorer").is_hidden()
        assert page.locator(".unscripted").is_visible()
        shown = page.locator("figure:not(details:not([open]) figure) svg").all()
        assert len(shown) > 5
        for figure in shown:
            assert figure.bounding_box()["height"] > 50
        assert page.locator("table:visible").count() > 2


@pytest.mark.parametrize("scripts", [True, False], ids=["scripts", "no-scripts"])
def test_print_shows_what_is_open_with_heads_on_each_page(browser: Any, measured: Path, scripts: bool) -> None:
    with Opened(browser, measured, wait=scripts, java_script_enabled=scripts) as page:
        page.emulate_media(media="print")
        page.set_viewport_size({"width": 680, "height": 960})  # what the margins leave of A4
        # one part wider than its paper, and the browser shrinks the whole report
        ends = "[...document.querySelectorAll('main > * *')].map((e) => e.getBoundingClientRect().right)"
        assert max(page.evaluate(ends)) <= 681
        opened = ":not(details:not([open]):not(.printed) *):not([hidden] *):not(.on-screen *)"
        figures, tables = page.locator(f"figure svg{opened}").all(), page.locator(f"table.cells{opened}").all()
        assert len(figures) > 5
        assert len(tables) > 4
        for part in (*figures, *tables):
            box = part.bounding_box()
            assert box is not None
            assert box["height"] > 20
            assert box["width"] > 20
        for hidden in ("#sec-trials", "nav", ".skip", ".viewer .controls"):
            assert page.locator(hidden).first.is_hidden()
        # the answer, its figure included, is on the first sheet
        assert page.locator("#boundaries-answer").bounding_box()["y"] + 200 < 960
        for closed in page.locator("details:not([open]):not(.printed)").all():
            assert closed.is_hidden()
        repeated = (
            "[...document.querySelectorAll('thead')].every((e) => getComputedStyle(e).display === 'table-header-group')"
        )
        assert page.evaluate(repeated)
        # a browser draws no button in a repeated head
        displayed = "[...document.querySelectorAll('thead button')].map((e) => getComputedStyle(e).display)"
        assert set(page.evaluate(displayed)) == ({"contents"} if scripts else set())
        # each criterion has its cost map on paper, and each experiment its answers
        maps = page.locator(".viewer figure[data-show^=costs]").all()
        assert len(maps) > 3
        assert all(each.is_visible() for each in maps)
        for each in page.locator("details.other .answers").all():
            assert each.bounding_box()["height"] > 100
        whole = "[...document.querySelectorAll('figure, .warnings')].map((e) => getComputedStyle(e).breakInside)"
        assert set(page.evaluate(whole)) == {"avoid"}
        pdf = page.pdf(prefer_css_page_size=True)
    sizes = set(re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf))
    assert {(round(float(w)), round(float(h))) for w, h in sizes} == {(595, 842)}  # A4 in points, upright
    assert 4 < len(re.findall(rb"/Type /Page\b", pdf)) <= 10


def test_one_experiment_prints_on_six_sheets(browser: Any, lwr: Any, falcon_outcome: Outcome, tmp_path: Path) -> None:
    alone = lwr.compare(experiments=["delay-2"], report=tmp_path / "lwr.html").report
    for path in (falcon_outcome.report, alone):
        with Opened(browser, path) as page:
            pdf = page.pdf(prefer_css_page_size=True)
            page.emulate_media(media="print")
            kept = "[...document.querySelectorAll('tbody tr:nth-child(2)')].map((e) => getComputedStyle(e).breakBefore)"
            assert set(page.evaluate(kept)) == {"avoid"}, "no heading of a table alone at the end of a sheet"
        assert 3 < len(re.findall(rb"/Type /Page\b", pdf)) <= 6, path


def test_all_five_answers_are_above_the_fold(browser: Any, sweep: Any, falcon_outcome: Outcome, tmp_path: Path) -> None:
    """A common laptop shows 1440 by 1000 pixels: with one experiment and with seven, nothing has to be scrolled."""
    seven = sweep.compare(report=tmp_path / "sweep.html").report
    for path in (falcon_outcome.report, seven):
        with Opened(browser, path) as page:
            page.set_viewport_size({"width": 1440, "height": 1000})
            ends = page.evaluate(
                "[...document.querySelector('.answers').children].map((e) => e.getBoundingClientRect().bottom)"
            )
            assert len(ends) == 10
            assert max(ends) <= 1000, path
            assert not page.locator(".short").is_visible(), "the answers themselves are"
        with Opened(browser, path, width=390) as page:
            assert page.locator(".short li").count() == 5
            box = page.locator(".short").bounding_box()
            assert box["y"] + box["height"] <= 844, "the five answers are in the first view of a phone"
            assert box["x"] + box["width"] <= 390
    with Opened(browser, seven, width=390) as page:
        shown = page.locator(".overview thead tr:last-child th").all()[:4]
        assert [each.inner_text().split()[0] for each in shown] == ["experiment", "K", "B", "boundary"]
        assert all(each.bounding_box()["x"] + each.bounding_box()["width"] <= 390 for each in shown)
        hint = "getComputedStyle(document.querySelector('.overview'), '::before').content"
        assert "Scrolls sideways" in page.evaluate(hint)
        # scrolled sideways, a row keeps its name, and its caption stays in the page
        page.evaluate("document.querySelector('.overview').scrollLeft = 250")
        assert page.locator(".overview tbody tr:first-child > :first-child").bounding_box()["x"] >= 0
        caption = page.locator(".overview caption").bounding_box()
        assert caption["x"] >= 0
        assert caption["x"] + caption["width"] <= 390
        assert page.locator(".up").is_visible()


def test_one_figure_of_costs_is_shown_and_chosen_by_lists_and_address(browser: Any, measured: Path) -> None:
    with Opened(browser, measured) as page:
        shown = page.locator(".viewer figure:visible")
        assert shown.count() == 1
        first = shown.get_attribute("id")
        page.select_option("#viewer-criterion", "overshoot")
        assert shown.count() == 1
        assert shown.get_attribute("data-criterion") == "overshoot"
        assert page.url.endswith(f"#{shown.get_attribute('id')}")
        page.select_option("#viewer-show", "measured against theory, all experiments")
        assert shown.get_attribute("id") == "residual-overshoot"
        page.evaluate(f"location.hash = '#{first}'")
        until(page, f"!document.getElementById('{first}').hidden")
        assert page.locator("#viewer-criterion").input_value() == shown.get_attribute("data-criterion")
    with Opened(browser, measured, wait=False, java_script_enabled=False) as page:
        assert page.locator(".viewer figure:visible").count() == 1
        page.locator(".viewer summary").click()
        assert page.locator(".viewer figure:visible").count() > 5


def test_table_of_trials_filters_sorts_and_compares_and_its_address_opens_it_again(page: Any) -> None:
    count = page.locator("#runs-count")
    total = int(count.inner_text().split()[2])
    page.select_option("#runs-verdict", "stable")
    stable = int(count.inner_text().split()[0])
    assert 0 < stable < total
    page.fill("#runs-search", "settled")
    assert int(count.inner_text().split()[0]) <= stable
    page.locator("#runs-table button.sort").nth(5).click()
    assert page.locator("#runs-table th[aria-sort=ascending]").count() == 1
    costs = page.locator("#runs-table tbody td:nth-child(7)").all_inner_texts()
    known = [float(text) for text in costs if re.fullmatch(r"[\d.]+", text)]
    assert len(known) > 10
    assert known == sorted(known)
    boxes = page.locator("#runs-table input[type=checkbox]")
    assert boxes.count() > 7
    for number in range(6):
        boxes.nth(number).press("Space")
    assert boxes.nth(6).is_disabled(), "six at most"
    assert page.locator("#runs-key li").count() == 6
    assert page.locator("#runs-plot canvas").is_visible()
    address, told = page.url, page.locator("#runs-key").inner_text()
    page.goto("about:blank")
    page.goto(address)
    until(page, DRAWN)
    until(page, "document.querySelectorAll('#runs-key li').length === 6")
    assert page.locator("#runs-key").inner_text() == told
    assert page.locator("#runs-verdict").input_value() == "stable"
    page.click("#runs-clear")
    assert page.locator("#runs-plot").is_hidden()


def test_the_table_of_trials_fills_the_page_and_gives_reasons(page: Any) -> None:
    rows = [row.split("\t") for row in page.locator("#runs-table tbody tr").all_inner_texts()]
    places = [(float(row[2].replace("−", "-")), float(row[1])) for row in rows]
    assert len(places) == 100
    assert places == sorted(places), "by damping, then by stiffness"
    assert all("–" not in row[5:] for row in rows)
    unstable = [row for row in rows if row[3] == "unstable"]
    assert ["unstable: no cost"] in [row[5:] for row in unstable], "a reason of all costs is given once"
    assert all(re.search("[a-z]{3}", row[5]) for row in unstable), "a reason in words"
    assert page.locator(".runs-scroll").bounding_box()["height"] > 600


def test_wrong_addresses_of_the_table_do_no_harm(browser: Any, measured: Path) -> None:
    for wrong in ("#runs-99", "#runs-0-99999?sort=77&verdict=none", "#runs-0-1-1-1-1-1-1-1-1"):
        opened = Opened(browser, measured)
        with opened as page:
            page.goto(measured.as_uri() + wrong)
            page.reload()
            until(page, DRAWN)
            assert opened.complaints == []


def test_contents_stay_in_sight_on_a_wide_screen(page: Any) -> None:
    page.locator("#sec-experiments").scroll_into_view_if_needed()
    box = page.locator("nav.contents").bounding_box()
    assert 0 <= box["y"] < 100


def test_nothing_moves_while_the_page_opens(page: Any) -> None:
    seen = "new Promise((done) => new PerformanceObserver((list) => done(list.getEntries().map((e) => e.value)))"
    shifts = page.evaluate(
        f"Promise.race([{seen}.observe({{type: 'layout-shift', buffered: true}})), "
        "new Promise((done) => setTimeout(() => done([]), 500))])"
    )
    assert sum(shifts) < 0.1


@pytest.mark.sampled
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_axe_finds_nothing_serious(browser: Any, measured: Path, width: int, scheme: str) -> None:
    with Opened(browser, measured, width=width, color_scheme=scheme) as page:
        assert faults_by_axe(page) == []


def faults_by_axe(page: Any) -> list[str]:
    """Findings of axe-core in a page with all its parts unfolded."""
    axe = Path(pytest.importorskip("axe_playwright_python").__file__).with_name("axe.min.js")
    page.evaluate(OPEN_ALL)
    page.evaluate(axe.read_text(encoding="utf-8"))
    tags = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"]
    found = page.evaluate("(tags) => axe.run({ runOnly: tags, resultTypes: ['violations'] })", tags)
    assert len(found["passes"]) > 20
    return [
        f"{rule['impact']} {rule['id']}: {node['target']} {node.get('failureSummary', '')}"
        for rule in found["violations"]
        for node in rule["nodes"][:3]
    ]


@pytest.mark.parametrize("width", [320, 390, 768])
def test_no_sideways_scrolling_on_narrow_screens(browser: Any, measured: Path, width: int) -> None:
    with Opened(browser, measured, width=width) as page:
        page.evaluate(OPEN_ALL)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.locator("#plane").bounding_box()["width"] <= width


def test_no_number_at_the_plane_is_cut(browser: Any, measured: Path) -> None:
    """The last number of the stiffness axis may stand at the very edge of the canvas."""
    with Opened(browser, measured, width=390) as page:
        page.evaluate("""() => {
          window.cut = [];
          const real = CanvasRenderingContext2D.prototype.fillText;
          CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
            const half = this.measureText(text).width / 2;
            if (this.canvas.id === "plane" && this.textAlign === "center" && this.getTransform().b === 0
                && x + half > this.canvas.clientWidth + 0.5) window.cut.push(text);
            real.call(this, text, x, y);
          };
          const plane = document.getElementById("plane");
          plane.focus();
        }""")
        # the axis ends 4 % beyond the stiffest trial: make that the round number that ends it
        page.evaluate("explorer.plane.kEnds = [0, 10000 * (1 + 1e-6)]")
        page.keyboard.press("ArrowRight")
        page.wait_for_timeout(100)
        assert page.evaluate("window.cut") == []


def test_the_page_of_two_experiments_has_the_layout_of_a_report(browser: Any, lwr: Any, tmp_path: Path) -> None:
    page_of_pair = against_experiments(lwr.processed, ("lwr", "delay-2"), ("lwr", "delay-4"), ("overshoot",))
    report_against.write(page_of_pair, tmp_path / "pair.html")
    for width, scheme in product(WIDTHS, SCHEMES):
        opened = Opened(browser, tmp_path / "pair.html", width=width, wait=False, color_scheme=scheme)
        with opened as page:
            assert faults_by_axe(page) == []
            assert page.evaluate("document.documentElement.scrollWidth") == width
            header, section = (page.locator(part).bounding_box() for part in ("h1", "#main section"))
            contents = page.locator("nav.contents").bounding_box()
            assert header["x"] >= 20
            assert section["x"] >= contents["x"] + (contents["width"] if width == WIDTHS[0] else 0)
            assert opened.complaints == []


def test_a_picture_of_a_log_has_one_margin(browser: Any, tmp_path: Path) -> None:
    log = tmp_path / "a.csv"
    log.write_text("n,x\n" + "".join(f"{row},{row % 7}.5\n" for row in range(60)), encoding="utf-8")
    look(log).write(tmp_path / "look.html")
    for width in WIDTHS:
        opened = browser.new_page(viewport={"width": width, "height": 900})
        opened.goto((tmp_path / "look.html").as_uri())
        parts = "['h1', 'main p', 'h3', 'figcaption', 'footer p']"
        found = opened.evaluate(f"{parts}.map(part => document.querySelector(part).getBoundingClientRect().x)")
        assert len(set(found)) == 1
        assert found[0] >= 20
        assert opened.evaluate("document.documentElement.scrollWidth") == width
        opened.close()
