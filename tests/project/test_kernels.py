"""Numbers that rounding moves most, under several kernels of linear algebra: each in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from places import ROOT

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


FILES = [
    f"tests/{place}.py"
    for place in (
        "theory/test_poles",
        "theory/test_energy",
        "theory/test_costs_by_name",
        "measured/signal/test_modes",
        "measured/identification/test_compiled_loops",
        "measured/identification/test_model",
    )
]

SENSITIVE = (
    "threefold and (known or plant0-0)",  # multiple poles
    "slow_responses and step and not loop2",  # sums over 1e4 samples, modes that are skew
    "plain_sums_over_samples",  # transfer functions beside sums
    "growth_of_one_known_mode",  # singular values and eigenvectors
    "ideal_device_behind_walls or (dense_normal_density and rigid)",  # the likelihood
)


@pytest.mark.sampled
@pytest.mark.parametrize("kernel", WITHOUT)
def test_numbers_do_not_depend_on_the_kernel(kernel: str) -> None:
    chosen = " or ".join(f"({expression})" for expression in SENSITIVE)
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-k", chosen, *FILES],
        cwd=ROOT,
        env=environment(kernel),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    assert int(run.stdout.rsplit(" passed", 1)[0].split()[-1]) >= 30, run.stdout
