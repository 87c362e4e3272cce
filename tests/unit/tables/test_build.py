"""The tables' values on a release written by hand, each number worked out without the devkit."""

from pathlib import Path

import numpy as np
import pytest
from support import tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import read_calib, write_raw_calib

FRAME_2 = f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/002"


@pytest.fixture(scope="module")
def hand_made(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    return DeepAccident(
        "v1", tiny_release.write_tiny_release(tmp_path_factory.mktemp("hand made")), verbose=False
    )


def test_the_scenario_is_what_its_name_and_meta_say(hand_made: DeepAccident) -> None:
    scenario = hand_made.get("scenario", tiny_release.SCENARIO_TOKEN)
    assert scenario["collision"] == {
        "ids": [1223, 1212],
        "classes": ["car", "car"],
        "impact": 6790.168605131015,
        "spawn_relation": "same",
        "contact_side": "front_side",
        "agents": ["ego_vehicle", "other_vehicle"],
    }
    expected = {
        "town": "Town03",
        "weather": "HardRain",
        "time_of_day": "Noon",
        "signalized": True,
        "designed_accident": True,
        "accident_type": 1,
        "num_frames": 4,
        "split": None,
        "folder": "",
        "first_frame_token": f"{tiny_release.SCENARIO_TOKEN}/001",
        "last_frame_token": f"{tiny_release.SCENARIO_TOKEN}/004",
    }
    assert {name: scenario[name] for name in expected} == expected


def test_left_handed_values_are_turned_once(hand_made: DeepAccident) -> None:
    pose = hand_made.get("ego_pose", FRAME_2)
    np.testing.assert_allclose(pose["rotation"], [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-12)
    assert pose["translation"] == [5.0, -2.0, 0.5]
    assert hand_made.get("sample", FRAME_2)["velocity"] == [0.0, -10.0]

    ego = hand_made.get("annotation", f"{FRAME_2}/0")
    assert ego["velocity_label"] == [0.0, -10.0]
    assert ego["actor_id"] == -100

    pedestrian = hand_made.get("annotation", f"{FRAME_2}/2")
    assert pedestrian["translation"] == [30.0, 1.5, -0.9]
    assert pedestrian["yaw"] == -2.19


def test_world_boxes_are_where_the_car_is_for_every_agent(hand_made: DeepAccident) -> None:
    for sample in hand_made.samples_of(f"{tiny_release.SCENARIO_TOKEN}/003"):
        van = next(box for box in hand_made.get_boxes(sample) if box.actor_id == 1300)
        np.testing.assert_allclose([*van.center, van.yaw], [20.6, -3.0, 1.3, 0.0], atol=1e-9)
        row = 0 if sample["agent"] == "infrastructure" else 1
        assert van.token == f"{sample['token']}/{row}"
        assert van.instance_token == f"{tiny_release.SCENARIO_TOKEN}/actor/1300"


@pytest.mark.parametrize("frame", [1, 2, 4])
def test_velocity_is_the_labels_decoded_or_comes_from_world_positions(
    hand_made: DeepAccident, frame: int
) -> None:
    """Differences are central in the middle of a track and one-sided at its ends.

    The LiDAR frame is yawed by −90° in the world.
    """
    token = f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/{frame:03d}"
    derived = hand_made.boxes(token, velocity="derived").velocity
    untracked = [np.nan] * 3
    np.testing.assert_allclose(derived, [[0, -10, 0], [2, 0, 0], untracked], atol=1e-9)

    van = hand_made.get("annotation", f"{token}/1")
    np.testing.assert_allclose(van["velocity"], [0.0, 2.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(hand_made.boxes(token).velocity[0], [0.0, -10.0, 0.0], atol=1e-9)


def test_velocity_is_exact_where_positions_tell_less(tmp_path: Path) -> None:
    """A van's label gives 3 m/s at the end of its track and NaN before; a walker is untracked."""

    def make_lines(agent: str, frame: int) -> list[str]:
        *own_lines, van, _ = tiny_release.label_lines(agent, frame)
        van_box = van.rsplit(" ", 5)[0]
        yaw = float(van_box.rsplit(" ", 1)[1])
        velocity = "nan nan"
        if frame == 4:
            velocity = f"{3 * float(np.cos(yaw))!r} {3 * float(np.sin(yaw))!r}"
        walker_velocity = f"{float(np.cos(0.5))} {float(np.sin(0.5))}"
        return [
            *own_lines,
            f"{van_box} {velocity} 1300 12 True",
            f"pedestrian 30.0 -1.5 -0.9 0.375 0.375 1.86 0.5 {walker_velocity} -1 0 True",
        ]

    root = tiny_release.write_tiny_release(tmp_path, lines_of=make_lines)
    da = DeepAccident("v1", root, verbose=False)
    for agent in ("ego_vehicle", "other_vehicle"):
        agent_token = f"{tiny_release.SCENARIO_TOKEN}/{agent}"
        last_velocity = da.boxes(f"{agent_token}/004").velocity
        np.testing.assert_allclose(last_velocity[1:], [[3, 0, 0], [1, 0, 0]], atol=1e-9)
        van_velocity = da.boxes(f"{agent_token}/002").velocity[1]
        np.testing.assert_allclose(van_velocity, [2, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("frame", "row", "velocity"), [("lidar", 1, [0.0, 2.0, 0.0]), ("world", 0, [0, -10, 0])]
)
def test_the_labels_own_velocity_can_be_asked_for(
    hand_made: DeepAccident, frame: str, row: int, velocity: list[float]
) -> None:
    """It is (vx, −vy) as if in the LiDAR frame; the agent's own row is already in world."""
    label_velocity = hand_made.boxes(FRAME_2, frame, velocity="label").velocity[row]
    np.testing.assert_allclose(label_velocity, velocity, atol=1e-9)


def test_the_colliding_pair_and_the_countdown_are_on_the_annotations(
    hand_made: DeepAccident,
) -> None:
    colliders = {record["token"] for record in hand_made.annotation if record["is_collider"]}
    assert colliders == {
        f"{tiny_release.SCENARIO_TOKEN}/{agent}/{frame:03d}/0"
        for agent in ("ego_vehicle", "other_vehicle")
        for frame in range(1, 5)
    }
    for table, token in (
        ("annotation", f"{FRAME_2}/1"),
        ("sample", FRAME_2),
        ("frame", f"{tiny_release.SCENARIO_TOKEN}/002"),
    ):
        assert hand_made.get(table, token)["time_to_impact"] == 0.2


def test_tracks_take_the_view_from_outside(hand_made: DeepAccident) -> None:
    ego = hand_made.get("track", f"{tiny_release.SCENARIO_TOKEN}/002/actor/1223")
    assert ego["agents"] == ["ego_vehicle"]
    assert ego["is_collider"] is True

    van = hand_made.get("track", f"{tiny_release.SCENARIO_TOKEN}/002/actor/1300")
    assert van["agents"] == list(tiny_release.AGENTS)
    np.testing.assert_allclose(van["translation"], [20.4, -3.0, 1.3], atol=1e-9)
    np.testing.assert_allclose(van["velocity"], [2.0, 0.0, 0.0], atol=1e-9)


def test_a_track_prefers_another_agents_row_to_the_actors_own(tmp_path: Path) -> None:
    def make_lines(agent: str, frame: int) -> list[str]:
        lines = tiny_release.label_lines(agent, frame)
        if agent == "other_vehicle":
            lines = [*lines, "car 25.0 -2.0 -1.2 4.5 1.9 1.5 0.0 0.0 0.0 1223 5 True"]
        return lines

    root = tiny_release.write_tiny_release(tmp_path, lines_of=make_lines)
    release = DeepAccident("v1", root, verbose=False)
    ego = release.get("track", f"{tiny_release.SCENARIO_TOKEN}/001/actor/1223")
    assert ego["agents"] == ["ego_vehicle", "other_vehicle"]
    np.testing.assert_allclose(ego["translation"], [5.0, 2.0, 1.24], atol=1e-9)


def test_cameras_are_optical_and_sit_where_calib_says(hand_made: DeepAccident) -> None:
    front = hand_made.get(
        "calibrated_sensor", f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/Camera_Front"
    )
    np.testing.assert_allclose(front["translation"], [2.0, 0.0, 1.64], atol=1e-12)
    optical_axis = np.array(front["matrix"])[:3, 2]
    np.testing.assert_allclose(optical_axis, [1, 0, 0], atol=1e-12)  # looks forward
    assert front["camera_intrinsic"] == [
        [1142.5184, 0.0, 800.0],
        [0.0, 1142.5184, 450.0],
        [0.0, 0.0, 1.0],
    ]
    left = hand_made.get(
        "calibrated_sensor", f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/Camera_FrontLeft"
    )
    assert left["translation"][1] > 0
    data = hand_made.get("sample_data", f"{FRAME_2}/Camera_Back")
    assert (data["width"], data["height"]) == (1600, 900)
    assert hand_made.get("sample_data", f"{FRAME_2}/lidar01")["width"] is None


@pytest.mark.parametrize(("shift", "rows"), [(0.0005, 1), (0.005, 2)])
def test_a_sensor_has_one_row_where_rounding_alone_differs(
    tmp_path: Path, shift: float, rows: int
) -> None:
    """Half a millimetre is the release's jitter; half a centimetre is a sensor that moved.

    The matrices are exact in both cases.
    """
    root = tiny_release.write_tiny_release(tmp_path)
    path = (
        root
        / tiny_release.SCENARIO_TYPE
        / "ego_vehicle"
        / "calib"
        / tiny_release.SCENARIO_NAME
        / f"{tiny_release.SCENARIO_NAME}_003.pkl"
    )
    raw = read_calib(path, raw=True)
    raw["lidar_to_ego"][0, 3] += shift
    write_raw_calib(path, raw)

    da = DeepAccident("v1", root, verbose=False)
    agent_token = f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle"
    lidar_token = f"{agent_token}/lidar01"
    tokens = [
        record["token"]
        for record in da.calibrated_sensor
        if record["agent_token"] == agent_token and record["token"].startswith(lidar_token)
    ]
    assert tokens == [lidar_token, f"{lidar_token}/2"][:rows]
    for frame, x_m in ((1, 0.0), (3, shift)):
        assert da.ego_from(f"{agent_token}/{frame:03d}", "lidar01").translation[0] == x_m
    codes = {finding.code for finding in da.findings(tiny_release.SCENARIO_TOKEN)}
    assert ("calib-changes" in codes) == (rows == 2)


def test_sensor_data_comes_with_boxes_in_the_sensors_frame(
    hand_made: DeepAccident, tmp_path: Path
) -> None:
    path, boxes, intrinsic = hand_made.get_sample_data(
        f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle_behind/001/Camera_Front"
    )
    camera_folder = (
        hand_made.dataroot / tiny_release.SCENARIO_TYPE / "ego_vehicle_behind" / "Camera_Front"
    )
    scenario_folder = camera_folder / tiny_release.SCENARIO_NAME
    assert path == scenario_folder / f"{tiny_release.SCENARIO_NAME}_001.jpg"
    van = next(box for box in boxes if box.actor_id == 1300)
    # 30.2 m ahead of the agent at x = −10, camera 2 m ahead and 2.14 m up; 3 m to its right
    np.testing.assert_allclose(van.center, [3.0, 0.84, 28.2], atol=1e-9)
    assert intrinsic is not None
    assert intrinsic[0, 0] == 1142.5184
    _, lidar_boxes, no_intrinsic = hand_made.get_sample_data(f"{FRAME_2}/lidar01")
    assert no_intrinsic is None
    assert {box.frame for box in lidar_boxes} == {"lidar"}


@pytest.mark.parametrize(("visible", "actors"), [("released", [1300]), ("camera", [1300, -1])])
def test_visibility(hand_made: DeepAccident, visible: str, actors: list[int]) -> None:
    """Only the van has points, and a camera of each agent sees it.

    The pedestrian is untracked; the agent itself never counts.
    """
    assert [box.actor_id for box in hand_made.get_boxes(FRAME_2, visible=visible)] == actors


def test_agents_sizes(hand_made: DeepAccident) -> None:
    behind = hand_made.get("agent", f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle_behind")
    assert behind["actor_id"] == 1236
    assert behind["category"] == "car"
    assert behind["size"] == [4.5, 1.9, 1.5]

    infrastructure = hand_made.get("agent", f"{tiny_release.SCENARIO_TOKEN}/infrastructure")
    assert infrastructure["size"] is None
    assert infrastructure["is_infrastructure"] is True
