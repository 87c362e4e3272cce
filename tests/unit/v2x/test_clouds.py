import itertools
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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
    scenario, cloud = da.scenario[0]["token"], da.aggregate_point_cloud(sample, sweeps=2)
    parts = [
        da.load_point_cloud(f"{scenario}/{agent}/{index}", "world")
        for index in ("004", "003")
        for agent in AGENTS
    ]
    assert cloud.frame == "world"
    assert_allclose(cloud.xyz, np.concatenate([part.xyz for part in parts]), atol=1e-6)
    assert_array_equal(cloud.intensity, np.concatenate([part.intensity for part in parts]))
    own = da.aggregate_point_cloud(sample, agents="single", frame="lidar")
    assert_allclose(own.xyz, da.load_point_cloud(sample, "lidar").xyz, atol=1e-6)
    assert len(da.aggregate_point_cloud(sample, agents="single", sweeps=99)) == sum(
        len(da.load_point_cloud(f"{scenario}/ego_vehicle/{index:03d}")) for index in range(1, 5)
    )
    assert_refused(
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
    assert_refused(
        *[
            (
                partial(call, sample),
                MissingFileError,
                r"no such file; .*, or leave out .* with on_missing='skip'",
            )
            for call in (da_partial.aggregate_point_cloud, da_partial.message_sizes)
        ],
        *[
            (
                partial(call, sample, on_missing="ignore"),
                ChoiceError,
                "on_missing: expected one of raise, skip, found 'ignore'",
            )
            for call in (da_partial.aggregate_point_cloud, da_partial.message_sizes)
        ],
    )
    assert not caplog.records
    cloud = da_partial.aggregate_point_cloud(sample, sweeps=2, on_missing="skip")
    assert len(cloud) == len(da.aggregate_point_cloud(sample, agents=names, sweeps=2))
    sizes = da_partial.message_sizes(sample, on_missing="skip")
    assert sizes["infrastructure"].cloud is None
    assert {name: sizes[name] for name in names} == da.message_sizes(sample, agents=names)
    assert [
        "2 of 8" in caplog.records[0].getMessage(),
        "1 of 4" in caplog.records[1].getMessage(),
    ] == [True, True]
    only = da_partial.aggregate_point_cloud(sample, agents=["infrastructure"], on_missing="skip")
    assert (len(only), only.frame) == (0, "world")


def test_compensated_points_lie_on_the_actors_of_the_present(da: DeepAccident, sample: str) -> None:
    """As many points are in the moving actors' present boxes as lay in their boxes of the time;
    without, fewer are.
    """
    tracks = scenario_tracks(da, da.scenario[0])
    moving = tracks.at(4).actor_id[np.linalg.norm(tracks.at(4).velocity, axis=1) > 4]
    recorded = np.zeros(len(moving), dtype=int)
    for index, agent in itertools.product(range(1, 5), AGENTS):
        points = da.load_point_cloud(f"{sample.rsplit('/', 2)[0]}/{agent}/{index:03d}", "world").xyz
        recorded += points_inside(tracks.at(index), moving, points)
    smeared, sharp = (
        points_inside(
            tracks.at(4),
            moving,
            da.aggregate_point_cloud(sample, sweeps=4, compensate=compensate).xyz,
        )
        for compensate in (False, True)
    )
    assert_allclose(
        sharp, recorded, rtol=0.1, atol=20
    )  # a point's range is off by more than a box's side is thick
    assert smeared.sum() < 0.95 * recorded.sum()
    assert len(da.aggregate_point_cloud(sample, sweeps=4)) == len(
        da.aggregate_point_cloud(sample, sweeps=4, compensate=True)
    )


def points_inside(boxes: Boxes, actors: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How many points (M, 3) lie in each actor's box, 1 cm to each side."""
    boxes = boxes.select(boxes.actor_id.searchsorted(actors))
    np.testing.assert_array_equal(boxes.actor_id, actors)
    return (
        Boxes.from_arrays(boxes.center, boxes.size + 0.02, boxes.yaw).contains(points).sum(axis=1)
    )


def test_compensation_makes_up_for_latency(da: DeepAccident, sample: str) -> None:
    moving = da.cooperative_boxes(sample)
    moving = moving.select(np.linalg.norm(moving.velocity, axis=1) > 4)
    wide = Boxes.from_arrays(moving.center, moving.size + 0.02, moving.yaw)
    hits = {
        compensate: wide.contains(
            da.aggregate_point_cloud(
                sample, agents=["infrastructure"], compensate=compensate, link=Link(latency=0.3)
            ).xyz
        ).sum()
        for compensate in (False, True)
    }
    assert hits[True] > 1.2 * hits[False]


def test_a_point_keeps_its_place_in_its_box() -> None:
    then = Boxes.from_arrays(
        [[0.0, 0, 0], [50, 0, 0]], [[4.0, 2, 2]] * 2, [0.0, 0], actor_id=[7, 8]
    )
    now = Boxes.from_arrays(
        [[10.0, 5, 1], [0, 0, 0]], [[4.0, 2, 2]] * 2, [np.pi / 2, 0], actor_id=[7, 9]
    )
    points = np.array([[1.5, 0.5, 0.2], [3, 0, 0], [50, 0, 0]])
    assert_allclose(moved_points(points, then, now), [[9.5, 6.5, 1.2], [3, 0, 0], [50, 0, 0]])
    assert_allclose(points[0], [1.5, 0.5, 0.2])


def test_of_boxes_that_overlap_the_last_moves_a_point_and_one_that_only_turns_moves_it_too() -> (
    None
):
    center, size = [[0.0, 0, 0], [1, 0, 0], [9, 0, 0]], [[4.0, 2, 2]] * 3
    then = Boxes.from_arrays(center, size, [0.0, 0, 0], actor_id=[5, 6, 7])
    now = Boxes.from_arrays(
        [[0.0, 0, 9], [1, 0, 0], [9, 0, 0]], size, [0.0, np.pi / 2, 0], actor_id=[5, 6, 7]
    )
    points = np.array([[-1.5, 0, 0], [1.5, 0.5, 0], [9.5, 0.1, 0.3]])
    assert_allclose(
        moved_points(points, then, now), [[-1.5, 0, 9], [0.5, 0.5, 0], [9.5, 0.1, 0.3]], atol=1e-12
    )
    assert_array_equal(moved_points(points, then, now.select([])), points)


def test_each_point_says_whose_and_how_old_it_is(da: DeepAccident, sample: str) -> None:
    """Of three sweeps 0.1 s apart; the partner's arrive 0.1 s late, the ego's do not, and none is
    from frame 0.
    """
    cloud = da.aggregate_point_cloud(
        sample, agents=["infrastructure"], sweeps=3, link=Link(latency=0.1)
    )
    both = da.aggregate_point_cloud(
        sample, agents="+infrastructure", sweeps=3, link=Link(latency=0.1)
    )
    for each, names in ((cloud, ["infrastructure"]), (both, ["ego_vehicle", "infrastructure"])):
        for name in names:
            of_agent = each.select(each.agent == AGENTS.index(name))
            for back in range(3):
                lag = round(0.1 * (back + (name == "infrastructure")), 1)
                taken = da.get_sample(da.scenario[0], name, 4 - round(lag * 10))
                assert (of_agent.time_lag == np.float32(lag)).sum() == len(
                    da.load_point_cloud(taken)
                )
    assert {AGENTS[code] for code in both.agent} == {"ego_vehicle", "infrastructure"}


def test_lost_clouds_leave_no_points(da: DeepAccident, sample: str) -> None:
    cloud = da.aggregate_point_cloud(
        sample, agents=["infrastructure"], link=Link(packet_loss=1), frame="ego"
    )
    assert len(cloud) == len(cloud.agent) == len(cloud.time_lag) == 0
    assert cloud.frame == "ego"


def test_a_cloud_in_an_image_of_its_own_agent(da: DeepAccident, sample: str) -> None:
    camera = f"{sample}/Camera_Front"
    image, shown = da.load_image(camera), da.map_pointcloud_to_image(camera)
    optical = da.transform(sample, sample, "Camera_Front", "lidar").apply(
        da.load_point_cloud(sample, "lidar").xyz
    )
    assert_allclose(shown.depth, optical[:, 2], atol=1e-9)
    assert shown.mask.sum() > 100
    assert not shown.mask[optical[:, 2] <= 0].any()
    u, v = np.floor(shown.pixels[shown.mask]).astype(int).T
    assert_array_equal(shown.color[shown.mask], image[v, u])
    assert not shown.color[~shown.mask].any()
    height, width = image.shape[:2]
    assert (u.min() >= 0, v.min() >= 0, u.max() < width, v.max() < height) == (True,) * 4
    assert da.map_pointcloud_to_image(camera, colors=False).color is None


def test_an_image_that_was_stored_smaller_is_read_at_the_same_place() -> None:
    image = np.arange(75, dtype=np.uint8).reshape(5, 5, 3)
    last = np.nextafter(13.0, 0)  # times 5/13 that is 5, which is no column any more
    lens, pixels = PinholeCamera(np.eye(3), 13, 13), np.array([[last, last], [0, 3.0], [20, 1]])
    assert_array_equal(
        colors_at(image, lens, pixels, np.array([True, True, False])),
        [image[4, 4], image[1, 0], [0, 0, 0]],
    )


def test_points_of_any_agent_in_any_camera_and_frame(da: DeepAccident, sample: str) -> None:
    pole = sample.replace("ego_vehicle", "infrastructure").replace("/004", "/002")
    camera, cloud = f"{sample}/Camera_Back", da.load_point_cloud(pole, "lidar")
    shown = da.map_pointcloud_to_image(camera, pole, colors=False)
    world = da.load_point_cloud(pole, "world")
    for again in (
        da.project_to_image(world, pole, camera, colors=False),
        da.project_to_image(world.xyz, sample, camera, colors=False),
        da.project_to_image(cloud.xyz, pole, camera, frame="lidar", colors=False),
        da.project_to_image(
            LidarPointCloud(cloud.xyz, cloud.intensity), pole, camera, colors=False
        ),
    ):
        assert_allclose(again.depth, shown.depth, atol=1e-6)
        assert_array_equal(again.mask, shown.mask)
    assert da.project_to_image(np.zeros((0, 3)), pole, camera).pixels.shape == (0, 2)


def test_sensors_that_are_no_camera_or_of_another_scenario(da: DeepAccident, sample: str) -> None:
    assert_refused(
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
    assert_refused(
        (
            lambda: da.project_to_image(np.zeros((1, 3)), other, f"{sample}/{CAMERAS[0]}"),
            ChoiceError,
            "expected two samples of one scenario",
        ),
    )


def test_message_sizes(da: DeepAccident, sample: str) -> None:
    sizes = da.message_sizes(sample, bev_shape=(8, 100, 50), bev_dtype=np.float16)
    assert list(sizes) == list(AGENTS)
    mine = sizes["ego_vehicle"]
    assert (mine.images, mine.cloud) == (
        24 + 6 * 64 * 36 * 3,
        24 + 16 * len(da.load_point_cloud(sample)),
    )
    assert (mine.boxes, mine.bev) == (24 + 45 * len(da.boxes(sample)), 24 + 8 * 100 * 50 * 2)
    assert da.message_sizes(sample, agents="single", clouds=False)["ego_vehicle"].cloud is None
    assert_refused(
        *[
            (partial(da.message_sizes, sample, bev_shape=wrong), ChoiceError, "bev_shape: expected")
            for wrong in ((8, 100), (0, 1, 1), 5, (1.5, 2, 3), "abc", None, ("a", 1, 1))
        ],
        (
            lambda: da.message_sizes(sample, bev_dtype="foo"),
            ChoiceError,
            "bev_dtype: expected a type such as 'float32', found 'foo'",
        ),
    )
    assert (
        da.message_sizes(sample, agents="single", bev_shape=np.array((8, 100, 50)))[
            "ego_vehicle"
        ].bev
        == 24 + 160000
    )
    assert (
        da.message_sizes(sample, agents="single", bev_shape=(1, 1, 1))["ego_vehicle"].bev == 24 + 4
    )
    usual = da.message_sizes(sample, agents="single")["ego_vehicle"]
    assert (usual.bev, usual.cloud) == (24 + 64 * 200 * 200 * 4, mine.cloud)


def test_message_sizes_are_of_what_arrives(da: DeepAccident, sample: str) -> None:
    late = da.message_sizes(sample, link=Link(latency=0.2, pose_noise=0.3))
    then, now = da.message_sizes(sample.replace("/004", "/002")), da.message_sizes(sample)
    assert late["ego_vehicle"] == now["ego_vehicle"]
    assert {agent: late[agent] for agent in AGENTS[1:]} == {
        agent: then[agent] for agent in AGENTS[1:]
    }
    assert late != now
    lossy = Link(packet_loss=0.5, seed=2)
    arrived = [message.agent for message in messages(da, sample, None, lossy)]
    assert 1 < len(arrived) < len(AGENTS)
    assert da.message_sizes(sample, link=lossy) == {agent: now[agent] for agent in arrived}
    assert_refused(
        (
            lambda: da.message_sizes(sample, link=Link(latency=0.4)),
            ConfigError,
            r"from frame 004; the longest possible is 0\.3 s",
        ),
    )


@pytest.mark.parametrize("sweeps", [0, -1, 2.0, 2.5, "a", None])
def test_sweeps_are_whole_numbers_from_1(da: DeepAccident, sample: str, sweeps: object) -> None:
    assert_refused(
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
    assert_array_equal(
        da.world_from(sample, "lidar01").matrix, da.world_from(sample, "lidar").matrix
    )
    assert da.boxes(sample, "lidar01").iou_bev(
        da.cooperative_boxes(sample, frame="lidar")
    ).max() == pytest.approx(1, abs=1e-12)


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
    assert_refused(
        *[
            (
                partial(call, sample, frame),
                ChoiceError,
                r"frame: expected one of world, ego, lidar, Camera_Front, .* found",
            )
            for call in calls
        ],
    )
