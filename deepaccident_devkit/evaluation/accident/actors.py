"""Which actors the instances of the truth are."""

from __future__ import annotations

import numpy as np

from deepaccident_devkit.arrays import BoolArray
from deepaccident_devkit.evaluation.accident.protocol import AccidentContext
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabels


def actor_of(cells: BoolArray, frame: int, label: MotionLabels, context: AccidentContext) -> int | None:
    """The actor that most of an instance's labelled cells belong to; of as many, the one that was drawn first.

    Args:
        cells: (H, W) where the instance is, as the label lies.
        frame: at which of the label's frames.
        label: the sample's.
        context: who the label's own box is.

    Returns:
        Its id; None if no cell is labelled, or if it is not known whose the label is.
    """
    drawn = label.instance[frame][cells]
    names, counts = np.unique(drawn[drawn > 0], return_counts=True)
    if not len(names):
        return None
    most = int(names[np.argmax(counts)])
    actor = next((actor for actor, name in label.id_map.items() if name == most), None)
    return context.own_actor_id if actor == OWN_BOX_ID else actor
