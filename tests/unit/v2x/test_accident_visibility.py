import itertools
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
import tiny
from numpy.testing import assert_array_equal
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.v2x import accident_visibility, accident_visible, accident_visible_mask, pair_in_view
from deepaccident_devkit.v2x.agents import SHEER_CURTAINS

VIEWS = np.array(list(itertools.product([False, True], repeat=3)))
SEEN = [False, True, False, True, False, True, True, True]


def test_unseen_is_not_in_view_now_and_at_one_moment_before() -> None:
    assert_array_equal(accident_visible_mask(VIEWS), SEEN)
    assert_array_equal(accident_visible_mask(VIEWS.reshape(2, 4, 3)), np.reshape(SEEN, (2, 4)))
    assert (accident_visible_mask([1, 0, 0]), accident_visible_mask(np.zeros((0, 3))).shape) == (np.array(False), (0,))


def test_without_a_collision_and_behind_sheer_curtains_all_is_seen() -> None:
    assert accident_visible_mask(VIEWS, collision=False).all()
    assert accident_visible_mask(VIEWS, exempt=True).all()
    assert_array_equal(accident_visible_mask(VIEWS, exempt=[True] + [False] * 7), [True, *SEEN[1:]])


@pytest.mark.parametrize("views", [[True], np.zeros((3, 2)), True, "abc", None])
def test_views_are_of_three_moments(views: object) -> None:
    assert_refused(
        (lambda: accident_visible_mask(views), GeometryError, "in_view: expected"),
    )


def test_a_pair_is_in_view_if_all_but_the_agent_itself_are() -> None:
    ids, mask = [5, 6, -1, -100, 5], [True, False, True, True, True]
    assert pair_in_view(mask, ids, (5, 7), own_id=7)
    assert not pair_in_view(mask, ids, (5, 7))
    assert not pair_in_view(mask, ids, (5, 6), own_id=7)
    assert not pair_in_view(mask, ids, (-1, -1), own_id=7)
    assert pair_in_view(mask, ids, np.array([5, 7]), own_id=7)


def watched(root: Path, seen: Collection[int], frames: int = 21, agent: str = "ego_vehicle", **release) -> DeepAccident:
    """One agent alone, which sees 1212 at the frames `seen`, and 1223 (the ego) always."""

    def lines(_: str, frame: int) -> list[str]:
        there = frame in seen
        return [
            "0 0",
            f"car 20.0 0.0 0.0 4.0 2.0 1.5 0 0 0 1212 {9 * there} {there}",
            "car 9.0 5.0 0.0 4.0 2.0 1.5 0 0 0 1223 9 True",
        ]

    tiny.write_tiny_release(root, frames=frames, agents=(agent,), lines_of=lines, **release)
    return DeepAccident(dataroot=root, verbose=False, workers=1)


@pytest.mark.parametrize(
    ("frames", "seen", "expected"),
    [
        (21, range(1, 22), "visible"),
        (21, {1, 6, 11, 16}, "visible"),
        (21, {21}, "invisible"),
        (21, {2, 3, 4, 5, 7, 8, 9, 10, 12, 17}, "invisible"),
        (21, {16}, "partial"),
        (21, {1}, "partial"),
        (10, {5}, "visible"),
        (10, {10}, "invisible"),
        (5, {5}, None),
    ],
)
def test_an_accident_is_seen_at_the_four_moments_or_at_some(
    tmp_path: Path, frames: int, seen: Collection[int], expected: str | None
) -> None:
    da = watched(tmp_path, seen, frames)
    assert accident_visibility(da, tiny.TOKEN) == expected
    for index in range(1, frames + 1):
        now, missed = index in seen, sum(moment not in seen for moment in (index, index - 5, index - 10))
        assert accident_visible(da, f"{tiny.TOKEN}/ego_vehicle/{index:03d}") == (now or missed < 2), index


def test_what_cannot_be_judged_and_what_always_counts_as_seen(tmp_path: Path, da: DeepAccident) -> None:
    for place, told, release in (
        ("silent", None, {"meta": None}),
        ("unlabelled", None, {"labelled": False}),
        ("nameless", None, {"meta": tiny.META.replace(" agents id: 1223 1236 1212 1237\n", "")}),
    ):
        other = watched(tmp_path / place, (), 6, **release)
        assert accident_visible(other, f"{tiny.TOKEN}/ego_vehicle/006") is told, place
        assert accident_visibility(other, tiny.TOKEN) is told, place
    pole = watched(tmp_path / "pole", {6}, 6, "infrastructure")
    assert accident_visibility(pole, tiny.TOKEN) is None
    assert [accident_visible(pole, f"{tiny.TOKEN}/infrastructure/{frame:03d}") for frame in (5, 6)] == [False, True]
    for number, name in enumerate(SHEER_CURTAINS):
        curtain = watched(tmp_path / f"{number}", (), 6, name=name)
        assert accident_visibility(curtain, f"{tiny.TYPE}/{name}") == "visible"
    [calm] = [scenario for scenario in da.scenario if scenario["collision"] is None][:1]
    assert (accident_visibility(da, calm), accident_visible(da, f"{calm['token']}/infrastructure/001")) == (None, True)
