"""What the check of recordings costs: ingest with and without it, in turns.

python benchmarks/recording.py [LOGS] [ROWS] [TURNS]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from logs import write_logs

from pipeline.intake.ingest import ingest
from pipeline.readers import log


def seconds(folder: Path, *, checked: bool) -> float:
    """Return the processor time of a first ingest of a folder [s]."""
    check, check_many = log.check_recording, log.check_recordings
    if not checked:
        log.check_recording, log.check_recordings = lambda samples: (), lambda logs: [()] * len(logs)
    try:
        with TemporaryDirectory() as processed:
            begin = time.process_time()
            ingest([folder], Path(processed))
            return time.process_time() - begin
    finally:
        log.check_recording, log.check_recordings = check, check_many


def main(logs: int = 2220, rows: int = 900, turns: int = 5) -> None:
    with TemporaryDirectory() as name:
        folder = Path(name) / "logs"
        write_logs(folder, logs, rows)
        pairs = [(seconds(folder, checked=True), seconds(folder, checked=False)) for _ in range(turns)]
    ratios = [one / other - 1 for one, other in pairs]
    print(f"{logs} logs of {rows} rows: {min(one for one, _ in pairs):.2f} s with the check, ", end="")
    print(f"{min(other for _, other in pairs):.2f} s without; it adds {100 * median(ratios):.0f} % (median of {turns})")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
