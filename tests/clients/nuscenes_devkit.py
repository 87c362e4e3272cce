"""nuscenes-devkit 1.2.0 on an export: `python tests/clients/nuscenes_devkit.py FOLDER`, in an
environment without ours.

FOLDER is what `make_nuscenes_devkit.py` made. Everything is compared with our own boxes, or
evaluated by the devkit.
"""

import json
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")

import numpy as np
from nuscenes import NuScenes
from nuscenes.eval.common.config import config_factory
from nuscenes.eval.detection.evaluate import DetectionEval
from nuscenes.eval.detection.utils import category_to_detection_name
from nuscenes.eval.tracking.evaluate import TrackingEval
from nuscenes.eval.tracking.utils import category_to_tracking_name
from nuscenes.prediction import PredictHelper
from nuscenes.utils.data_classes import LidarPointCloud
from nuscenes.utils.geometry_utils import BoxVisibility, points_in_box
from pyquaternion import Quaternion

VERSION, SPLIT = "v1.0-deepaccident", "deepaccident_train"
META = {
    name: name == "use_lidar"
    for name in ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
}


def main(folder: Path) -> None:
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        line = checked(folder)
    print(line)


def checked(folder: Path) -> str:
    """Run all checks; what they found."""
    before = resident()
    nusc = NuScenes(VERSION, str(folder / "export"), verbose=False)
    grown = resident() - before
    nusc.list_scenes()
    expected = json.loads((folder / "expected.json").read_text())
    boxes = check_boxes(nusc, expected)
    off = check_sweeps(nusc, expected)
    check_points(nusc)
    render(nusc, folder)
    check_futures(nusc)
    found = detect(nusc, folder)
    tracked = track(nusc, folder)
    return (
        f"nuscenes-devkit: {boxes} boxes in sensor frames within 1e-3 m, at sweeps "
        f"within {off:.2f} m, rendered; "
        f"AP 1.0 of {found}, MOTA 1.0 of {tracked}; "
        f"{grown / len(nusc.ego_pose) / 1000:.0f} kB of memory a sample: good"
    )


def resident() -> int:
    """Bytes of this process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def check_boxes(nusc: NuScenes, expected: dict) -> int:
    """Boxes in the frames of all sensors of all keyframes are ours."""
    count = 0
    for sample in nusc.sample:
        for channel, token in sample["data"].items():
            _, found, _ = nusc.get_sample_data(token, box_vis_level=BoxVisibility.NONE)
            ours = np.array(expected[sample["deepaccident_token"]][channel])
            if not found:
                assert len(ours) == 0
                continue
            actors = [nusc.get("sample_annotation", box.token)["actor_id"] for box in found]
            assert actors == ours[:, 0].tolist()
            assert np.abs(np.array([box.center for box in found]) - ours[:, 1:4]).max() < 1e-3
            assert np.abs(np.array([box.wlh for box in found]) - ours[:, 4:7]).max() < 1e-9
            for box, rotation in zip(found, ours[:, 7:], strict=True):
                assert Quaternion.absolute_distance(box.orientation, Quaternion(rotation)) < 1e-4
            count += len(found)
    assert count > 1000
    return count


def check_sweeps(nusc: NuScenes, expected: dict) -> float:
    """Boxes that the devkit interpolates at sweeps are near those of our 10 Hz labels; the 95th
    percentile, metres.
    """
    off = []
    for row in nusc.sample_data:
        sample = nusc.get("sample", row["sample_token"])
        if row["is_key_frame"] or row["channel"] != "LIDAR_TOP" or not sample["prev"]:
            continue
        steps = (sample["timestamp"] - row["timestamp"]) // 100_000
        assert 1 <= steps <= 4
        name, number = sample["deepaccident_token"].rsplit("/", 1)
        ours = {
            box[0]: box[1:4]
            for box in expected[f"{name}/{int(number) - steps:03d}"]["world"]
            if box[0] != -1
        }
        for box in nusc.get_boxes(row["token"]):
            record = nusc.get("sample_annotation", box.token)
            if record["prev"] and record["actor_id"] in ours:
                off.append(np.linalg.norm(box.center - ours[record["actor_id"]]))
    assert len(off) > 500
    assert np.percentile(off, 95) < 0.25, np.percentile(off, 95)
    return float(np.percentile(off, 95))


def check_points(nusc: NuScenes) -> None:
    """Boxes hold the points that their rows count; clouds of several sweeps come together."""
    wrong = total = 0
    for sample in nusc.sample:
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = LidarPointCloud.from_file(path).points[:3]
        for box in boxes:
            said = nusc.get("sample_annotation", box.token)["num_lidar_pts"]
            wrong += abs(points_in_box(box, points).sum() - said) > 3 + 0.05 * said
            total += said > 0
    assert total > 100
    assert wrong < 0.02 * total, (wrong, total)
    last = nusc.get("sample", nusc.scene[0]["last_sample_token"])
    cloud, times = LidarPointCloud.from_file_multisweep(
        nusc, last, "LIDAR_TOP", "LIDAR_TOP", nsweeps=6
    )
    assert np.allclose(np.unique(times), np.arange(6) / 10, atol=1e-6)
    assert cloud.points.shape == (4, times.shape[1])


def render(nusc: NuScenes, folder: Path) -> None:
    """Pictures of a camera, of the LiDAR over the map, of an annotation."""
    sample = nusc.get("sample", nusc.scene[0]["last_sample_token"])
    for channel in ("CAM_FRONT", "CAM_BACK_LEFT", "LIDAR_TOP"):
        path = folder / f"{channel}.png"
        nusc.render_sample_data(
            sample["data"][channel], nsweeps=3, underlay_map=True, out_path=str(path), verbose=False
        )
        assert path.stat().st_size > 1000
    seen = nusc.get_sample_data(sample["data"]["CAM_FRONT"])[1]
    nusc.render_annotation(seen[0].token, out_path=str(folder / "annotation.png"))
    assert (folder / "annotation.png").stat().st_size > 1000


def check_futures(nusc: NuScenes) -> None:
    """The prediction helper finds where an actor goes in the next two seconds."""
    helper, seen = PredictHelper(nusc), 0
    for sample in nusc.sample:
        for first in (nusc.get("sample_annotation", token) for token in sample["anns"]):
            record, path = first, []
            while record["next"] and len(path) < 4:
                record = nusc.get("sample_annotation", record["next"])
                path.append(record["translation"][:2])
            found = helper.get_future_for_agent(
                first["instance_token"], sample["token"], 2, in_agent_frame=False
            )
            assert np.allclose(found.reshape(-1, 2), np.reshape(path, (-1, 2)))
            seen += len(path) == 4
    assert seen > 100


def write_results(
    nusc: NuScenes, path: Path, kind: str, name_of: Callable[[str], str | None]
) -> None:
    """Write the true boxes of the split that have points as `detection` or `tracking` results."""
    scenes = set(json.loads((Path(nusc.table_root) / "splits.json").read_text())[SPLIT])
    results = {}
    for sample in nusc.sample:
        if nusc.get("scene", sample["scene_token"])["name"] not in scenes:
            continue
        results[sample["token"]] = boxes = []
        for record in (nusc.get("sample_annotation", token) for token in sample["anns"]):
            name = name_of(record["category_name"])
            if record["num_lidar_pts"] == 0 or name is None:
                continue
            box = {key: record[key] for key in ("sample_token", "translation", "size", "rotation")}
            box["velocity"] = np.nan_to_num(nusc.box_velocity(record["token"])[:2]).tolist()
            box |= {f"{kind}_name": name, f"{kind}_score": 1.0}
            if kind == "detection":
                box["attribute_name"] = nusc.get("attribute", record["attribute_tokens"][0])["name"]
            else:
                box["tracking_id"] = record["instance_token"]
            boxes.append(box)
    path.write_text(json.dumps({"meta": META, "results": results}))


def detect(nusc: NuScenes, folder: Path) -> str:
    """Perfect detections have AP 1.0 in every class, and no error of any kind."""
    path, config = folder / "detections.json", config_factory("detection_cvpr_2019")
    write_results(nusc, path, "detection", category_to_detection_name)
    evaluation = DetectionEval(
        nusc, config, str(path), SPLIT, str(folder / "detection"), verbose=False
    )
    metrics, _ = evaluation.evaluate()
    near = {
        box.detection_name
        for token in evaluation.sample_tokens
        for box in evaluation.gt_boxes[token]
    }
    assert {"car", "pedestrian"} <= near
    for name in near:
        assert metrics.mean_dist_aps[name] > 1 - 1e-9, (name, metrics.mean_dist_aps[name])
        errors = metrics.serialize()["label_tp_errors"][name]
        assert np.nanmax(list(errors.values())) < 1e-6, (name, errors)
    return ", ".join(sorted(near))


def track(nusc: NuScenes, folder: Path) -> str:
    """Perfect tracks have MOTA 1.0 in every class."""
    path, config = folder / "tracks.json", config_factory("tracking_nips_2019")
    write_results(nusc, path, "tracking", category_to_tracking_name)
    evaluation = TrackingEval(
        config,
        str(path),
        SPLIT,
        str(folder / "tracking"),
        VERSION,
        str(folder / "export"),
        verbose=False,
    )
    metrics, _ = evaluation.evaluate()
    found = {
        name: value for name, value in metrics.label_metrics["mota"].items() if not np.isnan(value)
    }
    assert {"car", "pedestrian"} <= found.keys()
    assert all(value > 1 - 1e-9 for value in found.values()), found
    return ", ".join(sorted(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
