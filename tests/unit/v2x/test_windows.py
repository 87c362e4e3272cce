"""Windows of a small release: holes, ends, no actors, headings through π and refused settings."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from support.tiny_release import (
    SCENARIO_TOKEN,
    ego_to_world,
    label_lines,
    lidar_height,
    pose,
    write_tiny_release,
)

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    GeometryError,
    NotAvailableError,
    TokenError,
)
from deepaccident_devkit.taxonomy import CATEGORIES
from deepaccident_devkit.v2x import WindowConfig, cooperative_view, stack_windows

NUM_FRAMES = 6
SAMPLE = f"{SCENARIO_TOKEN}/ego_vehicle/003"
POLE_SAMPLE = f"{SCENARIO_TOKEN}/infrastructure/003"
CYCLIST_ID, VAN_ID = 1400, 1300
EGO_BIT, POLE_BIT = 1, 16


def lines_with_cyclist(agent: str, frame: int) -> list[str]:
    """Add a cyclist who turns through π, and whom nobody annotates in frame 4.

    The ego annotates it with too few points to see it.
    """
    lines = label_lines(agent, frame)
    if frame == 4 or agent not in ("ego_vehicle", "infrastructure"):
        return lines
    lidar_to_world = ego_to_world(agent, frame) @ pose(z=lidar_height(agent))
    x, y, z, _ = (np.linalg.inv(lidar_to_world) @ [12.0, 30.0, 1.0, 1.0]).tolist()
    agent_yaw = np.arctan2(lidar_to_world[1, 0], lidar_to_world[0, 0])
    yaw = 3.0 + 0.1 * frame - float(agent_yaw)
    num_points = 0 if agent == "ego_vehicle" else 9
    lines.append(
        f"cyclist {x!r} {y!r} {z!r} 1.8 0.5 1.6 {yaw!r} 0.0 0.0 {CYCLIST_ID} {num_points} True"
    )
    return lines


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = tmp_path_factory.mktemp("tiny") / "release"
    write_tiny_release(root, frames=NUM_FRAMES, lines_of=lines_with_cyclist)
    return DeepAccident("v1", root, verbose=False)


def test_a_hole_stays_and_the_ends_are_not_valid(tiny: DeepAccident) -> None:
    window = tiny.window(SAMPLE, past=0.4, future=0.5, frame="world")
    assert window.index.tolist() == list(range(-1, 9))
    assert_allclose(window.time, np.arange(-4, 6) / 10)
    assert window.index[window.present] == 3
    row = window.actor_id.tolist().index(CYCLIST_ID)
    in_recording = np.isin(window.index, range(1, NUM_FRAMES + 1))
    assert_array_equal(window.valid[row], in_recording & (window.index != 4))
    assert window.valid.any(axis=0).tolist() == in_recording.tolist()

    assert np.isfinite(window.center).all(axis=-1).tolist() == window.valid.tolist()
    for name in ("yaw", "speed"):
        assert_array_equal(np.isfinite(window.arrays[name]), window.valid)
    assert_array_equal(window.seen_by[row] == POLE_BIT, window.valid[row])
    assert_array_equal(window.annotated_by[row] == EGO_BIT | POLE_BIT, window.valid[row])
    assert not window.seen_by[:, ~in_recording].any()
    assert CATEGORIES[window.category[row]] == "cyclist"
    assert window.instance[row] == f"{SCENARIO_TOKEN}/actor/{CYCLIST_ID}"
    assert window.own_actor_id in window.actor_id
    assert -1 not in window.actor_id


def test_where_labels_differ_the_own_row_comes_last_and_the_first_agent_first(
    tiny: DeepAccident, tmp_path: Path
) -> None:
    """As in `cooperative_view`, a vehicle's own row counts only if no other agent annotates it."""
    own_id = tiny.window(SAMPLE).own_actor_id
    van_lengths = {"ego_vehicle": "7.0", "infrastructure": "6.0"}

    def lines_that_differ(agent: str, frame: int) -> list[str]:
        van_size = f" {van_lengths[agent]} 2.0 2.2 "
        lines = [line.replace(" 5.0 2.0 2.2 ", van_size) for line in label_lines(agent, frame)]
        if agent == "infrastructure":
            lines.append(f"car 5.0 5.0 -1.2 9.0 1.9 1.5 0.0 0.0 0.0 {own_id} 50 True")
        return lines

    write_tiny_release(
        tmp_path, agents=tuple(van_lengths), frames=NUM_FRAMES, lines_of=lines_that_differ
    )
    da = DeepAccident("v1", tmp_path, verbose=False)
    window = da.window(SAMPLE, past=0.0, future=0.0)

    boxes = cooperative_view(da, SAMPLE).boxes
    lengths = dict(zip(boxes.actor_id.tolist(), boxes.size[:, 0].tolist(), strict=True))
    assert (lengths[own_id], lengths[VAN_ID]) == (9.0, 7.0)
    expected_lengths = [lengths[actor] for actor in window.actor_id.tolist()]
    assert window.size[:, 0, 0].tolist() == expected_lengths


def test_headings_pass_through_pi(tiny: DeepAccident) -> None:
    world, actor = (
        tiny.window(SAMPLE, past=0.2, future=0.3, frame=frame) for frame in ("world", "actor")
    )
    row = world.actor_id.tolist().index(CYCLIST_ID)
    numbers = world.index[world.valid[row]]
    # CARLA's y is right, so angles have the other sign here.
    expected = np.angle(np.exp(-1j * (3.0 + 0.1 * numbers)))
    assert_allclose(world.yaw[row, world.valid[row]], expected, atol=1e-6)
    assert expected.min() < 0 < expected.max()
    assert_allclose(actor.yaw[row, world.valid[row]], -0.1 * (numbers - 3), atol=1e-6)


def test_actors_of_the_present_or_of_any_moment(tiny: DeepAccident) -> None:
    hole = f"{SCENARIO_TOKEN}/ego_vehicle/004"
    assert CYCLIST_ID not in tiny.window(hole, 0.1, 0.1).actor_id
    window = tiny.window(hole, 0.1, 0.1, actors="any", frame="actor")
    row = window.actor_id.tolist().index(CYCLIST_ID)
    assert window.valid[row].tolist() == [True, False, True]
    assert np.isnan(window.center[row]).all()
    assert np.isnan(window.yaw[row]).all()
    assert np.isfinite(window.speed[row]).tolist() == window.valid[row].tolist()


def test_a_window_without_actors_has_the_same_shape(tmp_path: Path) -> None:
    write_tiny_release(tmp_path, lines_of=lambda agent, frame: label_lines(agent, frame)[:1])
    empty = DeepAccident("v1", tmp_path, verbose=False)
    for frame in ("ego", "actor"):
        window = empty.window(SAMPLE, 0.2, 0.3, frame=frame)
        assert len(window) == 0
        assert window.center.shape == (0, 6, 3)
        assert window.valid.shape == window.seen_by.shape == (0, 6)
        assert stack_windows([window, window])["velocity"].shape == (2, 0, 6, 3)


def test_a_copy_is_read_only_and_says_its_shapes(tiny: DeepAccident) -> None:
    window = tiny.window(SAMPLE)
    copy = pickle.loads(pickle.dumps(window))
    for name, array in copy.arrays.items():
        assert not array.flags.writeable, name
        assert_array_equal(array, window.arrays[name])
    assert "TrackWindow(" in repr(window)
    assert tiny.window(tiny.sample.get(POLE_SAMPLE)).own_actor_id is None


def test_refused_settings(tiny: DeepAccident, tmp_path: Path) -> None:
    write_tiny_release(tmp_path, labelled=False)
    unlabelled = DeepAccident("v1", tmp_path, verbose=False)
    short, long = tiny.window(SAMPLE, 0.1, 0.1), tiny.window(SAMPLE, 0.1, 0.2)
    in_world = tiny.window(SAMPLE, 0.1, 0.1, frame="world")
    assert_raises(
        (
            lambda: tiny.window(SAMPLE, step=0.25),
            ConfigError,
            ("step", "a multiple of 0.1 s", "0.25", "nearest is 0.2"),
        ),
        (
            lambda: tiny.window(SAMPLE, past=0.7, step=0.5),
            ConfigError,
            ("past", "a multiple of 0.5 s", "nearest is 0.5"),
        ),
        (lambda: tiny.window(SAMPLE, future=-1), ConfigError, ("future", "from 0", "-1")),
        (lambda: WindowConfig(past=float("nan")), ConfigError, ("past", "nan")),
        (lambda: WindowConfig(step=0), ConfigError, ("step", "from 0.1")),
        (lambda: WindowConfig(future=1e9), ConfigError, ("future", "to 60")),
        (lambda: tiny.window(SAMPLE, frame="road"), ChoiceError, ("frame", "ego", "actor")),
        (lambda: tiny.window(SAMPLE, agents="bus"), ChoiceError, ("agents", "ego_vehicle")),
        (lambda: tiny.window(SAMPLE, visible="no"), ChoiceError, ("visible", "released")),
        (lambda: tiny.window(SAMPLE, actors="all"), ChoiceError, ("actors", "present", "any")),
        (lambda: tiny.window("road"), TokenError, "road"),
        (lambda: unlabelled.window(SAMPLE), NotAvailableError, ("no label", "labelled sample")),
        (lambda: tiny.windows([]), GeometryError, "at least one window"),
        (lambda: stack_windows([short, long]), GeometryError, ("past, future", "2 kinds")),
        (lambda: stack_windows([short, in_world]), GeometryError, ("same frame", "2 kinds")),
        (lambda: short.augmented(np.eye(3)), GeometryError, ("matrix", "(4, 4)")),
    )
