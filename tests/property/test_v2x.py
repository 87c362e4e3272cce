"""Laws of the transforms between agents, over a synthetic release: any agents, moments, frames and
points.
"""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import points

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import quaternions
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR, OWN_ACTOR_ID
from deepaccident_devkit.v2x import AGENT_CONFIGS, Link, PoseNoise, relative_pose_to_ego

FRAMES = st.sampled_from(("world", "ego", "lidar", LIDAR, *CAMERAS))
PLACES = st.tuples(st.sampled_from(AGENTS), st.integers(1, 6))
"""An agent and a moment of the session's release."""
LINKS = st.builds(
    Link,
    latency=st.sampled_from((0.0, 0.1, 0.3)),
    pose_noise=st.none()
    | st.builds(PoseNoise, mean=st.floats(0, 0.5), heading_std=st.floats(0, 0.1)),
    packet_loss=st.sampled_from((0.0, 0.5)),
    seed=st.integers(0, 100),
)


def sample_of(da: DeepAccident, place: tuple[str, int]) -> str:
    agent, index = place
    return f"{da.scenario[0]['token']}/{agent}/{index:03d}"


@given(a=PLACES, b=PLACES, frame_a=FRAMES, frame_b=FRAMES)
def test_there_and_back_is_the_identity(da: DeepAccident, a, b, frame_a, frame_b) -> None:
    a, b = sample_of(da, a), sample_of(da, b)
    there, back = da.transform(a, b, frame_a, frame_b), da.transform(b, a, frame_b, frame_a)
    assert_allclose((there @ back).matrix, np.eye(4), atol=1e-6)
    assert_allclose(there.inverse().matrix, back.matrix, atol=1e-6)


@given(
    chain=st.lists(st.tuples(PLACES, FRAMES), min_size=5, max_size=5), p_world=points(reach=1000.0)
)
def test_a_world_point_seen_from_five_agents_returns(da: DeepAccident, chain, p_world) -> None:
    """Through five frames one after another, and back to world: within 1e-4 m."""
    position, here, frame = p_world, sample_of(da, (AGENTS[0], 1)), "world"
    for place, next_frame in chain:
        position = da.transform(sample_of(da, place), here, next_frame, frame).apply(position)
        here, frame = sample_of(da, place), next_frame
    assert_allclose(da.transform(here, here, "world", frame).apply(position), p_world, atol=1e-4)


@given(place=PLACES, chain=st.lists(st.tuples(PLACES, FRAMES), min_size=1, max_size=4))
def test_points_that_a_label_claims_lie_in_their_box_after_any_chain(
    da: DeepAccident, place, chain
) -> None:
    """Each box holds as many points as its label says, and keeps them wherever both are moved
    (faces ± 1 mm).
    """
    sample = sample_of(da, place)
    cloud, boxes = da.load_point_cloud(sample, "lidar").xyz, da.boxes(sample, "lidar")
    boxes = boxes.select(boxes.actor_id != OWN_ACTOR_ID)
    hits = boxes.contains(cloud)
    np.testing.assert_array_equal(hits.sum(axis=1), boxes.num_lidar_pts)
    here, frame = sample, "lidar"
    for to, next_frame in chain:
        target_from_here = da.transform(sample_of(da, to), here, next_frame, frame)
        cloud, boxes = target_from_here.apply(cloud), boxes.transform(target_from_here, next_frame)
        here, frame = sample_of(da, to), next_frame
    box, point = np.nonzero(hits)
    local = np.einsum(
        "nj,njk->nk", cloud[point] - boxes.center[box], quaternions.to_matrix(boxes.rotation)[box]
    )
    assert (np.abs(local) <= boxes.size[box] / 2 + 1e-3).all()


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
    again = da.cooperative_boxes(sample, agents=config, link=link)
    np.testing.assert_array_equal(first.center, again.center)
    alone = da.cooperative_boxes(sample, agents="single")
    own = alone.select(np.isin(alone.actor_id, da.boxes(sample).actor_id) & (alone.actor_id >= 0))
    center_of = dict(zip(first.actor_id.tolist(), first.center, strict=True))
    np.testing.assert_array_equal([center_of[actor] for actor in own.actor_id.tolist()], own.center)
