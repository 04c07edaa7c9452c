"""Environments in which numpy and its linear algebra compute as on another processor, for tests in own processes."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

WIDE = ("X86_V4", "AVX512")
"""Starts of numpy's names of instructions that processors before AVX-512 lack."""

WITHOUT = {"Nehalem": ("",), "Haswell": WIDE, "Zen": WIDE, "SkylakeX": (), "Sapphirerapids": ()}
"""OpenBLAS's name of each kernel, with the starts of what numpy is not to use there: processors from 2008 to 2023."""

PROBE = "import numpy as np; np.linalg.eigvals(np.ones((9, 9)) @ np.arange(81.0).reshape(9, 9))"


def environment(kernel: str) -> dict[str, str]:
    """Return the environment of a kernel; skip the test where processor or build of numpy do not have it."""
    variables, found = _probed(kernel)
    if found.lower() != kernel.lower():
        pytest.skip(f"OpenBLAS kernel {kernel}: not on this processor or in this build, which takes {found!r}")
    return variables


@cache
def _probed(kernel: str) -> tuple[dict[str, str], str]:
    """Environment of a kernel, and the one that takes effect in it; empty where that has no name or crashes."""
    usable = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    without = [name for name in usable if name.startswith(WITHOUT[kernel])]
    variables = os.environ | {"OPENBLAS_CORETYPE": kernel, "NPY_DISABLE_CPU_FEATURES": " ".join(without)}
    run = subprocess.run(
        [sys.executable, "-c", PROBE],
        env=variables | {"OPENBLAS_VERBOSE": "2"},
        capture_output=True,
        text=True,
        check=False,
    )
    cores = [
        line.removeprefix("Core: ") for line in (run.stdout + run.stderr).splitlines() if line.startswith("Core: ")
    ]
    return variables, cores[-1] if cores and run.returncode == 0 else ""
