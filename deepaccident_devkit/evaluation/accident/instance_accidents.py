"""`accidents_of`: the accidents in instance maps, from any framework."""

from __future__ import annotations

import math
from typing import Final

from numpy.typing import ArrayLike

from deepaccident_devkit.errors import ChoiceError, ConfigError
from deepaccident_devkit.evaluation.accident.reading import AccidentReading, accident_of
from deepaccident_devkit.evaluation.predictions import Accident, instances_of
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import LABEL_PROTOCOLS

LABEL_STEP: Final = 0.5
"""Seconds from one frame of the released labels to the next."""


def accidents_of(
    instance: ArrayLike,
    grid: BevGrid,
    *,
    step: float = LABEL_STEP,
    labels: str | None = "released",
    reading: AccidentReading | None = None,
) -> list[Accident]:
    """The accidents that instance maps show, as the protocol `paper` reads them: at most one of each prediction.

    Args:
        instance: (T, H, W), or K predictions (K, T, H, W): ids from 1 that stay the same over the frames, 0 or less
            elsewhere; in the present ego frame, the present first.
        grid: its cells; its orientation is how the maps lie.
        step: seconds from one frame to the next.
        labels: protocol of the labels that the maps are, or were learned from: where it has the half-cell shift, that
            is undone in positions. None for maps without any.
        reading: how an accident is read off maps; its foreground, link distance and redrawing are for heads alone. None
            for the protocol `paper`'s.

    Returns:
        In the order of the predictions, without those that have no accident. Positions are x forward, y left, metres;
        `ids` are those of the maps, ascending, and not actors'.

    Raises:
        GeometryError: the maps' shape is not the grid's, or they are not whole numbers.
        ChoiceError: no such labels.
        ConfigError: the step is not above 0.
    """
    if labels is not None and labels not in LABEL_PROTOCOLS:
        raise ChoiceError(f"labels: expected one of {', '.join(LABEL_PROTOCOLS)}, or None, found {labels!r}")
    if not 0 < step < math.inf:
        raise ConfigError(f"step: expected seconds above 0, found {step!r}")
    rules = None if labels is None else LABEL_PROTOCOLS[labels]
    maps = instances_of(instance, grid).instances
    read = [accident_of(each, grid, rules, reading or AccidentReading()) for each in (() if maps is None else maps)]
    return [
        Accident(positions=each.positions, time=each.contact.frame * step, ids=each.contact.ids)
        for each in read
        if each.contact is not None
    ]
