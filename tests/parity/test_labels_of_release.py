"""The golden labels (tests/data/golden, a_labels) once more, from files.

Each scene is written as a release by hand and read back through the tables. Poses, boxes and
visibility then come from label, calib and meta files, egomotion from poses; every cell of the
labels in each frame's own frame and at the present is equal, as in test_labels and test_warps.
"""

import pickle
from pathlib import Path

import numpy as np
import pytest

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry.conventions import flip_six_vector
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, CATEGORIES
from tests.parity.test_labels import LABEL_FRAMES, PRESENT, Scene, config_of

pytestmark = pytest.mark.golden_cases("a_labels", "scenes")
STEP = 5
SIZE = "4.5 1.9 1.5"


def test_labels_read_from_a_release_equal_the_released_codes(golden, tmp_path: Path) -> None:
    scene = Scene(golden)
    token = write_release(scene, tmp_path)
    release = DeepAccident(dataroot=tmp_path, verbose=False, workers=1)
    own = release.motion_labels(token, config_of(scene))
    differing = {
        name: int((getattr(own, name) != scene[name]).sum())
        for name in ("segmentation", "instance", "offset", "flow")
    }
    present = own.to_present()
    for name in ("segmentation", "instance", "offset", "flow"):
        differing[f"w_{name}"] = int((getattr(present, name) != scene[f"w_{name}"]).sum())
    assert differing == dict.fromkeys(differing, 0), (
        f"scene {golden.index}: differing cells {differing}"
    )
    known = own.valid[:-1] & own.valid[1:]
    given = flip_six_vector(scene["future_egomotions"])[:-1][known]
    np.testing.assert_allclose(own.future_egomotion[:-1][known], given, rtol=0, atol=1e-6)
    assert {str(actor): identity for actor, identity in own.id_map.items()} == scene.entry[
        "instance_map"
    ]
    assert own.label_valid.tolist() == scene["frame_valid"].astype(bool).tolist()


def write_release(scene: Scene, root: Path) -> str:
    """Write the scene's files, left-handed as they are, in layout B; frames between the key frames
    have no boxes.
    """
    present, length = scene.entry["timestamp"], scene.entry["scenario_length"]
    name = "Town03_type001_subtype0001_scenario00024"
    top = root / "type1_subtype1_accident"
    (top / "meta").mkdir(parents=True)
    ids = " ".join(str(scene.entry["agent_ids"][agent]) for agent in AGENTS[:4])
    weather = f"ClearNoon -1 -1 -1 -1 -1 -1 -1 {length + 10}"
    (top / "meta" / f"{name}.txt").write_text(
        f"{weather}\n colliding agents: none none\n agents id: {ids}\n"
    )
    for a, agent in enumerate(AGENTS):
        for kind in ("label", "calib"):
            (top / agent / kind / name).mkdir(parents=True)
        for number in range(1, length + 1):
            k = min(max(round((number - present) / STEP) + PRESENT, 0), 6)
            calib = calib_of(scene, k)
            stem = f"{name}_{number:03d}"
            (top / agent / "calib" / name / f"{stem}.pkl").write_bytes(
                pickle.dumps(calib, protocol=2)
            )
            t, between = divmod(number - present, STEP)
            rows = (
                []
                if between or not 0 <= t < LABEL_FRAMES
                else rows_of(scene, t, a, own=agent == scene.entry["agent"])
            )
            (top / agent / "label" / name / f"{stem}.txt").write_text(
                "\n".join(["0.0 0.0", *rows, ""])
            )
    return f"type1_subtype1_accident/{name}/{scene.entry['agent']}/{present:03d}"


def calib_of(scene: Scene, k: int) -> dict[str, np.ndarray]:
    there = next(
        index
        for index in sorted(range(7), key=lambda index: abs(index - k))
        if scene.has("e2w", index)
    )
    lens = np.array([[800.0, 1142.5, 0], [450.0, 0, -1142.5], [1.0, 0, 0]])
    return {
        "lidar_to_ego": scene["l2e", there],
        "ego_to_world": scene["e2w", there],
        **{f"lidar_to_{camera}": np.eye(4) for camera in CAMERAS},
        **{f"intrinsic_{camera}": lens for camera in CAMERAS},
    }


def rows_of(scene: Scene, t: int, a: int, *, own: bool) -> list[str]:
    """An agent's label lines; the sample's own agent has whole boxes, of the others the visibility
    rule is all.
    """
    ids, points, seen = (scene[f"vis_{name}", t, a] for name in ("ids", "pts", "cam"))
    if own:
        x, y, z, l, w, h, yaw, vx, vy = scene["boxes", t].T  # noqa: E741 - the label's own names
        boxes = [
            f"{x[i]!r} {y[i]!r} {z[i]!r} {l[i]!r} {w[i]!r} {h[i]!r} "
            f"{-yaw[i]!r} {vx[i]!r} {-vy[i]!r}"
            for i in range(len(ids))
        ]
    else:
        boxes = [f"{x!r} {y!r} -1.0 {SIZE} 0.0 0.0 0.0" for x, y in scene["vis_xy", t, a].tolist()]
    classes = [CATEGORIES[code] for code in scene["vis_cls", t, a]]
    return [
        f"{name} {box} {number} {count} {bool(camera)}".replace("np.float64(", "").replace(")", "")
        for name, box, number, count, camera in zip(
            classes, boxes, ids.tolist(), points.tolist(), seen, strict=True
        )
    ]
