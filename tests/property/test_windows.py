"""A window's cells are what `cooperative_view` returns at each moment, whatever the options."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.geometry import SE3, quaternions
from deepaccident_devkit.motion import Augmentation
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, UNTRACKED_ID
from deepaccident_devkit.v2x import AGENT_CONFIGS, cooperative_view, windows

NUM_FRAMES = 6
OPTIONS = st.fixed_dictionaries(
    {
        "past": st.sampled_from((0.0, 0.2, 0.4)),
        "future": st.sampled_from((0.0, 0.2, 0.8)),
        "step": st.sampled_from((0.1, 0.2)),
        "agents": st.sampled_from((None, *AGENT_CONFIGS, AGENTS[4:], AGENTS[2:4])),
        "visible": st.sampled_from((None, "camera", "released")),
        "actors": st.sampled_from(("present", "any")),
    }
)
SAMPLES = st.tuples(st.integers(0, 3), st.sampled_from(AGENTS), st.integers(1, NUM_FRAMES))
FRAMES = st.sampled_from(("world", "ego", "lidar", *CAMERAS))


def token_of(da: DeepAccident, sample: tuple[int, str, int]) -> str:
    scenario, agent, number = sample
    return f"{da.scenario[scenario]['token']}/{agent}/{number:03d}"


@settings(max_examples=20)
@given(sample=SAMPLES, options=OPTIONS, frame=FRAMES)
def test_a_cell_is_a_row_of_the_cooperative_view(da: DeepAccident, sample, options, frame) -> None:
    token = token_of(da, sample)
    window = da.window(token, frame=frame, **options)
    assert window.time[window.present] == 0
    present_ids = []
    any_ids = set()
    frame_from_world = da.world_from(token, frame).inverse()
    for step, number in enumerate(window.index.tolist()):
        if not 1 <= number <= NUM_FRAMES:
            assert not window.valid[:, step].any()
            assert not window.seen_by[:, step].any()
            assert not window.annotated_by[:, step].any()
            continue
        moment = f"{token.rsplit('/', 1)[0]}/{number:03d}"
        view = cooperative_view(da, moment, agents=options["agents"], visible=options["visible"])
        tracked = view.boxes.select(view.boxes.actor_id != UNTRACKED_ID)
        seen = cooperative_view(da, moment, visible="released")
        annotated = cooperative_view(da, moment)
        any_ids |= set(tracked.actor_id.tolist())
        if step == window.present:
            present_ids = tracked.actor_id.tolist()
        assert_array_equal(
            window.actor_id[window.valid[:, step]],
            tracked.actor_id[np.isin(tracked.actor_id, window.actor_id)],
        )
        for row in np.flatnonzero(window.valid[:, step]):
            box = tracked.select(tracked.actor_id == window.actor_id[row])
            moved = box.transform(frame_from_world, frame)
            assert_allclose(window.center[row, step], moved.center[0], atol=1e-6)
            heading = quaternions.to_matrix(moved.rotation[0])[:2, 0]
            # A camera looks along z, so the headings of some actors are hardly defined there.
            if np.hypot(*heading) > 1e-3:
                assert_allclose(np.cos(window.yaw[row, step] - moved.yaw[0]), 1, atol=1e-9)
            assert_allclose(window.velocity[row, step], moved.velocity[0], atol=1e-6)
            assert_allclose(window.speed[row, step], np.hypot(*box.velocity[0, :2]), atol=1e-6)
            assert_array_equal(window.size[row, step], box.size[0])
        for mask, of_all in ((window.seen_by, seen), (window.annotated_by, annotated)):
            masks = dict(zip(of_all.boxes.actor_id.tolist(), of_all.seen_by.tolist(), strict=True))
            expected = [masks.get(actor, 0) for actor in window.actor_id.tolist()]
            assert mask[:, step].tolist() == expected
    expected_ids = sorted(any_ids) if options["actors"] == "any" else present_ids
    assert window.actor_id.tolist() == expected_ids


@given(sample=SAMPLES, options=OPTIONS)
def test_each_actors_frame_begins_at_itself(da: DeepAccident, sample, options) -> None:
    token = token_of(da, sample)
    world = da.window(token, frame="world", **options)
    actor = da.window(token, frame="actor", **options)
    assert_array_equal(actor.valid, world.valid)
    assert_array_equal(actor.speed, world.speed)
    present = world.present
    for row in range(len(world)):
        if not world.valid[row, present]:
            assert np.isnan(actor.center[row]).all()
            assert np.isnan(actor.yaw[row]).all()
            continue
        yaw = float(world.yaw[row, present])
        world_from_actor = SE3.from_yaw(yaw, world.center[row, present])
        assert_allclose(world_from_actor.apply(actor.center[row]), world.center[row], atol=1e-6)
        assert_allclose(world_from_actor.rotate(actor.velocity[row]), world.velocity[row])
        assert_allclose(actor.yaw[row, present], 0, atol=1e-9)


@given(samples=st.lists(SAMPLES, min_size=1, max_size=4), options=OPTIONS, frame=FRAMES)
def test_a_batch_is_its_windows_with_padding(da: DeepAccident, samples, options, frame) -> None:
    tokens = [token_of(da, sample) for sample in samples]
    batch = windows(da, tokens, frame=frame, **options)
    parts = [da.window(token, frame=frame, **options) for token in tokens]
    num_actors = max(map(len, parts))
    for name, array in batch.items():
        for row, part in enumerate(parts):
            assert array.dtype == part.arrays[name].dtype
            if name in ("time", "index"):
                assert_array_equal(array[row], part.arrays[name])
                continue
            assert array.shape[:2] == (len(parts), num_actors)
            assert_array_equal(array[row, : len(part)], part.arrays[name])
    assert not batch["valid"][batch["actor_id"] == -1].any()


@settings(max_examples=20)
@given(
    sample=SAMPLES,
    rotation=st.floats(-3.1, 3.1),
    scale=st.floats(0.5, 2.0),
    flip=st.booleans(),
)
def test_an_augmentation_moves_all_of_a_window(
    da: DeepAccident, sample, rotation, scale, flip
) -> None:
    window = da.window(token_of(da, sample), 0.2, 0.2)
    augmentation = Augmentation(rotation=rotation, scale=scale, flip=flip)
    moved = window.augmented(augmentation.matrix)
    ahead = window.center.copy()
    ahead[..., 0] += np.cos(window.yaw)
    ahead[..., 1] += np.sin(window.yaw)
    linear = augmentation.matrix[:3, :3]
    heading = (ahead - window.center) @ linear.T
    assert_allclose(moved.center, window.center @ linear.T, atol=1e-9)
    assert_allclose(heading[..., 0], scale * np.cos(moved.yaw), atol=1e-9)
    assert_allclose(heading[..., 1], scale * np.sin(moved.yaw), atol=1e-9)
    assert_allclose(moved.velocity, window.velocity @ linear.T, atol=1e-9)
    assert_allclose(moved.speed, window.speed * scale)
    assert_allclose(moved.size, window.size * scale)
    assert_array_equal(moved.valid, window.valid)
