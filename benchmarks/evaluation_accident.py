"""Measure the accident evaluation of a sample: 6 predictions of 5 frames, 30 objects, 200 × 200
cells, post-processing included.
"""

import numpy as np

from benchmarks.labels import make_frames, make_motion
from benchmarks.measure import Figure, best_of, milliseconds, one_core
from deepaccident_devkit.evaluation.accident import PROTOCOLS, AccidentContext, AccidentProtocol
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels
from deepaccident_devkit.motion.drawing import motion_labels_from_boxes

PREDICTIONS, REPEATS = 6, 20


def measure() -> list[Figure]:
    frames = make_frames(np.random.default_rng(0))
    label = motion_labels_from_boxes(frames, make_motion(), MotionLabelConfig())
    label = label.to_present(centerness="bilinear")
    output = make_predictions(label, np.random.default_rng(1))
    with one_core():
        return [
            milliseconds(
                "accident_ms",
                count_seconds(PROTOCOLS["released"], output, label),
                bound=80.0,
                reference=9600,
            ),
            milliseconds(
                "accident_paper_ms",
                count_seconds(PROTOCOLS["paper"], output, label),
                bound=80.0,
            ),
        ]


def count_seconds(protocol: AccidentProtocol, output: MotionOutput, label: MotionLabels) -> float:
    """Return the time to count the matches of a sample."""
    context = AccidentContext()
    return best_of(REPEATS, lambda: protocol.counts(output, label, context))


def make_predictions(label: MotionLabels, source: np.random.Generator) -> MotionOutput:
    """Return what a good model predicts: the labels, with outlines and vectors that are a little
    off, differently in each prediction.
    """
    truth = MotionHeads.from_labels(label)
    heads = [noisy(truth, source) for _ in range(PREDICTIONS)]
    return MotionOutput(grid=label.config.grid, heads=tuple(heads))


def noisy(truth: MotionHeads, source: np.random.Generator) -> MotionHeads:
    """Return the heads with noise on segmentation, offset and flow."""
    foreground = truth.segmentation[:, 1] > 0
    logit = np.where(foreground, 3.0, -3.0) + source.normal(0, 0.8, foreground.shape)
    vectors = []
    for values in (truth.offset, truth.flow):
        known = np.where(values == truth.ignore_index, 0, values)
        vectors.append(known + source.normal(0, 0.3, values.shape))
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=truth.centerness,
        offset=vectors[0],
        flow=vectors[1],
        orientation=truth.orientation,
    )
