"""Two real accidents, of which public repositories tell positions: nothing false is said of them.

The positions lie beside the real scenario, in `real_accident`, whose README says whose they are. A
release of labels,
calib and meta is made of them: of Town03's both colliders at 10 Hz, of Town05's four agents at 1
    Hz. Invented are:
velocities (central differences), points and visibility, roles without an id; of meta the impact,
weather, words and class; of Town05 the sizes, headings (along the path), and what is between the
seconds (lines).
"""

from pathlib import Path

import numpy as np
import pytest
import tiny
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose
from wording import lacking

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.descriptions import avoidability
from deepaccident_devkit.plugins.safety import avoidability_report, lead_time_ledger
from deepaccident_devkit.render import render_accident
from deepaccident_devkit.validation import validate_release

Agents = dict[str, tuple[int, str, tuple[float, float, float], np.ndarray]]
"""Agent → id, class, size, and (F, 4) x, y, z of the box's centre and yaw, in CARLA's world."""
IDS = (4243, 4246, 4240, 4249)
CROSSING = "type1_subtype2_accident/Town05_type001_subtype0002_scenario00036"


@pytest.fixture
def tracks(request: pytest.FixtureRequest) -> Path:
    root: Path | None = request.config.getoption("--real")
    if root is None or not (root.parent / "real_accident").is_dir():
        pytest.skip("no real accidents: there is no folder real_accident beside the one of --real")
    return root.parent / "real_accident"


def release(root: Path, token: str, agents: Agents, meta: str) -> DeepAccident:
    """Labels, calib and meta of what agents record of each other."""
    moved = {
        agent: np.gradient(path[:, :2], 0.1, axis=0) @ (1, 1j)
        for agent, (*_, path) in agents.items()
    }

    def pose(agent: str, frame: int) -> np.ndarray:
        *_, size, path = agents[agent]
        x, y, z, yaw = path[frame - 1]
        return tiny.pose(float(np.degrees(yaw)), x, y, z - size[2] / 2)

    def lines(agent: str, frame: int) -> list[str]:
        lidar_from_world, rows = (
            np.linalg.inv(pose(agent, frame) @ tiny.pose(z=tiny.lidar_height(agent))),
            [],
        )
        for other, (actor, category, size, path) in agents.items():
            place = lidar_from_world @ [*path[frame - 1, :3], 1.0]
            turn = np.exp(1j * (path[frame - 1, 3] - agents[agent][3][frame - 1, 3]))
            velocity = turn * moved[other][frame - 1]
            numbers = (*place[:3], *size, np.angle(turn), velocity.real, velocity.imag)
            rows.append(
                f"{category} {' '.join(map(str, numbers))} "
                f"{-100 if other == agent else actor} 20 True"
            )
        return [f"{moved[agent][frame - 1].real} {moved[agent][frame - 1].imag}", *rows]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(tiny, "ego_to_world", pose)
        kind, name = token.split("/")
        told = {
            "agents": [*agents],
            "scenario_type": kind,
            "name": name,
            "meta": meta,
            "lines_of": lines,
        }
        tiny.write_tiny_release(root, frames=len(agents["ego_vehicle"][3]), **told)
    assert {each.severity for each in validate_release(root, workers=1).findings} <= {"note"}
    return DeepAccident(dataroot=root, verbose=False)


def test_a_merge_touches_from_frame_54_and_nothing_false_is_said(
    tracks: Path, tmp_path: Path
) -> None:
    """Town03's scenario 24: they come at 5 m/s; at the last frame, 0.4 m in each other, 2.7 m/s are
    left.
    """
    agents: Agents = {}
    for name, actor, size in (
        ("ego_vehicle", 2675, (4.9742, 2.0384, 1.5421)),
        ("other_vehicle", 2671, (4.8557, 2.0328, 1.6494)),
    ):
        x, z, y, m00, m20 = np.loadtxt(tracks / f"{name}.viewer.csv", delimiter=",", skiprows=1)[
            :, 1:
        ].T
        places = (
            x + 82.92406504775263,
            y - 127.44046977800473,
            z + 8.274037610661875,
            np.arctan2(m20, m00),
        )
        agents[name] = (actor, "car", size, np.column_stack(places))
    meta = (
        "MidRainSunset 2675 car 2671 car 5000.0 same front_side 66\n colliding agents: ego other\n"
    )
    merge = release(tmp_path, tiny.TOKEN, agents, f"{meta} agents id: 2675 2690 2671 2691\n")
    found = merge.collision(tiny.TOKEN)
    assert (found.frame, found.contact_frame) == (f"{tiny.TOKEN}/056", f"{tiny.TOKEN}/054")
    assert (found.touching, found.gap, found.apart, found.disagreements) == (0.2, 0.0, False, ())
    assert_allclose([*found.speeds, np.degrees(found.impact_angle)], [10.41, 8.95, 30.2], atol=0.05)
    ends = [merge.trajectory(instance).velocity[-1] for instance in found.instances]
    assert_allclose(
        [*np.linalg.norm(ends, axis=1), np.linalg.norm(ends[0] - ends[1])],
        [10.99, 10.51, 2.65],
        atol=0.05,
    )
    assert 4.5 < found.closing_speed < 5.8
    assert not lacking(
        merge.describe(tiny.TOKEN).text,
        "the ego, a car at 10.4 m/s, collides with the other vehicle, a car at "
        "8.9 m/s, left side to right",
        "outlines touching from 0.2 s before the last frame (within 0.1 s)",
    )
    check = avoidability(merge, tiny.TOKEN).check
    assert_allclose([check.time, check.delta_v.sum()], [5.29, 5.25], atol=0.05)
    for said in (lead_time_ledger(merge, workers=1), avoidability_report(merge, workers=1)):
        assert "or before it where outlines touch: 1 of 1 accidents, up to 0.2 s" in said.to_text()
    render_accident(
        merge, tiny.TOKEN, seconds=[0.5, 0.0], layers=["boxes", "grid"], fig=(figure := Figure())
    )
    shown = {each.get_text() for each in figure.findobj(Text)}
    assert {"0.5 s before", "the last frame"} <= shown
    assert any("outlines touching from 0.2 s before" in each for each in shown)


def test_nothing_false_is_said_of_a_crossing(tracks: Path, tmp_path: Path) -> None:
    """Town05's scenario 36 up to frame 91."""
    parts = [tracks / f"Town05_sub2_00036_accident_window_{part}.csv" for part in ("0-3", "4-9")]
    rows, agents = (
        [line.split(",") for part in parts for line in part.read_text().splitlines()[1:]],
        {},
    )
    for name, agent, actor in zip(
        ("ego", "ego_behind", "other", "other_behind"), tiny.AGENTS, IDS, strict=False
    ):
        seconds, east, north = np.array([row[2:5] for row in rows if row[0] == name], dtype=float).T
        x, y = (np.interp(np.arange(91) / 10, seconds, axis) for axis in (east, -north))
        steps = np.gradient(x) + 1j * np.gradient(y)
        moving = np.flatnonzero(np.abs(steps) > 0.05)
        yaw = np.angle(
            steps[moving[np.searchsorted(moving, np.arange(91)).clip(max=len(moving) - 1)]]
        )
        category, size = (
            ("truck", (8.47, 2.89, 3.83)) if "behind" in name else ("car", (4.60, 1.93, 1.52))
        )
        agents[agent] = (actor, category, size, np.column_stack([x, y, 0 * x + size[2] / 2, yaw]))
    meta = (
        "ClearNoon 4246 truck 4249 truck 9090.520 same front_side 101\n colliding "
        "agents: ego_behind other_behind\n"
    )
    da = release(tmp_path, CROSSING, agents, f"{meta} agents id: {' '.join(map(str, IDS))}\n")
    found = da.collision(CROSSING)
    told = found.actor_ids, found.sides, found.touching, found.disagreements
    assert told == ((4246, 4249), ("front", "right"), 0.1, ())
    assert (
        "a truck at 0.0 m/s, is hit on its right side by the vehicle behind the ego, "
        "a truck at 4.1 m/s, closing at" in da.describe(CROSSING).text
    )
