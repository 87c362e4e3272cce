import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.v2x import accident_visible_mask, pair_in_view

VIEWS = np.array(list(itertools.product([False, True], repeat=3)))
SEEN = [False, True, False, True, False, True, True, True]


def test_unseen_is_not_in_view_now_and_at_one_moment_before() -> None:
    assert_array_equal(accident_visible_mask(VIEWS), SEEN)
    assert_array_equal(accident_visible_mask(VIEWS.reshape(2, 4, 3)), np.reshape(SEEN, (2, 4)))
    assert accident_visible_mask([1, 0, 0]) == np.array(False)
    assert accident_visible_mask(np.zeros((0, 3))).shape == (0,)


def test_without_a_collision_and_behind_sheer_curtains_all_is_seen() -> None:
    assert accident_visible_mask(VIEWS, collision=False).all()
    assert accident_visible_mask(VIEWS, exempt=True).all()
    assert_array_equal(accident_visible_mask(VIEWS, exempt=[True] + [False] * 7), [True, *SEEN[1:]])


@pytest.mark.parametrize("views", [[True], np.zeros((3, 2)), True, "abc", None])
def test_views_are_of_three_moments(views: object) -> None:
    with pytest.raises(GeometryError, match="in_view: expected"):
        accident_visible_mask(views)


def test_a_pair_is_in_view_if_all_but_the_agent_itself_are() -> None:
    ids, mask = [5, 6, -1, -100, 5], [True, False, True, True, True]
    assert pair_in_view(mask, ids, (5, 7), own_id=7)
    assert not pair_in_view(mask, ids, (5, 7))
    assert not pair_in_view(mask, ids, (5, 6), own_id=7)
    assert not pair_in_view(mask, ids, (-1, -1), own_id=7)
    assert pair_in_view(mask, ids, np.array([5, 7]), own_id=7)
