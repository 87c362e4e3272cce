"""Run the released code's part of `beside` from a folder of its repository, or give the times that
it took on another machine.

Its functions for labels, warps, post-processing and VPQ need only torch, OpenCV, scikit-image and
scipy; of its packages only the folder of these files is imported. The rest needs mmcv and CUDA.
"""

import ast
import importlib
import os
import sys
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.evaluation_motion import labels_from_heads
from benchmarks.labels import RELEASED_MS, make_frames, make_motion
from benchmarks.labels_postprocess import clear_heads
from benchmarks.labels_warp import make_labels
from deepaccident_devkit.evaluation.motion import motion_counts
from deepaccident_devkit.evaluation.predictions import instances_of
from deepaccident_devkit.motion import (
    MotionHeads,
    MotionLabelConfig,
    motion_labels_from_boxes,
    predict_instances,
)

FOLDER: Final = "DEEPACCIDENT_RELEASED"
ELSEWHERE: Final = {
    "labels_from_boxes": RELEASED_MS,
    "labels_to_present": 15.0,
    "postprocessing": 497.0,
    "postprocessing_of_accidents": 499.0,
    "vpq_of_both_ranges": 14.7,
}
"""Milliseconds that the released code took, measured once when the golden files were made."""
_PLUGIN = "projects/mmdet3d_plugin"
_RANGES = (slice(None), slice(70, 130))
_GRID = {"xbound": [-50.0, 50.0, 0.5], "ybound": [-50.0, 50.0, 0.5], "zbound": [-10.0, 10.0, 20.0]}


def released_works() -> dict[str, tuple[Callable[[], object], dict[str, Callable[[], object]]]]:
    """Return, by the name of the work, ours and the released function where it can run here."""
    frames = make_frames(np.random.default_rng(0))
    motion = make_motion()
    labels = make_labels(np.random.default_rng(0))
    heads = clear_heads()
    truth = labels_from_heads(heads)
    prediction = labels_from_heads(clear_heads(seed=1)).instance
    instances = instances_of(prediction, truth.config.grid)
    ours = {
        "labels_from_boxes": lambda: motion_labels_from_boxes(frames, motion, MotionLabelConfig()),
        "labels_to_present": lambda: labels.to_present("bilinear"),
        "postprocessing": lambda: predict_instances(heads),
        "postprocessing_of_accidents": lambda: predict_instances(heads, "accident"),
        "vpq_of_both_ranges": lambda: motion_counts(instances, truth, trajectories=False),
    }
    folder = os.environ.get(FOLDER)
    if folder is None:
        return {name: (function, {}) for name, function in ours.items()}
    import torch

    torch.set_num_threads(1)
    code = Released(Path(folder))
    drawn = motion_labels_from_boxes(frames, motion, MotionLabelConfig())
    theirs = {
        "labels_from_boxes": partial(code.labels, drawn.instance, drawn.label_egomotion),
        "labels_to_present": partial(code.to_present, labels),
        "postprocessing": partial(code.postprocess, heads, ""),
        "postprocessing_of_accidents": partial(code.postprocess, heads, "_accident"),
        "vpq_of_both_ranges": partial(code.vpq, prediction, truth.instance),
    }
    return {name: (function, {"released": theirs[name]}) for name, function in ours.items()}


class Released:
    """The released functions, from a folder of the repository, without the packages around them."""

    def __init__(self, folder: Path) -> None:
        package = types.ModuleType("deepaccident_released")
        package.__path__ = [str(folder / _PLUGIN / "datasets/utils")]
        sys.modules[package.__name__] = package
        self._instance = importlib.import_module(f"{package.__name__}.instance")
        warper = importlib.import_module(f"{package.__name__}.warper")
        self._warper = warper.FeatureWarper(grid_conf=_GRID)
        metrics = folder / _PLUGIN / "metrics/metrics.py"
        self._metric = _load_class(metrics, "PanopticMetric_separate")

    def labels(self, instance: Any, egomotion: Any) -> object:
        """Make centres, offsets and flow of instances (T, H, W); the boxes are drawn already."""
        import torch

        convert = self._instance.convert_instance_mask_to_center_and_offset_label_with_warper
        maps = torch.from_numpy(instance.astype(np.int64))
        motion = torch.from_numpy(np.array(egomotion[: len(instance)]))
        return convert(maps, motion, int(instance.max()), warper=self._warper)

    def to_present(self, labels: Any) -> object:
        """Warp all maps of the labels to the present."""
        import torch

        maps = {
            "segmentation": (labels.segmentation[:, None], "nearest"),
            "instance": (labels.instance[:, None], "nearest"),
            "centerness": (labels.centerness, "bilinear"),
            "offset": (labels.offset, "nearest"),
            "flow": (labels.flow, "nearest"),
        }
        motion = torch.from_numpy(np.array(labels.label_egomotion)[None])
        warped = []
        for values, mode in maps.values():
            tensor = torch.from_numpy(values[None].astype(np.float32))
            warped.append(self._warper.cumulative_warp_features_reverse(tensor, motion, mode))
        return warped

    def postprocess(self, heads: MotionHeads, variant: str) -> object:
        """Read instances and trajectories off the heads."""
        import torch

        heads_by_name = {
            "segmentation": heads.segmentation,
            "instance_center": heads.centerness,
            "instance_offset": heads.offset,
            "instance_flow": heads.flow,
        }
        output = {}
        for name, values in heads_by_name.items():
            copy = np.array(values)  # the function writes into it
            output[name] = torch.from_numpy(copy)[None]
        function = f"predict_instance_segmentation_and_trajectories{variant}"
        return getattr(self._instance, function)(output, compute_matched_centers=True)

    def vpq(self, prediction: Any, truth: Any) -> object:
        """Count VPQ of instances (T, H, W) in both ranges."""
        import torch

        metric = self._metric(n_classes=2)
        for cells in _RANGES:
            cropped = [
                instance[None, :, cells, cells].astype(np.int64) for instance in (prediction, truth)
            ]
            metric.update(*map(torch.from_numpy, cropped))
        return metric


def _load_class(path: Path, name: str) -> Any:
    """Load a class of a file, without what the file imports."""
    import torch

    tree = ast.parse(path.read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    namespace = {"torch": torch}
    exec(compile(tree, str(path), "exec"), namespace)  # noqa: S102 - the folder is the caller's
    return namespace[name]
