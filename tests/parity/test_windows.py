"""The golden windows of tracks (tests/data/golden/windows), and those of nuscenes-devkit's
`PredictHelper` on the same release.
"""

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.packed_release import unpack_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.v2x import TrackWindow

CASES = range(9)
EXACT_ARRAYS = ("actor_id", "category", "valid", "seen_by")
TOLERANCE_M = 1e-3
TOLERANCE_RAD = 2e-3
TOLERANCE_MPS = 1e-3
# Tolerances where all positions come from one agent's labels.
OWN_TOLERANCE_M = 1e-4
OWN_TOLERANCE_RAD = 1e-6


@pytest.fixture(scope="module")
def golden_folder(pytestconfig: pytest.Config) -> Path:
    folder = pytestconfig.getoption("golden") / "windows"
    if not (folder / "release.npz").is_file():
        pytest.fail(f"{folder}: no golden windows; see pytest --golden DIR")
    return folder


@pytest.fixture(scope="module")
def packed_da(golden_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = unpack_release(golden_folder / "release.npz", tmp_path_factory.mktemp("windows"))
    return DeepAccident(dataroot=root, verbose=False, workers=1)


@functools.cache
def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def assert_same_angles(actual: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Compare angles in radians, of which π and −π are the same; NaN equals NaN."""
    difference = np.asarray(actual) - np.asarray(expected)
    assert_array_equal(np.isnan(actual), np.isnan(expected))
    assert_allclose(
        np.nan_to_num(np.remainder(difference + np.pi, 2 * np.pi), nan=np.pi),
        np.pi,
        rtol=0,
        atol=tolerance,
    )


@pytest.mark.parametrize("number", CASES)
def test_windows_equal_the_golden_ones(
    packed_da: DeepAccident, golden_folder: Path, number: int
) -> None:
    case = read_json(golden_folder / "cases.json")[number]
    options = dict(case["call"])
    token = options.pop("token")
    options["visible"] = "released" if options["visible"] else None

    window = packed_da.window(token, **options)

    with np.load(golden_folder / case["file"]) as expected:
        assert_allclose(window.time, expected["time"], atol=1e-9)
        assert_array_equal(window.index, expected["frame_number"])
        for name in EXACT_ARRAYS:
            assert_array_equal(getattr(window, name), expected[name], err_msg=name)
        has_one_agent = options["agents"] == "single"
        tolerance_m = OWN_TOLERANCE_M if has_one_agent else TOLERANCE_M
        assert_allclose(window.center, expected["center"], rtol=0, atol=tolerance_m)
        tolerance_rad = OWN_TOLERANCE_RAD if has_one_agent else TOLERANCE_RAD
        assert_same_angles(window.yaw, expected["yaw"], tolerance_rad)
        assert_allclose(window.size, expected["size"], rtol=0, atol=TOLERANCE_M)
        assert_allclose(window.speed, expected["speed"], rtol=0, atol=TOLERANCE_MPS)
        in_world = packed_da.window(token, **{**options, "frame": "world"})
        velocity = in_world.velocity[..., :2]
        assert_allclose(velocity, expected["velocity_world"], rtol=0, atol=TOLERANCE_MPS)
    assert window.valid.shape == (case["actors"], case["steps"])
    assert window.valid.sum() == case["valid"]


def steps_of(window: TrackWindow, records: list[dict[str, Any]]) -> list[int]:
    """Return the indices of the steps that records of `PredictHelper` belong to."""
    return [window.present + record["step"] for record in records]


def test_windows_at_2_hz_equal_those_of_predict_helper(
    packed_da: DeepAccident, golden_folder: Path
) -> None:
    num_cells = 0
    for token, actors in read_json(golden_folder / "predict_helper.json").items():
        windows = {}
        for frame in ("world", "ego", "actor"):
            windows[frame] = packed_da.window(token, 2, 3, step=0.5, agents="single", frame=frame)
        world, ego, actor = windows.values()
        other_ids = world.actor_id[world.actor_id != world.own_actor_id].tolist()
        assert sorted(map(int, actors)) == other_ids

        for actor_id, truth in actors.items():
            row = int(world.actor_id.searchsorted(int(actor_id)))
            records = [*truth["past"][::-1], truth["present"], *truth["future"]]
            steps = steps_of(world, records)
            assert np.flatnonzero(world.valid[row]).tolist() == steps
            num_cells += len(steps)
            for record, step in zip(records, steps, strict=True):
                assert_allclose(world.center[row, step, :2], record["global_xy"], atol=1e-3)
                assert_allclose(ego.center[row, step], record["ego_xyz"], atol=1e-3)
            yaws = np.array([[record["global_yaw"], record["ego_yaw"]] for record in records])
            assert_same_angles(world.yaw[row, steps], yaws[:, 0], OWN_TOLERANCE_RAD)
            assert_same_angles(ego.yaw[row, steps], yaws[:, 1], OWN_TOLERANCE_RAD)
            for part in ("past", "future"):
                # Theirs is y forward, x right.
                theirs = np.array(truth[f"{part}_agent_frame"]).reshape(-1, 2)
                ours = actor.center[row, steps_of(actor, truth[part]), :2]
                assert_allclose(ours, theirs[:, ::-1] * [1, -1], atol=1e-3)
    assert num_cells > 1000
