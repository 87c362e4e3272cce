"""Laws of the transforms between any agents, times, frames and points of a synthetic release."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from support.strategies import points

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import AGENT_CONFIGS, Link, PoseNoise, relative_pose_to_ego

FRAMES = st.sampled_from(("world", "ego", "lidar", LIDAR, *CAMERAS))
AGENT_FRAMES = st.tuples(st.sampled_from(AGENTS), st.integers(1, 6))
"""An agent and a frame number of the session's release."""
LINKS = st.builds(
    Link,
    latency=st.sampled_from((0.0, 0.1, 0.3)),
    pose_noise=st.none()
    | st.builds(PoseNoise, mean=st.floats(0, 0.5), heading_std=st.floats(0, 0.1)),
    packet_loss=st.sampled_from((0.0, 0.5)),
    seed=st.integers(0, 100),
)


def sample_of(da: DeepAccident, agent_frame: tuple[str, int]) -> str:
    agent, frame_number = agent_frame
    return f"{da.scenario[0]['token']}/{agent}/{frame_number:03d}"


@given(a=AGENT_FRAMES, b=AGENT_FRAMES, frame_a=FRAMES, frame_b=FRAMES)
def test_there_and_back_is_the_identity(da: DeepAccident, a, b, frame_a, frame_b) -> None:
    a, b = sample_of(da, a), sample_of(da, b)
    a_from_b = da.transform(a, b, frame_a, frame_b)
    b_from_a = da.transform(b, a, frame_b, frame_a)
    assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-6)
    assert_allclose(a_from_b.inverse().matrix, b_from_a.matrix, atol=1e-6)


@given(
    chain=st.lists(st.tuples(AGENT_FRAMES, FRAMES), min_size=5, max_size=5),
    p_world=points(reach=1000.0),
)
def test_a_world_point_seen_from_five_agents_returns(da: DeepAccident, chain, p_world) -> None:
    """It goes through five frames, one after another, and back to world within 1e-4 m."""
    position, sample, frame = p_world, sample_of(da, (AGENTS[0], 1)), "world"
    for agent_frame, next_frame in chain:
        next_sample = sample_of(da, agent_frame)
        position = da.transform(next_sample, sample, next_frame, frame).apply(position)
        sample, frame = next_sample, next_frame
    world_from_last = da.transform(sample, sample, "world", frame)
    assert_allclose(world_from_last.apply(position), p_world, atol=1e-4)


@given(start=AGENT_FRAMES, chain=st.lists(st.tuples(AGENT_FRAMES, FRAMES), min_size=1, max_size=4))
def test_points_that_a_label_claims_lie_in_their_box_after_any_chain(
    da: DeepAccident, start, chain
) -> None:
    """Each box holds the label's number of points, and keeps them when both move (± 1 mm)."""
    sample, frame = sample_of(da, start), "lidar"
    cloud = da.load_point_cloud(sample, "lidar").xyz
    boxes = da.boxes(sample, "lidar")
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    is_inside = boxes.contains(cloud)
    np.testing.assert_array_equal(is_inside.sum(axis=1), boxes.num_lidar_pts)

    for agent_frame, next_frame in chain:
        next_sample = sample_of(da, agent_frame)
        next_from_this = da.transform(next_sample, sample, next_frame, frame)
        cloud = next_from_this.apply(cloud)
        boxes = boxes.transform(next_from_this, next_frame)
        sample, frame = next_sample, next_frame
    box, point = np.nonzero(is_inside)
    offsets = cloud[point] - boxes.center[box]
    rotations = quaternions.to_matrix(boxes.rotation)[box]
    box_offsets = np.einsum("nj,njk->nk", offsets, rotations)
    assert (np.abs(box_offsets) <= boxes.size[box] / 2 + 1e-3).all()


@given(index=st.integers(1, 6), ego=st.sampled_from(AGENTS))
def test_relative_poses_are_the_transforms(da: DeepAccident, index, ego) -> None:
    agents = AGENT_CONFIGS["all"].agents_for(ego)
    samples = [sample_of(da, (agent, index)) for agent in agents]
    six = relative_pose_to_ego([da.world_from(sample, "ego").matrix for sample in samples])
    for vector, sample in zip(six, samples, strict=True):
        assert_allclose(vector, da.transform(samples[0], sample).to_six(), atol=1e-6)


@given(ego=st.sampled_from(AGENTS), link=LINKS, config=st.sampled_from(sorted(AGENT_CONFIGS)))
def test_a_link_draws_the_same_in_any_order_and_spares_the_ego(
    da: DeepAccident, ego, link, config
) -> None:
    sample = sample_of(da, (ego, 5))
    first = da.cooperative_boxes(sample, agents=config, link=link)
    da.cooperative_boxes(sample, agents="all", link=Link(pose_noise=0.1, seed=link.seed))
    second = da.cooperative_boxes(sample, agents=config, link=link)
    np.testing.assert_array_equal(first.center, second.center)

    ego_boxes = da.cooperative_boxes(sample, agents="single")
    is_seen = np.isin(ego_boxes.actor_id, da.boxes(sample).actor_id)
    ego_boxes = ego_boxes.select(is_seen & (ego_boxes.actor_id >= 0))
    centers = dict(zip(first.actor_id.tolist(), first.center, strict=True))
    same_centers = [centers[actor] for actor in ego_boxes.actor_id.tolist()]
    np.testing.assert_array_equal(same_centers, ego_boxes.center)
