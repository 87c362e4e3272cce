"""Motion labels of a sample of a release."""

from __future__ import annotations

from collections.abc import Mapping

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.motion.config import MotionLabelConfig, label_config
from deepaccident_devkit.motion.drawing.from_boxes import motion_labels_from_boxes
from deepaccident_devkit.motion.labels import MotionLabels
from deepaccident_devkit.motion.sample_boxes import sample_boxes


def motion_labels(
    dataset: Dataset,
    sample: RowArgument,
    config: MotionLabelConfig | str | None = None,
    *,
    id_map: Mapping[int, int] | None = None,
) -> MotionLabels:
    """The motion labels of a sample, each frame in its own ego frame; `MotionLabels.to_present` warps them.

    The agent's own row (−100) shows only as the ego's own box, and not at all with `draw_ego=False`. The released code
    does the same, since no agent ever sees that row; but with `filter_invisible=False` that code would rasterise it
    again, over the ego's box and under an id of its own. Here this never happens.

    Args:
        dataset: the release.
        sample: token or record of the present.
        config: what labels show, or the name of a preset; None for the released ones in the devkit's orientation.
        id_map: actor id → its id in an earlier sample. The released code keeps ids while a worker reads samples of one
            scenario and agent, so they depend on what the worker read before. With None ids start at 1.

    Returns:
        Labels of `config.label_frames` frames; those beyond the recording are not valid.

    Raises:
        TokenError: no such sample.
        NotAvailableError: the sample has no label, or an agent whose sight counts is not in this (partial) release.
        ChoiceError: no such agent or configuration of agents.
    """
    chosen = label_config(config)
    source = sample_boxes(dataset, sample, chosen)
    return motion_labels_from_boxes(
        source.frames, source.egomotion, chosen, valid=source.valid, is_vehicle=source.is_vehicle, id_map=id_map
    )
