"""The released code's part of `beside`: run from a folder of its repository, or what it took on
another machine.

Its functions for labels, warps, post-processing and VPQ need nothing but torch, OpenCV,
scikit-image and scipy; of its packages only the folder of these files is imported. The rest needs
mmcv and CUDA.
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

from benchmarks.evaluation_motion import label_of
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
"""Milliseconds that the released code took, measured once by those who made the goldens."""
_PLUGIN = "projects/mmdet3d_plugin"
_RANGES = (slice(None), slice(70, 130))
_GRID = {"xbound": [-50.0, 50.0, 0.5], "ybound": [-50.0, 50.0, 0.5], "zbound": [-10.0, 10.0, 20.0]}


def released_works() -> dict[str, tuple[Callable[[], object], dict[str, Callable[[], object]]]]:
    """Name of a work → ours, and the released one where it can run here."""
    frames, motion = make_frames(np.random.default_rng(0)), make_motion()
    labels, heads = make_labels(np.random.default_rng(0)), clear_heads()
    truth, other = label_of(heads), label_of(clear_heads(seed=1))
    found = instances_of(other.instance, truth.config.grid)
    ours: dict[str, Callable[[], object]] = {
        "labels_from_boxes": lambda: motion_labels_from_boxes(frames, motion, MotionLabelConfig()),
        "labels_to_present": lambda: labels.to_present("bilinear"),
        "postprocessing": lambda: predict_instances(heads),
        "postprocessing_of_accidents": lambda: predict_instances(heads, "accident"),
        "vpq_of_both_ranges": lambda: motion_counts(found, truth, trajectories=False),
    }
    folder = os.environ.get(FOLDER)
    if folder is None:
        return {name: (way, {}) for name, way in ours.items()}
    import torch

    torch.set_num_threads(1)
    code = Released(Path(folder))
    drawn = motion_labels_from_boxes(frames, motion, MotionLabelConfig())
    theirs: dict[str, Callable[[], object]] = {
        "labels_from_boxes": partial(code.labels, drawn.instance, drawn.label_egomotion),
        "labels_to_present": partial(code.to_present, labels),
        "postprocessing": partial(code.postprocessed, heads, ""),
        "postprocessing_of_accidents": partial(code.postprocessed, heads, "_accident"),
        "vpq_of_both_ranges": partial(code.vpq, other.instance, truth.instance),
    }
    return {name: (way, {"released": theirs[name]}) for name, way in ours.items()}


class Released:
    """The released functions, from a folder of the repository, without the packages around them."""

    def __init__(self, folder: Path) -> None:
        package = types.ModuleType("deepaccident_released")
        package.__path__ = [str(folder / _PLUGIN / "datasets/utils")]
        sys.modules[package.__name__] = package
        self._instance = importlib.import_module(f"{package.__name__}.instance")
        self._warper = importlib.import_module(f"{package.__name__}.warper").FeatureWarper(
            grid_conf=_GRID
        )
        metrics = folder / _PLUGIN / "metrics/metrics.py"
        self._metric = _definition(metrics, "PanopticMetric_separate")

    def labels(self, instance: Any, egomotion: Any) -> object:
        """Centres, offsets and flow of instances (T, H, W); the boxes are drawn already."""
        import torch

        convert = self._instance.convert_instance_mask_to_center_and_offset_label_with_warper
        maps = torch.from_numpy(instance.astype(np.int64))
        motion = torch.from_numpy(np.array(egomotion[: len(instance)]))
        return convert(maps, motion, int(instance.max()), warper=self._warper)

    def to_present(self, labels: Any) -> object:
        import torch

        maps = {
            "segmentation": (labels.segmentation[:, None], "nearest"),
            "instance": (labels.instance[:, None], "nearest"),
            "centerness": (labels.centerness, "bilinear"),
            "offset": (labels.offset, "nearest"),
            "flow": (labels.flow, "nearest"),
        }
        motion = torch.from_numpy(np.array(labels.label_egomotion)[None])
        return [
            self._warper.cumulative_warp_features_reverse(
                torch.from_numpy(each[None].astype(np.float32)), motion, mode
            )
            for each, mode in maps.values()
        ]

    def postprocessed(self, heads: MotionHeads, variant: str) -> object:
        import torch

        names = {
            "segmentation": heads.segmentation,
            "instance_center": heads.centerness,
            "instance_offset": heads.offset,
            "instance_flow": heads.flow,
        }
        output = {
            name: torch.from_numpy(np.array(each))[None] for name, each in names.items()
        }  # it writes into them
        read = getattr(self._instance, f"predict_instance_segmentation_and_trajectories{variant}")
        return read(output, compute_matched_centers=True)

    def vpq(self, prediction: Any, truth: Any) -> object:
        import torch

        metric = self._metric(n_classes=2)
        for part in _RANGES:
            metric.update(
                *(
                    torch.from_numpy(each[None, :, part, part].astype(np.int64))
                    for each in (prediction, truth)
                )
            )
        return metric


def _definition(path: Path, name: str) -> Any:
    """A class of a file, without what the file imports."""
    import torch

    tree = ast.parse(path.read_text(encoding="utf-8"))
    tree.body = [node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name]
    names: dict[str, Any] = {"torch": torch}
    exec(compile(tree, str(path), "exec"), names)  # noqa: S102 - the folder is the caller's
    return names[name]
