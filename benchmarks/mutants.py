"""How many wrong changes of the code the fast tests catch: `CHANGES`, one at a time, in a copy of the tree.

    python benchmarks/mutants.py [--only WORD] [--first N] [--count N] [--seconds 240]

For each change run the test files that touch its module, its own first, until one fails. Wanted: 57 of 60 caught.
A change whose text is not there once is printed as stale and counts as not caught.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("pipeline", "tests", "schemas", "docs", "README.md", "CHANGELOG.md", "pyproject.toml")
WANTED = 57


class Change(NamedTuple):
    """A wrong change of a module below ``pipeline/``: the text there, what replaces it, and tests beside its own."""

    module: str
    old: str
    new: str
    tests: str = ""


VERDICT, OUTCOME = "measured/signal/verdict.py", "measured/signal/outcome.py"
SETTLING, OPTIMUM, THESIS = "measured/cost/costs.py", "measured/experiment/best_trial.py", "measured/thesis.py"
INTERVALS, LIKELIHOOD = "measured/identification/intervals.py", "measured/identification/likelihood.py"
BAND, SESSIONS, SECURITY = "measured/experiment/boundary.py", "service/database.py", "service/security.py"
AGAINST, AGREEMENT = "comparison/against.py", "comparison/scores/agreement.py"

CHANGES = (
    Change(VERDICT, "REST_FLOORS = 8.0", "REST_FLOORS = 2.0"),
    Change("measured/student.py", "SIGMAS = 3.0", "SIGMAS = 0.5", "tests/measured/signal"),
    Change(VERDICT, "LEAST_FALL = 3.0", "LEAST_FALL = 30.0"),
    Change(VERDICT, "END = 0.8", "END = 0.5"),
    Change(VERDICT, "+ 2 * delay", "+ delay"),
    Change(VERDICT, "or not enough else rate / trial.sampling_period_s", "or not enough else rate"),
    Change(VERDICT, "    if rises:\n", "    if not rises:\n"),
    Change(OUTCOME, "max(BAND * travel", "max(10 * BAND * travel"),
    Change(OUTCOME, "LASTING = 0.8", "LASTING = 0.05"),
    Change("measured/signal/response.py", "SETTLED_SAMPLES = 5", "SETTLED_SAMPLES = 0"),
    Change(SETTLING, "np.nan if text else settled", "np.nan if text else settled + 1"),
    Change(SETTLING, "        if width < response.floor:", "        if width < 0 * response.floor:"),
    Change(SETTLING, "(response.floor + response.baseline_motion)", "(response.floor)"),
    Change(SETTLING, "_settled(size, width + margin), ", "_settled(size, width - margin), "),
    Change(OPTIMUM, "np.isfinite(cost) & ~unstable", "np.isfinite(cost)"),
    Change(OPTIMUM, "stiffness[free].max()", "stiffness[free].min()"),
    Change(OPTIMUM, "int(index[np.argmin(distance)])", "int(index[0])"),
    Change(THESIS, "float(known[n - rank])", "float(known[min(n - rank + 1, n - 1)])"),
    Change(THESIS, "SMALLEST_SIGNAL = 20.0", "SMALLEST_SIGNAL = 0.02"),
    Change(THESIS, "if irregular > EVEN:", "if irregular > 100 * EVEN:"),
    Change(THESIS, "acting.sum() - 0.5 * acting[-1]", "acting.sum()"),
    Change(THESIS, "FirstChange(first, edge + 1 + first)", "FirstChange(first + 1, edge + 1 + first)"),
    Change(THESIS, "if opposite < min(first, len(away)):", "if False:"),
    Change("measured/student.py", "CONFIDENCE = 0.95", "CONFIDENCE = 0.8", "tests/measured/identification"),
    Change(INTERVALS, "float(informative.sum() - 1)", "1e9"),
    Change(INTERVALS, "(count - 1) / count * (spread**2).sum(axis=0)", "0 * (spread**2).sum(axis=0)"),
    Change(INTERVALS, "if ends_at_zero and value - reach < 0:", "if False:"),
    Change(LIKELIHOOD, "WORTH = 5.0", "WORTH = 500.0"),
    Change(BAND, "single = NORMAL_95 * scatter", "single = 0.5 * NORMAL_95 * scatter"),
    Change(BAND, "student_95(found.freedom) * found.error", "found.error"),
    Change("measured/student.py", "inv_cdf(0.5 + CONFIDENCE / 2)", "inv_cdf(CONFIDENCE)"),
    Change("measured/experiment/boundary.py", "(high - low) ** 2 / 12", "(high - low) ** 2 / 3"),
    Change("comparison/loops/findings.py", "if not adequate:", "if False:"),
    Change(AGREEMENT, "wall = stiffness > 0", "wall = stiffness >= 0"),
    Change(AGREEMENT, "bounded & (low - limit[relative] > reach)", "bounded & (limit[relative] - low > reach)"),
    Change(AGAINST, "len(values) / 2 - half)) - 1, 0)", "len(values) / 2 - half)), 0)"),
    Change("base/units.py", "\"Ncm\": 1e-2", "\"Ncm\": 1e-3", "tests/readers"),
    Change("base/units.py", "2 * pi / 60", "2 * pi"),
    Change("store/names.py", "if safe.startswith((\".\", \"_\")) or", "if"),
    Change("store/names.py", "parent / (other if taken else name)", "parent / name"),
    Change("base/provenance.py", "return sha256(text.encode())[:16]", "return sha256(text.encode())[:4]"),
    Change("intake/stored_sources.py", "else sha256[:16]", "else sha256[:4]"),
    Change("records/trials.py", "result.hexdigest()[:16]", "result.hexdigest()[:4]"),
    Change(SESSIONS, "SESSION_S = 12 * 3600.0", "SESSION_S = 12e9 * 3600.0"),
    Change(SESSIONS, "sessions.expires > {time.time()} AND", "1 AND"),
    Change(SESSIONS, "(tokens.expires IS NULL OR tokens.expires > ?)", "(tokens.expires IS NULL OR ? > 0)"),
    Change(SECURITY, "and _name(host) not in LOCAL:", "and False:"),
    Change(SECURITY, "urlsplit(origin).netloc != host:", "False:"),
    Change(SECURITY, "ROLES.index(role) < ROLES.index(needed)", "ROLES.index(role) > ROLES.index(needed)"),
    Change(SECURITY, "return FORM in cookies and hmac.compare_digest(own.encode(), token.encode())", "return True"),
    Change(SECURITY, "self._within(self.seen)", "pass"),
    Change(SECURITY, "if left < 1.0:", "if left < 0.0:"),
    Change("simulation/simulate.py", "slots = in_force(delays) + 1", "slots = in_force(delays)"),
    Change("theory/poles.py", "(factors > 0)], max)", "(factors > 0)], min)"),
    Change("theory/passivity.py", "(4 * near - twice) / 3", "near"),
    Change("records/criteria.py", "none=1e-12", "none=1e-3", "tests/theory"),
    Change("rig/wish.py", "(1 - tolerance, 1 + tolerance)", "(1 + tolerance, 1 + tolerance)"),
    Change("planning/next_wall.py", "0.5 * (of.bottom + far)", "0.9 * (of.bottom + far)"),
)  # fmt: skip


def test_files(change: Change) -> list[str]:
    """Return the test files that touch the module of a change: of its name, those given, and those that import it."""
    module = Path(change.module)
    dotted = "pipeline." + change.module.removesuffix(".py").replace("/", ".")
    package, name = dotted.rsplit(".", 1)
    folder = ROOT / "tests" / module.parent
    files = {path: path.read_text(encoding="utf-8") for path in sorted((ROOT / "tests").rglob("test_*.py"))}
    own = [path for path in files if path.parent == folder and module.stem in path.stem]
    given = sorted((ROOT / change.tests).rglob("test_*.py")) if change.tests else []
    imports = (f"{dotted} ", f"{dotted}\n", f"from {package} import {name}", f"{dotted}.")
    importing = [path for path, text in files.items() if any(words in text for words in imports)]
    near = sorted((path for path in importing if "project" not in path.parts), key=lambda path: path.parent != folder)
    same = sorted(folder.glob("test_*.py"))
    return [str(path.relative_to(ROOT)) for path in dict.fromkeys([*own, *given, *near, *same])]


def outcome(change: Change, copy: Path, seconds: float) -> str:
    """Return ``caught``, ``survived`` or ``stale`` for a change, made in the copy and taken back."""
    file = copy / "pipeline" / change.module
    text = file.read_text(encoding="utf-8")
    if change.old not in text:
        return "stale"
    file.write_text(text.replace(change.old, change.new), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", "not slow"]
    env = {**os.environ, "PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1"}
    tests, end = test_files(change), time.monotonic() + seconds
    try:
        # one file after the other: most changes are caught by the first, and the others need not be read
        for test in tests:
            left = end - time.monotonic()
            if left <= 0:
                return "survived (time)"
            done = subprocess.run([*command, test], cwd=copy, env=env, capture_output=True, timeout=left, check=False)
            if done.returncode == 1:
                return "caught"
        return "survived"
    except subprocess.TimeoutExpired:
        return "survived (time)"
    finally:
        file.write_text(text, encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="changes of modules whose name holds this word")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=len(CHANGES))
    parser.add_argument("--seconds", type=float, default=240.0, help="longest time of the tests of one change")
    given = parser.parse_args()
    chosen = [change for change in CHANGES if given.only in change.module][given.first :][: given.count]
    found = []
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name)
        for part in COPIED:
            (shutil.copytree if (ROOT / part).is_dir() else shutil.copy)(ROOT / part, copy / part)
        for change in chosen:
            began = time.perf_counter()
            found.append(outcome(change, copy, given.seconds))
            words = f"{change.module}: {change.old} -> {change.new}"
            print(f"{found[-1]:<16} {time.perf_counter() - began:6.1f} s  {words}", flush=True)
    print(f"{found.count('caught')} of {len(found)} caught (wanted {WANTED} of {len(CHANGES)})")


if __name__ == "__main__":
    main()
