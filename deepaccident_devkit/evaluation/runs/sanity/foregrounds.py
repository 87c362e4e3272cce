"""Whether the heads' actors by the rule of accidents and paths are others than those by argmax.

The released rule compares the actor's logit alone with a threshold. Probabilities, and logits whose background's cells
have an actor's logit near 0, are then actors nearly everywhere, while IoU and VPQ, which take argmax, are fine.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, Final

import numpy as np

from deepaccident_devkit.evaluation.metrics.accident import AccidentReading, ReleasedAccidents
from deepaccident_devkit.evaluation.metrics.frames import first_frames
from deepaccident_devkit.evaluation.metrics.motion import MotionProtocol
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.runs.sanity.motion import actor_cells
from deepaccident_devkit.evaluation.runs.sanity.probes import percent
from deepaccident_devkit.motion import PostProcessing
from deepaccident_devkit.motion.postprocessing.predict import FOREGROUND_THRESHOLD, foreground_cells

NOT_COUNTED: Final[tuple[int, ...]] = (0, 0, 0)
_MANY_TIMES: Final = 2.0
_EXCESS: Final = 0.01
"""Share of the grid by which there have to be more actors than by argmax."""
_FEW_TIMES: Final = 0.5
_CELLS: Final = 100
"""Actors' cells by argmax below which a lack of them says nothing."""


def post_processing_of(rules: Any) -> PostProcessing | None:
    """How a protocol reads the instances of accidents, or of paths, off heads; None where it reads none."""
    if isinstance(rules, MotionProtocol):
        return rules.paths
    if isinstance(rules, ReleasedAccidents):
        return rules.post_processing
    reading = getattr(rules, "reading", None)
    return reading.post_processing if isinstance(reading, AccidentReading) else None


def foreground_counts(prediction: MotionOutput, frames: int, settings: PostProcessing | None) -> list[int]:
    """Cells of the last prediction that are actors by the settings' rule, those by argmax, and all; 0 of no heads."""
    if prediction.heads is None or settings is None or settings.foreground == "argmax":
        return [*NOT_COUNTED]
    by_rule = foreground_cells(first_frames(prediction.heads[-1], frames).segmentation, settings)
    by_argmax = actor_cells(prediction, frames)
    return [int(np.count_nonzero(by_rule)), int(np.count_nonzero(by_argmax)), by_argmax.size]


def foreground_warnings(facts: Collection[Mapping[str, Any]], settings: PostProcessing | None) -> list[str]:
    """A sentence if the rule of accidents or paths takes many more or far fewer cells for actors than argmax.

    Args:
        facts: of each sample, with `foreground` as `foreground_counts` gives it.
        settings: that rule's.
    """
    by_rule, by_argmax, cells = (sum(each["foreground"][index] for each in facts) for index in range(3))
    many = by_rule > _MANY_TIMES * by_argmax and by_rule - by_argmax >= _EXCESS * cells
    few = by_argmax >= _CELLS and by_rule < _FEW_TIMES * by_argmax
    if settings is None or not cells or not (many or few):
        return []
    warning = (
        f"the rule by which accidents and paths are read off heads takes {percent(by_rule / cells)} of the cells for "
        f"actors, argmax {percent(by_argmax / cells)}: it takes each cell where sigmoid(actor's logit) is above "
        f"{FOREGROUND_THRESHOLD:g}, whatever the background's logit is. Write logits and not probabilities, "
        "such as −x and x with x = (actor − background) / 2"
    )
    return [warning]
