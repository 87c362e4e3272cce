"""The preset `fiery` draws what FIERY's dataset class draws of the same boxes, where agents lean too."""

import plain_fiery
import pytest
import tiny
from numpy.testing import assert_array_equal
from pyquaternion import Quaternion

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, MotionLabelConfig


def leaning(agent: str, frame: int):
    """Up to 16° of lean; agents turn while they drive."""
    pose = tiny.pose(0, x=12.0 * tiny.AGENTS.index(agent) + 0.3 * frame, y=-4.0, z=0.5)
    turn = Quaternion(axis=(0, 0, 1), degrees=35 + 3 * frame) * Quaternion(axis=(0, 1, 0), degrees=13)
    pose[:3, :3] = (turn * Quaternion(axis=(1, 0, 0), degrees=9 - frame / 3)).rotation_matrix
    return pose


def lines(agent: str, frame: int) -> list[str]:
    """Cars around the agent; it sees some of them always, some at times, some never, and others see those."""
    own, later = agent != "infrastructure", frame > 12
    return [
        *tiny.label_lines(agent, frame)[:-1],
        *(
            f"{kind} {x} {y} -1.1 {4.4 + width:.3f} {width} 1.7 {angle} 0.0 0.0 {actor} {points} {seen}"
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
        root = tiny.write_tiny_release(tmp_path_factory.mktemp("slope") / "release", frames=28, lines_of=lines)
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
    others = {(rules.sight, rules.pose) for name, rules in LABEL_PROTOCOLS.items() if name != "fiery"}
    assert (others, MotionLabelConfig.from_dict(fiery.as_dict())) == ({("released", "whole")}, fiery)
    assert {"sight", "pose"}.isdisjoint(MotionLabelConfig().as_dict()["protocol"]), "digests of older files stay"
