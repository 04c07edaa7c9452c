"""Documents of a set of comparisons, kept so that a change of the code can be held against what was said before it.

    python benchmarks/documents.py store FOLDER          courses, real logs and damaged logs, compared
    python benchmarks/documents.py compare FOLDER FOLDER what differs, status 1 where something does

Texts and verdicts are to be equal, numbers to 1e-12 of their size; where a number comes from (`provenance`, paths, run
times, the program's version) is left out. `store` runs the commands of the `pipeline` package that Python finds.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from timing import PIPELINE

REAL = Path(__file__).parents[2] / "shared" / "real"
LEFT_OUT = {"provenance", "report", "logs", "version", "seconds", "stages"}
TOLERANCE = 1e-12
SHOWN = 40
"""Differences that are listed of each document."""


def run(folder: Path, *arguments: str) -> str:
    """Run one command and return what it prints; a status above 3 or a traceback ends the program."""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([*PIPELINE, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    if "Traceback" in done.stderr or done.returncode not in (0, 1, 3):
        sys.exit(f"pipeline {' '.join(arguments)}: status {done.returncode}\n{done.stderr[-2000:]}")
    return done.stdout


def damage(text: str, kind: int, random: np.random.Generator) -> str:
    """Return a log with one thing wrong, by its kind."""
    lines = text.splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if not line.startswith("#")) + 1
    row = int(random.integers(first + 5, len(lines) - 5))
    if kind == 0:  # cut in the middle of a row
        return "".join(lines[:row]) + lines[row][: len(lines[row]) // 2]
    if kind == 1:  # rows missing
        return "".join(lines[:row] + lines[row + 7 :])
    if kind == 2:  # a row twice
        return "".join([*lines[:row], lines[row], *lines[row:]])
    if kind == 3:  # not a number
        lines[row] = lines[row].rsplit(",", 1)[0] + ",nan\n"
    elif kind == 4:  # held by the sensor for 12 rows
        held = lines[row].rsplit(",", 1)[1]
        lines[row : row + 12] = [line.rsplit(",", 1)[0] + "," + held for line in lines[row : row + 12]]
    elif kind == 5:  # clipped command
        rows = [line.split(",") for line in lines[first:]]
        lines[first:] = [",".join([t, f"{min(max(float(c), -9.0), 9.0):.17g}", x]) for t, c, x in rows]
    elif kind == 6:  # the other sign of the command
        rows = [line.split(",") for line in lines[first:]]
        lines[first:] = [",".join([t, f"{-float(c):.17g}", x]) for t, c, x in rows]
    return "".join(lines)


def damaged_logs(source: Path, target: Path) -> None:
    """Write every seventh log of a course, each damaged in one of eight ways (the last: not at all)."""
    random = np.random.default_rng(14)
    target.mkdir(parents=True)
    for index, path in enumerate(sorted(source.rglob("*.csv"))[::7]):
        text = path.read_text(encoding="utf-8").replace("# device: falcon", "# device: damaged falcon")
        (target / path.name).write_text(damage(text, index % 8, random), encoding="utf-8")


def store(folder: Path) -> None:
    """Compare two demo courses, the damaged logs and the real ones; write a document a device below ``folder``."""
    documents = folder / "documents"
    shutil.rmtree(folder, ignore_errors=True)
    documents.mkdir(parents=True)
    run(folder, "demo")
    damaged_logs(folder / "raw" / "demo" / "falcon", folder / "raw" / "damaged")
    sources = [("damaged", folder / "raw" / "damaged")]
    sources += [(path.name, path) for path in sorted(REAL.iterdir()) if path.is_dir()] if REAL.is_dir() else []
    stores = ["processed/demo"]
    for name, source in sources:
        stores.append(f"processed/{name}")
        told = json.loads(run(folder, "ingest", str(source), "--processed", stores[-1], "--json"))
        for entry in told["quarantined"]:
            entry["path"] = Path(entry["path"]).name
        (documents / f"{name}.ingest.json").write_text(json.dumps(told["quarantined"], indent=1))
    for place in stores:
        stored = json.loads(run(folder, "status", "--processed", place, "--json"))["experiments"]
        for device in sorted({entry["device"] for entry in stored}):
            told = run(folder, "compare", "--device", device, "--processed", place, "--report", "page.html", "--json")
            (documents / f"{Path(place).name}.{device}.json").write_text(told)
    print(f"{len(list(documents.iterdir()))} documents in {documents}")


def differences(one: object, other: object, place: str = "") -> Iterator[str]:
    """Yield where two documents differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        for name in sorted({*one, *other} - LEFT_OUT):
            if name in one and name in other:
                yield from differences(one[name], other[name], f"{place}/{name}")
            else:
                yield f"{place}/{name}: only in the {'first' if name in one else 'second'}"
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        for index, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from differences(a, b, f"{place}/{index}")
    elif isinstance(one, float) and isinstance(other, float | int):
        if not math.isclose(one, other, rel_tol=TOLERANCE, abs_tol=0.0):
            yield f"{place}: {one!r} and {other!r}"
    elif one != other:
        yield f"{place}: {one!r:.200} and {other!r:.200}"


def compare(one: Path, other: Path) -> bool:
    """Print what differs between two folders of documents; return whether something does."""
    names = sorted({p.name for folder in (one, other) for p in (folder / "documents").iterdir()})
    differ = False
    for name in names:
        paths = [folder / "documents" / name for folder in (one, other)]
        if not all(path.is_file() for path in paths):
            found = [f"only in {next(path for path in paths if path.is_file())}"]
        else:
            found = list(differences(*(json.loads(path.read_text() or "null") for path in paths)))
        print(f"{name}: {len(found)} differences")
        print("".join(f"  {line}\n" for line in found[:SHOWN]), end="")
        differ |= bool(found)
    return differ


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("store", "compare"))
    parser.add_argument("folders", type=Path, nargs="+")
    asked = parser.parse_args()
    if asked.action == "store":
        store(asked.folders[0].resolve())
        return 0
    return int(compare(*asked.folders))


if __name__ == "__main__":
    sys.exit(main())
