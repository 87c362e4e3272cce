"""One real scenario: it follows the format of the release, and the devkit finds no fault in it.

Run with `pytest tests/real --real DIR`. Only some frames have their images and clouds.
"""

from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from support import plain_fiery

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.motion import MotionLabelConfig, motion_labels
from deepaccident_devkit.release import read_calib, read_label
from deepaccident_devkit.statistics import dataset_statistics, release_facts
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CAMERAS,
    INFRASTRUCTURE,
    LIDAR,
    OWN_ACTOR_ID,
    STATIC_ACTOR_ID,
    UNTRACKED_ID,
)
from deepaccident_devkit.v2x import project_to_image
from deepaccident_devkit.validation import validate_release
from real.conftest import TOKEN

CLOUD_FRAMES = (1, 26, 51, 76, 100)
IMAGE_FRAMES = (1, 51, 100)
BYTES_A_SAMPLE = 310e9 / 285e3
"""Of the whole release."""


def sample_token(agent: str, frame: int) -> str:
    return f"{TOKEN}/{agent}/{frame:03d}"


def test_it_opens_as_its_files_say(real: DeepAccident) -> None:
    (scenario,) = real.scenario
    assert scenario["token"] == TOKEN
    expected = {
        "weather": "Clear",
        "time_of_day": "Noon",
        "road_type": "three-way junction",
        "collision": None,
        "num_frames": 100,
        "velocity_frame": "released",
    }
    assert {field: scenario[field] for field in expected} == expected
    assert [agent["name"] for agent in real.agent] == list(AGENTS)
    assert len(real.sample) == 500


def test_few_pairs_interact_and_one_of_them_touches(real: DeepAccident) -> None:
    interactions = real.interactions(TOKEN)
    pairs = interactions.pairs
    num_actors = len(real.instance)
    assert 0 < len(pairs) < num_actors * (num_actors - 1) / 2 / 4
    assert len(interactions) < 10 * real.scenario[0]["num_frames"]
    are_both_parked = (pairs.actor_ids >= STATIC_ACTOR_ID).all(axis=1)
    assert not are_both_parked.any()

    is_touching = pairs.min_gap == 0
    assert is_touching.sum() == 1, "a car drives over a pedestrian's box, which meta does not name"
    assert pairs.min_ttc[is_touching] == pairs.pet[is_touching] == 0
    pedestrian_id = pairs.actor_ids[is_touching][0, 1]
    pedestrian = real.get("instance", f"{TOKEN}/actor/{pedestrian_id}")
    assert pedestrian["category"] == "pedestrian"
    text = real.describe(TOKEN).text
    assert (
        "meta names no collision in 9.9 s. The outlines of the other vehicle "
        "and a pedestrian overlap." in text
    )


@pytest.mark.parametrize("deep", [False, True])
def test_validate_tells_what_is_missing_and_nothing_else(real_root: Path, deep: bool) -> None:
    report = validate_release(real_root, deep=deep, workers=1)
    findings = [finding for finding in report.findings if finding.code != "sensor-frames-missing"]
    assert {finding.severity for finding in findings} == {"note"}
    texts = [finding.what for finding in findings if finding.code != "box-points-differ"]
    assert texts == ["actors 7242, 7247 overlap by up to 0.56 m, frames 24–28"]
    assert report.velocity_frames == {TOKEN: "released"}


@pytest.mark.parametrize("filter_invisible", [True, False])
def test_the_preset_fiery_draws_as_fierys_class(real: DeepAccident, filter_invisible: bool) -> None:
    """Agents lean by up to 14° here."""
    config = MotionLabelConfig.preset("fiery", filter_invisible=filter_invisible)
    inner_cells = (slice(None), plain_fiery.INNER_MARGIN, plain_fiery.INNER_MARGIN)
    for agent, frame in product(AGENTS, range(15, 81, 5)):
        token = sample_token(agent, frame)
        expected = plain_fiery.instances(real, token, filter_invisible=filter_invisible)
        instances = motion_labels(real, token, config).instance
        assert np.array_equal(instances[inner_cells], expected[inner_cells]), token


def test_decoded_velocities_are_the_displacements(real: DeepAccident) -> None:
    """They agree within 1 % in the median of all classes.

    As velocities in the world or the LiDAR frame, the labels' numbers would fit nothing.
    """
    decoded_errors, raw_errors, categories = [], [], []
    for sample in real.sample:
        boxes = real.boxes(sample)
        raw_velocity = real.boxes(sample, velocity="label").velocity[:, :2]
        derived_velocity = real.boxes(sample, velocity="derived").velocity[:, :2]
        speed = np.linalg.norm(derived_velocity, axis=1)
        is_moving = (speed > 1.0) & (boxes.actor_id > 0)
        for velocity, errors in (
            (boxes.velocity[:, :2], decoded_errors),
            (raw_velocity, raw_errors),
        ):
            error = np.linalg.norm(velocity - derived_velocity, axis=1)
            errors.append(error[is_moving] / speed[is_moving])
        categories.append(boxes.category[is_moving])

    decoded_error = np.concatenate(decoded_errors)
    is_car = np.concatenate(categories) == 0
    assert len(decoded_error) > 5000
    assert np.median(decoded_error) < 0.01
    assert (decoded_error[is_car] < 0.1).mean() > 0.98
    assert (np.concatenate(raw_errors) < 0.1).mean() < 0.25


def test_velocities_agree_between_agents(real: DeepAccident) -> None:
    """The decoded velocities of an actor at one time agree unless an agent pitches.

    The raw ones differ from agent to agent.
    """
    distances = []
    for frame in real.frame:
        views = [real.boxes(sample) for sample in real.samples_of(frame["token"])]
        for first, second in combinations(views, 2):
            tracked = first.select(first.actor_id > 0)
            _, first_rows, second_rows = np.intersect1d(
                tracked.actor_id, second.actor_id, return_indices=True
            )
            difference = tracked.velocity[first_rows] - second.velocity[second_rows]
            distances.append(np.linalg.norm(difference[:, :2], axis=1))
    assert np.quantile(np.concatenate(distances), 0.9) < 1e-3
    assert np.quantile(np.concatenate(distances), 0.99) < 0.1


def test_untracked_boxes_and_ends_of_tracks_have_velocities(real: DeepAccident) -> None:
    boxes = real.columns("annotation")
    assert np.isfinite(boxes["velocity"]).all()
    assert (boxes["actor_id"] == UNTRACKED_ID).any()


def test_a_sensor_has_one_row_and_every_frame_its_exact_matrix(
    real: DeepAccident, real_root: Path
) -> None:
    assert len(real.calibrated_sensor) <= 45
    scenario_type, name = TOKEN.split("/")
    for agent, frame in product(AGENTS, (1, 50, 100)):
        calib_folder = real_root / scenario_type / agent / "calib" / name
        calib = read_calib(calib_folder / f"{name}_{frame:03d}.pkl")
        sample = sample_token(agent, frame)
        ego_from_lidar = real.ego_from(sample, LIDAR)
        np.testing.assert_array_equal(ego_from_lidar.matrix, calib.ego_from_lidar.matrix)
        world_from_lidar = calib.world_from_ego @ calib.ego_from_lidar
        np.testing.assert_array_equal(
            real.world_from(sample, "lidar").matrix, world_from_lidar.matrix
        )
        for camera in CAMERAS:
            ego_from_camera = real.ego_from(sample, camera)
            camera_from_lidar = ego_from_camera.inverse() @ ego_from_lidar
            expected = calib.camera_from_lidar[camera].matrix
            np.testing.assert_allclose(camera_from_lidar.matrix, expected, atol=1e-12)
            nominal = real.get("calibrated_sensor", f"{TOKEN}/{agent}/{camera}")["matrix"]
            np.testing.assert_allclose(nominal, ego_from_camera.matrix, atol=1e-3)


def test_labels_are_read_to_the_digit(real: DeepAccident, real_root: Path) -> None:
    """Every number of every label is the `float` of its word."""
    scenario_type, name = TOKEN.split("/")
    for agent, frame in product(AGENTS, range(1, 101)):
        path = real_root / scenario_type / agent / "label" / name / f"{name}_{frame:03d}.txt"
        lines = [line.split() for line in path.read_text().splitlines()]
        header, *rows = [words for words in lines if len(words) > 1]
        expected = np.array([[float(word) for word in row[1:10]] for row in rows])

        labels = read_label(path, raw=True)
        np.testing.assert_array_equal(labels.agent_velocity[0], [float(word) for word in header])
        numbers = np.column_stack([labels.center, labels.size, labels.yaw, labels.velocity])
        np.testing.assert_array_equal(numbers, expected)

        token = sample_token(agent, frame)
        boxes = real.boxes(token, "lidar")
        np.testing.assert_array_equal(boxes.center * (1, -1, 1), expected[:, :3])
        assert [box.category for box in real.get_boxes(token)] == [row[0] for row in rows]
        np.testing.assert_array_equal(boxes.num_lidar_pts, [int(row[11]) for row in rows])
        np.testing.assert_array_equal(boxes.camera_visible, [row[12] == "True" for row in rows])


def test_all_agents_see_an_actor_in_the_same_place(real: DeepAccident) -> None:
    """Poses, transforms and labels agree to millimetres; each agent's own row lies within 0.3 m."""
    for frame in real.frame[::5]:
        views = {sample["agent"]: real.boxes(sample) for sample in real.samples_of(frame["token"])}
        centers: dict[int, list[np.ndarray]] = {}
        for boxes in views.values():
            for actor, center in zip(boxes.actor_id.tolist(), boxes.center, strict=True):
                if actor not in (OWN_ACTOR_ID, UNTRACKED_ID):
                    centers.setdefault(actor, []).append(center)
        for actor_centers in centers.values():
            assert np.ptp(actor_centers, axis=0).max() < 0.01
        for agent in AGENTS[:4]:
            boxes = views[agent]
            own_center = boxes.center[boxes.actor_id == OWN_ACTOR_ID][0]
            actor = real.get("agent", f"{TOKEN}/{agent}")["actor_id"]
            assert np.linalg.norm(own_center - centers[actor][0]) < 0.3


def test_the_ground_is_where_all_agents_see_it(real: DeepAccident) -> None:
    """In the cells that two clouds share, both give the same height of the road in the world."""
    for frame in CLOUD_FRAMES:
        samples = real.samples_of(f"{TOKEN}/{frame:03d}")
        agent_heights = [real.world_from(sample, "ego").translation[2] for sample in samples[:4]]
        road_height = np.mean(agent_heights)
        grounds = []
        for sample in samples:
            points = real.load_point_cloud(sample, "world").xyz
            road_points = points[np.abs(points[:, 2] - road_height) < 0.3]
            heights: dict[tuple[int, ...], float] = {}
            point_cells = np.floor(road_points[:, :2] / 0.5).astype(int)
            for cell, z in zip(point_cells.tolist(), road_points[:, 2].tolist(), strict=True):
                heights[tuple(cell)] = min(z, heights.get(tuple(cell), np.inf))
            grounds.append(heights)
        for first, second in combinations(grounds, 2):
            shared_cells = first.keys() & second.keys()
            if len(shared_cells) >= 50:
                differences = [first[cell] - second[cell] for cell in shared_cells]
                assert abs(np.median(differences)) < 0.03


def test_points_fall_on_the_right_pixels(real: DeepAccident) -> None:
    """An image has vertical edges where depth jumps between LiDAR points, and not beside them."""
    shifts = np.array([-60, -40, -24, -16, -8, 0, 8, 16, 24, 40, 60])
    contrast = np.zeros(len(shifts))
    num_edges = 0
    for frame in IMAGE_FRAMES:
        sample = sample_token(INFRASTRUCTURE, frame)
        cloud = real.load_point_cloud(sample, "lidar")
        for camera in CAMERAS:
            token = f"{sample}/{camera}"
            gray = cv2.cvtColor(real.load_image(token), cv2.COLOR_RGB2GRAY).astype(np.float32)
            slope = np.abs(cv2.Sobel(cv2.GaussianBlur(gray, (0, 0), 2), cv2.CV_32F, 1, 0))
            projection = project_to_image(real, cloud, sample, token, colors=False)
            is_visible = projection.mask
            edges = find_depth_edges(projection.pixels[is_visible], projection.depth[is_visible])
            num_edges += len(edges)
            rows = edges[:, 1].astype(int)
            for number, shift in enumerate(shifts):
                columns = np.clip(edges[:, 0] + shift, 0, gray.shape[1] - 1).astype(int)
                contrast[number] += slope[rows, columns].sum() / slope.mean()
    assert num_edges > 2000
    assert abs(shifts[contrast.argmax()]) <= 8
    assert contrast.max() > 1.15 * np.median(contrast)


def find_depth_edges(pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return the pixels (M, 2) where the depths of neighbours in a row differ by over 2 m.

    Each is the pixel of the nearer neighbour.
    """
    rows = np.round(pixels[:, 1] / 6)
    order = np.lexsort((pixels[:, 0], rows))
    pixels, depth, rows = pixels[order], depth[order], rows[order]
    are_neighbours = (rows[1:] == rows[:-1]) & (np.abs(np.diff(pixels[:, 0])) < 15)
    jumps = np.flatnonzero(are_neighbours & (np.abs(np.diff(depth)) > 2.0))
    return pixels[np.where(depth[jumps + 1] < depth[jumps], jumps + 1, jumps)]


def test_boxes_hold_the_points_that_labels_count(real: DeepAccident) -> None:
    """Three in four of the boxes with points hold exactly as many."""
    counts_by_sample, label_counts_by_sample = [], []
    for agent, frame in product(AGENTS, CLOUD_FRAMES):
        token = sample_token(agent, frame)
        boxes = real.boxes(token, "lidar")
        counts_by_sample.append(boxes.count_points(real.load_point_cloud(token, "lidar").xyz))
        label_counts_by_sample.append(boxes.num_lidar_pts)
    counts = np.concatenate(counts_by_sample)
    label_counts = np.concatenate(label_counts_by_sample)
    has_points = (counts > 0) | (label_counts > 0)
    assert has_points.sum() > 200
    assert (counts == label_counts)[has_points].mean() > 0.7
    assert np.corrcoef(counts, label_counts)[0, 1] > 0.999


def test_motion_labels_of_fifty_samples(real: DeepAccident) -> None:
    """Both protocols draw the actors that the rule sees, at the places of their boxes."""
    tokens = [sample["token"] for sample in real.sample[::10]]
    assert len(tokens) == 50
    num_drawn = 0
    for token in tokens:
        for protocol in ("released", "clean"):
            labels = motion_labels(real, token, MotionLabelConfig(protocol=protocol))
            assert labels.instance.shape == (5, 200, 200)
            np.testing.assert_array_equal(labels.segmentation.astype(bool), labels.instance > 0)
            boxes = real.boxes(token, "ego", visible="released")
            is_inside = (np.abs(boxes.center[:, :2]) < 48.0).all(axis=1)
            centers = boxes.center[is_inside & (boxes.size[:, 1] > 1.5), :2]
            columns, rows = np.floor((centers + 50.0) / 0.5).astype(int).T
            assert (labels.instance[0, rows, columns] > 0).all()
            num_drawn += len(centers)
    assert num_drawn > 300


def test_statistics_count_what_is_there(real: DeepAccident) -> None:
    text = dataset_statistics(real).to_json()
    assert "Town01" in text


def test_the_index_costs_at_most_one_percent(real: DeepAccident) -> None:
    """One percent of the bytes a sample of the whole release; the index includes its shards."""
    index = real.tables_folder.parent
    size = sum(path.stat().st_size for path in index.rglob("*") if path.is_file())
    assert size / len(real.sample) <= 0.01 * BYTES_A_SAMPLE


@pytest.mark.parametrize(
    ("view", "token"),
    [
        ("sample", sample_token(INFRASTRUCTURE, 51)),
        ("sample-data", f"{sample_token(INFRASTRUCTURE, 51)}/Camera_Back"),
        ("sample-data", f"{sample_token('ego_vehicle', 51)}/lidar01"),
        ("annotation", f"{sample_token(INFRASTRUCTURE, 51)}/3"),
        ("instance", f"{TOKEN}/actor/7247"),
        ("sample-data --color-by depth", f"{sample_token(INFRASTRUCTURE, 51)}/Camera_Back"),
        ("bev", sample_token("other_vehicle", 51)),
        ("labels", sample_token("ego_vehicle", 51)),
        ("visibility", sample_token(INFRASTRUCTURE, 51)),
        ("visibility --style table", f"{TOKEN}/051"),
    ],
)
def test_it_can_be_drawn(real: DeepAccident, tmp_path: Path, view: str, token: str) -> None:
    out = tmp_path / "picture.png"
    index = real.tables_folder.parents[1]
    arguments = [
        "render",
        *view.split(),
        str(real.dataroot),
        token,
        "--index-dir",
        str(index),
        "--out",
        str(out),
    ]
    result = CliRunner().invoke(deepaccident, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    picture = cv2.imread(str(out))
    assert picture is not None
    assert picture.std() > 10


def test_it_can_be_exported_to_mcap(real: DeepAccident, tmp_path: Path) -> None:
    """Frame 51 has all clouds and only the infrastructure's images; the others are left out."""
    mcap_reading = pytest.importorskip("support.mcap_reader")
    out = tmp_path / "real.mcap"
    index = str(real.tables_folder.parents[1])
    arguments = [
        "export",
        "mcap",
        str(real.dataroot),
        TOKEN,
        "--index-dir",
        index,
        "--frame-range",
        "50..52",
    ]
    result = CliRunner().invoke(
        deepaccident, [*arguments, "--out", str(out)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    messages = mcap_reading.read_mcap(out).messages
    for agent in AGENTS:
        assert len(messages[f"/{agent}/{LIDAR}/points"]) == 1
    for camera in CAMERAS:
        assert len(messages[f"/{INFRASTRUCTURE}/{camera}/image"]) == 1


def test_facts_say_nothing_false(real: DeepAccident) -> None:
    facts = {fact.key: fact for fact in release_facts(real, workers=1).facts}
    assert {fact.verdict for fact in facts.values()} == {"agree", "cannot say"}
    values = [facts[key].here for key in ("slow", "fast", "vehicles")]
    assert values == pytest.approx([0.16, 0.11, 11], abs=0.02)
