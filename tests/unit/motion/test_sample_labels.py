"""`da.motion_labels`: what the tables of a release give, from its first frame to its last, or in
part.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import plain_fiery
import pytest
import tiny
from numpy.testing import assert_array_equal
from pyquaternion import Quaternion
from refusals import assert_refused

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
EGO, POLE = f"{tiny.TOKEN}/ego_vehicle", f"{tiny.TOKEN}/infrastructure"
VAN, LATER, WALKER = 1300, 1301, 1302


def lines(agent: str, frame: int) -> list[str]:
    """tiny's own row and van; a car that nobody sees before frame 11, a pedestrian and two
    untracked cars.
    """
    seen = frame >= 11
    return [
        *tiny.label_lines(agent, frame)[:-1],
        f"car 14.0 7.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 {LATER} {9 * seen} {seen}",
        f"pedestrian 6.0 -5.0 -0.9 0.6 0.6 1.86 0.0 0.0 0.0 {WALKER} 9 True",
        "car -20.0 10.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 -1 99 True",
        "car -20.0 -10.0 -1.0 4.5 1.9 1.5 0.0 0.0 0.0 -1 99 True",
    ]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    return opened(
        tiny.write_tiny_release(
            tmp_path_factory.mktemp("tiny") / "release", frames=31, lines_of=lines
        )
    )


def opened(root: Path) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False, workers=1)


def drawn(labels: MotionLabels, actor: int) -> list[int]:
    """In how many cells an actor is drawn, frame by frame."""
    number = labels.id_map.get(actor, 0)
    return [int((frame == number).sum()) if number else 0 for frame in labels.instance]


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
    """The same through the public calls, a moment at a time; of one sample, and of many whatever
    lies beside them.
    """
    places = [(scenario["token"], agent) for scenario in da_motion.scenario for agent in AGENTS]
    records = [
        da_motion.get_sample(*place, number) for number in (1, 13, 26, 35) for place in places
    ]
    for record, labels in zip(records, da_motion.motion_labels_of(records, config), strict=True):
        assert_same(labels, by_public_calls(da_motion, record, config))
    assert_same(da_motion.motion_labels(records[-1], config), labels)


def by_public_calls(release: DeepAccident, record: dict, config: MotionLabelConfig) -> MotionLabels:
    recording, number = record["token"].rsplit("/", 1)
    length = release.get("scenario", record["scenario_token"])["num_frames"]
    numbers = [
        int(number) + offset for offset in (*config.offsets, config.offsets[-1] + config.step)
    ]
    tokens = [f"{recording}/{one:03d}" if 1 <= one <= length else None for one in numbers]
    poses = [np.eye(4) if one is None else release.world_from(one, "ego").matrix for one in tokens]
    frames = []
    for token in tokens[config.receptive_field - 1 : -1]:
        if token is None:
            frames.append(None)
            continue
        boxes, rows = release.boxes(token, "lidar"), release.annotation_rows(token)
        actors = boxes.actor_id
        seen = (
            visible_actors(release, token, agents=config.agents)
            if config.filter_invisible
            else actors
        )
        columns = {
            name: getattr(boxes, name) for name in ("center", "size", "actor_id", "category")
        }
        frames.append(
            FrameBoxes(
                **columns,
                yaw=release.columns("annotation")["yaw"][rows],
                visible=np.isin(actors, seen),
                ego_from_lidar=release.ego_from(token, LIDAR).matrix,
            )
        )
    there = [token is not None for token in tokens]
    motion, is_vehicle = egomotion(poses, there, config.rules), record["agent"] != "infrastructure"
    return motion_labels_from_boxes(frames, motion, config, valid=there[:-1], is_vehicle=is_vehicle)


def assert_same(one: MotionLabels, other: MotionLabels) -> None:
    for name in (*MAPS, "future_egomotion", "valid"):
        assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert dict(one.id_map) == dict(other.id_map)


def test_labels_of_the_first_frame(small: DeepAccident) -> None:
    labels = small.motion_labels(f"{EGO}/001")
    assert labels.valid.tolist() == [False] * 2 + [True] * 5
    assert_array_equal(labels.future_egomotion[:2], 0)
    assert labels.future_egomotion[2:].any(axis=1).all()
    assert labels.instance.any(axis=(1, 2)).all()


@pytest.mark.parametrize("number", [12, 26, 27, 31])
def test_labels_of_the_last_frames(small: DeepAccident, number: int) -> None:
    there = [number + 5 * step <= 31 for step in range(-2, 5)]
    after = [number + 5 * step <= 31 for step in range(-1, 6)]
    for protocol, mark in (("released", 0), ("clean", 255)):
        labels = small.motion_labels(f"{EGO}/{number:03d}", MotionLabelConfig(protocol=protocol))
        assert (labels.valid.tolist(), labels.future_egomotion.any(axis=1).tolist()) == (
            there,
            after,
        )
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
    """−101 and never −100, whether unseen actors are left out or not."""
    for filtered in (True, False):
        for protocol in ("released", "clean"):
            config = MotionLabelConfig(filter_invisible=filtered, protocol=protocol)
            with_ego = small.motion_labels(f"{EGO}/006", config)
            without = small.motion_labels(f"{EGO}/006", replace(config, draw_ego=False))
            assert -100 not in with_ego.id_map
            assert min(drawn(with_ego, OWN_BOX_ID)) > 20
            assert {*with_ego.id_map} - {*without.id_map} == {OWN_BOX_ID}
            middle = np.s_[:, 96:104, 94:106]
            assert with_ego.segmentation[middle].any(axis=(1, 2)).all()
            assert not without.segmentation[middle].any()


def test_the_pole_has_no_own_box(small: DeepAccident) -> None:
    for protocol in LABEL_PROTOCOLS:
        labels = small.motion_labels(f"{POLE}/006", MotionLabelConfig(protocol=protocol))
        assert OWN_BOX_ID not in labels.id_map
        assert not labels.segmentation[:, 98:102, 98:102].any()


def test_untracked_actors_are_seen_by_nobody(small: DeepAccident) -> None:
    for protocol in ("released", "clean"):
        assert (
            not small.motion_labels(f"{EGO}/006", MotionLabelConfig(protocol=protocol))
            .segmentation[:, 70:130, 50:70]
            .any()
        )
        everybody = small.motion_labels(
            f"{EGO}/006", MotionLabelConfig(protocol=protocol, filter_invisible=False)
        )
        left = [len(np.unique(frame[70:130, 50:70])) - 1 for frame in everybody.instance]
        assert left == [1 if protocol == "released" else 2] * 5


def test_whose_sight_counts(tmp_path: Path) -> None:
    """The van is seen by the pole alone."""

    def seen_by_pole(agent: str, frame: int) -> list[str]:
        return [
            line.replace(" 12 True", " 0 False") if agent != "infrastructure" else line
            for line in tiny.label_lines(agent, frame)
        ]

    release = opened(tiny.write_tiny_release(tmp_path, lines_of=seen_by_pole))
    for agents, there in {
        None: True,
        "all": True,
        "+infrastructure": True,
        ("infrastructure",): True,
        "single": False,
        "vehicles": False,
        ("ego_vehicle", "other_vehicle"): False,
    }.items():
        assert (
            VAN in release.motion_labels(f"{EGO}/002", MotionLabelConfig(agents=agents)).id_map
        ) == there, agents


def test_ids_go_on_from_the_sample_before(small: DeepAccident) -> None:
    """As a worker of the released code has them; what nobody met before comes behind."""
    assert {*small.motion_labels(f"{EGO}/001").id_map} == {OWN_BOX_ID, VAN, WALKER}
    before = {VAN: 1, 4711: 2}
    second = small.motion_labels(f"{EGO}/016", id_map=before)
    assert (dict(second.id_map), before) == (
        {VAN: 1, 4711: 2, OWN_BOX_ID: 3, LATER: 4, WALKER: 5},
        {VAN: 1, 4711: 2},
    )
    fresh = small.motion_labels(f"{EGO}/016")
    for actor, number in fresh.id_map.items():
        assert_array_equal(fresh.instance == number, second.instance == second.id_map[actor])
    for name in ("segmentation", "centerness", "offset", "flow"):
        assert_array_equal(getattr(fresh, name), getattr(second, name))


def test_vectors_turn_with_their_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The ego turns by 40 degrees within 2 s: at the present, a cell and its offset still lead to
    one place.

    The released ones lead elsewhere, the farther the longer the van.
    """
    monkeypatch.setattr(tiny, "ego_to_world", lambda _agent, frame: tiny.pose(2.0 * frame))
    release, errors = opened(tiny.write_tiny_release(tmp_path, frames=31)), {}
    for protocol in ("released", "clean"):
        labels = release.motion_labels(
            f"{EGO}/003", MotionLabelConfig(protocol=protocol)
        ).to_present()
        assert min(drawn(labels, VAN)) > 20
        errors[protocol] = [spread(labels, t, VAN) for t in range(5)]
    assert errors["released"][0] == 0 < min(errors["released"][2:]), errors
    assert errors["released"][4] > 2, errors
    assert max(errors["clean"]) <= 1, errors


def spread(labels: MotionLabels, t: int, actor: int) -> float:
    """How far apart, in cells, the places are that an actor's cells and their offsets lead to: half
    of the longer.
    """
    cells = np.argwhere(labels.instance[t] == labels.id_map[actor])
    return float(np.ptp(cells + labels.offset[t][:, cells[:, 0], cells[:, 1]].T, axis=0).max()) / 2


def test_a_sample_without_a_label(tmp_path: Path) -> None:
    release = opened(tiny.write_tiny_release(tmp_path, labelled=False))
    assert_refused(
        (
            lambda: release.motion_labels(f"{EGO}/002"),
            NotAvailableError,
            r"ego_vehicle/002 has no label \(the test split has",
        ),
    )


def test_agents_of_a_partial_release(tmp_path: Path) -> None:
    two = opened(
        tiny.write_tiny_release(tmp_path, agents=("ego_vehicle", "infrastructure"), lines_of=lines)
    )
    assert VAN in two.motion_labels(f"{EGO}/002").id_map
    assert (
        VAN in two.motion_labels(f"{EGO}/002", MotionLabelConfig(agents="+infrastructure")).id_map
    )
    assert_refused(
        *[
            (
                partial(two.motion_labels, f"{EGO}/002", MotionLabelConfig(agents=agents)),
                NotAvailableError,
                r"agents: other_vehicle\w* is not in this release|behind is not",
            )
            for agents in ("+other", "all", ("ego_vehicle", "other_vehicle"))
        ],
    )
    assert (
        VAN
        in two.motion_labels(
            f"{EGO}/002", MotionLabelConfig(agents="+other", filter_invisible=False)
        ).id_map
    )


def test_what_is_no_sample_and_agents_that_do_not_exist(small: DeepAccident) -> None:
    assert_refused(
        *[
            (
                partial(small.motion_labels, sample),
                TokenError,
                r"no token|expected a token or a record",
            )
            for sample in (
                "",
                "nothing",
                f"{EGO}/0",
                f"{EGO}/2",
                f"{EGO}/099",
                None,
                3,
                {"token": 3},
            )
        ],
        (lambda: small.motion_labels_of(f"{EGO}/001"), ChoiceError, "put it into a list"),
        *[
            (lambda wrong=wrong: MotionLabelConfig(agents=wrong), ChoiceError, r"agents?: expected")
            for wrong in ("everybody", ("pole",), ())
        ],
    )


def test_an_agent_without_labels_sees_nothing(tmp_path: Path) -> None:
    tiny.write_tiny_release(tmp_path, agents=("infrastructure",), labelled=False)
    release = opened(tiny.write_tiny_release(tmp_path, agents=("ego_vehicle",)))
    assert {*release.motion_labels(f"{EGO}/002").id_map} == {OWN_BOX_ID, VAN}
    assert {
        *release.motion_labels(f"{EGO}/002", MotionLabelConfig(agents=("infrastructure",))).id_map
    } == {OWN_BOX_ID}


def test_a_label_without_boxes(tmp_path: Path) -> None:
    release = opened(tiny.write_tiny_release(tmp_path, lines_of=lambda _agent, _frame: ["0.0 0.0"]))
    released = release.motion_labels(f"{EGO}/002")
    assert {*released.id_map} == {OWN_BOX_ID}  # the default box
    for token, config in (
        (f"{EGO}/002", MotionLabelConfig(protocol="clean")),
        (f"{POLE}/002", None),
    ):
        labels = release.motion_labels(token, config)
        assert not labels.id_map
        assert not labels.instance[0].any()
        assert (labels.offset == 255).all()


def leaning(agent: str, frame: int):
    """Up to 16° of lean; agents turn while they drive."""
    pose = tiny.pose(0, x=12.0 * tiny.AGENTS.index(agent) + 0.3 * frame, y=-4.0, z=0.5)
    turn = Quaternion(axis=(0, 0, 1), degrees=35 + 3 * frame) * Quaternion(
        axis=(0, 1, 0), degrees=13
    )
    pose[:3, :3] = (turn * Quaternion(axis=(1, 0, 0), degrees=9 - frame / 3)).rotation_matrix
    return pose


def lines_around(agent: str, frame: int) -> list[str]:
    """Cars around the agent; it sees some of them always, some at times, some never, and others see
    those.
    """
    own, later = agent != "infrastructure", frame > 12
    return [
        *tiny.label_lines(agent, frame)[:-1],
        *(
            f"{kind} {x} {y} -1.1 {4.4 + width:.3f} {width} 1.7 {angle} 0.0 0.0 "
            f"{actor} {points} {seen}"
            for kind, x, y, width, angle, actor, points, seen in (
                ("car", 14.03 + frame / 7, 7.1, 1.9, 0.4, 1301, 90, later),
                ("truck", 31.01, -19.3, 2.6, -1.2, 1302, 90, not own),
                ("cyclist", -8.2, 3.3, 0.6, 2.2, 1303, 0, True),
                ("pedestrian", 6.0, -5.0, 0.6, 0.1, 1304, 90, True),
                ("car", -20.0, 10.0, 1.9, 0.7, -1, 90, True),
                ("car", -20.0, -10.0, 1.9, 1.7, -1, 90, later),
                ("van", 40.2, 36.9, 2.1, -2.8, 1305, 0, True),
            )
        ),
    ]


@pytest.fixture(scope="module")
def slope(tmp_path_factory: pytest.TempPathFactory) -> DeepAccident:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiny, "ego_to_world", leaning)
        root = tiny.write_tiny_release(
            tmp_path_factory.mktemp("slope") / "release", frames=28, lines_of=lines_around
        )
    return DeepAccident(dataroot=root, verbose=False, workers=1)


@pytest.mark.parametrize("filter_invisible", [True, False])
@pytest.mark.parametrize("agent", ["ego_vehicle", "other_vehicle", "infrastructure"])
def test_it_draws_as_fierys_class(slope: DeepAccident, agent: str, filter_invisible: bool) -> None:
    config = MotionLabelConfig.preset("fiery", filter_invisible=filter_invisible)
    for number in (1, 5, 13, 24):
        token = f"{tiny.TOKEN}/{agent}/{number:03d}"
        labels = slope.motion_labels(token, config)
        expected = plain_fiery.instances(slope, token, filter_invisible=filter_invisible)
        inner = (labels.label_valid, plain_fiery.INNER, plain_fiery.INNER)
        assert_array_equal(labels.instance[inner], expected[inner])


def test_its_choices_are_fields(slope: DeepAccident) -> None:
    fiery = PRESETS["fiery"]
    assert (fiery.agents, fiery.rules.sight, fiery.rules.pose) == ("single", "camera", "yaw")
    others = {
        (rules.sight, rules.pose) for name, rules in LABEL_PROTOCOLS.items() if name != "fiery"
    }
    assert (others, MotionLabelConfig.from_dict(fiery.as_dict())) == (
        {("released", "whole")},
        fiery,
    )
    assert {"sight", "pose"}.isdisjoint(MotionLabelConfig().as_dict()["protocol"]), (
        "digests of older files stay"
    )
