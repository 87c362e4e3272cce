import itertools
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ChoiceError, ConfigError, MissingFileError, TokenError
from deepaccident_devkit.geometry import Boxes, LidarPointCloud, PinholeCamera
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.v2x import Link
from deepaccident_devkit.v2x.clouds import moved_points
from deepaccident_devkit.v2x.messages import messages
from deepaccident_devkit.v2x.poses import colors_at
from deepaccident_devkit.v2x.tracks import scenario_tracks


@pytest.fixture
def sample(da: DeepAccident) -> str:
    return f"{da.scenario[0]['token']}/ego_vehicle/004"


def test_agents_and_sweeps_come_one_after_another(da: DeepAccident, sample: str) -> None:
    scenario = da.scenario[0]["token"]
    cloud = da.aggregate_point_cloud(sample, sweeps=2)
    parts = [
        da.load_point_cloud(f"{scenario}/{agent}/{frame}", "world")
        for frame in ("004", "003")
        for agent in AGENTS
    ]
    assert cloud.frame == "world"
    assert_allclose(cloud.xyz, np.concatenate([part.xyz for part in parts]), atol=1e-6)
    assert_array_equal(cloud.intensity, np.concatenate([part.intensity for part in parts]))

    own_cloud = da.aggregate_point_cloud(sample, agents="single", frame="lidar")
    assert_allclose(own_cloud.xyz, da.load_point_cloud(sample, "lidar").xyz, atol=1e-6)

    samples = [f"{scenario}/ego_vehicle/{frame:03d}" for frame in range(1, 5)]
    all_sweeps = da.aggregate_point_cloud(sample, agents="single", sweeps=99)
    assert len(all_sweeps) == sum(len(da.load_point_cloud(token)) for token in samples)
    assert_raises(
        (
            lambda: da.aggregate_point_cloud(sample, sweeps=0),
            ChoiceError,
            "sweeps: expected a whole number of frames from 1, found 0",
        ),
    )


def test_missing_clouds_are_an_error_or_left_out(
    da: DeepAccident, da_partial: DeepAccident, sample: str, caplog: pytest.LogCaptureFixture
) -> None:
    names = list(AGENTS[:3])
    calls = (da_partial.aggregate_point_cloud, da_partial.message_sizes)
    missing = r"no such file; .*, or skip .* with on_missing='skip'"
    unknown_choice = "on_missing: expected one of raise, skip, found 'ignore'"
    assert_raises(
        *[(partial(call, sample), MissingFileError, missing) for call in calls],
        *[
            (partial(call, sample, on_missing="ignore"), ChoiceError, unknown_choice)
            for call in calls
        ],
    )
    assert not caplog.records

    cloud = da_partial.aggregate_point_cloud(sample, sweeps=2, on_missing="skip")
    assert len(cloud) == len(da.aggregate_point_cloud(sample, agents=names, sweeps=2))
    sizes = da_partial.message_sizes(sample, on_missing="skip")
    assert sizes["infrastructure"].cloud is None
    assert {name: sizes[name] for name in names} == da.message_sizes(sample, agents=names)
    assert "2 of 8" in caplog.records[0].getMessage()
    assert "1 of 4" in caplog.records[1].getMessage()

    empty_cloud = da_partial.aggregate_point_cloud(
        sample, agents=["infrastructure"], on_missing="skip"
    )
    assert (len(empty_cloud), empty_cloud.frame) == (0, "world")


def test_compensated_points_lie_on_the_actors_of_the_present(da: DeepAccident, sample: str) -> None:
    """The present boxes of moving actors hold as many points as their earlier boxes did, and
    fewer without compensation.
    """
    scenario = sample.rsplit("/", 2)[0]
    tracks = scenario_tracks(da, da.scenario[0])
    present = tracks.at(4)
    moving_ids = present.actor_id[np.linalg.norm(present.velocity, axis=1) > 4]
    recorded_counts = np.zeros(len(moving_ids), dtype=int)
    for frame, agent in itertools.product(range(1, 5), AGENTS):
        points = da.load_point_cloud(f"{scenario}/{agent}/{frame:03d}", "world").xyz
        recorded_counts += count_points_inside(tracks.at(frame), moving_ids, points)

    plain_cloud = da.aggregate_point_cloud(sample, sweeps=4)
    compensated_cloud = da.aggregate_point_cloud(sample, sweeps=4, compensate=True)
    smeared_counts = count_points_inside(present, moving_ids, plain_cloud.xyz)
    sharp_counts = count_points_inside(present, moving_ids, compensated_cloud.xyz)

    # a point's range is off by more than a box's side is thick
    assert_allclose(sharp_counts, recorded_counts, rtol=0.1, atol=20)
    assert smeared_counts.sum() < 0.95 * recorded_counts.sum()
    assert len(plain_cloud) == len(compensated_cloud)


def count_points_inside(boxes: Boxes, actor_ids: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Count the points (M, 3) in each actor's box, made 1 cm wider on every side."""
    boxes = boxes.select(boxes.actor_id.searchsorted(actor_ids))
    np.testing.assert_array_equal(boxes.actor_id, actor_ids)
    wide_boxes = Boxes.from_arrays(boxes.center, boxes.size + 0.02, boxes.yaw)
    return wide_boxes.contains(points).sum(axis=1)


def test_compensation_makes_up_for_latency(da: DeepAccident, sample: str) -> None:
    boxes = da.cooperative_boxes(sample)
    moving_boxes = boxes.select(np.linalg.norm(boxes.velocity, axis=1) > 4)
    wide_boxes = Boxes.from_arrays(moving_boxes.center, moving_boxes.size + 0.02, moving_boxes.yaw)
    options = {"agents": ["infrastructure"], "link": Link(latency=0.3)}
    plain_cloud = da.aggregate_point_cloud(sample, **options, compensate=False)
    compensated_cloud = da.aggregate_point_cloud(sample, **options, compensate=True)

    assert (
        wide_boxes.contains(compensated_cloud.xyz).sum()
        > 1.2 * wide_boxes.contains(plain_cloud.xyz).sum()
    )


def test_a_point_keeps_its_place_in_its_box() -> None:
    earlier_boxes = Boxes.from_arrays(
        [[0.0, 0, 0], [50, 0, 0]], [[4.0, 2, 2]] * 2, [0.0, 0], actor_id=[7, 8]
    )
    present_boxes = Boxes.from_arrays(
        [[10.0, 5, 1], [0, 0, 0]], [[4.0, 2, 2]] * 2, [np.pi / 2, 0], actor_id=[7, 9]
    )
    points = np.array([[1.5, 0.5, 0.2], [3, 0, 0], [50, 0, 0]])

    assert_allclose(
        moved_points(points, earlier_boxes, present_boxes), [[9.5, 6.5, 1.2], [3, 0, 0], [50, 0, 0]]
    )
    assert_allclose(points[0], [1.5, 0.5, 0.2])


def test_the_last_of_overlapping_boxes_moves_a_point_even_if_it_only_turns() -> None:
    actor_ids = [5, 6, 7]
    size = [[4.0, 2, 2]] * 3
    earlier_center = [[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]
    present_center = [[0.0, 0, 9], [1, 0, 0], [9, 0, 0]]
    earlier_boxes = Boxes.from_arrays(earlier_center, size, [0.0, 0, 0], actor_id=actor_ids)
    present_boxes = Boxes.from_arrays(present_center, size, [0.0, np.pi / 2, 0], actor_id=actor_ids)
    points = np.array([[-1.5, 0, 0], [1.5, 0.5, 0], [9.5, 0.1, 0.3]])

    moved_xyz = moved_points(points, earlier_boxes, present_boxes)
    assert_allclose(moved_xyz, [[-1.5, 0, 9], [0.5, 0.5, 0], [9.5, 0.1, 0.3]], atol=1e-12)
    assert_array_equal(moved_points(points, earlier_boxes, present_boxes.select([])), points)


def test_each_point_has_its_agent_and_its_age(da: DeepAccident, sample: str) -> None:
    """Three sweeps are 0.1 s apart; the partner's arrive 0.1 s late, the ego's do not, and none
    is from frame 0.
    """
    link = Link(latency=0.1)
    pole_cloud = da.aggregate_point_cloud(sample, agents=["infrastructure"], sweeps=3, link=link)
    both_clouds = da.aggregate_point_cloud(sample, agents="+infrastructure", sweeps=3, link=link)
    clouds = (
        (pole_cloud, "infrastructure"),
        (both_clouds, "ego_vehicle"),
        (both_clouds, "infrastructure"),
    )
    for (cloud, name), sweep in itertools.product(clouds, range(3)):
        lag_frames = sweep + (name == "infrastructure")
        lag_s = np.float32(round(0.1 * lag_frames, 1))
        recorded = da.load_point_cloud(da.get_sample(da.scenario[0], name, 4 - lag_frames))
        of_agent = cloud.select(cloud.agent == AGENTS.index(name))
        assert (of_agent.time_lag == lag_s).sum() == len(recorded)

    assert {AGENTS[code] for code in both_clouds.agent} == {"ego_vehicle", "infrastructure"}


def test_lost_clouds_leave_no_points(da: DeepAccident, sample: str) -> None:
    cloud = da.aggregate_point_cloud(
        sample, agents=["infrastructure"], link=Link(packet_loss=1), frame="ego"
    )
    assert len(cloud) == len(cloud.agent) == len(cloud.time_lag) == 0
    assert cloud.frame == "ego"


def test_a_cloud_in_an_image_of_its_own_agent(da: DeepAccident, sample: str) -> None:
    camera = f"{sample}/Camera_Front"
    image = da.load_image(camera)
    height, width = image.shape[:2]
    projected = da.map_pointcloud_to_image(camera)
    camera_from_lidar = da.transform(sample, sample, "Camera_Front", "lidar")
    depth = camera_from_lidar.apply(da.load_point_cloud(sample, "lidar").xyz)[:, 2]
    mask = projected.mask

    assert_allclose(projected.depth, depth, atol=1e-9)
    assert mask.sum() > 100
    assert not mask[depth <= 0].any()
    u, v = np.floor(projected.pixels[mask]).astype(int).T
    assert_array_equal(projected.color[mask], image[v, u])
    assert not projected.color[~mask].any()
    assert 0 <= u.min() <= u.max() < width
    assert 0 <= v.min() <= v.max() < height
    assert da.map_pointcloud_to_image(camera, colors=False).color is None


def test_an_image_that_was_stored_smaller_is_read_at_the_same_place() -> None:
    image = np.arange(75, dtype=np.uint8).reshape(5, 5, 3)
    camera = PinholeCamera(np.eye(3), 13, 13)
    last_pixel = np.nextafter(13.0, 0)  # times 5/13 that is 5, which is no column any more
    pixels = np.array([[last_pixel, last_pixel], [0, 3.0], [20, 1]])
    colors = colors_at(image, camera, pixels, np.array([True, True, False]))
    assert_array_equal(colors, [image[4, 4], image[1, 0], [0, 0, 0]])


def test_points_of_any_agent_in_any_camera_and_frame(da: DeepAccident, sample: str) -> None:
    pole = sample.replace("ego_vehicle", "infrastructure").replace("/004", "/002")
    camera = f"{sample}/Camera_Back"
    cloud = da.load_point_cloud(pole, "lidar")
    world = da.load_point_cloud(pole, "world")
    own_cloud = LidarPointCloud(cloud.xyz, cloud.intensity)
    expected = da.map_pointcloud_to_image(camera, pole, colors=False)

    for projected in (
        da.project_to_image(world, pole, camera, colors=False),
        da.project_to_image(world.xyz, sample, camera, colors=False),
        da.project_to_image(cloud.xyz, pole, camera, frame="lidar", colors=False),
        da.project_to_image(own_cloud, pole, camera, colors=False),
    ):
        assert_allclose(projected.depth, expected.depth, atol=1e-6)
        assert_array_equal(projected.mask, expected.mask)
    assert da.project_to_image(np.zeros((0, 3)), pole, camera).pixels.shape == (0, 2)


def test_sensors_that_are_no_camera_or_of_another_scenario(da: DeepAccident, sample: str) -> None:
    assert_raises(
        (
            lambda: da.map_pointcloud_to_image(f"{sample}/Camera_Top"),
            TokenError,
            r"the channels are Camera_Front",
        ),
        (
            lambda: da.map_pointcloud_to_image(f"{sample}/lidar01"),
            ChoiceError,
            r"camera: expected one of Camera_Front, .* found lidar01",
        ),
    )
    other = f"{da.scenario[1]['token']}/ego_vehicle/001"
    assert_raises(
        (
            lambda: da.project_to_image(np.zeros((1, 3)), other, f"{sample}/{CAMERAS[0]}"),
            ChoiceError,
            "expected two samples of one scenario",
        ),
    )


def test_message_sizes(da: DeepAccident, sample: str) -> None:
    sizes = da.message_sizes(sample, bev_shape=(8, 100, 50), bev_dtype=np.float16)
    ego_size = sizes["ego_vehicle"]
    assert list(sizes) == list(AGENTS)
    assert ego_size.images == 24 + 6 * 64 * 36 * 3
    assert ego_size.cloud == 24 + 16 * len(da.load_point_cloud(sample))
    assert ego_size.boxes == 24 + 45 * len(da.boxes(sample))
    assert ego_size.bev == 24 + 8 * 100 * 50 * 2
    assert_raises(
        *[
            (partial(da.message_sizes, sample, bev_shape=shape), ChoiceError, "bev_shape: expected")
            for shape in ((8, 100), (0, 1, 1), 5, (1.5, 2, 3), "abc", None, ("a", 1, 1))
        ],
        (
            lambda: da.message_sizes(sample, bev_dtype="foo"),
            ChoiceError,
            "bev_dtype: expected a type such as 'float32', found 'foo'",
        ),
    )

    own_sizes = partial(da.message_sizes, sample, agents="single")
    assert own_sizes(clouds=False)["ego_vehicle"].cloud is None
    assert own_sizes(bev_shape=np.array((8, 100, 50)))["ego_vehicle"].bev == 24 + 160000
    assert own_sizes(bev_shape=(1, 1, 1))["ego_vehicle"].bev == 24 + 4
    assert own_sizes()["ego_vehicle"].bev == 24 + 64 * 200 * 200 * 4
    assert own_sizes()["ego_vehicle"].cloud == ego_size.cloud


def test_message_sizes_count_only_arriving_messages(da: DeepAccident, sample: str) -> None:
    late_sizes = da.message_sizes(sample, link=Link(latency=0.2, pose_noise=0.3))
    earlier_sizes = da.message_sizes(sample.replace("/004", "/002"))
    sizes = da.message_sizes(sample)
    assert late_sizes == {**earlier_sizes, "ego_vehicle": sizes["ego_vehicle"]}
    assert late_sizes != sizes

    lossy_link = Link(packet_loss=0.5, seed=2)
    arrived_agents = [message.agent for message in messages(da, sample, None, lossy_link)]
    assert 1 < len(arrived_agents) < len(AGENTS)
    assert da.message_sizes(sample, link=lossy_link) == {
        agent: sizes[agent] for agent in arrived_agents
    }
    assert_raises(
        (
            lambda: da.message_sizes(sample, link=Link(latency=0.4)),
            ConfigError,
            r"from frame 004 .*longest possible latency is 0\.3 s",
        ),
    )


@pytest.mark.parametrize("sweeps", [0, -1, 2.0, 2.5, "a", None])
def test_sweeps_are_whole_numbers_from_1(da: DeepAccident, sample: str, sweeps: object) -> None:
    assert_raises(
        (
            lambda: da.aggregate_point_cloud(sample, sweeps=sweeps),
            ChoiceError,
            "sweeps: expected a whole number of frames from 1, found",
        ),
    )


def test_the_lidars_frame_has_one_name(da: DeepAccident, sample: str) -> None:
    results = [
        da.boxes(sample, "lidar01"),
        da.get_boxes(sample, "lidar01")[0],
        da.get_sample_data(f"{sample}/lidar01")[1][0],
        da.load_point_cloud(sample, "lidar01"),
        da.cooperative_boxes(sample, frame="lidar01"),
        da.aggregate_point_cloud(sample, agents="single", frame="lidar01"),
        da.trajectory(da.instance[0], sample, "lidar01"),
    ]
    assert [result.frame for result in results] == ["lidar"] * len(results)
    world_from_lidar = da.world_from(sample, "lidar")
    assert_array_equal(da.world_from(sample, "lidar01").matrix, world_from_lidar.matrix)
    overlaps = da.boxes(sample, "lidar01").iou_bev(da.cooperative_boxes(sample, frame="lidar"))
    assert overlaps.max() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("frame", ["map", "", None, 3, ["ego"]])
def test_frames_that_do_not_exist(da: DeepAccident, sample: str, frame: object) -> None:
    calls = [
        da.boxes,
        da.world_from,
        da.load_point_cloud,
        lambda token, frame: da.cooperative_boxes(token, frame=frame),
        lambda token, frame: da.aggregate_point_cloud(token, frame=frame),
        lambda token, frame: da.transform(token, token, frame),
        lambda token, frame: da.trajectory(da.instance[0], token, frame),
    ]
    assert_raises(
        *[
            (
                partial(call, sample, frame),
                ChoiceError,
                r"frame: expected one of world, ego, lidar, Camera_Front, .* found",
            )
            for call in calls
        ],
    )
