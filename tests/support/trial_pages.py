"""Trials of a report made by hand: two experiments of damped oscillations, names as hostile as wanted."""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np

from pipeline.comparison.figures.trial_page import PARTS, code, reference, step_size
from pipeline.rendering.report.report import pack
from pipeline.rendering.tables.trial_links import TrialPage

STIFFNESS = (500.0, 1000.0, 1500.0, 2000.0)
DAMPING = (0.0, 10.0, 20.0)
ROWS, EDGE = 120, 10


def response(stiffness: float, damping: float) -> np.ndarray:
    """Damped oscillation about 8 N / K; the more damping, the faster it decays. Grows for zero damping."""
    t = np.maximum(np.arange(ROWS) - EDGE, 0)
    rate = 0.004 * damping - 0.01
    return 8 / stiffness * (1 - np.exp(-rate * t) * np.cos(0.2 * t))


def trial_page(names: tuple[str, str] = ("1", "2"), text: str = "") -> TrialPage:
    """Return a page of trials in which every second trial has its response.

    Parameters
    ----------
    names : tuple of str
        Names of the experiments.
    text : str
        Stands in every text that a log can write to: trial id, reason, evidence, model, cost.
    """
    k, b = (values.ravel().tolist() for values in np.meshgrid(STIFFNESS, DAMPING))
    settle = [None if y == 0 else round(100 - 3 * y + x / 100) for x, y in zip(k, b, strict=True)]
    overshoot = [None if y == 0 else round(40 - y, 3) for y in b]
    experiments = []
    for number, name in enumerate(names):
        columns = {
            "k": k,
            "b": b,
            "v": "".join("1" if y == 0 else "0" for y in b),
            "o": "".join("0" if y == 0 else "1" for y in b),
            "c": [settle, overshoot],
            "measured": [[0, 2000, 2000], [0, 0, 20]],
            "theory": None if number else [[0, 2100, 2100], [0, 0, 20]],
        }
        responses = []
        for row in range(0, len(k), 2):
            x = response(k[row], b[row])
            step = step_size(x, 0.0)
            responses.append(
                {
                    "i": row,
                    "edge": EDGE,
                    "q": step,
                    "x": code(x, step),
                    "gq": step,
                    "g": code(0.95 * x, step),
                    "f": 8 / k[row],
                    "id": f"trial {row}{text}",
                    "why": text,
                    "evidence": f"known {text}",
                    "model": f"m = 1 kg {text}",
                    "costs": [f"{settle[row]} {text}", f"none: {text}"],
                }
            )
        experiments.append(
            {
                "name": name,
                "trials": len(k),
                "shown": len(responses),
                "period": 0.001,
                "delay": 4,
                "columns": pack(columns),
                "responses": pack(responses),
            }
        )
    content = {
        "units": {"stiffness": "N/m", "damping": "Ns/m"},
        "position": "m",
        "verdicts": ["stable", "unstable", "undecided"],
        "outcomes": ["diverged", "settled"],
        "criteria": [
            {
                "name": "settle_2pct",
                "first": True,
                "label": "settling time, 2 % band [samples]",
                "unit": "samples",
                "band": 0.02,
            },
            {"name": "overshoot", "first": False, "label": "overshoot [%]", "unit": "%", "band": None},
        ],
        "experiments": experiments,
    }
    places = {(name, f"trial {row}"): reference(n, row) for n, name in enumerate(names) for row in range(len(k))}
    return TrialPage(content, trials=2 * len(k), responses=len(k), places=places, limits={})


def decode(coded: dict[str, list[int]], step: float) -> np.ndarray:
    """Return the values that `trial_page.code` coded, as the script of the page does, each within half a step."""
    counted: list[int] = []
    for missed in coded["r"]:
        past = zip(coded["c"], reversed(counted), strict=False)
        counted.append(missed + (sum(c * value for c, value in past) + PARTS // 2) // PARTS)
    return np.asarray(counted, dtype=np.float64) * step


def unpack(packed: str) -> Any:
    """Return what `report.pack` packed."""
    return json.loads(zlib.decompress(base64.b64decode(packed)))
