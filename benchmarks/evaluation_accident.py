"""Accident evaluation of a sample: 6 predictions of 5 frames, 30 objects, 200 × 200 cells,
post-processing included.
"""

import numpy as np

from benchmarks.labels import make_frames, make_motion
from benchmarks.measure import Figure, best_of, one_core
from deepaccident_devkit.evaluation.accident import PROTOCOLS, AccidentContext, AccidentProtocol
from deepaccident_devkit.evaluation.predictions import MotionOutput
from deepaccident_devkit.motion import MotionHeads, MotionLabelConfig, MotionLabels
from deepaccident_devkit.motion.drawing import motion_labels_from_boxes

PREDICTIONS, REPEATS = 6, 20


def measure() -> list[Figure]:
    label = motion_labels_from_boxes(
        make_frames(np.random.default_rng(0)), make_motion(), MotionLabelConfig()
    )
    label = label.to_present(centerness="bilinear")
    output = predicted(label, np.random.default_rng(1))
    with one_core():
        return [
            Figure(
                name="accident_ms",
                value=milliseconds(PROTOCOLS["released"], output, label),
                unit="ms",
                bound=80.0,
                reference=9600,
            ),
            Figure(
                name="accident_paper_ms",
                value=milliseconds(PROTOCOLS["paper"], output, label),
                unit="ms",
                bound=80.0,
            ),
        ]


def milliseconds(protocol: AccidentProtocol, output: MotionOutput, label: MotionLabels) -> float:
    context = AccidentContext()
    return 1e3 * best_of(REPEATS, lambda: protocol.counts(output, label, context))


def predicted(label: MotionLabels, source: np.random.Generator) -> MotionOutput:
    """What a good model says: the labels, their outlines and vectors a little off, each time in
    another way.
    """
    truth = MotionHeads.from_labels(label)
    return MotionOutput(
        grid=label.config.grid, heads=tuple(noisy(truth, source) for _ in range(PREDICTIONS))
    )


def noisy(truth: MotionHeads, source: np.random.Generator) -> MotionHeads:
    logit = np.where(truth.segmentation[:, 1] > 0, 3.0, -3.0) + source.normal(
        0, 0.8, truth.segmentation[:, 1].shape
    )
    vectors = [
        np.where(values == truth.ignore_index, 0, values) + source.normal(0, 0.3, values.shape)
        for values in (truth.offset, truth.flow)
    ]
    return MotionHeads(
        segmentation=np.stack([-logit, logit], axis=1),
        centerness=truth.centerness,
        offset=vectors[0],
        flow=vectors[1],
        orientation=truth.orientation,
    )
