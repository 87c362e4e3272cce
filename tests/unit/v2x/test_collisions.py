from pathlib import Path

import numpy as np
import pytest
import tiny
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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
    path = da.trajectory(instance)
    assert len(path) == len(rows) > 0
    assert (path.frame, path.present) == ("world", None)
    assert_array_equal(path.center, [row["translation"] for row in rows])
    assert_allclose(
        path.timestamp, [da.get("frame", row["frame_token"])["timestamp"] for row in rows]
    )
    assert_array_equal(path.velocity, [row["velocity"] for row in rows])


def test_a_trajectory_in_a_samples_frame(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "other_vehicle", 3)
    instance = f"{da.scenario[0]['token']}/actor/{da.agent.get(sample['agent_token'])['actor_id']}"
    path, world = da.trajectory(instance, sample, "ego"), da.trajectory(instance)
    assert_allclose(
        path.center, da.world_from(sample, "ego").inverse().apply(world.center), atol=1e-9
    )
    assert (path.present, (np.diff(path.center[:, 0]) > 0).all()) == (3, True)
    assert_allclose(path.yaw, 0, atol=0.05)


def test_trajectories_that_cannot_be(da: DeepAccident) -> None:
    instance = da.instance[0]["token"]
    assert_refused(
        (lambda: da.trajectory(f"{da.scenario[0]['token']}/actor/7"), TokenError, "has no actor 7"),
        (
            lambda: da.trajectory(instance, frame="ego"),
            ChoiceError,
            "frame 'ego' is one of a sample",
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
        assert len(tracks.index) == len(rows)
        assert not np.any([tracks.boxes.num_lidar_pts, tracks.boxes.camera_visible])
        assert tracks.at(2).actor_id.tolist() == [
            da.get("instance", row["instance_token"])["actor_id"]
            for row in rows
            if row["frame_token"].endswith("/002")
        ]


def test_synthetic_accidents_end_in_contact(da: DeepAccident) -> None:
    accidents = [scenario for scenario in da.scenario if scenario["collision"]]
    assert first_accident(da) == accidents[0]["token"]
    for scenario in accidents:
        found = da.collision(scenario)
        assert (found.disagreements, list(found.actor_ids)) == ((), scenario["collision"]["ids"])
        assert (found.frame, found.gap) == (
            scenario["last_frame_token"],
            pytest.approx(0, abs=0.01),
        )
        assert found.closing_speed > 3
    assert {da.collision(scenario) for scenario in da.scenario if not scenario["collision"]} == {
        None
    }


def accident(tmp_path: Path, lines, meta: str = tiny.META, **release) -> DeepAccident:
    """Three frames in which all agents stand in the origin and the ego's label has lines by
    frame.
    """
    lines_of = lambda agent, frame: ["0 0", *(lines(frame) if agent == "ego_vehicle" else ())]  # noqa: E731
    return DeepAccident(
        dataroot=tiny.write_tiny_release(
            tmp_path, frames=3, meta=meta, lines_of=lines_of, **release
        ),
        verbose=False,
    )


@pytest.fixture
def origin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiny, "ego_to_world", lambda *_: tiny.pose())
    monkeypatch.setattr(tiny, "lidar_height", lambda _: 0.0)


@pytest.mark.usefixtures("origin")
def test_a_car_that_drives_into_anothers_left_side(tmp_path: Path) -> None:
    """1223 drives along CARLA's +y (our −y) at 10 m/s; 1212 crosses along x at 2 m/s, its left side
    towards it.
    """
    da = accident(
        tmp_path,
        # at the last frame 2.5 m before the other's middle, 0.5 m from side to bumper
        lambda frame: [
            f"car 20.0 {frame - 5.5} 0.0 2.0 2.0 1.5 {np.pi / 2} 0 0 1223 9 True",
            f"car {19.4 + 0.2 * frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )
    found = da.collision(tiny.TOKEN)
    assert found.instances == (f"{tiny.TOKEN}/actor/1223", f"{tiny.TOKEN}/actor/1212")
    assert (found.frame, found.gap) == (f"{tiny.TOKEN}/003", pytest.approx(0.5))
    assert_allclose(found.point, [20.0, 1.25, 0.0], atol=0.02)
    assert_allclose(found.speeds, (10, 2))
    assert (found.closing_speed, found.impact_angle) == (
        pytest.approx(10),
        pytest.approx(np.pi / 2),
    )
    assert (found.sides, found.disagreements) == (("front", "left"), ())


@pytest.mark.usefixtures("origin")
def test_what_meta_says_against_the_recording(tmp_path: Path) -> None:
    lines = (
        "car {} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True",
        "van {} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1212 9 True",
    )
    da = accident(
        tmp_path,
        lambda frame: [
            line.format(at + frame)
            for line, at in zip(lines[: 4 - frame], (20.0, 30.0), strict=False)
        ],
        meta=tiny.META.replace("front_side", "left_side"),
    )
    found = da.collision(da.scenario[0])
    assert (found.frame, found.gap, found.sides) == (
        f"{tiny.TOKEN}/002",
        pytest.approx(6),
        ("front", "rear"),
    )
    assert (found.closing_speed, found.impact_angle) == (pytest.approx(0), pytest.approx(0))
    assert found.disagreements == (
        "the pair is last seen at frame 002 of 003",
        "the pair is 6.00 m apart",
        "the classes are ['car', 'van'], meta says ['car', 'car']",
        "the sides are ['front', 'rear'], meta says left_side",
    )


@pytest.mark.usefixtures("origin")
@pytest.mark.parametrize(
    ("gap", "agrees", "apart"), [(1.2, True, False), (1.4, True, True), (1.6, False, True)]
)
def test_how_far_apart_a_pair_may_be_that_collides(
    tmp_path: Path, gap: float, agrees: bool, apart: bool
) -> None:
    """They close at 10 m/s."""
    da = accident(
        tmp_path,
        lambda frame: [
            f"car {17.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True",
            f"car {24.0 + gap} 0.0 0.0 4.0 2.0 1.5 {np.pi} 0 0 1212 9 True",
        ],
    )
    found = da.collision(tiny.TOKEN)
    assert (not found.disagreements, found.apart, found.touching) == (agrees, apart, None)


def test_an_agent_that_labels_itself_alone_has_the_speed_of_its_displacement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ego, 1223, drives at 10 m/s and says that it stands, as after the blow."""
    monkeypatch.setattr(tiny, "ego_to_world", lambda _, frame: tiny.pose(x=float(frame)))
    da = accident(
        tmp_path,
        lambda frame: [
            "car 0 0 -1.2 4.0 2.0 1.5 0.0 0 0 -100 9 True",
            f"car {9.0 - frame} 0.0 -1.2 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )
    assert_allclose(da.collision(tiny.TOKEN).speeds, (10, 0), atol=1e-6)


def test_where_contact_begins() -> None:
    """The first frame of the last run in which outlines touch, overlap or not."""
    assert [
        contact_begin(np.array(gaps))
        for gaps in ([1, 0.5], [1, 0.02, -0.4], [0, 1, -1, 0], [0, 0], [-1, 1, 2])
    ] == [
        *(None, 1, 2, 0, 0),
    ]


@pytest.mark.usefixtures("origin")
def test_the_blow_is_before_the_end(tmp_path: Path) -> None:
    """Of a car that pushes another from behind, the speeds are those of the last frame before the
    overlap.
    """
    pushing = (
        "21.0 0.0 0.0 4.0 2.0 1.5 0.0 10",
        "22.0 0.0 0.0 4.0 2.0 1.5 0.0 10",
        "21.9 0.0 0.0 4.0 2.0 1.5 0.0 0",
    )
    da = accident(
        tmp_path,
        lambda frame: [
            f"car {pushing[frame - 1]} 0 1223 9 True",
            f"car {25.5 + frame / 10} 0.0 0.0 4.0 2.0 1.5 0.0 1 0 1212 9 True",
        ],
        meta=tiny.META.replace("front_side", "rear_side"),
    )
    found = da.collision(tiny.TOKEN)
    assert (found.frame, found.contact_frame, found.touching) == (
        f"{tiny.TOKEN}/003",
        f"{tiny.TOKEN}/002",
        0.1,
    )
    assert_allclose([*found.speeds, found.closing_speed, found.gap], [10, 1, 9, 0])
    assert_allclose(found.point, [23.85, 0, 0], atol=0.03)
    assert (found.sides, found.disagreements) == (("front", "rear"), ())


def test_collisions_that_cannot_be_told(tmp_path: Path) -> None:
    unseen = accident(tmp_path / "unseen", lambda _: [])
    alone = accident(tmp_path / "alone", lambda frame: side_by_side(frame)[:1])
    one = accident(
        tmp_path / "one", side_by_side, meta=tiny.META.replace("1223 car 1212", "1223 car 1223")
    )
    twice = "meta names actor 1223 twice instead of a colliding pair"
    assert_refused(
        (lambda: one.collision(tiny.TOKEN), NotAvailableError, twice),
        (
            lambda: unseen.collision(tiny.TOKEN),
            NotAvailableError,
            "no label shows the colliding pair 1223 and 1212",
        ),
        (
            lambda: alone.collision(tiny.TOKEN),
            NotAvailableError,
            "counterpart not recorded: meta names actor 1212,",
        ),
        (lambda: unseen.collision("nowhere"), TokenError, "table 'scenario' has no token"),
    )
    made = dataset_statistics(one)
    assert (made.collisions, made.histograms["collision_angles"].left_out.counts["total"]) == (
        (),
        1,
    )


def side_by_side(frame: int) -> list[str]:
    return [
        f"car {16.0 + frame} {y} 0.0 4.0 2.0 1.5 0.0 0 0 {actor} 9 True"
        for actor, y in ((1223, 0.0), (1236, 3.0), (1212, 6.0), (1300, 9.0))
    ]


BOTH = ["ego_vehicle", "other_vehicle"]


@pytest.mark.usefixtures("origin")
@pytest.mark.parametrize(
    ("agents", "pair", "told", "names"),
    [
        (tiny.AGENTS, "1223 car 1212", "ego other", None),
        (tiny.AGENTS, "1212 car 1223", "ego other", None),  # in another order
        (tiny.AGENTS, "1223 car 1300", "ego none", None),
        (
            tiny.AGENTS,
            "1223 car 1212",
            "ego_behind other_behind",
            (BOTH, ["ego_vehicle_behind", "other_vehicle_behind"]),
        ),
        (
            tiny.AGENTS,
            "1223 car 1212",
            "ego other_behind",
            (BOTH, ["ego_vehicle", "other_vehicle_behind"]),
        ),
        (tiny.AGENTS, "1223 car 1212", "ego none", (BOTH, ["ego_vehicle", "none"])),
        (tiny.AGENTS, "1223 car 1212", "none none", (BOTH, ["none", "none"])),
        (tiny.AGENTS, "1223 car 1300", "ego other", (["ego_vehicle", "none"], BOTH)),
        # without the other's labels nobody says whose id 1212 is; but 1223 is the ego's
        (("ego_vehicle", "infrastructure"), "1223 car 1212", "ego other", None),
        (
            ("ego_vehicle", "infrastructure"),
            "1223 car 1212",
            "ego_behind other",
            (["ego_vehicle", "none"], ["ego_vehicle_behind", "other_vehicle"]),
        ),
    ],
)
def test_the_agents_that_meta_names_against_those_of_the_pair(
    tmp_path: Path,
    agents: tuple[str, ...],
    pair: str,
    told: str,
    names: tuple[list[str], list[str]] | None,
) -> None:
    meta = tiny.META.replace("1223 car 1212", pair).replace("ego other\n", f"{told}\n")
    said = (
        accident(tmp_path, side_by_side, meta=meta, agents=agents)
        .collision(tiny.TOKEN)
        .disagreements
    )
    about_agents = [words for words in said if words.startswith("the agents are")]
    assert about_agents == ([f"the agents are {names[0]}, meta says {names[1]}"] if names else [])


def outline(x: float, y: float, yaw: float, length: float, width: float) -> list[np.ndarray]:
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    return [
        (x, y) + ahead * length / 2 * a + left * width / 2 * b
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]


def nearest_line(corners: list[np.ndarray], others: list[np.ndarray]) -> np.ndarray:
    """The shortest way from one of the corners to a side of the other outline."""
    ways = []
    for corner in corners:
        for start, end in zip(others, others[1:] + others[:1], strict=True):
            share = np.clip(
                (corner - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1
            )
            ways.append(start + share * (end - start) - corner)
    return min(ways, key=np.linalg.norm)


@pytest.mark.usefixtures("origin")
def test_pairs_in_any_pose_by_plain_steps(tmp_path: Path) -> None:
    """At the first frame of contact they face each other along the side's normal with the widest
    gap, and close so.
    """
    source, told = np.random.default_rng(4), {}
    for number in range(8):
        name = tiny.NAME.replace("00024", f"{number:05d}")
        places, sizes = (
            source.uniform((18, -4, -np.pi), (26, 4, np.pi), (2, 3)),
            source.uniform((3, 1), (9, 3), (2, 2)),
        )
        steps = source.uniform(-0.8, 0.8, (2, 2))

        def lines(frame: int, places=places, sizes=sizes, steps=steps) -> list[str]:
            moved = (places[:, :2] + (frame - 3) * steps) * (1, -1)
            turns = np.exp(-1j * places[:, 2]) * (
                steps @ (10, -10j)
            )  # as the release writes velocities
            each = zip(moved, sizes, places[:, 2], turns, (1223, 1212), strict=True)
            return [
                f"car {x} {y} 0 {length} {width} 1.5 {-yaw} {velocity.real} "
                f"{velocity.imag} {actor} 9 True"
                for (x, y), (length, width), yaw, velocity, actor in each
            ]

        accident(tmp_path, lines, name=name, agents=("ego_vehicle",))
        told[name] = (places, sizes, steps)
    da, overlaps = DeepAccident(dataroot=tmp_path, verbose=False), 0
    for name, (places, sizes, steps) in told.items():
        found, yaws = da.collision(f"{tiny.TYPE}/{name}"), places[:, 2]
        normals = [
            np.array([np.cos(yaw), np.sin(yaw)])
            for turn in range(4)
            for yaw in yaws + turn * np.pi / 2
        ]
        ways = []
        for frame in (1, 2, 3):
            moved = np.column_stack([places[:, :2] + (frame - 3) * steps, yaws])
            first, second = (outline(*at, *size) for at, size in zip(moved, sizes, strict=True))
            gaps = [
                min(each @ way for each in second) - max(each @ way for each in first)
                for way in normals
            ]
            ways.append((max(gaps), normals[int(np.argmax(gaps))]))
        touching = [widest <= 0.02 for widest, _ in ways]
        met = 2 - touching[::-1].index(True) if any(touching) else 2
        while any(touching) and met and touching[met - 1]:
            met -= 1
        assert found.contact_frame == (
            f"{tiny.TYPE}/{name}/{met + 1:03d}" if any(touching) else None
        )
        facing, sides = ways[met][1], []
        for yaw, way in zip(yaws, (facing, -facing), strict=True):
            turn = (np.arctan2(way[1], way[0]) - yaw + np.pi / 4) % (2 * np.pi) // (np.pi / 2)
            sides.append(("front", "left", "rear", "right")[int(turn)])
        there, back = nearest_line(first, second), -nearest_line(second, first)
        apart = min(there, back, key=np.linalg.norm) if ways[-1][0] > 0 else np.zeros(2)
        overlaps += not apart.any()
        normal = (
            apart / np.linalg.norm(apart) if np.linalg.norm(apart) > 0.02 and met == 2 else facing
        )
        speeds = np.linalg.norm(10 * steps, axis=1)
        assert (found.sides, found.gap) == (
            tuple(sides),
            pytest.approx(np.linalg.norm(apart), abs=1e-6),
        )
        assert_allclose(
            [*found.speeds, found.closing_speed],
            [*speeds, 10 * (steps[0] - steps[1]) @ normal],
            atol=1e-4,
        )
        assert found.impact_angle == pytest.approx(
            abs((yaws[0] - yaws[1] + np.pi) % (2 * np.pi) - np.pi)
        )
    assert 1 < overlaps < 7


@pytest.mark.usefixtures("origin")
@pytest.mark.parametrize(("gap", "closing"), [(0.03, 10 / np.sqrt(2)), (0.01, 0)])
def test_corners_close_along_the_shortest_line_and_where_they_touch_along_a_sides_normal(
    tmp_path: Path, gap: float, closing: float
) -> None:
    away = gap / np.sqrt(2)
    da = accident(
        tmp_path,
        lambda frame: [
            f"car {17.0 + frame} 0.0 0.0 4.0 2.0 1.5 0.0 0 0 1223 9 True",
            f"car {24.0 + away - 0.002} {2 + away} 0.8 4.0 2.0 1.5 0.0 0 0 1212 9 True",
        ],
    )
    found = da.collision(tiny.TOKEN)
    assert (found.gap, found.closing_speed) == (
        pytest.approx(gap, abs=0.002),
        pytest.approx(closing, abs=0.4),
    )
    assert_allclose(found.point, [22, -1, 0.4], atol=0.02)


@pytest.mark.usefixtures("origin")
def test_in_a_recording_of_one_frame_the_labels_velocities_count(tmp_path: Path) -> None:
    rows = ["car 20 0 0 4 2 1.5 0 3.0 4.0 1223 9 True", "car 25 0 0 4 2 1.5 0 0 0 1212 9 True"]
    tiny.write_tiny_release(
        tmp_path, frames=1, agents=("ego_vehicle",), lines_of=lambda *_: ["0 0", *rows]
    )
    found = DeepAccident(dataroot=tmp_path, verbose=False).collision(tiny.TOKEN)
    assert (found.speeds, found.closing_speed) == ((pytest.approx(5), 0), pytest.approx(3))


def test_a_pair_is_labelled_if_both_are_and_are_two() -> None:
    cases = (
        ({"ids": [5, 7]}, [7, 5, 5]),
        ({"ids": [5, 7]}, [5, 6]),
        ({"ids": [5, 5]}, [5]),
        (None, [0]),
    )
    assert [labelled_pair(pair, np.array(labelled)) for pair, labelled in cases] == [
        (5, 7),
        None,
        None,
        None,
    ]


def test_the_scenario_to_begin_with(tmp_path: Path, da: DeepAccident) -> None:
    """An accident whose pair labels show, else any accident, else the first scenario; none at all
    is an error.
    """
    assert default_scenario(da) == first_accident(da)
    later = tiny.NAME.replace("00024", "00025")
    accident(tmp_path, lambda _: [])
    assert first_accident(DeepAccident(dataroot=tmp_path, verbose=False)) == tiny.TOKEN
    both = accident(tmp_path, side_by_side, name=later)
    assert first_accident(both) == default_scenario(both) == f"{tiny.TYPE}/{later}"
    silent = DeepAccident(
        dataroot=tiny.write_tiny_release(tmp_path / "silent", meta=None), verbose=False
    )
    assert default_scenario(silent) == tiny.TOKEN
    assert_refused(
        (
            lambda: first_accident(silent),
            NotAvailableError,
            (
                f"that a meta file names; .* its meta, or show another view of .* "
                f"there, such as {tiny.TOKEN}$"
            ),
        ),
        (lambda: silent.collision(tiny.TOKEN), NotAvailableError, "has no meta file"),
    )
