"""One real scenario: what the format says of the release holds on it, and the devkit reads it
without a doubt.

Run with `pytest tests/real --real DIR`. Its cameras and clouds are there for some frames alone.
"""

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import plain_fiery
import pytest
from click.testing import CliRunner

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
    assert (scenario["weather"], scenario["time_of_day"], scenario["road_type"]) == (
        "Clear",
        "Noon",
        "three-way junction",
    )
    assert (scenario["collision"], scenario["num_frames"], scenario["velocity_frame"]) == (
        None,
        100,
        "released",
    )
    assert [agent["name"] for agent in real.agent] == list(AGENTS)
    assert len(real.sample) == 500


def test_few_pairs_interact_and_one_of_them_touches(real: DeepAccident) -> None:
    found = real.interactions(TOKEN)
    actors = len(real.instance)
    assert 0 < len(found.pairs) < actors * (actors - 1) / 2 / 4
    assert len(found) < 10 * real.scenario[0]["num_frames"]
    assert not (found.pairs.actor_ids >= STATIC_ACTOR_ID).all(axis=1).any(), (
        "parked cars are no pair"
    )
    touching = found.pairs.min_gap == 0
    assert touching.sum() == 1, "a car drives over a pedestrian's box, which meta does not name"
    assert found.pairs.min_ttc[touching] == found.pairs.pet[touching] == 0
    pedestrian = real.get("instance", f"{TOKEN}/actor/{found.pairs.actor_ids[touching][0, 1]}")
    assert pedestrian["category"] == "pedestrian"
    text = real.describe(TOKEN).text
    assert (
        "meta names no collision in 9.9 s. The outlines of the other vehicle "
        "and a pedestrian overlap." in text
    )


@pytest.mark.parametrize("deep", [False, True])
def test_validate_tells_what_is_missing_and_nothing_else(real_root: Path, deep: bool) -> None:
    report = validate_release(real_root, deep=deep, workers=1)
    told = [finding for finding in report.findings if finding.code != "sensor-frames-missing"]
    said = [
        finding.what
        for finding in told
        if (finding.code, finding.severity) != ("box-points-differ", "note")
    ]
    assert said == ["actors 7242, 7247 overlap by up to 0.56 m, frames 24–28"]
    assert {finding.severity for finding in told} == {"note"}
    assert report.velocity_frames == {TOKEN: "released"}


@pytest.mark.parametrize("filter_invisible", [True, False])
def test_the_preset_fiery_draws_as_fierys_class(real: DeepAccident, filter_invisible: bool) -> None:
    """Agents lean by up to 14° here."""
    config = MotionLabelConfig.preset("fiery", filter_invisible=filter_invisible)
    for token in (sample_token(agent, frame) for agent in AGENTS for frame in range(15, 81, 5)):
        expected = plain_fiery.instances(real, token, filter_invisible=filter_invisible)
        drawn = motion_labels(real, token, config).instance
        inner = (slice(None), plain_fiery.INNER, plain_fiery.INNER)
        assert np.array_equal(drawn[inner], expected[inner]), token


def test_decoded_velocities_are_the_displacements(real: DeepAccident) -> None:
    """Within 1 % in the median, for all classes together; taken for world's or the LiDAR's they fit
    nothing.
    """
    off, raw_off, category = [], [], []
    for sample in real.sample:
        decoded, derived = real.boxes(sample), real.boxes(sample, velocity="derived")
        raw = real.boxes(sample, velocity="label").velocity
        moved = derived.velocity[:, :2]
        speed = np.linalg.norm(moved, axis=1)
        telling = (speed > 1.0) & (decoded.actor_id > 0)
        off.append(
            np.linalg.norm(decoded.velocity[:, :2] - moved, axis=1)[telling] / speed[telling]
        )
        raw_off.append(np.linalg.norm(raw[:, :2] - moved, axis=1)[telling] / speed[telling])
        category.append(decoded.category[telling])
    share, raw_share, cars = (
        np.concatenate(off),
        np.concatenate(raw_off),
        np.concatenate(category) == 0,
    )
    assert len(share) > 5000
    assert np.median(share) < 0.01
    assert (share[cars] < 0.1).mean() > 0.98
    assert (raw_share < 0.1).mean() < 0.25


def test_velocities_agree_between_agents(real: DeepAccident) -> None:
    """One actor, one moment, five agents: the raw pairs differ, the decoded ones do not, unless an
    agent pitches.
    """
    apart = []
    for frame in real.frame:
        views = [real.boxes(sample) for sample in real.samples_of(frame["token"])]
        for first, second in combinations(views, 2):
            ids = np.intersect1d(first.actor_id[first.actor_id > 0], second.actor_id)
            one, other = (
                view.velocity[[int(np.flatnonzero(view.actor_id == actor)[0]) for actor in ids]]
                for view in (first, second)
            )
            apart.append(np.linalg.norm((one - other)[:, :2], axis=1))
    assert np.quantile(np.concatenate(apart), 0.9) < 1e-3
    assert np.quantile(np.concatenate(apart), 0.99) < 0.1


def test_untracked_boxes_and_ends_of_tracks_have_velocities(real: DeepAccident) -> None:
    boxes = real.columns("annotation")
    assert np.isfinite(boxes["velocity"]).all()
    assert (boxes["actor_id"] == UNTRACKED_ID).any()


def test_a_sensor_has_one_row_and_every_frame_its_exact_matrix(
    real: DeepAccident, real_root: Path
) -> None:
    assert len(real.calibrated_sensor) <= 45
    folder, name = TOKEN.split("/")
    for agent in AGENTS:
        for frame in (1, 50, 100):
            calib = read_calib(
                real_root / folder / agent / "calib" / name / f"{name}_{frame:03d}.pkl"
            )
            sample = sample_token(agent, frame)
            np.testing.assert_array_equal(
                real.ego_from(sample, LIDAR).matrix, calib.ego_from_lidar.matrix
            )
            np.testing.assert_array_equal(
                real.world_from(sample, "lidar").matrix,
                (calib.world_from_ego @ calib.ego_from_lidar).matrix,
            )
            for camera in CAMERAS:
                camera_from_lidar = real.ego_from(sample, camera).inverse() @ real.ego_from(
                    sample, LIDAR
                )
                np.testing.assert_allclose(
                    camera_from_lidar.matrix, calib.camera_from_lidar[camera].matrix, atol=1e-12
                )
                nominal = real.get("calibrated_sensor", f"{TOKEN}/{agent}/{camera}")["matrix"]
                np.testing.assert_allclose(nominal, real.ego_from(sample, camera).matrix, atol=1e-3)


def test_labels_are_read_to_the_digit(real: DeepAccident, real_root: Path) -> None:
    """Every number of every label, by `float` of its word."""
    folder, name = TOKEN.split("/")
    for agent in AGENTS:
        for frame in range(1, 101):
            path = real_root / folder / agent / "label" / name / f"{name}_{frame:03d}.txt"
            first, *lines = [
                line.split() for line in path.read_text().splitlines() if len(line.split()) > 1
            ]
            labels, boxes = (
                read_label(path, raw=True),
                real.boxes(sample_token(agent, frame), "lidar"),
            )
            words = np.array([[float(word) for word in line[1:10]] for line in lines])
            np.testing.assert_array_equal(labels.agent_velocity[0], [float(word) for word in first])
            numbers = np.column_stack([labels.center, labels.size, labels.yaw, labels.velocity])
            np.testing.assert_array_equal(numbers, words)
            np.testing.assert_array_equal(boxes.center * (1, -1, 1), words[:, :3])
            assert [line[0] for line in lines] == [
                box.category for box in real.get_boxes(sample_token(agent, frame))
            ]
            np.testing.assert_array_equal(boxes.num_lidar_pts, [int(line[11]) for line in lines])
            np.testing.assert_array_equal(
                boxes.camera_visible, [line[12] == "True" for line in lines]
            )


def test_all_agents_see_an_actor_in_the_same_place(real: DeepAccident) -> None:
    """Poses, transforms and labels agree to millimetres; each agent's own row lies within 0.3 m."""
    for frame in real.frame[::5]:
        views = {sample["agent"]: real.boxes(sample) for sample in real.samples_of(frame["token"])}
        centers: dict[int, list[np.ndarray]] = {}
        for boxes in views.values():
            for actor, center in zip(boxes.actor_id.tolist(), boxes.center, strict=True):
                if actor not in (OWN_ACTOR_ID, UNTRACKED_ID):
                    centers.setdefault(actor, []).append(center)
        assert max(np.ptp(places, axis=0).max() for places in centers.values()) < 0.01
        for agent in AGENTS[:4]:
            own = views[agent].center[views[agent].actor_id == OWN_ACTOR_ID][0]
            actor = real.get("agent", f"{TOKEN}/{agent}")["actor_id"]
            assert np.linalg.norm(own - centers[actor][0]) < 0.3


def test_the_ground_is_where_all_agents_see_it(real: DeepAccident) -> None:
    """Heights of the road in the world, of the five agents' clouds, in the cells that two of them
    share.
    """
    for frame in CLOUD_FRAMES:
        grounds, samples = [], real.samples_of(f"{TOKEN}/{frame:03d}")
        road = np.mean([real.world_from(sample, "ego").translation[2] for sample in samples[:4]])
        for sample in samples:
            points = real.load_point_cloud(sample, "world").xyz
            near = points[np.abs(points[:, 2] - road) < 0.3]
            cells, place = np.unique(
                np.floor(near[:, :2] / 0.5).astype(int), axis=0, return_inverse=True
            )
            low = np.full(len(cells), np.inf)
            np.minimum.at(low, place.reshape(-1), near[:, 2])
            grounds.append(dict(zip(map(tuple, cells.tolist()), low.tolist(), strict=True)))
        for first, second in combinations(grounds, 2):
            shared = first.keys() & second.keys()
            if len(shared) >= 50:
                assert abs(np.median([first[cell] - second[cell] for cell in shared])) < 0.03


def test_points_fall_on_the_right_pixels(real: DeepAccident) -> None:
    """Where depth jumps from one LiDAR point to the next, the pictures have vertical edges: there,
    and not beside.
    """
    shifts = np.array([-60, -40, -24, -16, -8, 0, 8, 16, 24, 40, 60])
    contrast, edges = np.zeros(len(shifts)), 0
    for frame in IMAGE_FRAMES:
        sample = sample_token(INFRASTRUCTURE, frame)
        cloud = real.load_point_cloud(sample, "lidar")
        for camera in CAMERAS:
            image = cv2.cvtColor(real.load_image(f"{sample}/{camera}"), cv2.COLOR_RGB2GRAY).astype(
                np.float32
            )
            slope = np.abs(cv2.Sobel(cv2.GaussianBlur(image, (0, 0), 2), cv2.CV_32F, 1, 0))
            seen = project_to_image(real, cloud, sample, f"{sample}/{camera}", colors=False)
            places = _depth_edges(seen.pixels[seen.mask], seen.depth[seen.mask])
            edges += len(places)
            for number, shift in enumerate(shifts):
                column = np.clip(places[:, 0] + shift, 0, image.shape[1] - 1).astype(int)
                contrast[number] += slope[places[:, 1].astype(int), column].sum() / slope.mean()
    assert edges > 2000
    assert abs(shifts[contrast.argmax()]) <= 8
    assert contrast.max() > 1.15 * np.median(contrast)


def _depth_edges(pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(M, 2) pixels of the nearer of two neighbours in a row of points that lie over 2 m behind
    each other.
    """
    row = np.round(pixels[:, 1] / 6)
    order = np.lexsort((pixels[:, 0], row))
    pixels, depth, row = pixels[order], depth[order], row[order]
    neighbours = (row[1:] == row[:-1]) & (np.abs(np.diff(pixels[:, 0])) < 15)
    jump = np.flatnonzero(neighbours & (np.abs(np.diff(depth)) > 2.0))
    return pixels[np.where(depth[jump + 1] < depth[jump], jump + 1, jump)]


def test_boxes_hold_the_points_that_labels_count(real: DeepAccident) -> None:
    """Of the boxes with points three in four hold exactly as many."""
    counted, said = [], []
    for agent in AGENTS:
        for frame in CLOUD_FRAMES:
            boxes = real.boxes(sample_token(agent, frame), "lidar")
            counted.append(
                boxes.count_points(real.load_point_cloud(sample_token(agent, frame), "lidar").xyz)
            )
            said.append(boxes.num_lidar_pts)
    recount, label = np.concatenate(counted), np.concatenate(said)
    with_points = (recount > 0) | (label > 0)
    assert with_points.sum() > 200
    assert (recount == label)[with_points].mean() > 0.7
    assert np.corrcoef(recount, label)[0, 1] > 0.999


def test_motion_labels_of_fifty_samples(real: DeepAccident) -> None:
    """Both protocols draw whom the rule sees, where the boxes are."""
    tokens = [sample["token"] for sample in real.sample[::10]]
    assert len(tokens) == 50
    drawn = 0
    for token in tokens:
        for protocol in ("released", "clean"):
            labels = motion_labels(real, token, MotionLabelConfig(protocol=protocol))
            assert labels.instance.shape == (5, 200, 200)
            np.testing.assert_array_equal(labels.segmentation.astype(bool), labels.instance > 0)
            boxes = real.boxes(token, "ego", visible="released")
            inside = (np.abs(boxes.center[:, :2]) < 48.0).all(axis=1) & (boxes.size[:, 1] > 1.5)
            index = np.floor((boxes.center[inside, :2] + 50.0) / 0.5).astype(int)
            assert (labels.instance[0, index[:, 1], index[:, 0]] > 0).all()
            drawn += int(inside.sum())
    assert drawn > 300


def test_statistics_count_what_is_there(real: DeepAccident) -> None:
    text = dataset_statistics(real).to_json()
    assert "Town01" in text


def test_the_index_costs_at_most_one_percent(real: DeepAccident) -> None:
    """Shards included, of the whole release's bytes a sample."""
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
    """Of frame 51 all clouds and the pole's images are there; what is not there is left out and
    told.
    """
    mcap_reading = pytest.importorskip("mcap_reading")
    out, index = tmp_path / "real.mcap", str(real.tables_folder.parents[1])
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
    assert {agent: len(messages[f"/{agent}/{LIDAR}/points"]) for agent in AGENTS} == dict.fromkeys(
        AGENTS, 1
    )
    assert {
        camera: len(messages[f"/{INFRASTRUCTURE}/{camera}/image"]) for camera in CAMERAS
    } == dict.fromkeys(CAMERAS, 1)


def test_facts_say_nothing_false(real: DeepAccident) -> None:
    rows = {row.key: row for row in release_facts(real, workers=1).facts}
    assert {row.verdict for row in rows.values()} == {"agree", "cannot say"}
    assert [rows[key].here for key in ("slow", "fast", "vehicles")] == pytest.approx(
        [0.16, 0.11, 11], abs=0.02
    )
