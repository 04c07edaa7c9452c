"""What the documentation says exists: commands, options, links, symbols; examples in docstrings run."""

import ast
import doctest
import importlib
import re
from itertools import chain
from pathlib import Path

import pytest
from command_lines import commands, every_command, fault
from places import ROOT

PAGES = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
MODULES = sorted(".".join(path.relative_to(ROOT).with_suffix("").parts) for path in (ROOT / "pipeline").rglob("*.py"))
LARGEST_IMAGE = 150_000
PRIVATE = re.compile(r"(?<![\w.])/(?:work|tmp|home|root|mnt|opt)/")


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_commands_exist_with_their_options(page: Path) -> None:
    assert {command: fault(command) for command in commands(read(page)) if fault(command)} == {}


def test_log_of_the_readme_is_accepted(tmp_path: Path) -> None:
    from pipeline.intake.ingest import ingest
    from pipeline.store.storage import read_trials

    block = re.search(r"^ {4}# device: .*\n(?: {4}.*\n)+", read(ROOT / "README.md"), flags=re.MULTILINE)
    assert block
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text(re.sub(r"^ {4}", "", block[0], flags=re.MULTILINE), encoding="utf-8")
    report = ingest([tmp_path / "logs"], tmp_path / "processed")
    assert (report.found, report.ingested) == (1, 1)
    trial = read_trials(tmp_path / "processed").to_pylist()[0]
    assert (trial["device"], trial["stiffness"], trial["damping"], trial["step"]) == ("falcon", 3200, 18, 8)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", read(ROOT / "Makefile"), flags=re.MULTILINE))
    named = re.findall(r"(?:^ {4}|`)make ([a-z-]+)", read(page), flags=re.MULTILINE)
    assert set(named) <= targets


def headings_of(page: Path) -> set[str]:
    """Anchors of the headings of a page, as MyST and others make them."""
    titles = re.findall(r"^#+ (.*)$", read(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_links_lead_to_files_and_headings(page: Path) -> None:
    links = re.findall(r"\]\(([^)]+)\)", read(page))
    local = [link.partition("#") for link in links if "://" not in link]
    assert [file for file, _, _ in local if not (page.parent / file).exists()] == []
    headings = {file: headings_of(page.parent / file if file else page) for file, _, anchor in local if anchor}
    assert [f"{file}#{anchor}" for file, _, anchor in local if anchor and anchor not in headings[file]] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_modules_and_folders_that_are_named_exist(page: Path) -> None:
    paths = re.findall(r"`((?:pipeline|schemas|docs|tests)/[\w/.*]*)`", read(page))
    assert [path for path in paths if not any(ROOT.glob(path.rstrip("/")))] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_no_path_of_a_machine(page: Path) -> None:
    assert PRIVATE.findall(read(page)) == []


def test_the_worked_example_applies_to_the_code() -> None:
    """Each hunk of the diff in CONTRIBUTING.md starts from lines that the code has."""
    (diff,) = re.findall(r"^```diff\n(.*?)^```", read(ROOT / "CONTRIBUTING.md"), flags=re.MULTILINE | re.DOTALL)
    files = re.split(r"^--- a/", diff, flags=re.MULTILINE)[1:]
    assert len(files) == 6
    for part in files:
        code = read(ROOT / part.split("\n", 1)[0])
        for hunk in re.split(r"^@@.*\n", part, flags=re.MULTILINE)[1:]:
            before = "".join(f"{line[1:]}\n" for line in hunk.splitlines() if line[:1] != "+")
            assert before in code


def test_image_is_small_and_needs_no_network() -> None:
    images = [ROOT / name for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", read(ROOT / "README.md"))]
    assert images
    for image in images:
        assert image.stat().st_size <= LARGEST_IMAGE
        if image.suffix == ".svg":  # others hold no addresses
            assert not re.search(r'(?:href|src)="(?!#)|url\((?!#)|@import', read(image))


def test_the_site_names_the_trials_that_its_figure_shows() -> None:
    shown = re.search(r"[\d,]+ trials", read(ROOT / "docs" / "img" / "cost-map.svg"))
    assert shown
    assert f"{shown[0].split()[0]} simulated logs" in " ".join(read(ROOT / "docs" / "index.md").split())


def names_of_the_code() -> set[str]:
    """Arguments, attributes, keys and column names that occur in the package, and fields of device files."""
    names: set[str] = set()
    for path in (ROOT / "pipeline").rglob("*.py"):
        for node in ast.walk(ast.parse(read(path))):
            if isinstance(node, ast.arg):
                names.add(node.arg)
            elif isinstance(node, ast.Attribute):
                names.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                names.add(node.value)
    return names


def names_on_the_page() -> set[str]:
    """Names of code in the second column of the tables of symbols and of stored results."""
    section = read(ROOT / "docs" / "definitions.md").partition("## Symbols and names")[2]
    rows = [line.split("|") for line in section.splitlines() if line.startswith("|")]
    return {name for row in rows for name in re.findall(r"`([^`]+)`", row[2])}


def test_symbols_are_names_of_the_code() -> None:
    from pipeline.records.tables import COLUMNS

    listed = names_on_the_page()
    assert len(listed) > 40
    energy = {f"energy_{signal}_w{w}" for signal in ("step", "impulse") for w in (0, 1, 2)}
    assert listed - names_of_the_code() - energy - set(COLUMNS) == set()


def test_stored_columns_are_documented() -> None:
    from pipeline.records.tables import COLUMNS, TABLES

    results = {name for table, names in TABLES.items() if table != "trials" for name in names}
    # a correction repeats what its trial is known by
    results -= set(TABLES["trials"]) & set(TABLES["corrections"])
    bases = {re.sub(r"_w[12](?=_|$)", "_w0", re.sub(r"_(low|high|error)$", "", name)) for name in results}
    page = read(ROOT / "docs" / "definitions.md")
    assert [name for name in sorted(bases) if f"`{name}`" not in page] == []
    assert [name for name in sorted(results) if not COLUMNS[name].meaning] == []


def pages() -> str:
    return "\n".join(read(page) for page in PAGES if page.name not in ("CHANGELOG.md", "CONTRIBUTING.md"))


def test_every_command_and_option_is_documented() -> None:
    text = pages()
    missing = []
    for name, command in every_command():
        shown = [p for p in command.params if not getattr(p, "hidden", False)]
        options = [option for p in shown for option in (*p.opts, *p.secondary_opts) if option.startswith("--")]
        missing += [name] * (name not in text)
        missing += [f"{name} {option}" for option in options if not re.search(rf"{option}(?![\w-])", text)]
    assert [word for word in missing if not word.endswith(" --help")] == []


def test_every_criterion_and_format_is_documented() -> None:
    from typing import get_args

    from pipeline.profiles.profile_model import Format
    from pipeline.records.criteria import CRITERIA
    from pipeline.theory.optimum import POINT_CRITERIA

    text = read(ROOT / "docs" / "definitions.md")
    names = {name.removesuffix("_discrete") for name in (*CRITERIA, *POINT_CRITERIA)}
    assert len(names) > 15
    assert [name for name in sorted(names) if f"`{name}`" not in text] == []
    assert [name for name in get_args(Format) if f"`{name}`" not in read(ROOT / "docs" / "logs.md")] == []


def test_every_setting_is_documented() -> None:
    from pipeline.device.parts import LoopTable, SimulationParts

    page = read(ROOT / "docs" / "devices.md")
    keys = [key for model in (LoopTable, SimulationParts) for key in model.model_fields]
    assert len(keys) > 12
    assert [key for key in keys if f"`{key}`" not in page] == []
    source = "".join(read(path) for path in (ROOT / "pipeline").rglob("*.py"))
    variables = set(re.findall(r"\bPIPELINE_[A-Z]+\b", source))
    assert variables
    assert [name for name in sorted(variables) if f"`{name}`" not in pages()] == []


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    source = read(ROOT / Path(*name.split(".")).with_suffix(".py"))
    if ">>>" not in source:
        return
    assert doctest.testmod(importlib.import_module(name.removesuffix(".__init__"))).failed == 0


def test_citation_names_software_version_and_thesis() -> None:
    from pipeline import __version__

    text = read(ROOT / "CITATION.cff")
    assert re.search(rf"^version: {re.escape(__version__)}$", text, flags=re.MULTILINE)
    assert "family-names: Hulin" in text
    assert f"## {__version__}" in read(ROOT / "CHANGELOG.md")


def test_every_dependency_is_explained() -> None:
    import tomllib

    project = tomllib.loads(read(ROOT / "pyproject.toml"))
    needed = [*project["project"]["dependencies"], *chain(*project["project"]["optional-dependencies"].values())]
    needed += project["build-system"]["requires"]
    page = read(ROOT / "docs" / "dependencies.md")
    packages = {re.split(r"[<>=!~\[]", entry)[0] for entry in needed} - {project["project"]["name"]}
    assert [name for name in packages if f"| {name} |" not in page] == []


def test_tests_named_in_the_verification_exist() -> None:
    named = re.findall(r"`(test_\w+\.py)::(test_\w+)`( \(slow\))?", read(ROOT / "docs" / "verification.md"))
    assert len(named) > 40
    files = {path.name: path for path in (ROOT / "tests").rglob("test_*.py")}
    for file, name, slow in named:
        text = read(files[file])
        assert re.search(rf"^def {name}\(", text, flags=re.MULTILINE), f"{file}: no {name}"
        marked = re.search(rf"^@pytest\.mark\.slow\n(?:@.*\n)*def {name}\(", text, flags=re.MULTILINE)
        assert bool(marked) == bool(slow), f"{file}::{name}: marked slow in one of test and page only"
