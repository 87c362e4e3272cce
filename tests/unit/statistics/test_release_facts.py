"""The facts of a release: planted in releases written by hand, computed again plainly, and what is
said of them.
"""

import json
import math
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from tiny import META, TYPE, ego_to_world, lidar_height, pose, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.geometry.box_arrays import gaps_of_pairs
from deepaccident_devkit.statistics import FACTS, Fact, ReleaseFacts, release_facts
from deepaccident_devkit.statistics.scenario_facts import counted_scenario_facts

pytestmark = pytest.mark.slow

QUIET = "ClearNoon -1 -1 -1 -1 -1 -1 -1 18\n" + "\n".join(META.splitlines()[1:]).replace(
    "ego other", "none none"
)
UNKNOWN = META.replace("1212 car", "0 car").replace("ego other", "ego none")
NORMAL = TYPE.replace("accident", "normal")


def named(number: int) -> str:
    return f"Town03_type001_subtype0001_scenario{number:05d}"


def values_of(root: Path, key: str) -> list[float] | list[list[float]]:
    """The values of a fact, of all scenarios of a release."""
    da = DeepAccident(dataroot=root, verbose=False)
    found = [counted_scenario_facts(da, record).values.get(key) for record in da.scenario[:]]
    return [value for each in found if each is not None for value in each.tolist()]


@pytest.mark.parametrize(
    ("meta", "planted"),
    [
        (
            META,
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
            META,
            {
                "relation_known": 1,
                "relation_opposite": 0,
                "contact_known": 1,
                "unknown_partner": 0,
                "folder_right": 1,
            },
        ),
        (META.replace("front_side 14", "left_side 15"), {"contact_known": 0, "frames_by_meta": 0}),
        (META.replace("same", "opposite"), {"relation_known": 1, "relation_opposite": 1}),
        (
            UNKNOWN,
            {"unknown_partner": 1, "pair_background": 0, "pair_designed": 0, "agents_named": 1},
        ),
        (UNKNOWN.replace("0 car", "1300 van"), {"unknown_partner": 0, "pair_background": 1}),
        (
            META.replace("1223 car", "1236 car"),
            {"pair_follower": 1, "pair_behind": 0, "agents_named": 0},
        ),
        (META.replace("id: 1223 1236", "id: 1236 1223"), {"ids_ascend": 0}),
        (QUIET, {"none_none": 1, "accident_without": 1, "folder_right": 0}),
        (QUIET.replace("none none", "ego other"), {"none_none": 0}),
        (META.replace("straight", "up"), {"known_words": 0}),
    ],
)
def test_what_meta_says(tmp_path: Path, meta: str, planted: dict[str, float]) -> None:
    write_tiny_release(tmp_path, meta=meta)
    assert {key: min(values_of(tmp_path, key)) for key in planted} == planted


FRAMES = 24
CARS = ((1212, 0, 0, 0, 1), (1223, 0, 1, 0, 0), (20001, 60, 0, 20, 0), (20002, 62, 0, 20, 0))
"""Id, x, metres a frame, y, whether it is tilted: one drives at 10 m/s to one that stands; two
parked ones overlap.
"""


def write_crash(root: Path, lead: float, tilt: float) -> Path:
    """A release in which the rear car is at x = frame, and the other's centre at `lead`, its yaw
    `tilt` degrees.
    """

    def lines(agent: str, frame: int) -> list[str]:
        there = ego_to_world(agent, frame) @ pose(z=lidar_height(agent))
        made = ["0.0 10.0" if agent == "ego_vehicle" else "0.0 0.0"]
        made += [f"car 0 0 -1.2 4 2 1.5 0 {made[0]} -100 900 False"] * (agent != "infrastructure")
        for actor, start, speed, side, turned in (
            CARS if agent in ("ego_vehicle", "infrastructure") else ()
        ):
            x, y, z, _ = np.linalg.inv(there) @ (
                start + lead * (actor == 1212) + speed * frame,
                side,
                1,
                1,
            )
            yaw = np.radians(tilt * turned) - np.arctan2(there[1, 0], there[0, 0])
            velocity = f"{10 * speed * np.cos(yaw)} {10 * speed * np.sin(yaw)}"
            made += [f"car {x} {y} {z} 4 2 1.5 {yaw} {velocity} {actor} 10 True"] * (
                (actor, agent) != (1223, "ego_vehicle")
            )
        return made

    return write_tiny_release(
        root, frames=FRAMES, meta=META.replace("14\n", f"{FRAMES + 10}\n"), lines_of=lines
    )


@pytest.mark.parametrize(
    ("lead", "tilt", "planted"),
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
    tmp_path: Path, lead: float, tilt: float, planted: dict[str, list[float]]
) -> None:
    write_crash(tmp_path, lead, tilt)
    found = {
        key: np.unique(np.round(values_of(tmp_path, key), 6), axis=0).tolist() for key in planted
    }
    assert found == {
        key: pytest.approx(sorted(each)) if np.ndim(each) == 1 else sorted(each)
        for key, each in planted.items()
    }


def test_the_least_gaps_and_errors_are_those_of_plain_loops(da_motion: DeepAccident) -> None:
    record = next(each for each in da_motion.scenario[:] if each["collision"])
    rows = [row for row in da_motion.track[:] if row["scenario_token"] == record["token"]]
    at = {(row["instance_token"], int(row["frame_token"].rsplit("/", 1)[1])): row for row in rows}

    def box(actor: str, frame: int, seconds: float = 0) -> np.ndarray:
        """The outline, after seconds at the mean velocity of the last half second."""
        row, before = at[actor, frame], at.get((actor, frame - 5))
        place = np.array(row["translation"][:2])
        velocity = (
            (place - before["translation"][:2]) * 2 if before else np.array(row["velocity"][:2])
        )
        return np.array(
            [*(place + velocity * seconds), *row["size"][:2], quaternions.yaw_of(row["rotation"])]
        )

    found = counted_scenario_facts(da_motion, record).values
    for frame, second, hit in (
        (11, 1, 0),
        (11, 2, 0),
        (11, 3, 1),
        (21, 1, 0),
        (21, 2, 1),
        (31, 1, 1),
    ):
        times = np.arange(10 * second - 9, 10 * second + 1) / 10
        ahead = {
            actor: np.array([box(actor, frame, time) for time in times])
            for actor, when in at
            if when == frame
        }
        moving = {
            each for each in ahead if np.hypot(*(box(each, frame, 1) - box(each, frame))[:2]) > 0.5
        }
        pairs = [pair for pair in combinations(ahead, 2) if moving & set(pair)]
        least = min(gaps_of_pairs(ahead[one], ahead[other]).min() for one, other in pairs)
        assert [least, hit] == pytest.approx(found[f"foreseen_{second}"][frame // 10 - 1])
    errors = [
        [
            np.hypot(*(box(actor, ahead) - box(actor, frame, (ahead - frame) / 10))[:2])
            for ahead in seen
        ]
        for actor, frame in at
        if frame % 5 == 1
        and frame > 5
        and (seen := [each for each in range(frame + 10, 36, 10) if (actor, each) in at])
    ]
    assert np.sort([found["ade"], found["fde"]]) == pytest.approx(
        np.sort([[np.mean(each) for each in errors], [each[-1] for each in errors]]), abs=1e-9
    )


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve accidents and twelve twins; a collision with id 0, another with an odd word; in a
    folder with a name.
    """
    odd = {1: UNKNOWN, 2: META.replace("front_side", "left_side")}
    root = tmp_path_factory.mktemp("facts") / "home of Jane Doe"
    for number in range(12):
        write_tiny_release(
            root, name=named(number), meta=odd.get(number, META), agents=("ego_vehicle",)
        )
        write_tiny_release(
            root,
            name=named(number),
            scenario_type=NORMAL,
            meta=QUIET,
            agents=("ego_vehicle",),
            frames=8,
        )
    return root


def row_of(report: ReleaseFacts, key: str, kind: str | None = None) -> Fact:
    return next(row for row in report.facts if row.key == key and kind in (None, row.kind))


def test_rows_say_share_interval_and_verdict(many: Path) -> None:
    da = DeepAccident(dataroot=many, verbose=False, workers=1)
    report = release_facts(da, workers=1)
    assert [row.name for row in report.facts] == [fact.name for fact in FACTS]
    unknown = row_of(report, "unknown_partner")
    assert (unknown.here, unknown.cases, unknown.scenarios, unknown.verdict) == (
        1 / 12,
        12,
        12,
        "agree",
    )
    for end in unknown.ends or ():  # Wilson's ends are where the share is 1.96 standard errors away
        assert abs(end - 1 / 12) == pytest.approx(1.96 * math.sqrt(end * (1 - end) / 12))
    own = row_of(report, "own_row")  # 144 samples are as sure as their 24 scenarios
    assert (own.cases, own.ends) == (144, (pytest.approx(24 / (24 + 1.96**2)), 1))
    told = {
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
    assert {key: row_of(report, *key).verdict for key in told} == told
    assert (row_of(report, "length").here, row_of(report, "accident_frames", "least").here) == (
        1,
        4,
    )
    assert (report.counts["token 8"], report.counts["label ids"]) == (
        {"front_side": 11, "left_side": 1},
        {"from 1 on": 144, "-100": 144, "-1": 144},
    )
    with ThreadPoolExecutor(2) as pool:
        assert release_facts(da, executor=pool) == report
    few = release_facts(da, [da.scenario[0]["token"]], workers=1)
    assert {
        row.verdict
        for row in few.facts
        if row.kind in ("share", "mean", "median", "few", "area", "range")
    } == {"cannot say"}


def test_text_and_json_name_nobody_and_tell_what_is_left_out(tmp_path: Path) -> None:
    root = tmp_path / "Jane Doe's"
    for number, kinds in enumerate(({}, {}, {}, {"meta": None}, {"labelled": False})):
        write_tiny_release(root, name=named(number), frames=3, **kinds)
    label = root / TYPE / "ego_vehicle" / "label"
    (label / named(0) / f"{named(0)}_002.txt").unlink()
    (label / named(1) / f"{named(1)}_002.txt").write_text("0 0\ncar 1 2 3\n")
    asked = ["info", str(root), "--facts", "--workers", "1"]
    text, as_json = (
        CliRunner().invoke(deepaccident, [*asked, *more], catch_exceptions=False)
        for more in ((), ("--json",))
    )
    found = json.loads(as_json.stdout)
    assert (text.exit_code, found["scenarios"], found["left_out"]) == (0, 3, 2)
    rows = {row["key"]: (row["here"], row["cases"], row["verdict"]) for row in found["facts"]}
    assert [rows[key] for key in ("fields", "gapless")] == [(0.75, 4, "differ")] * 2
    assert (rows["folder_right"][1], found["counts"]["agents with labels"]) == (2, {"5": 2, "0": 1})
    assert not [
        each for each in ("Jane", str(tmp_path), named(2)) if each in text.stdout + as_json.stdout
    ]
