"""What a process of this package does before anything else."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder


class _NoPandas(MetaPathFinder):
    """Finds pandas nowhere, and leaves other modules to others."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        if fullname == "pandas":
            raise ModuleNotFoundError("pandas is left out here: see pipeline.base.process")


def leave_out_pandas() -> None:
    """Keep this process from importing pandas, which pyarrow does where it is installed, for 0.2 s and 40 MB.

    Tables are never data frames here. Only for processes that run nothing but this package: in others pandas would be
    missing for everybody.
    """
    sys.meta_path.insert(0, _NoPandas())
