"""The golden labels (tests/data/golden, a_labels) once more, read from files.

Each scene is written as a release and read back through the tables. Poses, boxes and visibility
then come from label, calib and meta files, egomotion from poses. As in test_labels and test_warps,
every cell of the labels is equal, in each frame's own frame and at the present.
"""

import pickle
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.conventions import flip_six_vector
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, CATEGORIES
from tests.parity.test_labels import LABEL_FRAMES, PRESENT, Scene, make_config

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")
STEP_FRAMES = 5
SIZE_M = "4.5 1.9 1.5"
MAPS = ("segmentation", "instance", "offset", "flow")


def test_labels_read_from_a_release_equal_the_released_codes(golden, tmp_path: Path) -> None:
    scene = Scene(golden)
    token = write_release(scene, tmp_path)
    release = DeepAccident(dataroot=tmp_path, verbose=False, workers=1)

    labels = release.motion_labels(token, make_config(scene))

    present = labels.to_present()
    for name in MAPS:
        differing = getattr(labels, name) != scene[name]
        assert differing.sum() == 0, f"scene {golden.index}, {name}"
        differing_at_present = getattr(present, name) != scene[f"w_{name}"]
        assert differing_at_present.sum() == 0, f"scene {golden.index}, {name} at the present"

    is_known = labels.valid[:-1] & labels.valid[1:]
    egomotion = labels.future_egomotion[:-1][is_known]
    expected_egomotion = flip_six_vector(scene["future_egomotions"])[:-1][is_known]
    np.testing.assert_allclose(egomotion, expected_egomotion, rtol=0, atol=1e-6)
    id_map = {str(actor): identity for actor, identity in labels.id_map.items()}
    assert id_map == scene.entry["instance_map"]
    assert labels.label_valid.tolist() == scene["frame_valid"].astype(bool).tolist()


def write_release(scene: Scene, root: Path) -> str:
    """Write the scene's left-handed files in layout B and return the sample's token.

    Frames between the key frames have no boxes.
    """
    present = scene.entry["timestamp"]
    length = scene.entry["scenario_length"]
    name = "Town03_type001_subtype0001_scenario00024"
    top = root / "type1_subtype1_accident"
    (top / "meta").mkdir(parents=True)
    ids = " ".join(str(scene.entry["agent_ids"][agent]) for agent in AGENTS[:4])
    weather = f"ClearNoon -1 -1 -1 -1 -1 -1 -1 {length + 10}"
    (top / "meta" / f"{name}.txt").write_text(
        f"{weather}\n colliding agents: none none\n agents id: {ids}\n"
    )
    for a, agent in enumerate(AGENTS):
        labels = top / agent / "label" / name
        calibs = top / agent / "calib" / name
        labels.mkdir(parents=True)
        calibs.mkdir(parents=True)
        for number in range(1, length + 1):
            stem = f"{name}_{number:03d}"
            k = min(max(round((number - present) / STEP_FRAMES) + PRESENT, 0), 6)
            (calibs / f"{stem}.pkl").write_bytes(pickle.dumps(make_calib(scene, k), protocol=2))

            rows = []
            t, frames_since_key = divmod(number - present, STEP_FRAMES)
            if frames_since_key == 0 and 0 <= t < LABEL_FRAMES:
                rows = make_rows(scene, t, a, own=agent == scene.entry["agent"])
            (labels / f"{stem}.txt").write_text("\n".join(["0.0 0.0", *rows, ""]))
    return f"type1_subtype1_accident/{name}/{scene.entry['agent']}/{present:03d}"


def make_calib(scene: Scene, k: int) -> dict[str, np.ndarray]:
    """Return the calibration of the nearest frame that has a pose."""
    frames_with_pose = [index for index in range(7) if scene.has("e2w", index)]
    nearest = min(frames_with_pose, key=lambda index: abs(index - k))
    lens = np.array([[800.0, 1142.5, 0], [450.0, 0, -1142.5], [1.0, 0, 0]])
    return {
        "lidar_to_ego": scene["l2e", nearest],
        "ego_to_world": scene["e2w", nearest],
        **{f"lidar_to_{camera}": np.eye(4) for camera in CAMERAS},
        **{f"intrinsic_{camera}": lens for camera in CAMERAS},
    }


def make_rows(scene: Scene, t: int, a: int, *, own: bool) -> list[str]:
    """Return an agent's label lines.

    The sample's own agent has full boxes; the others only what the visibility rule reads.
    """
    ids = scene["vis_ids", t, a]
    if own:
        x, y, z, l, w, h, yaw, vx, vy = scene["boxes", t].T  # noqa: E741 - the label's own names
        boxes = [
            f"{x[i]!r} {y[i]!r} {z[i]!r} {l[i]!r} {w[i]!r} {h[i]!r} "
            f"{-yaw[i]!r} {vx[i]!r} {-vy[i]!r}"
            for i in range(len(ids))
        ]
    else:
        centers = scene["vis_xy", t, a].tolist()
        boxes = [f"{x!r} {y!r} -1.0 {SIZE_M} 0.0 0.0 0.0" for x, y in centers]

    columns = (boxes, ids, scene["vis_cls", t, a], scene["vis_pts", t, a], scene["vis_cam", t, a])
    rows = []
    for box, actor_id, code, num_points, in_camera in zip(*columns, strict=True):
        row = f"{CATEGORIES[code]} {box} {actor_id} {num_points} {bool(in_camera)}"
        rows.append(row.replace("np.float64(", "").replace(")", ""))
    return rows
