"""The facts of a release: planted by hand, computed again by plain loops, and reported."""

import json
import math
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from support.tiny_release import (
    META_TEXT,
    SCENARIO_TYPE,
    ego_to_world,
    lidar_height,
    pose,
    write_tiny_release,
)
from support.tiny_release_index import label_path

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.statistics import FACTS, Fact, ReleaseFacts, release_facts
from deepaccident_devkit.statistics.scenario_facts import counted_scenario_facts

pytestmark = pytest.mark.slow

QUIET_META = "ClearNoon -1 -1 -1 -1 -1 -1 -1 18\n" + "\n".join(META_TEXT.splitlines()[1:]).replace(
    "ego other", "none none"
)
UNKNOWN_PARTNER_META = META_TEXT.replace("1212 car", "0 car").replace("ego other", "ego none")
NORMAL_TYPE = SCENARIO_TYPE.replace("accident", "normal")


def name_scenario(number: int) -> str:
    return f"Town03_type001_subtype0001_scenario{number:05d}"


def read_values(root: Path, key: str) -> list[float] | list[list[float]]:
    """Return the values of a fact in all scenarios of a release."""
    da = DeepAccident(dataroot=root, verbose=False)
    values = []
    for scenario in da.scenario[:]:
        scenario_values = counted_scenario_facts(da, scenario).values.get(key)
        if scenario_values is not None:
            values += scenario_values.tolist()
    return values


@pytest.mark.parametrize(
    ("meta", "expected"),
    [
        (
            META_TEXT,
            {
                "pair_designed": 1,
                "ids_ascend": 1,
                "agents_named": 1,
                "frames_by_meta": 1,
                "short": 1,
                "known_words": 1,
            },
        ),
        (
            META_TEXT,
            {
                "relation_known": 1,
                "relation_opposite": 0,
                "contact_known": 1,
                "unknown_partner": 0,
                "folder_right": 1,
            },
        ),
        (
            META_TEXT.replace("front_side 14", "left_side 15"),
            {"contact_known": 0, "frames_by_meta": 0},
        ),
        (META_TEXT.replace("same", "opposite"), {"relation_known": 1, "relation_opposite": 1}),
        (
            UNKNOWN_PARTNER_META,
            {"unknown_partner": 1, "pair_background": 0, "pair_designed": 0, "agents_named": 1},
        ),
        (
            UNKNOWN_PARTNER_META.replace("0 car", "1300 van"),
            {"unknown_partner": 0, "pair_background": 1},
        ),
        (
            META_TEXT.replace("1223 car", "1236 car"),
            {"pair_follower": 1, "pair_behind": 0, "agents_named": 0},
        ),
        (META_TEXT.replace("id: 1223 1236", "id: 1236 1223"), {"ids_ascend": 0}),
        (QUIET_META, {"none_none": 1, "accident_without": 1, "folder_right": 0}),
        (QUIET_META.replace("none none", "ego other"), {"none_none": 0}),
        (META_TEXT.replace("straight", "up"), {"known_words": 0}),
    ],
)
def test_what_meta_says(tmp_path: Path, meta: str, expected: dict[str, float]) -> None:
    write_tiny_release(tmp_path, meta=meta)
    assert {key: min(read_values(tmp_path, key)) for key in expected} == expected


NUM_FRAMES = 24


def write_crash(root: Path, lead: float, tilt: float) -> Path:
    """Write a release in which one car drives at 10 m/s towards one that stands.

    The rear car is at x = frame and the other one at x = `lead`, with a yaw of `tilt` degrees. Two
    parked cars overlap.
    """
    # id, x in metres, metres a frame, y in metres, yaw in degrees
    cars = (
        (1212, lead, 0, 0, tilt),
        (1223, 0, 1, 0, 0),
        (20001, 60, 0, 20, 0),
        (20002, 62, 0, 20, 0),
    )

    def make_lines(agent: str, frame: int) -> list[str]:
        world_from_lidar = ego_to_world(agent, frame) @ pose(z=lidar_height(agent))
        agent_yaw = np.arctan2(world_from_lidar[1, 0], world_from_lidar[0, 0])
        agent_velocity = "0.0 10.0" if agent == "ego_vehicle" else "0.0 0.0"
        lines = [agent_velocity]
        if agent != "infrastructure":
            lines.append(f"car 0 0 -1.2 4 2 1.5 0 {agent_velocity} -100 900 False")
        if agent not in ("ego_vehicle", "infrastructure"):
            return lines
        for actor_id, start, speed, side, degrees in cars:
            if (actor_id, agent) == (1223, "ego_vehicle"):
                continue  # no agent labels its own car a second time
            center = (start + speed * frame, side, 1, 1)
            x, y, z, _ = np.linalg.inv(world_from_lidar) @ center
            yaw = np.radians(degrees) - agent_yaw
            velocity = f"{10 * speed * np.cos(yaw)} {10 * speed * np.sin(yaw)}"
            lines.append(f"car {x} {y} {z} 4 2 1.5 {yaw} {velocity} {actor_id} 10 True")
        return lines

    meta = META_TEXT.replace("14\n", f"{NUM_FRAMES + 10}\n")
    return write_tiny_release(root, frames=NUM_FRAMES, meta=meta, lines_of=make_lines)


@pytest.mark.parametrize(
    ("lead", "tilt", "expected"),
    [
        (
            26.5,
            0,
            {
                "overlap_frames": [2],
                "overlap_depth": [1.5],
                "touch_at_end": [1],
                "touch_in_second": [1],
            },
        ),
        (
            26.5,
            0,
            {
                "heading": [0],
                "relative_speed": [10],
                "gap_closes": [1],
                "ade": [0],
                "fde": [0],
                "slow": [0.75],
            },
        ),
        (
            40.0,
            0,
            {"overlap_frames": [0], "overlap_depth": [], "touch_in_second": [0], "gap_closes": [0]},
        ),
        (24.0, 0, {"overlap_frames": [5], "touch_in_second": [0], "relative_speed": [10]}),
        (28.2, 30, {"heading": [30], "gap_closes": [1]}),
        (
            26.5,
            0,
            {
                "overlap_samples": [1],
                "overlap_stand": [0, 1],
                "overlap_mixed": [0, 1],
                "overlap_move": [0],
            },
        ),
        (
            26.5,
            0,
            {
                "vehicles": [3],
                "next_gap": [0, 1.5],
                "next_near": [1],
                "next_touch": [0, 1],
                "own_row": [1],
            },
        ),
        (
            26.5,
            0,
            {
                "foreseen_1": [[1.5, 0], [0, 1]],
                "foreseen_2": [[0, 1]],
                "foreseen_3": [],
                "lights": [1],
            },
        ),
        (
            26.5,
            0,
            {
                "foreseen_all_1": [[0, 0], [0, 1]],
                "speed": [0, 10],
                "start_speed": [0, 10],
                "pole_height": [0],
            },
        ),
        (
            26.5,
            0,
            {
                "velocities_released": [1],
                "sensors_stay": [1],
                "jitter": [0],
                "pitch": [0],
                "agents": [1],
            },
        ),
    ],
)
def test_what_labels_show(
    tmp_path: Path, lead: float, tilt: float, expected: dict[str, list[float]]
) -> None:
    write_crash(tmp_path, lead, tilt)
    for key, expected_values in expected.items():
        values = np.round(read_values(tmp_path, key), 6)
        unique_values = np.unique(values, axis=0).tolist()
        if np.ndim(expected_values) == 1:
            assert unique_values == pytest.approx(sorted(expected_values)), key
        else:
            assert unique_values == sorted(expected_values), key


def test_the_least_gaps_and_errors_are_those_of_plain_loops(da_motion: DeepAccident) -> None:
    (scenario,) = da_motion.find(collision=True)
    tracks = {}
    for track in da_motion.track[:]:
        if track["scenario_token"] == scenario["token"]:
            frame = int(track["frame_token"].rsplit("/", 1)[1])
            tracks[track["instance_token"], frame] = track

    def predict_box(actor: str, frame: int, seconds: float = 0) -> np.ndarray:
        """Return the box after seconds at the mean velocity of the last half second."""
        track = tracks[actor, frame]
        earlier_track = tracks.get((actor, frame - 5))
        center = np.array(track["translation"][:2])
        velocity = np.array(track["velocity"][:2])
        if earlier_track:
            velocity = (center - earlier_track["translation"][:2]) * 2
        yaw = quaternions.yaw_of(track["rotation"])
        return np.array([*(center + velocity * seconds), *track["size"][:2], yaw])

    def distance(box: np.ndarray, other_box: np.ndarray) -> float:
        return np.hypot(*(box - other_box)[:2])

    facts = counted_scenario_facts(da_motion, scenario).values
    for frame, second, is_hit in (
        (11, 1, 0),
        (11, 2, 0),
        (11, 3, 1),
        (21, 1, 0),
        (21, 2, 1),
        (31, 1, 1),
    ):
        times = np.arange(10 * second - 9, 10 * second + 1) / 10
        actors = [actor for actor, actor_frame in tracks if actor_frame == frame]
        boxes = {
            actor: np.array([predict_box(actor, frame, time) for time in times]) for actor in actors
        }
        moving = {
            actor
            for actor in actors
            if distance(predict_box(actor, frame, 1), predict_box(actor, frame)) > 0.5
        }
        pairs = [pair for pair in combinations(actors, 2) if moving & set(pair)]
        min_gap = min(gaps_of_pairs(boxes[first], boxes[second]).min() for first, second in pairs)
        assert [min_gap, is_hit] == pytest.approx(facts[f"foreseen_{second}"][frame // 10 - 1])

    average_errors, final_errors = [], []
    for actor, frame in tracks:
        future_frames = [
            future for future in range(frame + 10, 36, 10) if (actor, future) in tracks
        ]
        if frame % 5 == 1 and frame > 5 and future_frames:
            errors = []
            for future in future_frames:
                predicted = predict_box(actor, frame, (future - frame) / 10)
                errors.append(distance(predict_box(actor, future), predicted))
            average_errors.append(np.mean(errors))
            final_errors.append(errors[-1])
    assert np.sort(facts["ade"]) == pytest.approx(np.sort(average_errors), abs=1e-9)
    assert np.sort(facts["fde"]) == pytest.approx(np.sort(final_errors), abs=1e-9)


@pytest.fixture(scope="module")
def many_accidents(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve accidents and their twins, in a folder with a person's name.

    One collision has the id 0, another one an odd word.
    """
    odd_metas = {1: UNKNOWN_PARTNER_META, 2: META_TEXT.replace("front_side", "left_side")}
    root = tmp_path_factory.mktemp("facts") / "home of Jane Doe"
    for number in range(12):
        write_tiny_release(
            root,
            name=name_scenario(number),
            meta=odd_metas.get(number, META_TEXT),
            agents=("ego_vehicle",),
        )
        write_tiny_release(
            root,
            name=name_scenario(number),
            scenario_type=NORMAL_TYPE,
            meta=QUIET_META,
            agents=("ego_vehicle",),
            frames=8,
        )
    return root


def find_fact(report: ReleaseFacts, key: str, kind: str | None = None) -> Fact:
    facts = [fact for fact in report.facts if fact.key == key]
    return next(fact for fact in facts if kind in (None, fact.kind))


def test_rows_say_share_interval_and_verdict(many_accidents: Path) -> None:
    da = DeepAccident(dataroot=many_accidents, verbose=False, workers=1)
    report = release_facts(da, workers=1)
    assert [fact.name for fact in report.facts] == [fact.name for fact in FACTS]

    partner = find_fact(report, "unknown_partner")
    assert partner.here == 1 / 12
    assert partner.cases == partner.scenarios == 12
    assert partner.verdict == "agree"
    for end in partner.ends or ():  # Wilson's ends are where the share is 1.96 standard errors away
        assert abs(end - 1 / 12) == pytest.approx(1.96 * math.sqrt(end * (1 - end) / 12))

    own_row = find_fact(report, "own_row")  # 144 samples are as sure as their 24 scenarios
    assert own_row.cases == 144
    assert own_row.ends == (pytest.approx(24 / (24 + 1.96**2)), 1)

    verdicts = {
        ("contact_known", "all"): "differ",
        ("relation_known", "all"): "agree",
        ("relation_opposite", "some"): "differ",
        ("short", "share"): "differ",
        ("twins", "share"): "agree",
        ("length", "area"): "agree",
        ("accident_frames", "median"): "differ",
        ("accident_frames", "mean"): "differ",
        ("accident_frames", "least"): "agree",
        ("speed", "most"): "differ",
        ("agents", "all"): "differ",
        ("slow", "few"): "differ",
        ("overlap_depth", "few"): "cannot say",
        ("foreseen_1", "area"): "cannot say",
        ("pole_height", "range"): "cannot say",
    }
    assert {key: find_fact(report, *key).verdict for key in verdicts} == verdicts
    assert find_fact(report, "length").here == 1
    assert find_fact(report, "accident_frames", "least").here == 4
    assert report.counts["token 8"] == {"front_side": 11, "left_side": 1}
    assert report.counts["label ids"] == {"from 1 on": 144, "-100": 144, "-1": 144}
    with ThreadPoolExecutor(2) as pool:
        assert release_facts(da, executor=pool) == report

    one_scenario = release_facts(da, [da.scenario[0]["token"]], workers=1)
    kinds = ("share", "mean", "median", "few", "area", "range")
    estimates = [fact for fact in one_scenario.facts if fact.kind in kinds]
    assert {fact.verdict for fact in estimates} == {"cannot say"}


def test_text_and_json_name_nobody_and_tell_what_is_left_out(tmp_path: Path) -> None:
    root = tmp_path / "Jane Doe's"
    for number, options in enumerate(({}, {}, {}, {"meta": None}, {"labelled": False})):
        write_tiny_release(root, name=name_scenario(number), frames=3, **options)
    label_path(root, name=name_scenario(0)).unlink()
    label_path(root, name=name_scenario(1)).write_text("0 0\ncar 1 2 3\n")

    arguments = ["info", str(root), "--facts", "--workers", "1"]
    text = CliRunner().invoke(deepaccident, arguments, catch_exceptions=False)
    as_json = CliRunner().invoke(deepaccident, [*arguments, "--json"], catch_exceptions=False)
    report = json.loads(as_json.stdout)
    assert (text.exit_code, report["scenarios"], report["left_out"]) == (0, 3, 2)
    rows = {row["key"]: (row["here"], row["cases"], row["verdict"]) for row in report["facts"]}
    assert rows["fields"] == rows["gapless"] == (0.75, 4, "differ")
    assert rows["folder_right"][1] == 2
    assert report["counts"]["agents with labels"] == {"5": 2, "0": 1}
    for name in ("Jane", str(tmp_path), name_scenario(2)):
        assert name not in text.stdout + as_json.stdout
