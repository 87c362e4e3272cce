"""The tokens of boxes' actors lead from arrays to tracks."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.tiny_release import META_TEXT, write_tiny_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import GeometryError
from deepaccident_devkit.geometry import SE3, Boxes
from deepaccident_devkit.geometry.boxes import concatenate
from deepaccident_devkit.v2x.tracks import scenario_tracks


def test_tokens_are_those_of_the_annotations(both_layouts: DeepAccident) -> None:
    for sample in both_layouts.sample[::5]:
        annotations = both_layouts.annotation[both_layouts.annotation_rows(sample)]
        tokens = [annotation["instance_token"] for annotation in annotations]
        boxes = both_layouts.boxes(sample)
        assert len(tokens) > 0
        assert boxes.instance_token == tokens
        assert [box.instance_token for box in boxes] == tokens
        assert [box.instance_token for box in both_layouts.get_boxes(sample)] == tokens


def test_selections_transforms_and_copies_keep_the_tokens(da: DeepAccident) -> None:
    boxes = da.boxes(da.sample[0])
    tokens = boxes.instance_token
    shifted = boxes.transform(SE3.identity(), "ego")
    for kept in (boxes[:], boxes.select(np.ones(len(boxes), dtype=bool)), shifted):
        assert kept.instance_token == tokens
    assert pickle.loads(pickle.dumps(boxes)).instance_token == tokens
    assert boxes.select([2, 1]).instance_token == [tokens[2], tokens[1]]
    assert boxes[:0].instance_token == []


def test_tokens_of_merged_boxes_and_tracks(da: DeepAccident) -> None:
    sample = da.sample[-1]
    scenario = sample["scenario_token"]
    merged = da.cooperative_boxes(sample)
    expected = [
        None if actor == -1 else f"{scenario}/actor/{actor}" for actor in merged.actor_id.tolist()
    ]
    assert merged.instance_token == expected

    tracks = scenario_tracks(da, scenario)
    assert tracks.boxes.instance_token == [
        f"{scenario}/actor/{actor}" for actor in tracks.actor_id.tolist()
    ]
    row = len(tracks.index) - 1
    trajectory = da.trajectory(tracks.boxes.instance_token[row])
    assert_allclose(trajectory.center[-1], tracks.boxes.center[row])


def test_joined_boxes_keep_what_all_parts_share(da: DeepAccident) -> None:
    frame = da.samples_of(da.frame[0])
    ego, other = (
        da.boxes(sample) for sample in frame if sample["agent"] in ("ego_vehicle", "other_vehicle")
    )
    others_of_ego = ego.select(ego.actor_id != -100)

    joined = concatenate([others_of_ego, other], "world")
    assert joined.instance_token == others_of_ego.instance_token + other.instance_token

    # −100 names two vehicles here.
    joined = concatenate([ego, other], "world")
    own_tokens = [
        token
        for token, actor in zip(joined.instance_token, joined.actor_id, strict=True)
        if actor == -100
    ]
    assert own_tokens == [None, None]

    foreign = da.boxes(da.sample[-1])
    assert foreign.scenario != ego.scenario
    assert concatenate([ego, foreign], "world").instance_token is None


def test_boxes_that_are_not_from_a_release() -> None:
    boxes = Boxes.from_arrays(np.zeros((2, 3)), np.ones((2, 3)), [0, 0], actor_id=[7, -1])
    assert boxes.instance_token is None
    assert boxes[0].instance_token is None
    assert replace(boxes, scenario="type/name").instance_token == ["type/name/actor/7", None]
    with pytest.raises(GeometryError, match=r"Boxes\.scenario: expected a token or None, found 3"):
        replace(boxes, scenario=3)


def test_an_own_row_of_an_unknown_agent_has_no_token(tmp_path: Path) -> None:
    meta = META_TEXT.replace("1223 1236 1212 1237", "1223 -1 1212 1237")
    write_tiny_release(tmp_path, meta=meta)
    dataset = DeepAccident("v1", tmp_path, verbose=False)
    for agent, has_token in (("ego_vehicle", True), ("ego_vehicle_behind", False)):
        boxes = dataset.boxes(dataset.get_sample(dataset.scenario[0], agent, 1))
        own_row = boxes.actor_id.tolist().index(-100)
        assert (boxes.instance_token[own_row] is not None) == has_token
