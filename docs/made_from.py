"""Sources of the images of README and pages, and their hashes in `img/made_from.json`; ``make docs`` renews them last.

An image is stale if its sources changed after it was made: `tests/project/test_images.py` compares the hashes.
"""

from __future__ import annotations

import json
from pathlib import Path

from pipeline.base.provenance import sha256

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "img"
FILE = IMAGES / "made_from.json"

_DRAWING = "pipeline/rendering/figures/drawing.py"
_PAGE = ("docs/make_screens.py", "pipeline/rendering/templates/report.css", "pipeline/rendering/figures/boundaries.py")
_ANSWERS = (*_PAGE, _DRAWING, "pipeline/rendering/templates/answers.html.j2", "schemas/devices/falcon-real.toml")
_TUTORIAL = ("docs/make_tutorial.py", _DRAWING)

MADE_FROM: dict[str, tuple[str, ...]] = {
    "cost-map.svg": ("docs/make_figure.py", "pipeline/comparison/figures/maps.py", _DRAWING),
    "explorer.png": ("docs/make_screens.py", "pipeline/explorer/*", "schemas/devices/falcon.toml"),
    "falcon.svg": ("docs/make_falcon.py",),
    "first-screen.png": (
        *_ANSWERS,
        "pipeline/rendering/templates/report.html.j2",
        "pipeline/rendering/templates/first_screen_words.j2",
        "pipeline/rendering/templates/report/brief.html.j2",
    ),
    "identification.svg": ("docs/make_identification.py",),
    "identification-page.png": (
        "docs/make_identification.py",
        "pipeline/surface/identification_page.py",
        "pipeline/surface/free_run_residuals.py",
        "pipeline/rendering/templates/sectioned_page.html.j2",
        "pipeline/rendering/templates/report.css",
        _DRAWING,
    ),
    "scatter.svg": ("docs/make_scatter.py",),
    "service.png": (
        *_ANSWERS,
        "pipeline/service/pages/static/service.css",
        "pipeline/service/pages/templates/base.html.j2",
        "pipeline/service/pages/templates/experiment.html.j2",
    ),
    "start-limits.svg": (*_TUTORIAL, "pipeline/rendering/figures/boundaries.py"),
    "start-log.svg": (*_TUTORIAL, "pipeline/rendering/figures/overview.py"),
} | {
    f"gallery/{script.stem}.svg": (f"docs/gallery/{script.name}", "docs/gallery/matplotlibrc")
    for script in sorted((ROOT / "docs" / "gallery").glob("figure_*.py"))
}
"""Patterns of the sources of each image: what draws it and what it shows, not the numerics below, which have tests."""


def hashes() -> dict[str, str]:
    """Return a hash of the present sources of each image."""
    found = {}
    for image, patterns in MADE_FROM.items():
        files = sorted(file for pattern in patterns for file in ROOT.glob(pattern) if file.is_file())
        texts = (f"{file.relative_to(ROOT).as_posix()}\n{file.read_text('utf-8')}" for file in files)
        found[image] = sha256("\0".join(texts).encode())[:16]
    return found


def main() -> None:
    """Write the hashes."""
    FILE.write_text(json.dumps(hashes(), indent=1, sort_keys=True) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
