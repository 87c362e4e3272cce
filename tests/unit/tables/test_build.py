"""The tables' values on a release written by hand: every number here was worked out apart from the
devkit.
"""

from pathlib import Path

import numpy as np
import pytest
import tiny

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.release import read_calib, write_raw_calib

FRAME_2 = f"{tiny.TOKEN}/ego_vehicle/002"


@pytest.fixture(scope="module")
def hand_made(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    return DeepAccident(
        "v1", tiny.write_tiny_release(tmp_path_factory.mktemp("hand made")), verbose=False
    )


def test_the_scenario_is_what_its_name_and_meta_say(hand_made: DeepAccident) -> None:
    scenario = hand_made.get("scenario", tiny.TOKEN)
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
        "first_frame_token": f"{tiny.TOKEN}/001",
        "last_frame_token": f"{tiny.TOKEN}/004",
    }
    assert {name: scenario[name] for name in expected} == expected


def test_left_handed_values_are_turned_once(hand_made: DeepAccident) -> None:
    pose = hand_made.get("ego_pose", FRAME_2)
    np.testing.assert_allclose(pose["rotation"], [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-12)
    own, pedestrian = (hand_made.get("annotation", f"{FRAME_2}/{row}") for row in (0, 2))
    assert (pose["translation"], hand_made.get("sample", FRAME_2)["velocity"]) == (
        [5.0, -2.0, 0.5],
        [0.0, -10.0],
    )
    assert (own["velocity_label"], own["actor_id"]) == ([0.0, -10.0], -100)
    assert (pedestrian["translation"], pedestrian["yaw"]) == ([30.0, 1.5, -0.9], -2.19)


def test_world_boxes_are_where_the_car_is_for_every_agent(hand_made: DeepAccident) -> None:
    for sample in hand_made.samples_of(f"{tiny.TOKEN}/003"):
        van = next(box for box in hand_made.get_boxes(sample) if box.actor_id == 1300)
        np.testing.assert_allclose([*van.center, van.yaw], [20.6, -3.0, 1.3, 0.0], atol=1e-9)
        assert van.token == f"{sample['token']}/{0 if sample['agent'] == 'infrastructure' else 1}"
        assert van.instance_token == f"{tiny.TOKEN}/actor/1300"


@pytest.mark.parametrize("frame", [1, 2, 4])
def test_velocity_is_the_labels_decoded_or_comes_from_world_positions(
    hand_made: DeepAccident, frame: int
) -> None:
    """In the LiDAR frame's axes, yawed by −90° in world. Central in the middle, one-sided at the
    ends.
    """
    token = f"{tiny.TOKEN}/ego_vehicle/{frame:03d}"
    derived = hand_made.boxes(token, velocity="derived").velocity
    np.testing.assert_allclose(
        derived, [[0, -10, 0], [2, 0, 0], [np.nan] * 3], atol=1e-9
    )  # one is untracked
    np.testing.assert_allclose(
        hand_made.get("annotation", f"{token}/1")["velocity"], [0.0, 2.0, 0.0], atol=1e-9
    )
    np.testing.assert_allclose(hand_made.boxes(token).velocity[0], [0.0, -10.0, 0.0], atol=1e-9)


def test_velocity_is_exact_where_positions_tell_less(tmp_path: Path) -> None:
    """A van whose label says 3 m/s at the end of its track, an untracked walker, and a van without
    a number.
    """

    def lines(agent: str, frame: int) -> list[str]:
        own, walker = (
            tiny.label_lines(agent, frame)[:-2],
            "pedestrian 30.0 -1.5 -0.9 0.375 0.375 1.86 {} {} {} -1 0 True",
        )
        place = tiny.label_lines(agent, frame)[-2].rsplit(" ", 5)[0]
        yaw = float(place.rsplit(" ", 1)[1])
        said = f"{3 * float(np.cos(yaw))!r} {3 * float(np.sin(yaw))!r}" if frame == 4 else "nan nan"
        return [
            *own,
            f"{place} {said} 1300 12 True",
            walker.format(0.5, float(np.cos(0.5)), float(np.sin(0.5))),
        ]

    da = DeepAccident("v1", tiny.write_tiny_release(tmp_path, lines_of=lines), verbose=False)
    for agent in ("ego_vehicle", "other_vehicle"):
        at_end = da.boxes(f"{tiny.TOKEN}/{agent}/004").velocity
        np.testing.assert_allclose(at_end[1:], [[3, 0, 0], [1, 0, 0]], atol=1e-9)
        np.testing.assert_allclose(
            da.boxes(f"{tiny.TOKEN}/{agent}/002").velocity[1], [2, 0, 0], atol=1e-9
        )


@pytest.mark.parametrize(
    ("frame", "row", "velocity"), [("lidar", 1, [0.0, 2.0, 0.0]), ("world", 0, [0, -10, 0])]
)
def test_the_labels_own_velocity_can_be_asked_for(
    hand_made: DeepAccident, frame: str, row: int, velocity: list[float]
) -> None:
    """(vx, −vy) of the label as if in the LiDAR frame; the agent's own row is in world already."""
    found = hand_made.boxes(FRAME_2, frame, velocity="label").velocity[row]
    np.testing.assert_allclose(found, velocity, atol=1e-9)


def test_the_colliding_pair_and_the_countdown_are_on_the_annotations(
    hand_made: DeepAccident,
) -> None:
    assert {record["token"] for record in hand_made.annotation if record["is_collider"]} == {
        f"{tiny.TOKEN}/{agent}/{frame:03d}/0"
        for agent in ("ego_vehicle", "other_vehicle")
        for frame in range(1, 5)
    }
    for table, token in (
        ("annotation", f"{FRAME_2}/1"),
        ("sample", FRAME_2),
        ("frame", f"{tiny.TOKEN}/002"),
    ):
        assert hand_made.get(table, token)["time_to_impact"] == 0.2


def test_tracks_take_the_view_from_outside(hand_made: DeepAccident) -> None:
    van, ego = (hand_made.get("track", f"{tiny.TOKEN}/002/actor/{actor}") for actor in (1300, 1223))
    assert (van["agents"], ego["agents"], ego["is_collider"]) == (
        list(tiny.AGENTS),
        ["ego_vehicle"],
        True,
    )
    np.testing.assert_allclose(van["translation"], [20.4, -3.0, 1.3], atol=1e-9)
    np.testing.assert_allclose(van["velocity"], [2.0, 0.0, 0.0], atol=1e-9)


def test_a_track_prefers_another_agents_row_to_the_actors_own(tmp_path: Path) -> None:
    def lines(agent: str, frame: int) -> list[str]:
        seen = (
            []
            if agent != "other_vehicle"
            else ["car 25.0 -2.0 -1.2 4.5 1.9 1.5 0.0 0.0 0.0 1223 5 True"]
        )
        return tiny.label_lines(agent, frame) + seen

    release = DeepAccident("v1", tiny.write_tiny_release(tmp_path, lines_of=lines), verbose=False)
    ego = release.get("track", f"{tiny.TOKEN}/001/actor/1223")
    assert ego["agents"] == ["ego_vehicle", "other_vehicle"]
    np.testing.assert_allclose(ego["translation"], [5.0, 2.0, 1.24], atol=1e-9)


def test_cameras_are_optical_and_sit_where_calib_says(hand_made: DeepAccident) -> None:
    front = hand_made.get("calibrated_sensor", f"{tiny.TOKEN}/ego_vehicle/Camera_Front")
    np.testing.assert_allclose(front["translation"], [2.0, 0.0, 1.64], atol=1e-12)
    np.testing.assert_allclose(
        np.array(front["matrix"])[:3, 2], [1, 0, 0], atol=1e-12
    )  # looks forward
    assert front["camera_intrinsic"] == [
        [1142.5184, 0.0, 800.0],
        [0.0, 1142.5184, 450.0],
        [0.0, 0.0, 1.0],
    ]
    left = hand_made.get("calibrated_sensor", f"{tiny.TOKEN}/ego_vehicle/Camera_FrontLeft")
    assert left["translation"][1] > 0
    data = hand_made.get("sample_data", f"{FRAME_2}/Camera_Back")
    assert (data["width"], data["height"]) == (1600, 900)
    assert hand_made.get("sample_data", f"{FRAME_2}/lidar01")["width"] is None


@pytest.mark.parametrize(("shift", "rows"), [(0.0005, 1), (0.005, 2)])
def test_a_sensor_has_one_row_where_rounding_alone_differs(
    tmp_path: Path, shift: float, rows: int
) -> None:
    """Half a millimetre is the release's jitter, half a centimetre a sensor that moved; matrices
    are exact in both.
    """
    root = tiny.write_tiny_release(tmp_path)
    path = root / tiny.TYPE / "ego_vehicle" / "calib" / tiny.NAME / f"{tiny.NAME}_003.pkl"
    raw = read_calib(path, raw=True)
    raw["lidar_to_ego"][0, 3] += shift
    write_raw_calib(path, raw)
    da = DeepAccident("v1", root, verbose=False)
    tokens = [
        record["token"]
        for record in da.calibrated_sensor
        if record["agent_token"].endswith("/ego_vehicle")
    ]
    lidar = f"{tiny.TOKEN}/ego_vehicle/lidar01"
    assert [token for token in tokens if token.startswith(lidar)] == [lidar, f"{lidar}/2"][:rows]
    exact = [
        da.ego_from(f"{tiny.TOKEN}/ego_vehicle/{frame:03d}", "lidar01").translation[0]
        for frame in (1, 3)
    ]
    assert exact == [0.0, shift]
    assert ("calib-changes" in {finding.code for finding in da.findings(tiny.TOKEN)}) == (rows == 2)


def test_sensor_data_comes_with_boxes_in_the_sensors_frame(
    hand_made: DeepAccident, tmp_path: Path
) -> None:
    path, boxes, intrinsic = hand_made.get_sample_data(
        f"{tiny.TOKEN}/ego_vehicle_behind/001/Camera_Front"
    )
    assert (
        path
        == hand_made.dataroot
        / tiny.TYPE
        / "ego_vehicle_behind"
        / "Camera_Front"
        / tiny.NAME
        / (f"{tiny.NAME}_001.jpg")
    )
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
    """The van has 12 points and a camera for all; the pedestrian is untracked, the agent itself
    never counts.
    """
    assert [box.actor_id for box in hand_made.get_boxes(FRAME_2, visible=visible)] == actors


def test_agents_sizes(hand_made: DeepAccident) -> None:
    behind, pole = (
        hand_made.get("agent", f"{tiny.TOKEN}/{name}")
        for name in ("ego_vehicle_behind", "infrastructure")
    )
    assert (behind["actor_id"], behind["category"], behind["size"]) == (
        1236,
        "car",
        [4.5, 1.9, 1.5],
    )
    assert (pole["size"], pole["is_infrastructure"]) == (None, True)
