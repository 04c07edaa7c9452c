"""Run the session of `pipeline start` that the tutorial shows, and draw its pictures; run by ``make docs``.

The logs are those that the page's own files write. The session runs in a pseudo-terminal (not on Windows).
"""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import chdir, suppress
from pathlib import Path

from pipeline.profiles.profile_files import read_profile
from pipeline.rendering.figures.drawing import draw
from pipeline.rendering.figures.overview import recorded_figure
from pipeline.surface.log_picture import look

DOCS = Path(__file__).parent
PAGE = DOCS / "tutorial.md"
PICTURES = {name: DOCS / "img" / f"start-{name}.svg" for name in ("log", "limits")}

WORDS = ("start", "bare", "--no-open")
ANSWERS = ("", "mm")
"""Command of the session, and what is typed: Enter for the unit of the force, mm for that of the position."""

COLUMNS = 118
"""Width of the terminal."""

LONGEST_S = 600.0
"""How long a session may take [s]."""

_BLOCK = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_SESSION = re.compile(r"(?<=^```text session\n).*?(?=^```$)", re.MULTILINE | re.DOTALL)
_ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")

_STYLE = (
    "<style>svg{color:#1f2328;background:#fff;--fig-faint:#ddd;font-family:sans-serif}"
    "@media(prefers-color-scheme:dark){svg{color:#e6edf3;background:#0d1117;--paper:#0d1117;--fig-faint:#30363d;"
    "--fig-blue:#58a6ff;--fig-green:#3fb950}}</style>"
)
"""Colours of the page, which a report's style sheet would bring."""


def in_terminal(folder: Path, words: Sequence[str], answers: Sequence[str]) -> tuple[int, str, list[str]]:
    """Run the command line in a pseudo-terminal and answer its questions in turn.

    Returns the exit status, what was shown without progress, and the answers that nobody asked for.
    """
    import pty

    main, terminal = pty.openpty()
    environment = os.environ | {"COLUMNS": str(COLUMNS), "TERM": "dumb", "BROWSER": "true"}
    process = subprocess.Popen(
        [sys.executable, "-m", "pipeline", *words],
        cwd=folder,
        env=environment,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
    )
    os.close(terminal)
    shown, waiting, until = b"", list(answers), time.monotonic() + LONGEST_S
    with suppress(OSError):  # when nobody writes to it any more
        while time.monotonic() < until:
            if select.select([main], [], [], 0.2)[0]:
                part = os.read(main, 10_000)
                if not part:
                    break
                shown += part
                # a question ends with its proposal in brackets and a colon
                if waiting and re.search(rb"\[[^\]\n]*\]:? $", shown):
                    os.write(main, f"{waiting.pop(0)}\n".encode())
            elif process.poll() is not None:
                break
    os.close(main)
    text = _ANSI.sub("", shown.decode("utf-8", "replace")).replace("\r\n", "\n")
    passing = ("\r", "━", "compiling")
    lines = [line for line in text.split("\n") if not any(sign in line for sign in passing)]
    return process.wait(), "\n".join(lines), waiting


def write_logs(folder: Path) -> None:
    """Write the logs of the page: its Python files are run, behind the simulation that they need."""
    section = PAGE.read_text(encoding="utf-8").split("## Ten minutes with your own files")[1]
    files = [(name, text) for language, name, text in _BLOCK.findall(section) if language == "python"]
    (simulate,) = re.findall(r"^pipeline (simulate .*) --out simulated$", section, re.MULTILINE)
    subprocess.run(
        [sys.executable, "-m", "pipeline", *simulate.split(), "--out", "simulated"],
        cwd=folder,
        check=True,
        capture_output=True,
    )
    for name, text in files:
        (folder / name).write_text(text, encoding="utf-8")
        subprocess.run([sys.executable, name], cwd=folder, check=True)


def pictures(folder: Path) -> dict[str, str]:
    """Return the pictures behind a session in a folder: its first log, and the limits of the report, as SVG."""
    profile = read_profile(folder / "bare.toml")
    with chdir(folder):
        first = min((folder / "bare").glob("Messung *.csv"), key=lambda path: path.name)
        _, columns = look(first, profile).trials[0]
        panels = draw(recorded_figure("log", "first log", columns, "time [s]")).panels
        subprocess.run(
            [sys.executable, "-m", "pipeline", "compare", "--device", "bare", "--export", "paper"],
            check=True,
            capture_output=True,
        )
        limits = (folder / "paper" / "figures" / "boundaries-answer-0.svg").read_text(encoding="utf-8")
    return {"log": _stacked(panels, "First log of the folder: command and position"), "limits": limits}


def _stacked(panels: Sequence[str], title: str) -> str:
    """Return one SVG file with panels below each other."""
    boxes = [re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', panel) for panel in panels]
    sizes = [(float(box[1]), float(box[2])) for box in boxes if box]
    width, height, top = max(w for w, _ in sizes), sum(h for _, h in sizes), 0.0
    parts = []
    for panel, (w, h) in zip(panels, sizes, strict=True):
        parts.append(panel.replace("<svg ", f'<svg y="{top:g}" width="{w:g}" height="{h:g}" ', 1))
        top += h
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'viewBox="0 0 {width:g} {height:g}" width="{width:g}" height="{height:g}"><title>{title}</title>'
    )
    return head + _STYLE + "".join(parts) + "</svg>\n"


def run_session(folder: Path) -> str:
    """Return what the session of the page shows in a folder with its logs.

    Raises
    ------
    RuntimeError
        If it does not end as the page says.
    """
    status, shown, left = in_terminal(folder, WORDS, ANSWERS)
    if status or left:
        raise RuntimeError(f"the session ends with status {status}, and nobody asked for {left}:\n{shown}")
    return "\n".join(line.rstrip() for line in shown.strip().split("\n")) + "\n"


def main() -> None:
    """Put the session into the page, and write its pictures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_logs(folder)
        shown = run_session(folder)
        text = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(_SESSION.sub(lambda _: shown, text, count=1), encoding="utf-8")
        for key, picture in pictures(folder).items():
            PICTURES[key].write_text(picture, encoding="utf-8")


if __name__ == "__main__":
    main()
