"""Detections in the colours of their matches."""

import numpy as np
from drawing import new_axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.evaluation import DetectedBoxes, detection_truth
from deepaccident_devkit.render import detached_figure
from deepaccident_devkit.render.outcomes import draw_detection_outcome
from deepaccident_devkit.render.outcomes.evaluation import render_evaluation
from deepaccident_devkit.render.styles import OUTCOME_COLORS


def test_detections_are_coloured_by_their_matches(da_motion: DeepAccident, sample: str) -> None:
    truth = detection_truth(da_motion, sample, "paper")
    truth = truth.select((np.abs(truth.center[:, :2]) < 50).all(axis=1))  # well within the protocol's area
    some = np.arange(2, len(truth))
    center = np.vstack([truth.center[some] + (0.3, 0.0, 0.0), [[20.0, -45.0, 0.0]]])
    detected = DetectedBoxes.from_arrays(
        center,
        np.vstack([truth.size[some], [[4.0, 2.0, 1.5]]]),
        np.append(truth.yaw[some], 0.0),
        np.linspace(1, 0.5, len(center)),
        category=np.append(truth.category[some], 0),
        frame="lidar",
    )
    ax = draw_detection_outcome(detected, truth, "paper", ax=new_axes())
    shapes = {
        to_hex(each.get_edgecolor()[0]): each.get_paths()
        for each in ax.collections
        if isinstance(each, PolyCollection) and len(each.get_paths())
    }
    (false,) = shapes[OUTCOME_COLORS["false"]]
    assert_allclose(false.vertices[:4].mean(axis=0), (20, -45))
    missed = [path.vertices[:4].mean(axis=0) for path in shapes[OUTCOME_COLORS["missed"]]]
    assert_allclose(missed, truth.center[:2, :2], atol=1e-6)
    assert len(shapes[OUTCOME_COLORS["right"]]) == len(some)
    assert ax.get_title() == f"at 2 m: {len(some)} TP, 1 FP, 2 FN;\ncentres off by 0.30 m on average"
    ego_from_lidar = da_motion.ego_from(sample, "lidar01")
    moved = DetectedBoxes(boxes=detected.boxes.transform(ego_from_lidar, "ego"), scores=detected.scores)
    figure = render_evaluation(da_motion, sample, moved, protocol="paper", fig=detached_figure((10, 6)))
    assert figure.axes[1].get_title().startswith(f"at 2 m: {len(some)} TP, 1 FP, ")
    assert figure.axes[0].get_title().startswith(f"true boxes: {len(some)} found, ")
