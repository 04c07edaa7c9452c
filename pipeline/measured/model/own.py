"""What each trial says alone of mass, damping and delay: a step by its own likelihood from the common numbers."""

from __future__ import annotations

import numpy as np

from pipeline.measured.model.identified import Identified
from pipeline.measured.model.intervals import physical
from pipeline.measured.model.scatter import inverse

OWN = {"mass": "gain", "damping": "delta", "delay": "delay"}
"""Quantities that are told by trial; the others stay as they are in it."""


def own_numbers(found: Identified) -> dict[str, list[float]]:
    """Return mass [kg, kg m^2], damping [Ns/m, Nms/rad] and delay [samples] of each trial, each with its error.

    Friction, a constant force and all other parts are those of the trial by the model, or common.
    """
    fit, scales = found.choice.fit, found.scales
    names, numbers = list(fit.device.names), fit.device.numbers
    places = [names.index(number) for number in OWN.values() if number in names]
    quantities, effects = physical(scales), fit.device.effects
    if fit.few:
        return {}
    result = {}
    for trial, (product, weight) in enumerate(zip(fit.moments.products, fit.solved.weight, strict=True)):
        information, score = product[:-1, :-1], product[:-1, -1]
        if effects is not None:
            held = effects[trial].copy()
            held[places] = 0.0
            score = score - information @ held
        own = information[np.ix_(places, places)]
        if not (np.diagonal(own) > 0).all():
            continue
        known = inverse(own)
        step, covariance = known @ score[places], known * fit.solved.noise / weight
        told: list[float] = []
        base, size = np.array([numbers[names[place]] for place in places]), np.sqrt(np.diagonal(covariance))
        near = np.minimum(size, 1e-3 * np.abs(base) + 1e-9)
        for name, number in OWN.items():
            if number not in names:
                told += [0.0, 0.0]
                continue
            factor = 1 / scales.period if name == "delay" else 1.0
            changed = [base, *(base + sign * each for each in np.diag(near) for sign in (1, -1))]
            value, *ends = (
                factor * quantities[name](numbers | dict(zip((names[p] for p in places), at.tolist(), strict=True)))
                for at in changed
            )
            slope = np.array([(up - down) for up, down in zip(ends[::2], ends[1::2], strict=True)]) / (2 * near)
            told += [value + float(slope @ step), float(np.sqrt(slope @ covariance @ slope))]
        result[found.names[trial]] = told
    return result
