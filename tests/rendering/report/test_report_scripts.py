"""Scripts of the report: what is shipped unchanged, what the page's policy allows, and what a name cannot do."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import tomllib
from dataclasses import replace

import pytest
from report_data import HOSTILE, report_data
from trial_pages import trial_page

from pipeline.rendering.report import page_template, report
from pipeline.rendering.report.page_template import TEMPLATES, json_text, policy, scripts

NAMES = (
    HOSTILE,
    "</script><script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "=HYPERLINK(0)",
    "<!--<script>",
    "a\u2028b & 'c'",
)


@pytest.fixture(scope="module")
def page() -> str:
    return report.render(replace(report_data(full=False), trials=trial_page()))


def inline(page: str) -> list[str]:
    return re.findall(r"<script>(.*?)</script>", page, flags=re.DOTALL)


def test_files_of_others_are_unchanged_and_named_with_version_and_licence() -> None:
    listed = tomllib.loads((TEMPLATES / "vendor/VERSIONS.toml").read_text(encoding="utf-8"))["file"]
    assert {entry["name"] for entry in listed} == {p.name for p in (TEMPLATES / "vendor").iterdir()} - {"VERSIONS.toml"}
    for entry in listed:
        content = (TEMPLATES / "vendor" / entry["name"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"], entry["name"]
        assert entry["licence"] == "MIT"
    assert b"(v1.6.32)" in (TEMPLATES / page_template.PLOT).read_bytes()


def test_licence_travels_with_the_page(page: str) -> None:
    assert "Copyright (c) 2022 Leon Sorokin" in page
    assert "Permission is hereby granted" in page


def test_policy_names_the_hash_of_each_script_and_allows_nothing_else(page: str) -> None:
    stated = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert stated
    rules = dict(rule.split(" ", 1) for rule in stated[1].replace("&#39;", "'").split("; "))
    assert rules["default-src"] == "'none'"
    allowed = re.findall(r"'sha256-([^']+)'", rules["script-src"])
    assert "unsafe" not in rules["script-src"]
    found = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline(page)]
    assert sorted(found) == sorted(allowed)
    assert len(found) == 4
    assert set(rules) == {"default-src", "script-src", "style-src", "img-src", "base-uri", "form-action"}


def test_policy_without_scripts_allows_none() -> None:
    assert "script-src 'none'" in policy(())


def test_page_without_trials_has_the_scripts_of_tables_and_explorer() -> None:
    page = report.render(report_data(full=False))
    assert inline(page) == list(scripts(with_trials=False, with_explorer=True))
    assert "uPlot" not in page
    assert 'id="sec-trials"' not in page


def test_scripts_build_no_code_and_no_markup_from_data() -> None:
    own = "".join(
        (TEMPLATES / name).read_text() for name in (*page_template.PAGE_SCRIPTS, *page_template.TRIALS_SCRIPTS)
    )
    for word in [
        "eval",
        "Function(",
        "innerHTML",
        "outerHTML",
        "insertAdjacentHTML",
        "document.write",
        "fetch",
        "http",
    ]:
        assert word not in own
    assert "</script" not in "".join(scripts(with_trials=True)).lower()
    assert not re.search(r"\beval\(|new Function|XMLHttpRequest|fetch\(", (TEMPLATES / page_template.PLOT).read_text())


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground_in_both_colour_schemes(scheme: str) -> None:
    """WCAG 2.1, 1.4.3: 4.5 to 1 for text; 1.4.11: 3 to 1 for lines that carry meaning."""
    sheet = (TEMPLATES / "report.css").read_text(encoding="utf-8")
    first, second = re.findall(r":root \{(.*?)\}", sheet, flags=re.DOTALL)[:2]
    colours = dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", first if scheme == "light" else second))
    for text in ("ink", "soft", "link"):
        for ground in ("paper", "wash"):
            assert contrast(colours[text], colours[ground]) >= 4.5, (text, ground)
    assert contrast(colours["ink"], colours["note"]) >= 4.5
    for line in ("blue", "vermillion", "green", "purple", "orange", "sky"):
        assert contrast(colours[f"fig-{line}"], colours["paper"]) >= 3, line


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours by WCAG 2.1."""

    def luminance(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.03928 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("name", NAMES)
def test_json_in_the_page_holds_no_markup_and_comes_back(name: str) -> None:
    text = json_text({"name": name, name: [1, None]})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": name, name: [1, None]}


@pytest.mark.parametrize("name", NAMES)
def test_hostile_names_change_no_element_of_the_page(name: str, page: str) -> None:
    """The page of a hostile name has the same tags and attributes as one of a harmless name."""
    plain, hostile = (
        report.render(replace(report_data(full=False), trials=trial_page((text, "2"), text))) for text in ("1", name)
    )
    assert re.findall(r"<(/?\w+)", strip(plain)) == re.findall(r"<(/?\w+)", strip(hostile))
    found = re.search(r'id="trial-data">(.*?)</script>', hostile)
    assert found
    assert json.loads(found[1])["experiments"][0]["name"] == name


def strip(page: str) -> str:
    """The page without what stands inside its scripts."""
    return re.sub(r"(<script[^>]*>).*?</script>", r"\1</script>", page, flags=re.DOTALL)
