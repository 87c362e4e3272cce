"""mmdet3d 1.4.0 on an export: `python tests/clients/mmdet3d_infos.py FOLDER`, in an environment
without ours.

FOLDER is what `make_mmdet3d_infos.py` made. mmcv-lite has no `mmcv.ops`; datasets and loading need
none of it, but
mmdet3d imports it: a stand-in has every name.
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
THEIRS = {"car": "car", "van": "car", "truck": "truck", "cyclist": "bicycle"}
"""Our class → nuScenes', where they differ."""


class Names(ModuleType):
    """A module in which every name is a class."""

    __path__: Sequence[str] = ()

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class Finder(MetaPathFinder, Loader):
    """Finds the compiled parts of mmcv."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        return (
            ModuleSpec(name, self, is_package=True)
            if name.startswith(("mmcv.ops", "mmcv._ext"))
            else None
        )

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return Names(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


def main(folder: Path) -> None:
    sys.meta_path.insert(0, Finder())
    told = json.loads((folder / "expected.json").read_text())
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        from mmdet3d.datasets import NuScenesDataset
        from mmengine.registry import init_default_scope

        init_default_scope("mmdet3d")
        names: dict[str, Any] = {}
        exec(told["class"], names)  # noqa: S102
        found = [
            checked(kind, folder / axes, told["exports"][axes])
            for axes in told["exports"]
            for kind in (NuScenesDataset, names["DeepAccidentDataset"])
        ]
        for axes, expected in told["exports"].items():
            check_metric(NuScenesDataset, folder / axes, expected)
    boxes, points, sweeps = map(sum, zip(*found, strict=True))
    print(
        f"mmdet3d: {boxes} boxes within 1e-3 m, with {points} points in them as "
        f"labelled, {sweeps} sweeps in place, "
        "cameras, six classes, AP 1.0 of NuScenesMetric's JSON: good"
    )


def checked(kind: Any, root: Path, expected: dict[str, Any]) -> tuple[int, int, int]:
    """Compare a dataset of all splits with what is expected; the numbers of boxes, of points in
    them, and of sweeps.
    """
    totals, seen = Counter[str](), set()
    for file in sorted(root.glob("deepaccident_infos_*.pkl")):
        dataset = opened(kind, file)
        for index in range(len(dataset)):
            info = dataset.get_data_info(index)
            about = info["deepaccident"]
            name = f"{about['scenario']}/{about['agent']}/{about['frame']:03d}"
            seen.add(name)
            assert info["sample_idx"] == index
            truth = expected[name]
            check_boxes(info["ann_info"], truth, kind.METAINFO["classes"])
            check_camera(info["images"]["CAM_BACK_LEFT"], truth)
            points = dataset.prepare_data(index)["points"].numpy()
            totals["points"] += check_points(points[points[:, 4] == 0], truth)
            totals["sweeps"] += check_clouds(points, truth)
            totals["boxes"] += len(truth["boxes"])
    assert seen == set(expected)
    assert min(totals.values()) > 100, totals
    return totals["boxes"], totals["points"], totals["sweeps"]


def opened(kind: Any, file: Path) -> Any:
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
    """True boxes as results, which the metric writes for the nuScenes devkit: that finds them all,
    in the world.
    """
    import torch
    from mmdet3d.evaluation.metrics import NuScenesMetric
    from nuscenes import NuScenes
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.detection.evaluate import DetectionEval

    (file,) = root.glob("deepaccident_infos_*.pkl")
    dataset, made = opened(kind, file), root / "results"
    metric = NuScenesMetric(
        data_root=str(root), ann_file=str(file), format_only=True, jsonfile_prefix=str(made)
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
        metric.process(
            {}, [{"pred_instances_3d": boxes, "pred_instances": {}, "sample_idx": index}]
        )
    metric.compute_metrics(metric.results)
    evaluation = DetectionEval(
        NuScenes("v1.0-deepaccident", str(root), verbose=False),
        config_factory("detection_cvpr_2019"),
        str(made / "pred_instances_3d" / "results_nusc.json"),
        file.stem.replace("infos_", ""),
        output_dir=str(made),
        verbose=False,
    )
    precision = evaluation.evaluate()[0].serialize()["mean_dist_aps"]
    there = {THEIRS.get(name, name) for moment in expected.values() for name in moment["classes"]}
    found = {name for name, value in precision.items() if abs(value - 1) < 1e-6}
    assert {"car", "truck", "pedestrian"} <= found <= there, precision


def check_boxes(info: dict[str, Any], truth: dict[str, Any], classes: Sequence[str]) -> None:
    boxes, labels = info["gt_bboxes_3d"], [classes[label] for label in info["gt_labels_3d"]]
    assert labels == [
        name if name in classes and "van" in classes else THEIRS.get(name, name)
        for name in truth["classes"]
    ]
    theirs = np.column_stack(
        [boxes.gravity_center.numpy(), boxes.dims.numpy(), boxes.yaw.numpy(), boxes.tensor[:, 7:]]
    )
    off = theirs - np.array(truth["boxes"]).reshape(-1, 9)
    off[:, 6] = np.arctan2(np.sin(off[:, 6]), np.cos(off[:, 6]))
    assert np.abs(off).max(initial=0) < 1e-3, off


def check_points(points: np.ndarray, truth: dict[str, Any]) -> int:
    """Every box holds the points that its label counts."""
    total = 0
    for box, count in zip(truth["boxes"], truth["points"], strict=True):
        x, y, z = (points[:, :3] - box[:3]).T
        cos, sin = np.cos(box[6]), np.sin(box[6])
        length, width, height = np.array(box[3:6]) / 2 + 1e-4
        within = (
            (np.abs(x * cos + y * sin) < length)
            & (np.abs(y * cos - x * sin) < width)
            & (np.abs(z) < height)
        )
        assert abs(within.sum() - count) <= 1 + 0.02 * count, (box, within.sum(), count)
        total += count
    return total


def check_clouds(points: np.ndarray, truth: dict[str, Any]) -> int:
    """The clouds before a keyframe are all there and where they belong; the last column is how old
    a point is.
    """
    for age, (count, mean) in truth["clouds"].items():
        cloud = points[np.abs(points[:, 4] - float(age)) < 0.01]
        assert len(cloud) == count, (age, len(cloud), count)
        assert np.abs(cloud[:, :3].mean(axis=0, dtype=np.float64) - mean).max() < 1e-3
    assert len(points) == sum(count for count, _ in truth["clouds"].values())
    return len(truth["clouds"]) - 1


def check_camera(camera: dict[str, Any], truth: dict[str, Any]) -> None:
    """Its image is there, and a point before it is seen where it should be."""
    assert Path(camera["img_path"]).is_file()
    u, v, depth = (
        np.array(camera["cam2img"]) @ (np.array(camera["lidar2cam"]) @ [*truth["ahead"], 1])[:3]
    )
    assert np.abs(np.array([u, v]) / depth - truth["pixel"]).max() < 1e-3


if __name__ == "__main__":
    main(Path(sys.argv[1]))
