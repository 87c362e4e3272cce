from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release import META_TEXT, SCENARIO_NAME, SCENARIO_TOKEN, SCENARIO_TYPE

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.statistics import dataset_statistics
from deepaccident_devkit.v2x.collisions import (
    contact_begin,
    default_scenario,
    first_accident,
    labelled_pair,
)
from deepaccident_devkit.v2x.tracks import scenario_tracks


def test_a_trajectory_is_the_rows_of_the_track_table(da: DeepAccident) -> None:
    instance = da.instance[3]
    rows = [track for track in da.track if track["instance_token"] == instance["token"]]
    frames = [da.get("frame", row["frame_token"]) for row in rows]
    path = da.trajectory(instance)

    assert len(path) == len(rows) > 0
    assert (path.frame, path.present) == ("world", None)
    assert_array_equal(path.center, [row["translation"] for row in rows])
    assert_allclose(path.timestamp, [frame["timestamp"] for frame in frames])
    assert_array_equal(path.velocity, [row["velocity"] for row in rows])


def test_a_trajectory_in_a_samples_frame(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "other_vehicle", 3)
    actor_id = da.agent.get(sample["agent_token"])["actor_id"]
    instance = f"{da.scenario[0]['token']}/actor/{actor_id}"
    ego_from_world = da.world_from(sample, "ego").inverse()
    path = da.trajectory(instance, sample, "ego")

    assert_allclose(path.center, ego_from_world.apply(da.trajectory(instance).center), atol=1e-9)
    assert path.present == 3
    assert (np.diff(path.center[:, 0]) > 0).all()
    assert_allclose(path.yaw, 0, atol=0.05)


def test_trajectories_that_cannot_be(da: DeepAccident) -> None:
    instance = da.instance[0]["token"]
    assert_raises(
        (lambda: da.trajectory(f"{da.scenario[0]['token']}/actor/7"), TokenError, "has no actor 7"),
        (
            lambda: da.trajectory(instance, frame="ego"),
            ChoiceError,
            "frame 'ego' belongs to one agent",
        ),
        (
            lambda: da.trajectory(instance, f"{da.scenario[1]['token']}/ego_vehicle/001", "ego"),
            ChoiceError,
            "different worlds",
        ),
    )


def test_tracks_of_every_scenario_are_its_own(da: DeepAccident) -> None:
    for scenario in da.scenario:
        tracks = scenario_tracks(da, scenario)
        rows = [track for track in da.track if track["scenario_token"] == scenario["token"]]
        second_frame_rows = [row for row in rows if row["frame_token"].endswith("/002")]
        instances = [da.get("instance", row["instance_token"]) for row in second_frame_rows]
        assert len(tracks.index) == len(rows)
        assert not np.any([tracks.boxes.num_lidar_pts, tracks.boxes.camera_visible])
        assert tracks.at(2).actor_id.tolist() == [instance["actor_id"] for instance in instances]


def test_synthetic_accidents_end_in_contact(da: DeepAccident) -> None:
    accidents = [scenario for scenario in da.scenario if scenario["collision"]]
    assert first_accident(da) == accidents[0]["token"]
    for scenario in accidents:
        collision = da.collision(scenario)
        assert collision.disagreements == ()
        assert list(collision.actor_ids) == scenario["collision"]["ids"]
        assert collision.frame == scenario["last_frame_token"]
        assert collision.gap == pytest.approx(0, abs=0.01)
        assert collision.closing_speed > 3
    calm_scenarios = [scenario for scenario in da.scenario if not scenario["collision"]]
    assert {da.collision(scenario) for scenario in calm_scenarios} == {None}


def make_accident(
    tmp_path: Path,
    make_lines: Callable[[int], list[str]],
    meta: str = META_TEXT,
    **release,
) -> DeepAccident:
    """Write three frames in which only the ego's labels have rows."""

    def make_agent_lines(agent: str, frame: int) -> list[str]:
        return ["0 0", *(make_lines(frame) if agent == "ego_vehicle" else ())]

    tiny_release.write_tiny_release(
        tmp_path, frames=3, meta=meta, lines_of=make_agent_lines, **release
    )
    return DeepAccident(dataroot=tmp_path, verbose=False)


@pytest.fixture
def agents_at_origin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiny_release, "ego_to_world", lambda *_: tiny_release.pose())
    monkeypatch.setattr(tiny_release, "lidar_height", lambda _: 0.0)


@pytest.mark.usefixtures("agents_at_origin")
def test_a_car_that_drives_into_anothers_left_side(tmp_path: Path) -> None:
    """Car 1223 drives along CARLA's +y (our −y) at 10 m/s; 1212 crosses along x at 2 m/s and shows
    its left side.
    """
    da = make_accident(
        tmp_path,
        # at the last frame 2.5 m before the other's middle, 0.5 m from side to bumper
        lambda frame: [
            f"car 20.0 {frame - 5.5} 0.0 2.0 2.0 1.5 {np.pi / 2} 0 0 1223 9 True",
            f"car {19.4 + 0.2 * frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )
    scenario = SCENARIO_TOKEN
    collision = da.collision(scenario)

    assert collision.instances == (f"{scenario}/actor/1223", f"{scenario}/actor/1212")
    assert collision.frame == f"{scenario}/003"
    assert collision.gap == pytest.approx(0.5)
    assert_allclose(collision.point, [20.0, 1.25, 0.0], atol=0.02)
    assert_allclose(collision.speeds, (10, 2))
    assert collision.closing_speed == pytest.approx(10)
    assert collision.impact_angle == pytest.approx(np.pi / 2)
    assert (collision.sides, collision.disagreements) == (("front", "left"), ())


@pytest.mark.usefixtures("agents_at_origin")
def test_where_meta_and_the_recording_disagree_is_named(tmp_path: Path) -> None:
    def make_lines(frame: int) -> list[str]:
        car = f"car {20.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True"
        van = f"van {30.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1212 9 True"
        return [car, van][: 4 - frame]

    meta = META_TEXT.replace("front_side", "left_side")
    da = make_accident(tmp_path, make_lines, meta=meta)

    collision = da.collision(da.scenario[0])
    assert collision.frame == f"{SCENARIO_TOKEN}/002"
    assert collision.gap == pytest.approx(6)
    assert collision.sides == ("front", "rear")
    assert collision.closing_speed == pytest.approx(0)
    assert collision.impact_angle == pytest.approx(0)
    assert collision.disagreements == (
        "the pair is last seen at frame 002 of 003",
        "the pair is 6.00 m apart",
        "the classes are ['car', 'van'], meta says ['car', 'car']",
        "the sides are ['front', 'rear'], meta says left_side",
    )


@pytest.mark.usefixtures("agents_at_origin")
@pytest.mark.parametrize(
    ("gap_m", "expected_agreement", "expected_apart"),
    [(1.2, True, False), (1.4, True, True), (1.6, False, True)],
)
def test_how_far_apart_a_pair_may_be_that_collides(
    tmp_path: Path, gap_m: float, expected_agreement: bool, expected_apart: bool
) -> None:
    """The two cars close at 10 m/s."""
    da = make_accident(
        tmp_path,
        lambda frame: [
            f"car {17.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True",
            f"car {24.0 + gap_m} 0.0 0.0 4.0 2.0 1.5 {np.pi} 0 0 1212 9 True",
        ],
    )
    collision = da.collision(SCENARIO_TOKEN)

    assert (not collision.disagreements) == expected_agreement
    assert (collision.apart, collision.touching) == (expected_apart, None)


def test_an_agent_that_labels_only_itself_has_the_speed_of_its_displacement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ego, 1223, drives at 10 m/s but its label gives it no speed, as after the impact."""
    monkeypatch.setattr(
        tiny_release, "ego_to_world", lambda _, frame: tiny_release.pose(x=float(frame))
    )
    da = make_accident(
        tmp_path,
        lambda frame: [
            "car 0 0 -1.2 4.0 2.0 1.5 0.0 0 0 -100 9 True",
            f"car {9.0 - frame} 0.0 -1.2 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )

    assert_allclose(da.collision(SCENARIO_TOKEN).speeds, (10, 0), atol=1e-6)


def test_where_contact_begins() -> None:
    """Contact begins at the first frame of the last run in which outlines touch or overlap."""
    cases = (
        ([1, 0.5], None),
        ([1, 0.02, -0.4], 1),
        ([0, 1, -1, 0], 2),
        ([0, 0], 0),
        ([-1, 1, 2], 0),
    )
    for gaps, expected in cases:
        assert contact_begin(np.array(gaps)) == expected


@pytest.mark.usefixtures("agents_at_origin")
def test_the_impact_may_be_before_the_end(tmp_path: Path) -> None:
    """If a car pushes another from behind, its speed at the impact is that of the last frame before
    the overlap.
    """
    pushing_car = (
        "21.0 0.0 0.0 4.0 2.0 1.5 0.0 10",
        "22.0 0.0 0.0 4.0 2.0 1.5 0.0 10",
        "21.9 0.0 0.0 4.0 2.0 1.5 0.0 0",
    )
    da = make_accident(
        tmp_path,
        lambda frame: [
            f"car {pushing_car[frame - 1]} 0 1223 9 True",
            f"car {25.5 + frame / 10} 0.0 0.0 4.0 2.0 1.5 0.0 1 0 1212 9 True",
        ],
        meta=META_TEXT.replace("front_side", "rear_side"),
    )

    collision = da.collision(SCENARIO_TOKEN)
    assert collision.frame == f"{SCENARIO_TOKEN}/003"
    assert collision.contact_frame == f"{SCENARIO_TOKEN}/002"
    assert collision.touching == 0.1
    assert_allclose([*collision.speeds, collision.closing_speed, collision.gap], [10, 1, 9, 0])
    assert_allclose(collision.point, [23.85, 0, 0], atol=0.03)
    assert (collision.sides, collision.disagreements) == (("front", "rear"), ())


def test_collisions_that_labels_do_not_show(tmp_path: Path) -> None:
    da_unseen = make_accident(tmp_path / "unseen", lambda _: [])
    da_without_counterpart = make_accident(
        tmp_path / "alone", lambda frame: cars_side_by_side(frame)[:1]
    )
    da_named_twice = make_accident(
        tmp_path / "one",
        cars_side_by_side,
        meta=META_TEXT.replace("1223 car 1212", "1223 car 1223"),
    )

    assert_raises(
        (
            lambda: da_named_twice.collision(SCENARIO_TOKEN),
            NotAvailableError,
            "meta names actor 1223 twice instead of a colliding pair",
        ),
        (
            lambda: da_unseen.collision(SCENARIO_TOKEN),
            NotAvailableError,
            "no label shows the colliding pair 1223 and 1212",
        ),
        (
            lambda: da_without_counterpart.collision(SCENARIO_TOKEN),
            NotAvailableError,
            "counterpart not recorded: meta names actor 1212,",
        ),
        (lambda: da_unseen.collision("nowhere"), TokenError, "table 'scenario' has no token"),
    )
    statistics = dataset_statistics(da_named_twice)
    assert statistics.collisions == ()
    assert statistics.histograms["collision_angles"].left_out.counts["total"] == 1


def cars_side_by_side(frame: int) -> list[str]:
    return [
        f"car {16.0 + frame} {y} 0.0 4.0 2.0 1.5 0.0 0 0 {actor_id} 9 True"
        for actor_id, y in ((1223, 0.0), (1236, 3.0), (1212, 6.0), (1300, 9.0))
    ]


VEHICLE_PAIR = ["ego_vehicle", "other_vehicle"]


@pytest.mark.usefixtures("agents_at_origin")
@pytest.mark.parametrize(
    ("agents", "pair", "meta_agents", "disagreement"),
    [
        (tiny_release.AGENTS, "1223 car 1212", "ego other", None),
        (tiny_release.AGENTS, "1212 car 1223", "ego other", None),  # in another order
        (tiny_release.AGENTS, "1223 car 1300", "ego none", None),
        (
            tiny_release.AGENTS,
            "1223 car 1212",
            "ego_behind other_behind",
            (VEHICLE_PAIR, ["ego_vehicle_behind", "other_vehicle_behind"]),
        ),
        (
            tiny_release.AGENTS,
            "1223 car 1212",
            "ego other_behind",
            (VEHICLE_PAIR, ["ego_vehicle", "other_vehicle_behind"]),
        ),
        (tiny_release.AGENTS, "1223 car 1212", "ego none", (VEHICLE_PAIR, ["ego_vehicle", "none"])),
        (tiny_release.AGENTS, "1223 car 1212", "none none", (VEHICLE_PAIR, ["none", "none"])),
        (
            tiny_release.AGENTS,
            "1223 car 1300",
            "ego other",
            (["ego_vehicle", "none"], VEHICLE_PAIR),
        ),
        # without the other's labels, no file says which agent is 1212; but 1223 is the ego
        (("ego_vehicle", "infrastructure"), "1223 car 1212", "ego other", None),
        (
            ("ego_vehicle", "infrastructure"),
            "1223 car 1212",
            "ego_behind other",
            (["ego_vehicle", "none"], ["ego_vehicle_behind", "other_vehicle"]),
        ),
    ],
)
def test_agents_of_the_pair_that_differ_from_those_in_meta_are_named(
    tmp_path: Path,
    agents: tuple[str, ...],
    pair: str,
    meta_agents: str,
    disagreement: tuple[list[str], list[str]] | None,
) -> None:
    meta = META_TEXT.replace("1223 car 1212", pair)
    meta = meta.replace("ego other\n", f"{meta_agents}\n")
    da = make_accident(tmp_path, cars_side_by_side, meta=meta, agents=agents)
    expected = []
    if disagreement:
        expected = [f"the agents are {disagreement[0]}, meta says {disagreement[1]}"]

    messages = da.collision(SCENARIO_TOKEN).disagreements
    assert [text for text in messages if text.startswith("the agents are")] == expected


def outline_corners(
    x: float, y: float, yaw: float, length: float, width: float
) -> list[np.ndarray]:
    heading = np.array([np.cos(yaw), np.sin(yaw)])
    ahead = length / 2 * heading
    left = width / 2 * np.array([-heading[1], heading[0]])
    center = np.array([x, y])
    return [
        center + ahead + left,
        center - ahead + left,
        center - ahead - left,
        center + ahead - left,
    ]


def nearest_line(corners: list[np.ndarray], other_corners: list[np.ndarray]) -> np.ndarray:
    """Return the shortest vector from one of the corners to a side of the other outline."""
    lines = []
    for index, start in enumerate(other_corners):
        side = other_corners[index - 3] - start
        for corner in corners:
            share = np.clip((corner - start) @ side / (side @ side), 0, 1)
            lines.append(start + share * side - corner)
    return min(lines, key=np.linalg.norm)


@dataclass(frozen=True)
class MovingPair:
    """Two boxes (first axis) that move straight; poses (x, y, yaw) are of the last of 3 frames."""

    poses: np.ndarray
    sizes: np.ndarray
    steps: np.ndarray

    def centers_at(self, frame: int) -> np.ndarray:
        return self.poses[:, :2] + (frame - 3) * self.steps

    def outlines_at(self, frame: int) -> list[list[np.ndarray]]:
        values = np.column_stack([self.centers_at(frame), self.poses[:, 2], self.sizes])
        return [outline_corners(*row) for row in values]

    def label_lines(self, frame: int) -> list[str]:
        yaws = self.poses[:, 2]
        centers = self.centers_at(frame) * (1, -1)
        # as the release writes velocities
        velocities = np.exp(-1j * yaws) * (self.steps @ (10, -10j))
        columns = [centers, self.sizes, -yaws, velocities.real, velocities.imag]
        return [
            f"car {x} {y} 0 {length} {width} 1.5 {yaw} {velocity_x} {velocity_y} {actor_id} 9 True"
            for (x, y, length, width, yaw, velocity_x, velocity_y), actor_id in zip(
                np.column_stack(columns), (1223, 1212), strict=True
            )
        ]


def widest_gap(first: list[np.ndarray], second: list[np.ndarray], yaws: np.ndarray) -> tuple:
    """Return the widest gap along a side's normal, and this normal (towards the second outline)."""
    angles = [yaw + turn * np.pi / 2 for turn in range(4) for yaw in yaws]
    normals = [np.array([np.cos(angle), np.sin(angle)]) for angle in angles]
    gaps = []
    for normal in normals:
        first_end = max(corner @ normal for corner in first)
        second_start = min(corner @ normal for corner in second)
        gaps.append(second_start - first_end)
    widest = int(np.argmax(gaps))
    return gaps[widest], normals[widest]


def side_towards(direction: np.ndarray, yaw: float) -> str:
    """Return the side of a box that faces a direction."""
    angle = np.arctan2(direction[1], direction[0]) - yaw
    quarter = (angle + np.pi / 4) % (2 * np.pi) // (np.pi / 2)
    return ("front", "left", "rear", "right")[int(quarter)]


@pytest.mark.usefixtures("agents_at_origin")
def test_pairs_in_any_pose_by_plain_steps(tmp_path: Path) -> None:
    """At the first frame of contact the two face each other along the side's normal with the
    widest gap, and close along it.
    """
    rng = np.random.default_rng(4)
    pairs = {}
    for number in range(8):
        name = SCENARIO_NAME.replace("00024", f"{number:05d}")
        poses = rng.uniform((18, -4, -np.pi), (26, 4, np.pi), (2, 3))
        sizes = rng.uniform((3, 1), (9, 3), (2, 2))
        pairs[name] = MovingPair(poses, sizes, rng.uniform(-0.8, 0.8, (2, 2)))
        make_accident(tmp_path, pairs[name].label_lines, name=name, agents=("ego_vehicle",))
    da = DeepAccident(dataroot=tmp_path, verbose=False)

    num_overlaps = 0
    for name, pair in pairs.items():
        scenario = f"{SCENARIO_TYPE}/{name}"
        collision = da.collision(scenario)
        yaws = pair.poses[:, 2]
        gaps = [widest_gap(*pair.outlines_at(frame), yaws) for frame in (1, 2, 3)]
        is_touching = [gap <= 0.02 for gap, _ in gaps]

        contact_index = 2
        expected_frame = None
        if any(is_touching):
            contact_index -= is_touching[::-1].index(True)
            while contact_index and is_touching[contact_index - 1]:
                contact_index -= 1
            expected_frame = f"{scenario}/{contact_index + 1:03d}"
        assert collision.contact_frame == expected_frame

        facing_normal = gaps[contact_index][1]
        sides = (side_towards(facing_normal, yaws[0]), side_towards(-facing_normal, yaws[1]))
        assert collision.sides == sides

        line = np.zeros(2)
        if gaps[-1][0] > 0:
            first, second = pair.outlines_at(3)
            lines = (nearest_line(first, second), -nearest_line(second, first))
            line = min(lines, key=np.linalg.norm)
        distance = np.linalg.norm(line)
        num_overlaps += distance == 0
        assert collision.gap == pytest.approx(distance, abs=1e-6)

        normal = line / distance if distance > 0.02 and contact_index == 2 else facing_normal
        first_velocity, second_velocity = 10 * pair.steps
        closing_speed = (first_velocity - second_velocity) @ normal
        assert_allclose(collision.speeds, np.linalg.norm(10 * pair.steps, axis=1), atol=1e-4)
        assert collision.closing_speed == pytest.approx(closing_speed, abs=1e-4)
        angle = (yaws[0] - yaws[1] + np.pi) % (2 * np.pi) - np.pi
        assert collision.impact_angle == pytest.approx(abs(angle))
    assert 1 < num_overlaps < 7


@pytest.mark.usefixtures("agents_at_origin")
@pytest.mark.parametrize(("gap_m", "closing_speed"), [(0.03, 10 / np.sqrt(2)), (0.01, 0)])
def test_corners_close_along_the_shortest_line_and_where_they_touch_along_a_sides_normal(
    tmp_path: Path, gap_m: float, closing_speed: float
) -> None:
    offset = gap_m / np.sqrt(2)
    da = make_accident(
        tmp_path,
        lambda frame: [
            f"car {17.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True",
            f"car {24.0 + offset - 0.002} {2 + offset} 0.8 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )
    collision = da.collision(SCENARIO_TOKEN)

    assert collision.gap == pytest.approx(gap_m, abs=0.002)
    assert collision.closing_speed == pytest.approx(closing_speed, abs=0.4)
    assert_allclose(collision.point, [22, -1, 0.4], atol=0.02)


@pytest.mark.usefixtures("agents_at_origin")
def test_in_a_recording_of_one_frame_the_labels_velocities_count(tmp_path: Path) -> None:
    rows = ["car 20 0 0 4 2 1.5 0 3.0 4.0 1223 9 True", "car 25 0 0 4 2 1.5 0 0 0 1212 9 True"]
    tiny_release.write_tiny_release(
        tmp_path, frames=1, agents=("ego_vehicle",), lines_of=lambda *_: ["0 0", *rows]
    )
    da = DeepAccident(dataroot=tmp_path, verbose=False)
    collision = da.collision(SCENARIO_TOKEN)

    assert collision.speeds == (pytest.approx(5), 0)
    assert collision.closing_speed == pytest.approx(3)


def test_a_pair_is_labelled_if_both_are_and_are_two() -> None:
    assert labelled_pair({"ids": [5, 7]}, np.array([7, 5, 5])) == (5, 7)
    assert labelled_pair({"ids": [5, 7]}, np.array([5, 6])) is None
    assert labelled_pair({"ids": [5, 5]}, np.array([5])) is None
    assert labelled_pair(None, np.array([0])) is None


def test_the_scenario_to_begin_with(tmp_path: Path, da: DeepAccident) -> None:
    """Choose an accident with a labelled pair, otherwise any accident, otherwise the first
    scenario.
    """
    assert default_scenario(da) == first_accident(da)
    later_name = SCENARIO_NAME.replace("00024", "00025")
    make_accident(tmp_path, lambda _: [])
    da_unlabelled = DeepAccident(dataroot=tmp_path, verbose=False)
    assert first_accident(da_unlabelled) == SCENARIO_TOKEN

    da_both = make_accident(tmp_path, cars_side_by_side, name=later_name)
    assert first_accident(da_both) == default_scenario(da_both) == f"{SCENARIO_TYPE}/{later_name}"

    tiny_release.write_tiny_release(tmp_path / "silent", meta=None)
    da_silent = DeepAccident(dataroot=tmp_path / "silent", verbose=False)
    assert default_scenario(da_silent) == SCENARIO_TOKEN
    assert_raises(
        (
            lambda: first_accident(da_silent),
            NotAvailableError,
            (
                f"that a meta file names; .* its meta, or show another view of .* "
                f"in the release, such as {SCENARIO_TOKEN}$"
            ),
        ),
        (
            lambda: da_silent.collision(SCENARIO_TOKEN),
            NotAvailableError,
            "has no meta file",
        ),
    )
