"""Native logs for tests: right ones (seeded), and one for each fault with the row and words to expect."""

import numpy as np

from pipeline.records.native import NativeHeader, format_header

ROWS = 30
HEADER_LINES = 10
"""Lines that `format_header` writes, column line included; the first sample stands in the next one."""


def log_text(stiffness=300.0, damping=2.0, device="bench", experiment="1", seed=0, rows=ROWS, **more) -> str:
    rng = np.random.default_rng([seed, int(stiffness), rows])
    values = np.column_stack([np.arange(rows) * 0.001, rng.normal(size=rows), rng.normal(size=rows) * 1e-3])
    header = format_header(NativeHeader(device, experiment, stiffness, damping, 8.0, 0.001, **more))
    return header + "".join("{:.17g},{:.17g},{:.17g}\n".format(*row) for row in values)


def short_log(stiffness: float, experiment: str = "1", rows: int = 3) -> str:
    """A log that is quickly written: its command counts up from its stiffness."""
    head = log_text(stiffness, experiment=experiment, rows=2).split("time_s")[0]
    return head + "time_s,command,position\n" + "".join(f"{k},{stiffness + k!r},{k}\n" for k in range(rows))


def with_cell(text: str, row: int, line: str) -> str:
    lines = text.split("\n")
    lines[row - 1] = line
    return "\n".join(lines)


GOOD = log_text()
FAULTS = {
    "text cell": (with_cell(GOOD, 17, "0.006,abc,0"), 17, "command must be a number.*'abc'"),
    "empty cell": (with_cell(GOOD, 12, "0.001,,0"), 12, "command has no value"),
    "NaN": (with_cell(GOOD, 20, "0.009,0,nan"), 20, "position is nan|position must be"),
    "infinity": (with_cell(GOOD, 40, "0.029,1e999,0"), 40, "command is inf"),
    "fourth value": (with_cell(GOOD, 13, "0.002,0,0,0"), 13, "expected 3 values, found 4"),
    "second value missing": (with_cell(GOOD, 13, "0.002,0"), 13, "expected 3 values, found 2"),
    "blank line": (with_cell(GOOD, 13, ""), 13, "a blank line between rows"),
    "time stands still": (with_cell(GOOD, 14, "0.002,0,0"), 14, "expected time to increase"),
    "carriage return": (with_cell(GOOD, 15, "0.004,0,0\r0.0041,0,0"), 15, "expected 3 values.*0.004"),
    "digit separator": (with_cell(GOOD, 16, "0.005,1_0,0"), 16, "'1_0'"),
    "no stiffness": (GOOD.replace("# stiffness", "# stiff"), 1, "no 'stiffness'.*# stiffness: <value>"),
    "NaN header": (GOOD.replace("300 ", "nan "), 3, "stiffness must be a finite number"),
    "column too many": (GOOD.replace("position\n", "position,velocity\n"), 10, "columns must be exactly"),
    "columns swapped": (GOOD.replace("command,position", "position,command"), 10, "columns must be exactly"),
    "no column line": ("\n".join(GOOD.split("\n")[:9]) + "\n", 10, "column line .* is missing"),
    "header only": ("\n".join(GOOD.split("\n")[:10]) + "\n", 11, "0 samples; expected at least 2"),
    "one sample": ("\n".join(GOOD.split("\n")[:11]) + "\n", 11, "1 samples; expected at least 2"),
    "empty file": ("", 1, "file is empty"),
    "other file": ("a,b\n1,2\n", 1, "columns must be exactly .*a,b"),
}
