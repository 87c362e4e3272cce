"""Two real accidents with positions from public repositories; the devkit reports nothing false.

The positions lie beside the real scenario, in `real_accident`; its README gives their source. The
tests make a release of labels, calib and meta from them: Town03 has both colliders at 10 Hz, Town05
four agents at 1 Hz. Invented are the velocities (central differences), points and visibility, roles
without an id, and the impact, weather, words and class of meta. In Town05 the sizes, the headings
(along the path) and the positions between the seconds (on lines) are invented too.
"""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose
from support import tiny_release
from support.text_contents import missing_parts

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


def write_release(root: Path, token: str, agents: Agents, meta: str) -> DeepAccident:
    """Write labels, calib and meta of what agents record of each other."""
    # velocities as complex numbers, x + iy
    velocities = {
        agent: np.gradient(path[:, :2], 0.1, axis=0) @ (1, 1j)
        for agent, (*_, path) in agents.items()
    }

    def ego_to_world(agent: str, frame: int) -> np.ndarray:
        *_, size, path = agents[agent]
        x, y, z, yaw = path[frame - 1]
        return tiny_release.pose(float(np.degrees(yaw)), x, y, z - size[2] / 2)

    def make_lines(agent: str, frame: int) -> list[str]:
        ego_from_lidar = tiny_release.pose(z=tiny_release.lidar_height(agent))
        lidar_from_world = np.linalg.inv(ego_to_world(agent, frame) @ ego_from_lidar)
        agent_yaw = agents[agent][3][frame - 1, 3]
        agent_velocity = velocities[agent][frame - 1]
        lines = [f"{agent_velocity.real} {agent_velocity.imag}"]
        for other, (actor_id, category, size, path) in agents.items():
            x, y, z, _ = lidar_from_world @ [*path[frame - 1, :3], 1.0]
            rotation = np.exp(1j * (path[frame - 1, 3] - agent_yaw))
            velocity = rotation * velocities[other][frame - 1]
            numbers = (x, y, z, *size, np.angle(rotation), velocity.real, velocity.imag)
            label_id = -100 if other == agent else actor_id
            lines.append(f"{category} {' '.join(map(str, numbers))} {label_id} 20 True")
        return lines

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny_release, "ego_to_world", ego_to_world)
        scenario_type, name = token.split("/")
        tiny_release.write_tiny_release(
            root,
            frames=len(agents["ego_vehicle"][3]),
            agents=list(agents),
            scenario_type=scenario_type,
            name=name,
            meta=meta,
            lines_of=make_lines,
        )
    findings = validate_release(root, workers=1).findings
    assert {finding.severity for finding in findings} <= {"note"}
    return DeepAccident(dataroot=root, verbose=False)


def test_a_merge_touches_from_frame_54_and_nothing_false_is_said(
    tracks: Path, tmp_path: Path
) -> None:
    """In scenario 24 of Town03 two cars approach at 5 m/s.

    At the last frame they overlap by 0.4 m, and 2.7 m/s are left.
    """
    agents: Agents = {}
    for name, actor, size in (
        ("ego_vehicle", 2675, (4.9742, 2.0384, 1.5421)),
        ("other_vehicle", 2671, (4.8557, 2.0328, 1.6494)),
    ):
        table = np.loadtxt(tracks / f"{name}.viewer.csv", delimiter=",", skiprows=1)
        x, z, y, m00, m20 = table[:, 1:].T
        columns = (
            x + 82.92406504775263,
            y - 127.44046977800473,
            z + 8.274037610661875,
            np.arctan2(m20, m00),
        )
        agents[name] = (actor, "car", size, np.column_stack(columns))
    meta = (
        "MidRainSunset 2675 car 2671 car 5000.0 same front_side 66\n colliding agents: ego other\n"
        " agents id: 2675 2690 2671 2691\n"
    )
    token = tiny_release.SCENARIO_TOKEN
    da = write_release(tmp_path, token, agents, meta)

    contact = da.collision(token)
    assert contact.frame == f"{token}/056"
    assert contact.contact_frame == f"{token}/054"
    assert (contact.touching, contact.gap, contact.apart) == (0.2, 0.0, False)
    assert contact.disagreements == ()
    assert_allclose(contact.speeds, [10.41, 8.95], atol=0.05)
    assert_allclose(np.degrees(contact.impact_angle), 30.2, atol=0.05)
    assert 4.5 < contact.closing_speed < 5.8
    first, second = (da.trajectory(instance).velocity[-1] for instance in contact.instances)
    last_speeds = [np.linalg.norm(velocity) for velocity in (first, second, first - second)]
    assert_allclose(last_speeds, [10.99, 10.51, 2.65], atol=0.05)
    check = avoidability(da, token).check
    assert_allclose([check.time, check.delta_v.sum()], [5.29, 5.25], atol=0.05)

    assert not missing_parts(
        da.describe(token).text,
        "the ego, a car at 10.4 m/s, collides with the other vehicle, a car at "
        "8.9 m/s, left side to right",
        "outlines touching from 0.2 s before the last frame (within 0.1 s)",
    )
    for report in (lead_time_ledger(da, workers=1), avoidability_report(da, workers=1)):
        text = report.to_text()
        assert "or before it where outlines touch: 1 of 1 accident, up to 0.2 s" in text

    figure = Figure()
    render_accident(da, token, seconds=[0.5, 0.0], layers=["boxes", "grid"], fig=figure)
    texts = {text.get_text() for text in figure.findobj(Text)}
    assert {"0.5 s before", "the last frame"} <= texts
    assert any("outlines touching from 0.2 s before" in text for text in texts)


def test_nothing_false_is_said_of_a_crossing(tracks: Path, tmp_path: Path) -> None:
    """Town05's scenario 36 up to frame 91."""
    rows = []
    for part in ("0-3", "4-9"):
        path = tracks / f"Town05_sub2_00036_accident_window_{part}.csv"
        rows += [line.split(",") for line in path.read_text().splitlines()[1:]]

    num_frames = 91
    agents: Agents = {}
    for name, agent, actor_id in zip(
        ("ego", "ego_behind", "other", "other_behind"), tiny_release.AGENTS, IDS, strict=False
    ):
        agent_rows = np.array([row[2:5] for row in rows if row[0] == name], dtype=float)
        seconds, east, north = agent_rows.T
        frame_times = np.arange(num_frames) / 10
        x = np.interp(frame_times, seconds, east)
        y = np.interp(frame_times, seconds, -north)

        # a standing agent has the heading of its next step
        steps = np.gradient(x) + 1j * np.gradient(y)
        moving_frames = np.flatnonzero(np.abs(steps) > 0.05)
        next_moves = np.searchsorted(moving_frames, np.arange(num_frames))
        last_move = len(moving_frames) - 1
        yaw = np.angle(steps[moving_frames[next_moves.clip(max=last_move)]])
        if "behind" in name:
            category, size = "truck", (8.47, 2.89, 3.83)
        else:
            category, size = "car", (4.60, 1.93, 1.52)
        z = np.full(num_frames, size[2] / 2)
        agents[agent] = (actor_id, category, size, np.column_stack([x, y, z, yaw]))
    meta = (
        "ClearNoon 4246 truck 4249 truck 9090.520 same front_side 101\n colliding "
        f"agents: ego_behind other_behind\n agents id: {' '.join(map(str, IDS))}\n"
    )
    da = write_release(tmp_path, CROSSING, agents, meta)

    contact = da.collision(CROSSING)
    assert contact.actor_ids == (4246, 4249)
    assert contact.sides == ("front", "right")
    assert contact.touching == 0.1
    assert contact.disagreements == ()
    assert (
        "a truck at 0.0 m/s, is hit on its right side by the vehicle behind the ego, "
        "a truck at 4.1 m/s, closing at" in da.describe(CROSSING).text
    )
