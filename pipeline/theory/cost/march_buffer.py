"""Samples of many points between two rounds of `pipeline.theory.cost.march`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.records.batch import Booleans, Floats, Integers


@dataclass
class Buffer:
    """Samples of the points that still move: row j of ``position`` is sample k + j - history."""

    index: Integers
    alpha: Floats
    beta: Floats
    lever: Floats
    position: Floats
    velocity: Floats
    push: Floats
    sample: Floats
    """Number of the sample in the row after the history, before the next round."""
    stop: Floats
    """Sample from which on the response surely stays inside the band; infinity where that is not known."""

    def keep(self, mask: Booleans, whole: bool = False) -> Buffer:
        """Return some of the points; of the samples only those that `_Motion.run` goes on from, or all positions."""
        return _collected([self], [mask], whole)


def _collected(buffers: list[Buffer], masks: list[Booleans], whole: bool = False) -> Buffer:
    counts = [int(mask.sum()) for mask in masks]
    places = np.cumsum([0, *counts])
    shapes = {name: getattr(buffers[0], name).shape[:-1] for name in Buffer.__dataclass_fields__}
    result = Buffer(
        *(
            np.empty((*shapes[name], places[-1]), getattr(buffers[0], name).dtype)
            for name in Buffer.__dataclass_fields__
        )
    )
    rows = len(result.position)
    kept = {"position": rows if whole else rows - len(result.push), "velocity": 1, "push": 0}
    for buffer, mask, i, j in zip(buffers, masks, places[:-1], places[1:], strict=True):
        for name in Buffer.__dataclass_fields__:
            values, into = getattr(buffer, name), getattr(result, name)
            first = len(values) - kept[name] if name in kept else 0
            if values.ndim == 2:
                into[first:, i:j] = values[first:, mask]
            else:
                into[i:j] = values[mask]
    return result


def joined(buffers: list[Buffer]) -> Buffer:
    """Return the points of several buffers in one."""
    return _collected(buffers, [np.ones(len(buffer.index), np.bool_) for buffer in buffers])
