"""First hour: 40 walls as a lab might bring them, from their folder to a report, and 20 mistakes that must not get in.

    python benchmarks/first_hour.py [FOLDER]

writes the logs: cp1252, decimal commas, milliseconds and millimetres, positions that fall where the force pushes, K
and B in the file names, steps of 4 and 6 N in a sheet beside them. It then runs ``pipeline start`` without a terminal,
compares what was stored with the truth, and repeats that for each mistake: every one has to be stopped or warned of.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

MASS, DAMPING, PERIOD_S, DELAY = 0.55, 3.0, 0.001, 3
"""Device: kg, Ns/m, s, samples."""

ROWS, EDGE = 500, 40
TRAVEL = 0.06
"""Length of a log and row of its step; position at which it is cut [m]."""

NOISE, QUANTUM = 2e-6, 1e-6
"""Of the position sensor [m]."""


class Wall(NamedTuple):
    """Stiffness [N/mm], damping [Ns/m], step [N] and number of a log."""

    stiffness: float
    damping: float
    step: float
    number: int

    @property
    def name(self) -> str:
        """Name of the log, with a decimal comma."""
        return f"Messung {self.number:02d} K{self.stiffness:g} B{self.damping:g}".replace(".", ",") + ".csv"


def walls() -> list[Wall]:
    """Return 40 walls: eight stiffnesses at five dampings, steps of 4 and 6 N in turn."""
    pairs = [(k, b) for b in (5.0, 15.0, 30.0, 50.0, 80.0) for k in (0.5, 1.5, 3.0, 5.0, 7.5, 10.5, 14.0, 18.5)]
    return [Wall(k, b, 4.0 + 2.0 * (i % 2), i + 1) for i, (k, b) in enumerate(pairs)]


def response(wall: Wall) -> tuple[np.ndarray, np.ndarray]:
    """Return command [N] and position [m] of a step response against a wall, cut where it leaves the travel."""
    rng = np.random.default_rng(wall.number)
    x, v, read = 0.0, 0.0, 0.0
    waiting, command, position = [0.0] * DELAY, [], []
    stay = np.exp(-DAMPING / MASS * PERIOD_S)
    for row in range(ROWS):
        before, read = read, QUANTUM * round((x + NOISE * rng.normal()) / QUANTUM)
        before = read if row == 0 else before
        moved = 0.0 if row == 0 else read - position[0]
        u = wall.step * (row >= EDGE) - 1e3 * wall.stiffness * moved - wall.damping * (read - before) / PERIOD_S
        command.append(u)
        position.append(read)
        waiting.append(u)
        # exact over a sample: m x'' + b x' = F
        limit = waiting.pop(0) / DAMPING
        x += limit * PERIOD_S + (v - limit) * (1 - stay) * MASS / DAMPING
        v = limit + (v - limit) * stay
        if abs(x) > TRAVEL:
            break
    return np.array(command), np.array(position)


HEADING = "Zeit [ms];Kraft [N];Weg [mm]"


def log_text(wall: Wall) -> str:
    """Return a log as the lab writes it: a banner, German numbers, a position that falls where the force pushes."""
    command, position = response(wall)
    rows = [
        f"{1e3 * PERIOD_S * i:.3f};{u:.6f};{-1e3 * x:.6f}"
        for i, (u, x) in enumerate(zip(command, position, strict=True))
    ]
    return "\n".join(["Prüfstand 3 – Messung", HEADING, *(row.replace(".", ",") for row in rows), ""])


def sheet_text(chosen: list[Wall]) -> str:
    """Return the sheet: a row a log, with the step."""
    rows = [f"{wall.number};{wall.name};{wall.step:g};Meier" for wall in chosen]
    return "\n".join(["Nr;Datei;F0 [N];Prüfer", *rows, ""])


def write_set(folder: Path) -> list[Wall]:
    """Write the logs and their sheet; return the walls."""
    folder.mkdir(parents=True, exist_ok=True)
    chosen = walls()
    for wall in chosen:
        (folder / wall.name).write_text(log_text(wall), encoding="cp1252")
    (folder / "Messungen.csv").write_text(sheet_text(chosen), encoding="cp1252")
    (folder / "README.txt").write_text("Prüfstand 3\n", encoding="utf-8")
    return chosen


Mutation = Callable[[Path, list[Wall]], None]


def _in_logs(old: str, new: str, count: int | None = None) -> Mutation:
    def mutate(folder: Path, chosen: list[Wall]) -> None:
        for wall in chosen[:count]:
            path = folder / wall.name
            path.write_text(path.read_text(encoding="cp1252").replace(old, new), encoding="cp1252")

    return mutate


def _in_sheet(change: Callable[[str], str]) -> Mutation:
    def mutate(folder: Path, chosen: list[Wall]) -> None:
        path = folder / "Messungen.csv"
        path.write_text(change(path.read_text(encoding="cp1252")), encoding="cp1252")

    return mutate


def _columns(change: Callable[[list[str]], list[str]], count: int | None = None) -> Mutation:
    """Change the cells of each row of numbers."""

    def mutate(folder: Path, chosen: list[Wall]) -> None:
        for wall in chosen[:count]:
            path = folder / wall.name
            lines = path.read_text(encoding="cp1252").splitlines()
            rows = [";".join(change(line.split(";"))) for line in lines[2:]]
            path.write_text("\n".join([*lines[:2], *rows, ""]), encoding="cp1252")

    return mutate


def _renamed(change: Callable[[Wall], Wall], at: int) -> Mutation:
    def mutate(folder: Path, chosen: list[Wall]) -> None:
        wall = chosen[at]
        (folder / wall.name).rename(folder / change(wall).name)
        sheet = folder / "Messungen.csv"
        text = sheet.read_text(encoding="cp1252").replace(wall.name, change(wall).name)
        sheet.write_text(text, encoding="cp1252")

    return mutate


def _minus(cell: str) -> str:
    return cell[1:] if cell.startswith("-") else f"-{cell}"


def _times(cell: str, factor: float) -> str:
    return f"{factor * float(cell.replace(',', '.')):.6f}".replace(".", ",")


MUTATIONS: dict[str, Mutation] = {
    "force labelled mN": _in_logs("Kraft [N]", "Kraft [mN]"),
    "force labelled kN": _in_logs("Kraft [N]", "Kraft [kN]"),
    "position labelled m": _in_logs("Weg [mm]", "Weg [m]"),
    "position labelled um": _in_logs("Weg [mm]", "Weg [µm]"),
    "time labelled s": _in_logs("Zeit [ms]", "Zeit [s]"),
    "time labelled us": _in_logs("Zeit [ms]", "Zeit [us]"),
    "force and position swapped in the heading": _in_logs("Kraft [N];Weg [mm]", "Weg [mm];Kraft [N]"),
    "force labelled V": _in_logs("Kraft [N]", "Kraft [V]"),
    "sign of the force": _columns(lambda row: [row[0], _minus(row[1]), row[2]]),
    "sign of the position in one log": _columns(lambda row: [*row[:2], _minus(row[2])], 1),
    "sign of the force in one log": _columns(lambda row: [row[0], _minus(row[1]), row[2]], 1),
    "position in m in one log": _columns(lambda row: [*row[:2], _times(row[2], 1e-3)], 1),
    "steps of two logs exchanged": _in_sheet(lambda text: _exchanged(text)),
    "step labelled mN": _in_sheet(lambda text: text.replace("F0 [N]", "F0 [mN]")),
    "a row is missing": _in_sheet(lambda text: "\n".join(text.splitlines()[:-1]) + "\n"),
    "a row names another log": _in_sheet(lambda text: text.replace(walls()[0].name, walls()[1].name)),
    "a step is no number": _in_sheet(lambda text: text.replace(";6;", ";sechs;", 1)),
    "K of one name ten times": _renamed(lambda wall: wall._replace(stiffness=10 * wall.stiffness), 3),
    "B of one name tenfold": _renamed(lambda wall: wall._replace(damping=10 * wall.damping), 12),
    "decimal points in one log": _columns(lambda row: [cell.replace(",", ".") for cell in row], 1),
    "a cell is a text": _in_logs(";0,000000;", ";--;", 1),
}
"""What is wrong in the set, by name."""


def _exchanged(text: str) -> str:
    lines = text.splitlines()
    lines[1], lines[2] = lines[1].replace(";4;", ";6;"), lines[2].replace(";6;", ";4;")
    return "\n".join([*lines, ""])


class Run(NamedTuple):
    """What a command did: exit status, output, seconds."""

    status: int
    text: str
    seconds: float


def pipeline(folder: Path, *words: str) -> Run:
    """Run a command in a folder, without a terminal."""
    begun = time.perf_counter()
    command = [sys.executable, "-m", "pipeline", *words]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, encoding="utf-8", stdin=subprocess.DEVNULL
    )
    return Run(done.returncode, done.stdout + done.stderr, time.perf_counter() - begun)


def wrong_trials(folder: Path, chosen: list[Wall]) -> list[str]:
    """Return the stored trials that are none of the walls, or whose position moves against its step."""
    from pipeline.store.samples import load_trials
    from pipeline.store.storage import read_trials

    processed = folder / "processed"
    if not processed.is_dir():
        return []
    table = read_trials(processed)
    truth = {wall.number: wall for wall in chosen}
    wrong = []
    for row, trial in zip(table.to_pylist(), load_trials(processed, table), strict=True):
        wall = truth[int(re.search(r"Messung (\d+)", row["source_path"])[1])]  # type: ignore[index]
        turned = np.sign(trial.position[EDGE + 30] - trial.position[0]) * np.sign(row["step"])
        expected = {"stiffness": 1e3 * wall.stiffness, "damping": wall.damping, "step": wall.step}
        off = [name for name, value in expected.items() if not np.isclose(abs(row[name]), value, rtol=1e-9)]
        wrong += [f"{wall.name}: {', '.join([*off, *(['sign'] if turned < 0 else [])])}"] if off or turned < 0 else []
    return wrong


def measure(folder: Path) -> dict[str, Any]:
    """Run the set as it is: exit status, seconds, and what is wrong."""
    chosen = write_set(folder / "bench")
    run = pipeline(folder, "start", "bench", "--yes", "--no-open")
    report = folder / "reports" / "bench.html"
    return {
        "status": run.status,
        "seconds": round(run.seconds, 1),
        "report": report.is_file(),
        "wrong": wrong_trials(folder, chosen),
        "text": run.text,
    }


def mistaken(name: str, folder: Path) -> dict[str, Any]:
    """Run the set with a mistake, up to what is stored: whether it was stopped or warned of, and what got in wrong."""
    chosen = write_set(folder / "bench")
    MUTATIONS[name](folder / "bench", chosen)
    run = pipeline(folder, "start", "bench", "--yes", "--no-open", "--store-only")
    told = re.compile(r"[Ww]arning|Error|[1-9]\d* refused|open:|cure|which is right")
    warned = [line for line in run.text.splitlines() if told.search(line)]
    wrong = wrong_trials(folder, chosen)
    return {"stopped": run.status == 1 or run.status == 2, "told": warned[:3], "wrong": wrong, "status": run.status}


def main() -> None:
    """Print the numbers of the set, and what became of each mistake."""
    keep = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with TemporaryDirectory() as place:
        folder = keep or Path(place)
        found = measure(folder)
        print(found.pop("text"))
        print(json.dumps(found, indent=1, ensure_ascii=False))
        for number, name in enumerate(MUTATIONS):
            with TemporaryDirectory() as other:
                got = mistaken(name, Path(other))
            silent = not got["stopped"] and not got["told"]
            words = "stopped" if got["stopped"] else "warned" if got["told"] else "no effect"
            told = got["told"][0][:160] if got["told"] else ""
            loud = " WRONG AND SILENT" if silent and got["wrong"] else ""
            print(f"{number + 1:2d} {name}: {words}{loud}, {len(got['wrong'])} wrong trials stored. {told}")


if __name__ == "__main__":
    main()
