"""Folders that tests read from."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
"""Folder of the project."""

SHARED = ROOT.parent / "shared"
"""Reference data and real logs beside the project; tests that use it are skipped where it is missing."""


def docs_script(name: str) -> Any:
    """Load a script of docs/ as a module, which may import its neighbours while it is loaded."""
    folder = str(ROOT / "docs")
    spec = spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    before = sys.modules.get(name)
    sys.modules[name] = module  # dataclasses look their module up
    sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(folder)
        sys.modules.pop(name)
        if before is not None:
            sys.modules[name] = before
    return module
