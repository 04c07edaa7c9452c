"""Sphinx's settings of the documentation site: `make site` builds it from these pages."""

from pathlib import Path

from sphinx.application import Sphinx

from pipeline import __version__
from pipeline.device_data.devices import known_devices
from pipeline.explorer.entries import device_entries
from pipeline.explorer.page import page

project = "pipeline"
author = "the authors of pipeline"
html_show_copyright = html_show_sphinx = False
version = release = __version__

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence", "dollarmath"]
nb_execution_mode = "off"  # the notebook is stored with what it printed; a test runs it again

autodoc_typehints = "none"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = "pipeline"
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}


def _explorer(app: Sphinx, error: Exception | None) -> None:
    """Write the explorer beside the pages, which show it in a frame."""
    if error is None:
        (Path(app.outdir) / "explore.html").write_text(page(device_entries(known_devices().values())), encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Add what the site has beside its pages."""
    app.connect("build-finished", _explorer)
