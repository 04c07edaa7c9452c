"""Numbers that rounding moves most, under several kernels of linear algebra: each in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest
from kernels import WITHOUT, environment
from places import ROOT

FILES = [
    f"tests/{place}.py"
    for place in (
        "theory/test_poles",
        "theory/test_energy",
        "theory/test_costs",
        "measured/signal/test_modes",
        "measured/model/test_model",
    )
]

SENSITIVE = (
    "threefold and (known or plant0-0)",  # multiple poles
    "slow_responses and step and not loop2",  # sums over 1e4 samples, modes that are skew
    "plain_sums_over_samples",  # transfer functions beside sums
    "growth_of_one_known_mode",  # singular values and eigenvectors
    "ideal_device_behind_walls or dense_covariance",  # the likelihood
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
