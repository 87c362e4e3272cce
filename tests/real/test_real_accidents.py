"""Two real accidents, of which public repositories tell positions: nothing false is said of them.

The positions lie beside the real scenario, in `real_accident`, whose README says whose they are. A release of labels,
calib and meta is made of them: of Town03's both colliders at 10 Hz, of Town05's actors at 1 Hz. Invented are:
velocities (central differences), points and visibility, the pole's place, roles without an id; of meta the impact,
weather, words and class; of Town05 the sizes, headings (along the path), and what is between the seconds (lines).
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import tiny
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render import render_accident
from deepaccident_devkit.safety import avoidability, avoidability_report, lead_time_ledger
from deepaccident_devkit.validation import validate_release

Actors = dict[int, tuple[str, tuple[float, float, float], np.ndarray]]
"""Id → class, size, and (F, 4) x, y, z of the box's centre and yaw, in CARLA's world."""
META = """{first}
 colliding agents: {pair}
 agents id: {ids}
 road_type: four-way junction
"""


@pytest.fixture(scope="session")
def tracks(request: pytest.FixtureRequest) -> Path:
    root: Path | None = request.config.getoption("--real")
    if root is None or not (root.parent / "real_accident").is_dir():
        pytest.skip("no real accidents: there is no folder real_accident beside the one of --real")
    return root.parent / "real_accident"


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def release(root: Path, token: str, actors: Actors, agents: dict[str, int], meta: str) -> DeepAccident:
    """Labels, calib and meta of what some of the actors, and a pole amid them, record."""
    scenario_type, name = token.split("/")
    frames = len(next(iter(actors.values()))[2])
    middle = np.mean([path.mean(axis=0) for _, _, path in actors.values()], axis=0)
    moved = {actor: np.gradient(path[:, :2], 0.1, axis=0) for actor, (_, _, path) in actors.items()}

    def pose(agent: str, frame: int) -> np.ndarray:
        if agent not in agents:
            return tiny.pose(0, *middle[:2], middle[2] + 3.0)
        _, size, path = actors[agents[agent]]
        x, y, z, yaw = path[frame - 1]
        return tiny.pose(float(np.degrees(yaw)), x, y, z - size[2] / 2)

    def lines(agent: str, frame: int) -> list[str]:
        world_from_lidar = pose(agent, frame) @ tiny.pose(z=tiny.lidar_height(agent))
        turn, rows = np.arctan2(world_from_lidar[1, 0], world_from_lidar[0, 0]), []
        for actor, (category, size, path) in actors.items():
            x, y, z, _ = np.linalg.inv(world_from_lidar) @ [*path[frame - 1, :3], 1.0]
            own, yaw = agents.get(agent) == actor, path[frame - 1, 3] - turn
            yaw = 0.0 if own else float(np.arctan2(np.sin(yaw), np.cos(yaw)))
            velocity = np.exp(1j * yaw) * (moved[actor][frame - 1] @ (1, 1j))
            numbers = (x, y, z, *size, yaw, velocity.real, velocity.imag)
            rows.append(f"{category} {' '.join(map(str, map(float, numbers)))} {-100 if own else actor} 20 True")
        first = moved[agents[agent]][frame - 1] if agent in agents else (0.0, 0.0)
        return [f"{float(first[0])} {float(first[1])}", *rows]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tiny, "ego_to_world", pose)
        tiny.write_tiny_release(
            root,
            frames=frames,
            agents=[*agents, "infrastructure"],
            scenario_type=scenario_type,
            name=name,
            meta=meta,
            lines_of=lines,
        )
    return DeepAccident(dataroot=root, verbose=False)


@pytest.fixture(scope="session")
def merge(tracks: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Town03's scenario 24."""
    actors: Actors = {}
    for actor, name, size in (
        (2675, "ego", (4.9742, 2.0384, 1.5421)),
        (2671, "other", (4.8557, 2.0328, 1.6494)),
    ):
        rows = [
            {key: float(value) for key, value in row.items()} for row in rows_of(tracks / f"{name}_vehicle.viewer.csv")
        ]
        path = [
            (
                row["vx"] + 82.92406504775263,
                row["vz"] - 127.44046977800473,
                row["vup"] + 8.274037610661875,
                np.arctan2(row["m20"], row["m00"]),
            )
            for row in rows
        ]
        actors[actor] = ("car", size, np.array(path))
    first = "MidRainSunset 2675 car 2671 car 5000.0 same front_side 66"
    meta = META.format(first=first, pair="ego other", ids="2675 2690 2671 2691")
    agents = {"ego_vehicle": 2675, "other_vehicle": 2671}
    return release(tmp_path_factory.mktemp("merge"), tiny.TOKEN, actors, agents, meta)


def quiet(da: DeepAccident) -> list[str]:
    return [str(found) for found in validate_release(da.dataroot, workers=1).findings if found.severity != "note"]


def test_a_merge_touches_from_frame_54(merge: DeepAccident) -> None:
    """The two close at 5 m/s before, and at 2.7 m/s at the last frame, where they are 0.4 m in each other."""
    found = merge.collision(tiny.TOKEN)
    assert (found.frame, found.contact_frame) == (f"{tiny.TOKEN}/056", f"{tiny.TOKEN}/054")
    assert (found.touching, found.gap, found.apart, found.disagreements) == (0.2, 0.0, False, ())
    assert_allclose([*found.speeds, np.degrees(found.impact_angle)], [10.41, 8.95, 30.2], atol=0.05)
    ends = [merge.trajectory(instance).velocity[-1] for instance in found.instances]
    assert_allclose([*np.linalg.norm(ends, axis=1), np.linalg.norm(ends[0] - ends[1])], [10.99, 10.51, 2.65], atol=0.05)
    assert 4.5 < found.closing_speed < 5.8
    assert quiet(merge) == []


def test_nothing_false_is_said_of_the_merge(merge: DeepAccident) -> None:
    text = merge.describe(tiny.TOKEN).text
    assert "the ego, a car at 10.4 m/s, collides with the other vehicle, a car at 8.9 m/s, left side to right" in text
    assert "outlines touching from 0.2 s before the last frame (within 0.1 s)" in text
    found = avoidability(merge, tiny.TOKEN)
    assert 5.2 < found.check.time <= 5.3, "before frame 54"
    assert_allclose(found.check.delta_v.sum(), 5.25, atol=0.05)
    early = "or before it where outlines touch: 1 of 1 accidents, up to 0.2 s"
    for said in (lead_time_ledger(merge, workers=1), avoidability_report(merge, workers=1)):
        assert early in said.to_text()
    render_accident(merge, tiny.TOKEN, seconds=[0.5, 0.0], layers=["boxes", "grid"], fig=(figure := Figure()))
    shown = {each.get_text() for each in figure.findobj(Text)}
    assert {"0.5 s before", "the last frame"} <= shown
    assert any("outlines touching from 0.2 s before" in each for each in shown)


TRUCK = (8.47, 2.89, 3.83)
SIZES = {"truck": TRUCK, "vehicle": (4.60, 1.93, 1.52), "car": (4.60, 1.93, 1.52), "pedestrian": (0.38, 0.38, 1.86)}
ROLES = {"other": 4240, "ego": 4243, "ego_behind": 4246, "other_behind": 4249}
CROSSING = "type1_subtype2_accident/Town05_type001_subtype0002_scenario00036"


@pytest.fixture(scope="session")
def crossing(tracks: Path, tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    """Town05's scenario 36 up to frame 91: those of whom every second is told, and the others from first to last."""
    rows = [row for part in ("0-3", "4-9") for row in rows_of(tracks / f"Town05_sub2_00036_accident_window_{part}.csv")]
    actors: Actors = {}
    for number, name in enumerate(dict.fromkeys(row["actor"] for row in rows)):
        mine = [row for row in rows if row["actor"] == name]
        told = np.array([(float(row["t"]), float(row["e"]), -float(row["n"])) for row in mine])
        if told[0, 0] > 0 or told[-1, 0] < 9:
            continue
        x, y = (np.interp(np.arange(91) / 10, told[:, 0], told[:, axis]) for axis in (1, 2))
        steps = np.gradient(x) + 1j * np.gradient(y)
        moving = np.flatnonzero(np.abs(steps) > 0.05)
        yaw = np.angle(steps[moving[np.searchsorted(moving, np.arange(91)).clip(max=len(moving) - 1)]])
        size = SIZES[mine[0]["class"]]
        category = {"vehicle": "car"}.get(mine[0]["class"], mine[0]["class"])
        actors[ROLES.get(name, 4300 + number)] = (category, size, np.column_stack([x, y, 0 * x + size[2] / 2, yaw]))
    first = "ClearNoon 4246 truck 4249 truck 9090.520 same front_side 101"
    meta = META.format(first=first, pair="ego_behind other_behind", ids="4243 4246 4240 4249")
    agents = {"ego_vehicle": 4243, "ego_vehicle_behind": 4246, "other_vehicle": 4240, "other_vehicle_behind": 4249}
    return release(tmp_path_factory.mktemp("crossing"), CROSSING, actors, agents, meta)


def test_nothing_false_is_said_of_a_crossing(crossing: DeepAccident) -> None:
    found = crossing.collision(CROSSING)
    assert (found.actor_ids, found.sides, found.touching, found.disagreements) == (
        *((4246, 4249), ("front", "right"), 0.1, ()),
    )
    assert (
        "a truck at 0.0 m/s, is hit on its right side by the vehicle behind the ego, a truck at 4.1 m/s, closing at"
        in crossing.describe(CROSSING).text
    )
    assert quiet(crossing) == []
