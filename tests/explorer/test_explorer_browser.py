"""The explorer in a real browser: by mouse, keyboard and address, on a phone, in print, and fast.

Needs Chromium (`apt-get install chromium`) and Playwright (`pip install -e '.[dev]'`); skipped where one is missing.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

import pipeline
from pipeline.device_data.devices import known_devices
from pipeline.explorer.entries import device_entries, with_trials
from pipeline.explorer.page import page as page_of

pytestmark = [pytest.mark.slow, pytest.mark.browser]

WORST = {
    "mass": 0.58, "damping": 4.0, "sampling_period_s": 0.001, "delay_samples": 9.5, "actuator_lag_s": 0.003,
    "force_gain": 1.2, "velocity": {"kind": "butterworth", "order": 4, "cutoff_hz": 80.0},
    "mode": {"frequency_hz": 45.0, "damping_ratio": 0.02, "mass": 0.1, "sensor": "motor", "load_damping": 0.5},
    "operator": {"mass": 0.1, "damping": 2.0, "stiffness": 100.0},
}  # fmt: skip
"""All parts at once."""

DRAG = """async () => {
  const slider = document.getElementById("explore-delay_samples");
  const start = Number(slider.value), frame = () => new Promise((go) => requestAnimationFrame(go));
  for (let i = 0; i < 150; i++) {
    slider.value = start + 60 * Math.sin(i / 20);
    slider.dispatchEvent(new Event("input"));
    await frame(), await frame();
  }
}"""
"""Moves a slider, a step every second frame."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("explorer") / "explore.html"
    falcon, *others = device_entries(known_devices().values())
    falcon = next(e for e in (falcon, *others) if e["label"] == "Novint Falcon, 1")
    measured = {**with_trials(falcon, [(3000.0, 40.0, True), (9000.0, 20.0, False)]), "limits": [[40.0, 8000.0]]}
    rubs = [[20.0, 7000.0, 5000.0], [60.0, 14000.0, 10500.0], [80.0, 13000.0, None]]
    sticky = {"label": "sticky", "loop": falcon["loop"], "friction": rubs}
    late = {"label": "late", "loop": falcon["loop"], "passive_reason": "the delay jitters"}
    entries = [{**measured, "wall": {"stiffness": 4000.0, "damping": 60.0}}, *others, sticky, late]
    path.write_text(page_of(entries), encoding="utf-8")
    return path


@pytest.fixture
def opened(browser: Any, file: Path) -> Iterator[Any]:
    contexts, complaints = [], []

    def open_page(state: dict[str, Any] | None = None, width: int = 1440, **options: Any) -> Any:
        # waiting for a condition evaluates text, which the policy of the page forbids
        context = browser.new_context(viewport={"width": width, "height": 900}, bypass_csp=True, **options)
        contexts.append(context)
        tab = context.new_page()
        tab.on("console", lambda message: complaints.append(message.text))
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        tab.on(
            "request",
            lambda request: complaints.extend([request.url] * (not request.url.startswith(("file:", "blob:")))),
        )
        tab.goto(file.as_uri() + (f"#explore={quote(json.dumps(state))}" if state else ""))
        tab.wait_for_selector(".what-if .what-summary dd")
        return tab

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def largest(tab: Any) -> float:
    """Largest stable stiffness as the page prints it."""
    return float(tab.inner_text(".what-summary dd").split()[0].replace(",", ""))


def state_of(tab: Any) -> dict[str, Any]:
    """State that the address keeps."""
    state: dict[str, Any] = json.loads(tab.evaluate("decodeURIComponent(location.hash.slice('#explore='.length))"))
    return state


def test_what_one_more_sample_of_delay_costs(opened):
    tab = opened()
    assert largest(tab) == 13629
    field = tab.get_by_role("spinbutton", name="delay d")
    field.fill("5")
    field.press("Enter")
    tab.wait_for_function("document.querySelector('.what-summary dd').textContent.includes('compared with the device')")
    assert largest(tab) == 9550.3
    assert "−29.9 % compared with the device" in tab.inner_text(".what-summary dd")
    tab.get_by_role("button", name="Reset to device").click()
    tab.wait_for_function("!document.querySelector('.what-summary dd').textContent.includes('against')")
    assert largest(tab) == 13629


def test_what_limits_a_device_with_friction(opened):
    tab = opened()
    tab.get_by_label("device", exact=True).select_option(label="sticky")
    row = tab.locator(".bars .bar", has_text="the device without its friction")
    row.wait_for()
    assert row.inner_text().splitlines()[-1] == "−25 %", "14,000 with friction, 10,500 without"
    assert row.locator(".loss").bounding_box()["width"] > 10
    tab.get_by_label("device", exact=True).select_option(label="Novint Falcon, 1")
    row.wait_for(state="detached")


def test_the_jitter_is_left_out_of_the_device_as_it_is(opened):
    """Another delay is a constant one; the device's own delay has its jitter again."""
    tab = opened()
    words = "the jitter of the delay (replaced by its mean, 4 samples)"
    field = tab.get_by_role("spinbutton", name="delay d")
    for delay, left_out in (("5", False), ("4", True)):
        assert (words in tab.inner_text(".what-summary")) is not left_out
        field.fill(delay)
        field.press("Enter")
        tab.wait_for_function(
            f"document.querySelector('.what-summary').textContent.includes('jitter') === {str(left_out).lower()}"
        )
        assert (words in tab.inner_text(".what-summary")) is left_out


def test_a_wall_is_typed(opened):
    tab = opened()
    tab.get_by_label("wall stiffness K [N/m]").fill("1000")
    tab.keyboard.press("Tab")
    tab.get_by_label("wall damping B [Ns/m]").fill("2")
    tab.keyboard.press("Enter")
    tab.wait_for_function("document.querySelector('.what-walls').textContent.includes('stable, passive')")
    tab.wait_for_function(
        "document.querySelector('.live').textContent.includes('Wall of 1000 N/m and 2 Ns/m: stable, passive')"
    )
    tab.get_by_label("wall damping B [Ns/m]").fill("20")
    tab.keyboard.press("Enter")
    tab.wait_for_function("document.querySelector('.what-walls').textContent.includes('stable, not passive')")
    row = pipeline.Loop(0.58, 4.0, 0.001, 4).points(1000, 20).iloc[0]
    shown = dict(line.split("\t") for line in tab.inner_text(".what-walls tbody").splitlines())
    assert shown["energy, weight t"] == f"{row['energy_step_w1']:.1f} samples²"
    assert shown["settling (2 %)"] == f"{row['settle_2pct']:.1f} ms"


def test_no_wall_is_passive_where_the_logs_prove_none(opened):
    tab = opened()
    tab.get_by_label("device", exact=True).select_option(label="late")
    tab.wait_for_function(
        "document.querySelector('.what-summary').textContent.includes('not proven: the delay jitters')"
    )
    tab.get_by_label("wall stiffness K [N/m]").fill("1000")
    tab.keyboard.press("Tab")
    tab.get_by_label("wall damping B [Ns/m]").fill("2")
    tab.keyboard.press("Enter")
    tab.wait_for_function(
        "document.querySelector('.live').textContent.includes('Wall of 1000 N/m and 2 Ns/m: stable.')"
    )
    assert "passive" not in tab.inner_text(".what-walls tbody")
    assert "every passive hand)" not in tab.inner_text(".what-if")


def test_two_fingers_zoom(opened):
    tab = opened(width=390, has_touch=True)
    fingers = tab.context.new_cdp_session(tab)
    box = tab.locator(".middle > svg").bounding_box()
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    before = tab.inner_text(".what-walls tbody")

    def touch(kind: str, apart: float) -> None:
        points = [{"x": x - apart, "y": y, "id": 0}, {"x": x + apart, "y": y, "id": 1}]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points if apart else []})

    touch("touchStart", 30)
    for apart in range(32, 62, 2):
        touch("touchMove", apart)
    touch("touchEnd", 0)
    tab.wait_for_function("decodeURIComponent(location.hash).includes('\"view\":{')")
    (low, high), _ = state_of(tab)["view"].values()
    assert 0.4 < (high - low) / (1.08 * 13629) < 0.6
    assert tab.inner_text(".what-walls tbody") == before


def test_a_wall_is_moved_by_keys_and_dragged(opened):
    tab = opened()
    tab.focus(".middle > svg")
    before = tab.inner_text(".what-walls tbody tr td")
    tab.keyboard.press("ArrowRight")
    tab.wait_for_function(f"document.querySelector('.what-walls td').textContent !== {json.dumps(before)}")
    tab.keyboard.press("p")
    tab.wait_for_function("document.querySelectorAll('.what-walls thead th').length === 3")
    box = tab.locator(".middle > svg").bounding_box()
    tab.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 0.3 * box["height"])
    tab.mouse.down()
    tab.mouse.up()
    tab.wait_for_function("document.querySelector('.what-walls tbody').textContent.includes('unstable')")
    tab.wait_for_function("document.querySelector('.live').textContent.includes('unstable')")


def test_sliders_are_labelled_and_announce_their_values(opened):
    tab = opened()
    slider = tab.get_by_role("slider", name="mass m")
    assert slider.get_attribute("aria-valuetext") == "0.58 kg"
    slider.focus()
    tab.keyboard.press("ArrowRight")
    tab.wait_for_function("document.getElementById('explore-mass').getAttribute('aria-valuetext') !== '0.58 kg'")
    bare = "(all) => all.filter((one) => !one.labels.length && !one.ariaLabel).length"
    assert tab.eval_on_selector_all(".what-if :is(input, select)", bare) == 0


def test_the_address_keeps_what_was_set(opened, browser):
    tab = opened({"e": 0, "loop": WORST, "wall": {"stiffness": 300, "damping": 5}, "pins": [], "view": None})
    expected = pipeline.Loop(**WORST).boundary().attrs["stiffness_max"]
    assert largest(tab) == pytest.approx(expected, rel=1e-4)
    tab.get_by_role("spinbutton", name="mass m").fill("0.7")
    tab.keyboard.press("Enter")
    tab.wait_for_function("decodeURIComponent(location.hash).includes('\"mass\":0.7')")
    shown = largest(tab)
    tab.reload()
    tab.wait_for_selector(".what-summary dd")
    assert largest(tab) == shown


def test_an_address_that_is_pasted_is_shown(opened):
    """All that can be set comes back, also in a page that is open."""
    tab = opened()
    tab.focus(".middle > svg")
    for key in ("ArrowRight", "p", "ArrowUp", "p", "+", "Shift+ArrowRight"):
        tab.keyboard.press(key)
    for part, choice in (
        ("velocity", "kalman"),
        ("mode", "motor"),
        ("operator", "hand"),
        ("criterion", "energy_step_w0"),
        ("sweep", "mass"),
    ):
        tab.select_option(f"#explore-{part}", choice)
    tab.wait_for_function("decodeURIComponent(location.hash).includes('energy_step_w0')")
    two_stars = "document.querySelector('.middle > svg path.best').getAttribute('d').split('M').length === 3"
    tab.wait_for_function(two_stars, timeout=60000)
    parts = ".middle > svg", ".what-summary", ".what-walls"
    other = opened()
    other.evaluate("(hash) => { location.hash = hash; }", tab.evaluate("location.hash"))
    other.wait_for_function(two_stars, timeout=60000)
    plain = "(all) => all.map((one) => one.innerHTML.replace(/explorer-clip-\\d+/g, ''))"
    assert [other.eval_on_selector_all(part, plain) for part in parts] == [
        tab.eval_on_selector_all(part, plain) for part in parts
    ]
    assert state_of(tab)["pins"] != []


def test_exports_give_the_same_numbers(opened, tmp_path, call):
    tab = opened({"e": 0, "loop": WORST})

    def saved(name: str) -> str:
        with tab.expect_download() as event:
            tab.get_by_role("button", name=f"Save {name}").click()
        event.value.save_as(tmp_path / name)
        return (tmp_path / name).read_text()

    written = tomllib.loads(saved("TOML"))
    loop = {**{k: v for k, v in written.items() if k not in ("name", "loop")}, **written["loop"]}
    assert pipeline.Loop(**loop) == pipeline.Loop(**WORST)
    (tmp_path / "TOML").rename(tmp_path / "device.toml")
    status, out, _ = call("theory", "boundary", "--device", "device.toml", "--json")
    assert status == 0
    assert json.loads(out)["stiffness_max"] == pytest.approx(largest(tab), rel=1e-4)
    assert call("explore", "--device", "device.toml", "--out", "again.html")[0] == 0
    assert (
        json.loads(re.search(r'explorer-entries">\[(.*?)\]</script>', (tmp_path / "again.html").read_text())[1])[
            "loop"
        ]["velocity"]
        == WORST["velocity"]
    )
    rows = np.genfromtxt(saved("CSV").splitlines(), delimiter=",", skip_header=1)
    expected = pipeline.Loop(**WORST).limits(rows[50:300:50, 1])["stiffness"]
    assert rows[50:300:50, 0] == pytest.approx(expected.to_numpy(), rel=1e-6)
    assert saved("SVG").startswith("<svg")
    line = tab.inner_text(".line code")
    row = eval(line, {"pipeline": pipeline}).iloc[0]  # the line that a reader pastes
    shown = tab.inner_text(".what-walls tbody tr:nth-child(4) td")
    assert float(shown) == pytest.approx(row["spectral_radius"], rel=1e-5)


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1440, 390, 320])
def test_it_fits_and_is_accessible(opened, width, scheme):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    tab = opened(width=width, color_scheme=scheme)
    tab.wait_for_selector(".what-if .bar")
    assert tab.evaluate("document.documentElement.scrollWidth") <= width
    found = axe.Axe().run(tab, options={"runOnly": ["wcag2a", "wcag2aa"]})
    assert [(v["id"], v["nodes"][0]["target"]) for v in found.response["violations"]] == []


def test_it_prints_as_a_figure(opened, tmp_path):
    tab = opened()
    tab.emulate_media(media="print")
    assert tab.is_visible(".middle > svg")
    assert not tab.is_visible(".what-if .left")
    pdf = tab.pdf()
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 3


@pytest.mark.parametrize("loop", [None, WORST], ids=["falcon", "worst"])
def test_sixty_frames_a_second(browser, opened, loop):
    """Processor time of a frame while a slider is dragged: script, style, layout and painting by the page's thread."""
    tab = opened({"e": 0, "loop": loop} if loop else None)
    tab.wait_for_selector(".what-if .bar")
    browser.start_tracing(page=tab, categories=["devtools.timeline", "toplevel"])
    tab.evaluate(DRAG)
    events = [each for each in json.loads(browser.stop_tracing())["traceEvents"] if each.get("ph") == "X"]
    frames = [each for each in events if each["name"] == "FireAnimationFrame" and each["tdur"] > 1000]
    thread = {(each["pid"], each["tid"]) for each in frames}
    tasks = [each for each in events if "RunTask" in each["name"] and (each["pid"], each["tid"]) in thread]
    spent = np.array(
        [
            next(task["tdur"] for task in tasks if task["ts"] <= frame["ts"] <= task["ts"] + task["dur"]) / 1000
            for frame in frames
        ]
    )
    print(f"median {np.median(spent):.1f} ms, 95 % {np.percentile(spent, 95):.1f} ms of {len(spent)} frames")
    assert len(thread) == 1
    assert len(spent) > 100
    assert np.median(spent) <= 12
    assert np.percentile(spent, 95) <= 20
