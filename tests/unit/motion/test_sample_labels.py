"""Check `da.motion_labels`: labels from the tables of a release, from its first frame to its last,
or of a part of it.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pyquaternion import Quaternion
from support import plain_fiery, tiny_release
from support.expected_errors import assert_raises
from support.tiny_release_index import open_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, NotAvailableError, TokenError
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    OWN_BOX_ID,
    PRESETS,
    FrameBoxes,
    MotionLabelConfig,
    MotionLabels,
    motion_labels_from_boxes,
)
from deepaccident_devkit.motion.warping import egomotion
from deepaccident_devkit.taxonomy import AGENTS, LIDAR
from deepaccident_devkit.v2x.cooperation import visible_actors

MAPS = ("segmentation", "instance", "centerness", "offset", "flow")
EGO = f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle"
POLE = f"{tiny_release.SCENARIO_TOKEN}/infrastructure"
VAN = 1300
LATE_CAR = 1301
WALKER = 1302


def make_lines(agent: str, frame: int) -> list[str]:
    """Return tiny's own row and van, a car that nobody sees before frame 11, a pedestrian and two
    untracked cars.
    """
    seen = frame >= 11
    return [
        *tiny_release.label_lines(agent, frame)[:-1],
        f"car 14.0 7.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 {LATE_CAR} {9 * seen} {seen}",
        f"pedestrian 6.0 -5.0 -0.9 0.6 0.6 1.86 0.0 0.0 0.0 {WALKER} 9 True",
        "car -20.0 10.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 -1 99 True",
        "car -20.0 -10.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 -1 99 True",
    ]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = tmp_path_factory.mktemp("tiny") / "release"
    tiny_release.write_tiny_release(root, frames=31, lines_of=make_lines)
    return open_release(root)


def count_cells(labels: MotionLabels, actor: int) -> list[int]:
    """Count the cells that an actor is drawn in, frame by frame."""
    if actor not in labels.id_map:
        return [0] * len(labels.instance)
    is_actor = labels.instance == labels.id_map[actor]
    return is_actor.sum(axis=(1, 2)).tolist()


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        *(
            config for name, config in PRESETS.items() if name != "fiery"
        ),  # test_it_draws_as_fierys_class
        MotionLabelConfig(protocol="clean"),
        MotionLabelConfig(agents="single"),
        MotionLabelConfig(agents=("infrastructure", "other_vehicle"), protocol="beverse"),
        MotionLabelConfig(
            agents="+behind", protocol="clean", receptive_field=1, future_frames=7, step=3
        ),
        MotionLabelConfig(filter_invisible=False),
    ],
)
def test_it_draws_what_boxes_poses_and_visible_actors_say(
    da_motion: DeepAccident, config: MotionLabelConfig
) -> None:
    """Labels are the same through the public calls, a moment at a time; of one sample, and of many
    whatever lies beside them.
    """
    recordings = [(scenario["token"], agent) for scenario in da_motion.scenario for agent in AGENTS]
    records = [
        da_motion.get_sample(*recording, number)
        for number in (1, 13, 26, 35)
        for recording in recordings
    ]
    for record, labels in zip(records, da_motion.motion_labels_of(records, config), strict=True):
        assert_same_labels(labels, draw_by_public_calls(da_motion, record, config))
    assert_same_labels(da_motion.motion_labels(records[-1], config), labels)


def draw_by_public_calls(
    release: DeepAccident, record: dict, config: MotionLabelConfig
) -> MotionLabels:
    recording, present = record["token"].rsplit("/", 1)
    length = release.get("scenario", record["scenario_token"])["num_frames"]
    tokens = []
    poses = []
    for offset in (*config.offsets, config.offsets[-1] + config.step):
        number = int(present) + offset
        if 1 <= number <= length:
            token = f"{recording}/{number:03d}"
            tokens.append(token)
            poses.append(release.world_from(token, "ego").matrix)
        else:
            tokens.append(None)
            poses.append(np.eye(4))

    frames = []
    for token in tokens[config.receptive_field - 1 : -1]:
        if token is None:
            frames.append(None)
            continue
        boxes = release.boxes(token, "lidar")
        rows = release.annotation_rows(token)
        visible = np.ones(len(boxes.actor_id), dtype=bool)
        if config.filter_invisible:
            seen = visible_actors(release, token, agents=config.agents)
            visible = np.isin(boxes.actor_id, seen)
        frames.append(
            FrameBoxes(
                center=boxes.center,
                size=boxes.size,
                actor_id=boxes.actor_id,
                category=boxes.category,
                yaw=release.columns("annotation")["yaw"][rows],
                visible=visible,
                ego_from_lidar=release.ego_from(token, LIDAR).matrix,
            )
        )

    valid = [token is not None for token in tokens]
    motion = egomotion(poses, valid, config.rules)
    is_vehicle = record["agent"] != "infrastructure"
    return motion_labels_from_boxes(frames, motion, config, valid=valid[:-1], is_vehicle=is_vehicle)


def assert_same_labels(labels: MotionLabels, expected: MotionLabels) -> None:
    for name in (*MAPS, "future_egomotion", "valid"):
        assert_array_equal(getattr(labels, name), getattr(expected, name), err_msg=name)
    assert dict(labels.id_map) == dict(expected.id_map)


def test_labels_of_the_first_frame(small: DeepAccident) -> None:
    labels = small.motion_labels(f"{EGO}/001")
    assert labels.valid.tolist() == [False] * 2 + [True] * 5
    assert_array_equal(labels.future_egomotion[:2], 0)
    assert labels.future_egomotion[2:].any(axis=1).all()
    assert labels.instance.any(axis=(1, 2)).all()


@pytest.mark.parametrize("number", [12, 26, 27, 31])
def test_labels_of_the_last_frames(small: DeepAccident, number: int) -> None:
    valid = [number + 5 * step <= 31 for step in range(-2, 5)]
    next_is_valid = [number + 5 * step <= 31 for step in range(-1, 6)]
    for protocol, mark in (("released", 0), ("clean", 255)):
        labels = small.motion_labels(f"{EGO}/{number:03d}", MotionLabelConfig(protocol=protocol))
        assert labels.valid.tolist() == valid
        assert labels.future_egomotion.any(axis=1).tolist() == next_is_valid
        missing = ~labels.label_valid
        for name in ("segmentation", "instance", "centerness"):
            assert (getattr(labels, name)[missing] == mark).all()
        assert (labels.offset[missing] == 255).all()
        assert (labels.flow[missing] == 255).all()
        last = int(labels.label_valid.sum()) - 1
        assert (labels.flow[last] == 255).all()
        assert (labels.flow[:last] != 255).any(axis=(1, 2, 3)).all()


def test_a_step_and_a_past_that_leave_the_recording(small: DeepAccident) -> None:
    labels = small.motion_labels(
        f"{EGO}/016", MotionLabelConfig(receptive_field=9, future_frames=1, step=20)
    )
    assert labels.valid.tolist() == [False] * 8 + [True, False]
    assert_array_equal(labels.future_egomotion, 0)
    assert not labels.instance[1].any()


def test_own_row_only_as_the_egos_own_box(small: DeepAccident) -> None:
    """Its id is −101 and never −100, whether unseen actors are left out or not."""
    middle = np.s_[:, 96:104, 94:106]
    for filtered in (True, False):
        for protocol in ("released", "clean"):
            config = MotionLabelConfig(filter_invisible=filtered, protocol=protocol)
            with_ego = small.motion_labels(f"{EGO}/006", config)
            without = small.motion_labels(f"{EGO}/006", replace(config, draw_ego=False))
            assert -100 not in with_ego.id_map
            assert min(count_cells(with_ego, OWN_BOX_ID)) > 20
            assert {*with_ego.id_map} - {*without.id_map} == {OWN_BOX_ID}
            assert with_ego.segmentation[middle].any(axis=(1, 2)).all()
            assert not without.segmentation[middle].any()


def test_the_pole_has_no_own_box(small: DeepAccident) -> None:
    for protocol in LABEL_PROTOCOLS:
        labels = small.motion_labels(f"{POLE}/006", MotionLabelConfig(protocol=protocol))
        assert OWN_BOX_ID not in labels.id_map
        assert not labels.segmentation[:, 98:102, 98:102].any()


def test_untracked_actors_are_seen_by_nobody(small: DeepAccident) -> None:
    around_untracked = np.s_[:, 70:130, 50:70]
    for protocol, instances_per_frame in (("released", 1), ("clean", 2)):
        config = MotionLabelConfig(protocol=protocol)
        seen = small.motion_labels(f"{EGO}/006", config)
        assert not seen.segmentation[around_untracked].any()

        unfiltered = small.motion_labels(f"{EGO}/006", replace(config, filter_invisible=False))
        for frame in unfiltered.instance[around_untracked]:
            assert len(np.unique(frame)) - 1 == instances_per_frame


def test_an_actor_is_drawn_if_a_chosen_agent_sees_it(tmp_path: Path) -> None:
    """The van is seen only by the pole."""

    def make_lines_seen_by_pole(agent: str, frame: int) -> list[str]:
        lines = tiny_release.label_lines(agent, frame)
        if agent != "infrastructure":
            lines = [line.replace(" 12 True", " 0 False") for line in lines]
        return lines

    root = tiny_release.write_tiny_release(tmp_path, lines_of=make_lines_seen_by_pole)
    release = open_release(root)
    for agents, is_drawn in {
        None: True,
        "all": True,
        "+infrastructure": True,
        ("infrastructure",): True,
        "single": False,
        "vehicles": False,
        ("ego_vehicle", "other_vehicle"): False,
    }.items():
        labels = release.motion_labels(f"{EGO}/002", MotionLabelConfig(agents=agents))
        assert (VAN in labels.id_map) == is_drawn, agents


def test_ids_go_on_from_the_sample_before(small: DeepAccident) -> None:
    """A worker of the released code keeps its ids; actors that it has not met yet come after
    them.
    """
    first = small.motion_labels(f"{EGO}/001")
    assert {*first.id_map} == {OWN_BOX_ID, VAN, WALKER}

    previous_ids = {VAN: 1, 4711: 2}
    second = small.motion_labels(f"{EGO}/016", id_map=previous_ids)
    assert dict(second.id_map) == {VAN: 1, 4711: 2, OWN_BOX_ID: 3, LATE_CAR: 4, WALKER: 5}
    assert previous_ids == {VAN: 1, 4711: 2}

    fresh = small.motion_labels(f"{EGO}/016")
    for actor, number in fresh.id_map.items():
        assert_array_equal(fresh.instance == number, second.instance == second.id_map[actor])
    for name in ("segmentation", "centerness", "offset", "flow"):
        assert_array_equal(getattr(fresh, name), getattr(second, name))


def test_vectors_turn_with_their_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ego turns by 40 degrees within 2 s; at the present, all cells of the van and their
    offsets must still lead to one point.

    The released ones do not, and miss it the more the longer the van is.
    """
    monkeypatch.setattr(
        tiny_release, "ego_to_world", lambda _agent, frame: tiny_release.pose(2.0 * frame)
    )
    release = open_release(tiny_release.write_tiny_release(tmp_path, frames=31))

    spreads = {}
    for protocol in ("released", "clean"):
        labels = release.motion_labels(f"{EGO}/003", MotionLabelConfig(protocol=protocol))
        present = labels.to_present()
        assert min(count_cells(present, VAN)) > 20
        spreads[protocol] = [measure_spread(present, t, VAN) for t in range(5)]

    assert spreads["released"][0] == 0 < min(spreads["released"][2:]), spreads
    assert spreads["released"][4] > 2, spreads
    assert max(spreads["clean"]) <= 1, spreads


def measure_spread(labels: MotionLabels, t: int, actor: int) -> float:
    """Measure, in cells, how far the centres that an actor's cells and offsets lead to spread from
    their middle.
    """
    cells = np.argwhere(labels.instance[t] == labels.id_map[actor])
    rows, columns = cells.T
    centers = cells + labels.offset[t][:, rows, columns].T
    return float(np.ptp(centers, axis=0).max()) / 2


def test_a_sample_without_a_label(tmp_path: Path) -> None:
    release = open_release(tiny_release.write_tiny_release(tmp_path, labelled=False))
    assert_raises(
        (
            lambda: release.motion_labels(f"{EGO}/002"),
            NotAvailableError,
            r"ego_vehicle/002 has no label \(the test split has",
        ),
    )


def test_agents_of_a_partial_release(tmp_path: Path) -> None:
    agents = ("ego_vehicle", "infrastructure")
    release = open_release(
        tiny_release.write_tiny_release(tmp_path, agents=agents, lines_of=make_lines)
    )
    for config in (
        None,
        MotionLabelConfig(agents="+infrastructure"),
        MotionLabelConfig(agents="+other", filter_invisible=False),
    ):
        assert VAN in release.motion_labels(f"{EGO}/002", config).id_map

    for missing_agents in ("+other", "all", ("ego_vehicle", "other_vehicle")):
        config = MotionLabelConfig(agents=missing_agents)
        assert_raises(
            (
                partial(release.motion_labels, f"{EGO}/002", config),
                NotAvailableError,
                r"agents: other_vehicle\w* is not in this release|behind is not",
            ),
        )


def test_what_is_no_sample_and_agents_that_do_not_exist(small: DeepAccident) -> None:
    for sample in ("", "nothing", f"{EGO}/0", f"{EGO}/2", f"{EGO}/099", None, 3, {"token": 3}):
        assert_raises(
            (
                partial(small.motion_labels, sample),
                TokenError,
                r"no token|expected a token or a record",
            ),
        )
    for agents in ("everybody", ("pole",), ()):
        assert_raises(
            (partial(MotionLabelConfig, agents=agents), ChoiceError, r"agents?: expected"),
        )
    assert_raises(
        (lambda: small.motion_labels_of(f"{EGO}/001"), ChoiceError, "put it into a list"),
    )


def test_an_agent_without_labels_sees_nothing(tmp_path: Path) -> None:
    tiny_release.write_tiny_release(tmp_path, agents=("infrastructure",), labelled=False)
    release = open_release(tiny_release.write_tiny_release(tmp_path, agents=("ego_vehicle",)))

    all_agents = release.motion_labels(f"{EGO}/002")
    assert {*all_agents.id_map} == {OWN_BOX_ID, VAN}

    pole_only = release.motion_labels(f"{EGO}/002", MotionLabelConfig(agents=("infrastructure",)))
    assert {*pole_only.id_map} == {OWN_BOX_ID}


def test_a_label_without_boxes(tmp_path: Path) -> None:
    release = open_release(
        tiny_release.write_tiny_release(tmp_path, lines_of=lambda _agent, _frame: ["0.0 0.0"])
    )
    released = release.motion_labels(f"{EGO}/002")
    assert {*released.id_map} == {OWN_BOX_ID}  # the default box

    clean = release.motion_labels(f"{EGO}/002", MotionLabelConfig(protocol="clean"))
    pole = release.motion_labels(f"{POLE}/002")
    for labels in (clean, pole):
        assert not labels.id_map
        assert not labels.instance[0].any()
        assert (labels.offset == 255).all()


def make_leaning_pose(agent: str, frame: int) -> np.ndarray:
    """Return the pose of an agent that leans by up to 16° and turns while it drives."""
    x = 12.0 * tiny_release.AGENTS.index(agent) + 0.3 * frame
    yaw = Quaternion(axis=(0, 0, 1), degrees=35 + 3 * frame)
    pitch = Quaternion(axis=(0, 1, 0), degrees=13)
    roll = Quaternion(axis=(1, 0, 0), degrees=9 - frame / 3)

    pose = tiny_release.pose(0, x=x, y=-4.0, z=0.5)
    pose[:3, :3] = (yaw * pitch * roll).rotation_matrix
    return pose


def make_lines_around(agent: str, frame: int) -> list[str]:
    """Place cars around the agent; it sees some always, some at times and some never, and the other
    agents may see them.
    """
    is_vehicle = agent != "infrastructure"
    is_late = frame > 12
    lines = tiny_release.label_lines(agent, frame)[:-1]
    for kind, x, y, width, yaw, actor, points, seen in (
        ("car", 14.03 + frame / 7, 7.1, 1.9, 0.4, 1301, 90, is_late),
        ("truck", 31.01, -19.3, 2.6, -1.2, 1302, 90, not is_vehicle),
        ("cyclist", -8.2, 3.3, 0.6, 2.2, 1303, 0, True),
        ("pedestrian", 6.0, -5.0, 0.6, 0.1, 1304, 90, True),
        ("car", -20.0, 10.0, 1.9, 0.7, -1, 90, True),
        ("car", -20.0, -10.0, 1.9, 1.7, -1, 90, is_late),
        ("van", 40.2, 36.9, 2.1, -2.8, 1305, 0, True),
    ):
        size = f"{4.4 + width:.3f} {width} 1.7"
        lines.append(f"{kind} {x} {y} -1.1 {size} {yaw} 0.0 0.0 {actor} {points} {seen}")
    return lines


@pytest.fixture(scope="module")
def slope(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    root = tmp_path_factory.mktemp("slope") / "release"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny_release, "ego_to_world", make_leaning_pose)
        tiny_release.write_tiny_release(root, frames=28, lines_of=make_lines_around)
    return open_release(root)


@pytest.mark.parametrize("filter_invisible", [True, False])
@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle", "infrastructure"])
def test_it_draws_as_fierys_class(slope: DeepAccident, agent: str, filter_invisible: bool) -> None:
    config = MotionLabelConfig.preset("fiery", filter_invisible=filter_invisible)
    for number in (1, 5, 13, 24):
        token = f"{tiny_release.SCENARIO_TOKEN}/{agent}/{number:03d}"
        labels = slope.motion_labels(token, config)
        expected = plain_fiery.instances(slope, token, filter_invisible=filter_invisible)
        inner = (labels.label_valid, plain_fiery.INNER_MARGIN, plain_fiery.INNER_MARGIN)
        assert_array_equal(labels.instance[inner], expected[inner])


def test_the_choices_of_fierys_class_are_fields(slope: DeepAccident) -> None:
    fiery = PRESETS["fiery"]
    assert fiery.agents == "single"
    assert fiery.rules.sight == "camera"
    assert fiery.rules.pose == "yaw"
    for name, rules in LABEL_PROTOCOLS.items():
        if name != "fiery":
            assert (rules.sight, rules.pose) == ("released", "whole")
    assert MotionLabelConfig.from_dict(fiery.as_dict()) == fiery

    protocol_fields = MotionLabelConfig().as_dict()["protocol"]
    assert {"sight", "pose"}.isdisjoint(protocol_fields), "digests of older files stay"
