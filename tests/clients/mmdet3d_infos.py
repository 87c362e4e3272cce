"""Run mmdet3d 1.4.0 on an export: `python tests/clients/mmdet3d_infos.py FOLDER`, in an
environment without the devkit.

FOLDER is the output of `make_mmdet3d_infos.py`. mmdet3d imports `mmcv.ops`, which mmcv-lite lacks
and which datasets and loading do not need, so that a stub with every name replaces it.
"""

import json
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

CAMERAS = (
    "CAM_FRONT",
    "CAM_FRONT_LEFT",
    "CAM_FRONT_RIGHT",
    "CAM_BACK",
    "CAM_BACK_LEFT",
    "CAM_BACK_RIGHT",
)
NUSCENES_CLASSES = {"car": "car", "van": "car", "truck": "truck", "cyclist": "bicycle"}
"""nuScenes' class by ours, where they may differ."""


class StubModule(ModuleType):
    """A module in which every name is an empty class."""

    __path__: Sequence[str] = ()

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class StubFinder(MetaPathFinder, Loader):
    """Provides stubs for the compiled parts of mmcv."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        if name.startswith(("mmcv.ops", "mmcv._ext")):
            return ModuleSpec(name, self, is_package=True)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return StubModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


def main(folder: Path) -> None:
    sys.meta_path.insert(0, StubFinder())
    document = json.loads((folder / "expected.json").read_text())
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        from mmdet3d.datasets import NuScenesDataset
        from mmengine.registry import init_default_scope

        init_default_scope("mmdet3d")
        names: dict[str, Any] = {}
        exec(document["class"], names)  # noqa: S102
        totals = Counter[str]()
        for axes, expected in document["exports"].items():
            for kind in (NuScenesDataset, names["DeepAccidentDataset"]):
                totals += check_dataset(kind, folder / axes, expected)
            check_metric(NuScenesDataset, folder / axes, expected)
    print(
        f"mmdet3d: {totals['boxes']} boxes within 1e-3 m, with {totals['points']} points in them "
        f"as labelled, {totals['sweeps']} sweeps in place, "
        "cameras, six classes, AP 1.0 of NuScenesMetric's JSON: good"
    )


def check_dataset(kind: Any, root: Path, expected: dict[str, Any]) -> Counter[str]:
    """Compare a dataset of all splits with the expected samples.

    Returns:
        Numbers of boxes, of points in them, and of sweeps.
    """
    totals = Counter[str]()
    seen_samples = set()
    for file in sorted(root.glob("deepaccident_infos_*.pkl")):
        dataset = open_dataset(kind, file)
        for index in range(len(dataset)):
            info = dataset.get_data_info(index)
            sample = "{scenario}/{agent}/{frame:03d}".format(**info["deepaccident"])
            seen_samples.add(sample)
            assert info["sample_idx"] == index

            truth = expected[sample]
            check_boxes(info["ann_info"], truth, kind.METAINFO["classes"])
            check_camera(info["images"]["CAM_BACK_LEFT"], truth)
            points = dataset.prepare_data(index)["points"].numpy()
            totals["points"] += check_points(points[points[:, 4] == 0], truth)
            totals["sweeps"] += check_clouds(points, truth)
            totals["boxes"] += len(truth["boxes"])

    assert seen_samples == set(expected)
    assert min(totals.values()) > 100, totals

    return totals


def open_dataset(kind: Any, file: Path) -> Any:
    return kind(
        data_root=str(file.parent),
        ann_file=file.name,
        data_prefix={
            "pts": "samples/LIDAR_TOP",
            "sweeps": "sweeps/LIDAR_TOP",
            **{camera: f"samples/{camera}" for camera in CAMERAS},
        },
        modality={"use_lidar": True, "use_camera": True},
        pipeline=[
            {"type": "LoadPointsFromFile", "coord_type": "LIDAR", "load_dim": 5, "use_dim": 5},
            {
                "type": "LoadPointsFromMultiSweeps",
                "sweeps_num": 10,
                "load_dim": 5,
                "use_dim": 5,
                "test_mode": True,
            },
        ],
        filter_empty_gt=False,
    )


def check_metric(kind: Any, root: Path, expected: dict[str, Any]) -> None:
    """Give true boxes to mmdet3d's metric as results; the nuScenes devkit must match them all."""
    import torch
    from mmdet3d.evaluation.metrics import NuScenesMetric
    from nuscenes import NuScenes
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval

    (file,) = root.glob("deepaccident_infos_*.pkl")
    dataset = open_dataset(kind, file)
    results = root / "results"
    metric = NuScenesMetric(
        data_root=str(root), ann_file=str(file), format_only=True, jsonfile_prefix=str(results)
    )
    metric.dataset_meta = dataset.metainfo
    for index in range(len(dataset)):
        truth = dataset.get_data_info(index)["ann_info"]
        labels = torch.tensor(truth["gt_labels_3d"])
        boxes = {
            "bboxes_3d": truth["gt_bboxes_3d"],
            "labels_3d": labels,
            "scores_3d": torch.ones(len(labels)),
        }
        result = {"pred_instances_3d": boxes, "pred_instances": {}, "sample_idx": index}
        metric.process({}, [result])
    metric.compute_metrics(metric.results)
    evaluation = DetectionEval(
        NuScenes("v1.0-deepaccident", str(root), verbose=False),
        config_factory("detection_cvpr_2019"),
        str(results / "pred_instances_3d" / "results_nusc.json"),
        file.stem.replace("infos_", ""),
        output_dir=str(results),
        verbose=False,
    )
    precision = evaluation.evaluate()[0].serialize()["mean_dist_aps"]
    perfect = {name for name, value in precision.items() if abs(value - 1) < 1e-6}
    present = set()
    for truth in expected.values():
        present |= {NUSCENES_CLASSES.get(name, name) for name in truth["classes"]}

    assert {"car", "truck", "pedestrian"} <= perfect <= present, precision


def check_boxes(info: dict[str, Any], truth: dict[str, Any], classes: Sequence[str]) -> None:
    labels = [classes[label] for label in info["gt_labels_3d"]]
    renamed = NUSCENES_CLASSES
    if "van" in classes:
        renamed = {name: new for name, new in NUSCENES_CLASSES.items() if name not in classes}
    assert labels == [renamed.get(name, name) for name in truth["classes"]]

    boxes = info["gt_bboxes_3d"]
    columns = [
        boxes.gravity_center.numpy(),
        boxes.dims.numpy(),
        boxes.yaw.numpy(),
    ]
    values = np.column_stack([*columns, boxes.tensor[:, 7:]])
    errors = values - np.array(truth["boxes"]).reshape(-1, 9)
    errors[:, 6] = np.arctan2(np.sin(errors[:, 6]), np.cos(errors[:, 6]))
    assert np.abs(errors).max(initial=0) < 1e-3, errors


def check_points(points: np.ndarray, truth: dict[str, Any]) -> int:
    """Check that every box holds the points that its label counts; return their sum."""
    total = 0
    for box, count in zip(truth["boxes"], truth["points"], strict=True):
        x, y, z = (points[:, :3] - box[:3]).T
        cos, sin = np.cos(box[6]), np.sin(box[6])
        length, width, height = np.array(box[3:6]) / 2 + 1e-4
        is_inside = np.abs(x * cos + y * sin) < length
        is_inside &= np.abs(y * cos - x * sin) < width
        is_inside &= np.abs(z) < height
        num_inside = is_inside.sum()
        assert abs(num_inside - count) <= 1 + 0.02 * count, (box, num_inside, count)
        total += count
    return total


def check_clouds(points: np.ndarray, truth: dict[str, Any]) -> int:
    """Check that all clouds before a keyframe are in place; return the number of sweeps.

    The last column of the points is their age.
    """
    total = 0
    for age_s, (count, expected_mean) in truth["clouds"].items():
        cloud = points[np.abs(points[:, 4] - float(age_s)) < 0.01]
        assert len(cloud) == count, (age_s, len(cloud), count)
        mean = cloud[:, :3].mean(axis=0, dtype=np.float64)
        assert np.abs(mean - expected_mean).max() < 1e-3
        total += count

    assert len(points) == total

    return len(truth["clouds"]) - 1


def check_camera(camera: dict[str, Any], truth: dict[str, Any]) -> None:
    """Check that the image exists and that a point before the camera projects to its pixel."""
    assert Path(camera["img_path"]).is_file()
    point_in_camera = np.array(camera["lidar2cam"]) @ [*truth["ahead"], 1]
    u, v, depth = np.array(camera["cam2img"]) @ point_in_camera[:3]
    assert np.abs(np.array([u, v]) / depth - truth["pixel"]).max() < 1e-3


if __name__ == "__main__":
    main(Path(sys.argv[1]))
