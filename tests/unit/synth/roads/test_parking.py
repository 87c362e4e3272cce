"""Parking slots."""

import numpy as np

from deepaccident_devkit.synth.roads import ROAD_CODES, Junction, RoadSpec
from deepaccident_devkit.synth.roads.parking import SLOT_LENGTH


def corners(places, length, width):
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * [length / 2, width / 2]
    cos, sin = np.cos(places[:, 2, None]), np.sin(places[:, 2, None])
    x = places[:, 0, None] + cos * signs[:, 0] - sin * signs[:, 1]
    y = places[:, 1, None] + sin * signs[:, 0] + cos * signs[:, 1]
    return np.stack([x, y], axis=-1)


def test_a_parked_van_stands_on_its_strip(junction):
    places = junction.parking_places()
    if not junction.spec.parking:
        assert places.shape == (0, 3)
        return
    vans = corners(places, 5.0, 2.1)
    assert np.isin(junction.ground_map().at(vans.reshape(-1, 2)), ROAD_CODES).all()
    beside = np.abs(vans).min(axis=2)
    assert (beside > junction.spec.lanes_edge).all()
    assert (beside < junction.spec.road_edge).all()
    assert (np.abs(vans).max(axis=2) > junction.spec.stop_line[1] + 5).all()


def test_slots_do_not_overlap_and_face_with_the_traffic():
    places = Junction(RoadSpec()).parking_places()
    distance = np.hypot(*(places[:, None, :2] - places[None, :, :2]).T)
    np.fill_diagonal(distance, np.inf)
    np.testing.assert_allclose(distance.min(axis=1), SLOT_LENGTH)
    heading = np.column_stack([np.cos(places[:, 2]), np.sin(places[:, 2])])
    right = np.column_stack([heading[:, 1], -heading[:, 0]])
    assert ((places[:, :2] * right).sum(axis=1) > 4).all()  # keeps right: the middle line is to the left
