"""Run nuscenes-devkit 1.2.0 on an export: `python tests/clients/nuscenes_devkit.py FOLDER`, in an
environment without our devkit.

FOLDER is the output of `make_nuscenes_devkit.py`. Everything is compared with our own boxes or
evaluated by the nuScenes devkit.
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
from nuscenes.utils.geometry_utils import BoxVisibility, points_in_box, view_points
from pyquaternion import Quaternion

VERSION, SPLIT = "v1.0-deepaccident", "deepaccident_train"
FULL_WIDTH_PX = 1600
META = {
    name: name == "use_lidar"
    for name in ("use_camera", "use_lidar", "use_radar", "use_map", "use_external")
}


def main(folder: Path) -> None:
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        summary = run_checks(folder)
    print(summary)


def run_checks(folder: Path) -> str:
    """Run all checks and summarise their results in one line."""
    memory_before = resident_bytes()
    nusc = NuScenes(VERSION, str(folder / "export"), verbose=False)
    memory_per_sample = (resident_bytes() - memory_before) / len(nusc.ego_pose)
    nusc.list_scenes()
    expected = json.loads((folder / "expected.json").read_text())
    num_boxes = check_boxes(nusc, expected)
    sweep_error_m = check_sweeps(nusc, expected)
    check_points(nusc)
    check_rendering(nusc, folder)
    num_pixels = check_plans(nusc, json.loads((folder / "plans.json").read_text()))
    num_states = check_windows(nusc, json.loads((folder / "windows.json").read_text()))
    detected_classes = check_detection(nusc, folder)
    tracked_classes = check_tracking(nusc, folder)
    return (
        f"nuscenes-devkit: {num_boxes} boxes in sensor frames within 1e-3 m, at sweeps "
        f"within {sweep_error_m:.2f} m, rendered; "
        f"{num_pixels} points of plans within half a pixel; {num_states} states of windows; "
        f"AP 1.0 of {detected_classes}, MOTA 1.0 of {tracked_classes}; "
        f"{memory_per_sample / 1000:.0f} kB of memory a sample: good"
    )


def resident_bytes() -> int:
    """Return the bytes of this process that are in memory."""
    num_pages = int(Path("/proc/self/statm").read_text().split()[1])
    return num_pages * 4096


def check_boxes(nusc: NuScenes, expected: dict) -> int:
    """Check that the boxes of each keyframe equal ours in every sensor's frame; return their
    number.
    """
    num_boxes = 0
    for sample in nusc.sample:
        for channel, token in sample["data"].items():
            _, boxes, _ = nusc.get_sample_data(token, box_vis_level=BoxVisibility.NONE)
            ours = np.array(expected[sample["deepaccident_token"]][channel])
            if not boxes:
                assert len(ours) == 0
                continue
            actors = [nusc.get("sample_annotation", box.token)["actor_id"] for box in boxes]

            assert actors == ours[:, 0].tolist()

            centers = np.array([box.center for box in boxes])
            assert np.abs(centers - ours[:, 1:4]).max() < 1e-3

            sizes = np.array([box.wlh for box in boxes])
            assert np.abs(sizes - ours[:, 4:7]).max() < 1e-9
            for box, rotation in zip(boxes, ours[:, 7:], strict=True):
                assert Quaternion.absolute_distance(box.orientation, Quaternion(rotation)) < 1e-4

            num_boxes += len(boxes)

    assert num_boxes > 1000

    return num_boxes


def check_sweeps(nusc: NuScenes, expected: dict) -> float:
    """Check that boxes interpolated at sweeps are near our 10 Hz labels.

    Returns:
        95th percentile of the distances in metres.
    """
    distances_m = []
    for row in nusc.sample_data:
        sample = nusc.get("sample", row["sample_token"])
        if row["is_key_frame"] or row["channel"] != "LIDAR_TOP" or not sample["prev"]:
            continue
        steps = (sample["timestamp"] - row["timestamp"]) // 100_000
        assert 1 <= steps <= 4

        name, number = sample["deepaccident_token"].rsplit("/", 1)
        our_boxes = expected[f"{name}/{int(number) - steps:03d}"]["world"]
        our_centers = {box[0]: box[1:4] for box in our_boxes if box[0] != -1}
        for box in nusc.get_boxes(row["token"]):
            record = nusc.get("sample_annotation", box.token)
            actor = record["actor_id"]
            if record["prev"] and actor in our_centers:
                distances_m.append(np.linalg.norm(box.center - our_centers[actor]))

    assert len(distances_m) > 500

    percentile_m = np.percentile(distances_m, 95)
    assert percentile_m < 0.25, percentile_m

    return float(percentile_m)


def check_points(nusc: NuScenes) -> None:
    """Check that boxes hold the points that their rows count, and that sweeps can be joined."""
    wrong = total = 0
    for sample in nusc.sample:
        path, boxes, _ = nusc.get_sample_data(sample["data"]["LIDAR_TOP"])
        points = LidarPointCloud.from_file(path).points[:3]
        for box in boxes:
            expected = nusc.get("sample_annotation", box.token)["num_lidar_pts"]
            count = points_in_box(box, points).sum()
            wrong += abs(count - expected) > 3 + 0.05 * expected
            total += expected > 0

    assert total > 100
    assert wrong < 0.02 * total, (wrong, total)

    last = nusc.get("sample", nusc.scene[0]["last_sample_token"])
    cloud, times = LidarPointCloud.from_file_multisweep(
        nusc, last, "LIDAR_TOP", "LIDAR_TOP", nsweeps=6
    )

    assert np.allclose(np.unique(times), np.arange(6) / 10, atol=1e-6)
    assert cloud.points.shape == (4, times.shape[1])


def check_rendering(nusc: NuScenes, folder: Path) -> None:
    """Render two cameras, the LiDAR over the map, and an annotation."""
    sample = nusc.get("sample", nusc.scene[0]["last_sample_token"])
    for channel in ("CAM_FRONT", "CAM_BACK_LEFT", "LIDAR_TOP"):
        path = folder / f"{channel}.png"
        nusc.render_sample_data(
            sample["data"][channel], nsweeps=3, underlay_map=True, out_path=str(path), verbose=False
        )
        assert path.stat().st_size > 1000
    _, visible_boxes, _ = nusc.get_sample_data(sample["data"]["CAM_FRONT"])
    picture = folder / "annotation.png"
    nusc.render_annotation(visible_boxes[0].token, out_path=str(picture))

    assert picture.stat().st_size > 1000


def check_plans(nusc: NuScenes, plans: dict) -> int:
    """Check that plans are drawn in each camera where `view_points` has their points, within half
    a pixel of a full image; return the number of these points.
    """
    num_points = 0
    for scene in nusc.scene:
        sample = nusc.get("sample", scene["last_sample_token"])
        plan = plans.pop(sample["deepaccident_token"], {"drawn": {}})
        for channel, drawn in plan["drawn"].items():
            data = nusc.get("sample_data", sample["data"][channel])
            ego_pose = nusc.get("ego_pose", data["ego_pose_token"])
            sensor = nusc.get("calibrated_sensor", data["calibrated_sensor_token"])
            points = np.array(plan["points"])
            for pose in (ego_pose, sensor):
                rotation = Quaternion(pose["rotation"]).rotation_matrix
                points = (points - pose["translation"]) @ rotation
            points = points[points[:, 2] > 1.0]
            theirs = view_points(points.T, np.array(sensor["camera_intrinsic"]), normalize=True)
            pixels = theirs[:2].T
            is_inside = ((pixels > 0) & (pixels < [data["width"], data["height"]])).all(axis=1)
            shares = pixels[is_inside] / data["width"]
            distances = np.linalg.norm(shares[:, None] - np.array(drawn), axis=-1)
            nearest = FULL_WIDTH_PX * distances.min(axis=1)

            assert nearest.max(initial=0.0) < 0.5, (channel, nearest)

            num_points += len(nearest)

    assert not plans
    assert num_points > 10

    return num_points


def check_windows(nusc: NuScenes, windows: dict) -> int:
    """Check that the prediction helper returns the states of our windows before and after each
    keyframe, in the world and in the actor's frame; return their number.
    """
    helper = PredictHelper(nusc)
    num_states = 0
    for sample in nusc.sample:
        states_by_actor = windows[sample["deepaccident_token"]]
        for token in sample["anns"]:
            record = nusc.get("sample_annotation", token)
            if record["actor_id"] == -1:
                continue
            ours = np.array(states_by_actor.pop(str(record["actor_id"])))
            agent = (record["instance_token"], sample["token"])
            for get_states, seconds, is_side in (
                (helper.get_past_for_agent, 2, ours[:, 0] < 0),
                (helper.get_future_for_agent, 3, ours[:, 0] > 0),
            ):
                rows = get_states(*agent, seconds, in_agent_frame=False, just_xy=False)
                in_actor = get_states(*agent, seconds, in_agent_frame=True)
                # Theirs begin next to the present, and have y forward and x to the right.
                x, y = np.reshape(in_actor, (-1, 2)).T
                theirs = []
                for row, forward, left in zip(rows, y, -x, strict=True):
                    elapsed = nusc.get("sample", row["sample_token"])["timestamp"]
                    step = round((elapsed - sample["timestamp"]) / 5e5)
                    theirs.append([step, *row["translation"][:2], forward, left])
                theirs = np.reshape(sorted(theirs), (-1, 5))

                assert np.array_equal(theirs[:, 0], ours[is_side, 0])
                assert np.abs(theirs - ours[is_side]).max(initial=0) < 1e-3

                num_states += len(theirs)

        assert not states_by_actor

    assert num_states > 1000

    return num_states


def write_results(
    nusc: NuScenes, path: Path, kind: str, name_of: Callable[[str], str | None]
) -> None:
    """Write the split's true boxes that have points as `detection` or `tracking` results."""
    scenes = set(json.loads((Path(nusc.table_root) / "splits.json").read_text())[SPLIT])
    results = {}
    for sample in nusc.sample:
        if nusc.get("scene", sample["scene_token"])["name"] not in scenes:
            continue
        boxes = results[sample["token"]] = []
        for token in sample["anns"]:
            record = nusc.get("sample_annotation", token)
            name = name_of(record["category_name"])
            if record["num_lidar_pts"] == 0 or name is None:
                continue
            box = {key: record[key] for key in ("sample_token", "translation", "size", "rotation")}
            box["velocity"] = np.nan_to_num(nusc.box_velocity(token)[:2]).tolist()
            box |= {f"{kind}_name": name, f"{kind}_score": 1.0}
            if kind == "detection":
                box["attribute_name"] = nusc.get("attribute", record["attribute_tokens"][0])["name"]
            else:
                box["tracking_id"] = record["instance_token"]
            boxes.append(box)
    path.write_text(json.dumps({"meta": META, "results": results}))


def check_detection(nusc: NuScenes, folder: Path) -> str:
    """Check that perfect detections have AP 1.0 and no error; return the classes."""
    path = folder / "detections.json"
    config = config_factory("detection_cvpr_2019")
    write_results(nusc, path, "detection", category_to_detection_name)
    evaluation = DetectionEval(
        nusc, config, str(path), SPLIT, str(folder / "detection"), verbose=False
    )
    metrics, _ = evaluation.evaluate()
    present = {box.detection_name for box in evaluation.gt_boxes.all}

    assert {"car", "pedestrian"} <= present

    for name in present:
        precision = metrics.mean_dist_aps[name]
        assert precision > 1 - 1e-9, (name, precision)
        errors = metrics.serialize()["label_tp_errors"][name]
        assert np.nanmax(list(errors.values())) < 1e-6, (name, errors)
    return ", ".join(sorted(present))


def check_tracking(nusc: NuScenes, folder: Path) -> str:
    """Check that perfect tracks have MOTA 1.0 in every class; return the classes."""
    path = folder / "tracks.json"
    config = config_factory("tracking_nips_2019")
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
    accuracies = metrics.label_metrics["mota"]
    known = {name: value for name, value in accuracies.items() if not np.isnan(value)}

    assert {"car", "pedestrian"} <= known.keys()
    assert all(value > 1 - 1e-9 for value in known.values()), known

    return ", ".join(sorted(known))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
