"""Pages of the service in a browser: narrow and wide, light and dark, by the keyboard alone, without script errors."""

from time import monotonic, process_time

import pytest

from pipeline.service.results import DocumentRequest
from pipeline.service.results import trials as draw_trials

pytestmark = [pytest.mark.slow, pytest.mark.browser]

WIDTHS = (320, 390, 1440)
PATHS = ("/", "/devices/falcon", "/devices/falcon/file", "/devices/falcon/experiments/1", "/trials", "/jobs", "/upload",
         "/quarantine", "/compare?runs=falcon/1", "/plan?run=falcon/1", "/theory", "/reports", "/audit",
         "/api")  # fmt: skip


BEYOND = """[...document.querySelectorAll('main *')].filter((e) => !e.closest('.scroll') || e.matches('.scroll'))
  .filter((e) => e.getBoundingClientRect().right > document.documentElement.clientWidth + 1)
  .map((e) => `${e.tagName}.${e.getAttribute('class') || ''}`).slice(0, 8)"""
"""Elements that end beyond the right edge of the page, those in a part that scrolls left out."""

LEFT = """name => { const one = document.querySelector(name);
  return one.getBoundingClientRect().left + parseFloat(getComputedStyle(one).paddingLeft); }"""
"""Left edge of the text of an element."""


@pytest.fixture
def trial(served):
    found = served.get("trials?limit=1&verdict=stable&sort=-stiffness").content["items"][0]["id"]
    served.get(f"/trials/{found}", Accept="text/html")
    served.all_done()
    return f"/trials/{found}"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_fit_their_width_without_errors_and_findings(chromium, served, trial, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    tab = chromium.new_page(color_scheme=scheme)
    complaints, too_wide, apart, violations = [], [], [], []
    tab.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    job = served.get("jobs?limit=1").content["items"][0]["id"]
    for path in (*PATHS, "/login", trial, f"/overlay?trial={trial.rpartition('/')[2]}", f"/jobs/{job}"):
        tab.goto(f"http://127.0.0.1:{served.port}{path}")
        for width in WIDTHS:
            tab.set_viewport_size({"width": width, "height": 900})
            if tab.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth") > 0:
                too_wide.append((path, width, tab.evaluate(BEYOND)))
            edges = [tab.evaluate(LEFT, name) for name in ("h1", "main")]
            if not edges[0] == edges[1] >= 10:
                apart.append((path, width, edges))
            violations += [
                (path, width, each["id"], [node["target"] for node in each["nodes"]][:3])
                for each in axe.run(tab).response["violations"]
            ]
    assert (too_wide, apart, violations, complaints) == ([], [], [], [])
    tab.close()


@pytest.mark.parametrize("path", PATHS)
def test_every_control_is_reached_by_the_keyboard_alone(chromium, served, path):
    tab = chromium.new_page()
    tab.goto(f"http://127.0.0.1:{served.port}{path}")
    wanted = tab.evaluate(
        "[...document.querySelectorAll('a[href], button, select, input, textarea, summary')]"
        ".filter((e) => e.checkVisibility() && !e.disabled && e.type !== 'hidden' && e.tabIndex >= 0)"
        ".map((e, n) => { e.dataset.stop = n; return n; })"
    )
    reached = set()
    for _ in range(len(wanted) + 40):
        tab.keyboard.press("Tab")
        stop = tab.evaluate("document.activeElement.dataset.stop")
        if stop is not None:
            reached.add(int(stop))
    assert len(wanted) > 5
    assert sorted(set(wanted) - reached) == []
    tab.close()


def test_a_table_that_is_wider_than_its_page_says_that_it_scrolls(chromium, served):
    tab = chromium.new_page(viewport={"width": 390, "height": 900})
    tab.goto(f"http://127.0.0.1:{served.port}/trials")
    tab.locator("table").first.wait_for()
    found = tab.evaluate(
        "[...document.querySelectorAll('.scroll')].filter((e) => e.checkVisibility())"
        ".map((e) => [e.scrollWidth > e.clientWidth + 1, getComputedStyle(e, '::before').content.includes('Scrolls')])"
    )
    assert [True, True] in found
    assert all(wide == says for wide, says in found)
    tab.set_viewport_size({"width": 2400, "height": 900})
    assert tab.evaluate("getComputedStyle(document.querySelector('.scroll'), '::before').content") == "none"
    tab.close()


@pytest.mark.parametrize("path", ["/trials", "/devices/falcon/experiments/1"])
def test_stiffness_damping_and_verdict_are_in_sight_on_a_phone(chromium, served, path):
    tab = chromium.new_page(viewport={"width": 390, "height": 900})
    tab.goto(f"http://127.0.0.1:{served.port}{path}")
    table = tab.locator("table", has=tab.locator("input[name=trial]"))
    table.wait_for()
    heads = table.locator("thead th").all_inner_texts()
    assert [head.split()[0] for head in heads[1:4]] == ["K", "B", "Verdict"]
    box = table.locator("thead th").nth(3).bounding_box()
    assert box["x"] + box["width"] <= 390
    tab.close()


def test_a_trial_is_looked_at_by_the_keyboard_alone(chromium, served, trial):
    tab = chromium.new_page()
    tab.goto(f"http://127.0.0.1:{served.port}{trial}")
    plot = tab.locator(".plot").first
    plot.wait_for()
    assert tab.locator(".plot").count() == 3
    reached = 0
    while not plot.evaluate("e => e === document.activeElement"):
        tab.keyboard.press("Tab")
        reached += 1
        assert reached < 60
    for _ in range(3):
        tab.keyboard.press("Shift+ArrowRight")
    values = tab.locator(".plot .u-value")
    assert all(text.strip() for text in values.all_inner_texts())
    before = values.first.inner_text()
    tab.keyboard.press("ArrowRight")
    assert values.first.inner_text() != before
    width = "plots[1].scales.x.max - plots[1].scales.x.min"
    whole = tab.evaluate(width)
    tab.keyboard.press("+")
    assert tab.evaluate(width) < 0.8 * whole, "all panels show the same part"
    tab.keyboard.press("0")
    assert tab.evaluate(width) == pytest.approx(whole, rel=0.05)
    tab.close()


def test_a_drawn_trial_is_there_without_a_reload(served):

    trials = served.get("trials?limit=40&verdict=stable&sort=stiffness").content["items"]
    paths = [f"/trials/{each['id']}" for each in trials[20:24]]
    served.get(paths[0], Accept="text/html")
    served.all_done()
    times = []
    for path in paths:
        begun = monotonic()
        text = served.get(path, Accept="text/html").content.decode()
        times.append(monotonic() - begun)
        served.all_done()
    assert "<svg" in text
    assert '<meta name="reload"' not in text
    print("seconds:", [f"{each:.2f}" for each in times])


def test_a_trial_is_drawn_in_half_a_second_of_a_processor(falcon, falcon_outcome):
    """The worker's part of a page: the clock of a busy computer says little about it."""
    ids = falcon.stages("1").texts("response", "trial_id")
    draw_trials(falcon.processed, DocumentRequest(places=(("falcon", "1", ids[50]),)), [falcon_outcome.result])
    begun = process_time()
    for trial in ids[60:64]:
        drawn = draw_trials(
            falcon.processed, DocumentRequest(places=(("falcon", "1", trial),)), [falcon_outcome.result]
        )
    assert (process_time() - begun) / 4 < 0.5
    assert len(drawn.panels) == 3
