"""Items without an augmentation hold what the devkit's own calls return, as tensors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from support.expected_errors import assert_raises
from torch.utils.data import DataLoader
from torch_extra.items import load_item

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    MissingFileError,
    NotAvailableError,
    SensorFileError,
    TokenError,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import Augmentation, MotionLabelConfig
from deepaccident_devkit.motion.sample_labels import motion_labels
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS
from deepaccident_devkit.training.torch import (
    AllEgosDataset,
    ImageConfig,
    V2XConfig,
    V2XDataset,
    collate,
    collate_all_egos,
)
from deepaccident_devkit.v2x import AGENT_CONFIGS, WindowConfig, cooperating_agents

LABELS = MotionLabelConfig(receptive_field=2, future_frames=3, step=1)


def project_points(
    image_from_ego: torch.Tensor, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (N, 2) and depths (N,) of points (N, 3) in the ego frame."""
    matrix = image_from_ego.double().numpy()
    rays = points @ matrix[:3, :3].T + matrix[:3, 3]
    depths = rays[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return rays[:, :2] / depths[:, None], depths


def test_an_item_of_one_sample(da: DeepAccident, sample: str) -> None:
    [item] = list(V2XDataset(da, [sample]))
    assert (item["token"], item["agents"]) == (sample, ("ego_vehicle",))
    assert item["agent_valid"].tolist() == [[True]]
    assert_array_equal(item["ego_from_agent"], np.eye(4)[None, None])
    assert_array_equal(item["augmentation"], np.eye(4))
    assert_allclose(item["world_from_ego"], da.world_from(sample, "ego").matrix)

    points = da.load_point_cloud(sample, "ego").points
    assert_array_equal(item["points"][0][0], points.astype(np.float32))


def test_boxes_are_the_devkits_with_zero_for_an_unknown_velocity(
    da: DeepAccident, sample: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    boxes = da.boxes(sample, "ego", "released")
    is_known = np.arange(len(boxes)) > 0
    velocity = np.where(is_known[:, None], boxes.velocity, np.nan)
    monkeypatch.setattr(type(da), "boxes", lambda *_: replace(boxes, velocity=velocity))

    item = load_item(da, sample, points=False)

    assert_allclose(
        item["boxes"],
        np.column_stack([boxes.center, boxes.size, boxes.yaw, np.nan_to_num(velocity[:, :2])]),
        atol=1e-4,
    )
    assert_array_equal(item["velocity_known"], is_known)
    assert_array_equal(item["categories"], boxes.category)
    assert_array_equal(item["actor_ids"], boxes.actor_id)


@pytest.mark.parametrize("agents", [*AGENT_CONFIGS, ["infrastructure", "other_vehicle"], None])
@pytest.mark.parametrize("ego", AGENTS)
def test_each_agent_sends_its_own_frame(
    da: DeepAccident, ego: str, agents: str | list[str] | None
) -> None:
    scenario = da.scenario[1]
    token = f"{scenario['token']}/{ego}/004"
    item = load_item(da, token, agents=agents, boxes="cooperative")

    assert item["agents"] == tuple(dict.fromkeys([ego, *cooperating_agents(da, token, agents)]))
    for row, name in enumerate(item["agents"]):
        sender = da.get_sample(scenario, name, 4)
        assert_allclose(
            item["ego_from_agent"][row, 0],
            da.transform(token, sender).matrix,
            atol=1e-4,
        )
        cloud = da.load_point_cloud(sender, "ego")
        assert_allclose(item["points"][row][0][:, :3], cloud.xyz, atol=1e-4)

    boxes = da.cooperative_boxes(token, agents=item["agents"], frame="ego", visible="released")
    assert_allclose(item["boxes"][:, :3], boxes.center, atol=1e-4)
    assert_array_equal(item["actor_ids"], boxes.actor_id)


def test_past_frames_end_with_the_present(da: DeepAccident, sample: str) -> None:
    item = load_item(
        da, sample, past=3, step=2, agents="+other", images=ImageConfig(resize=(9, 16))
    )

    assert item["agent_valid"].tolist() == [[False, True, True]] * 2
    assert not item["images"][:, 0].any()
    for key in (
        "ego_from_agent",
        "agent_from_past",
        "intrinsics",
        "ego_from_camera",
        "image_from_ego",
    ):
        blank = item[key][:, 0]
        assert_array_equal(blank, np.broadcast_to(np.eye(blank.shape[-1]), blank.shape))

    for row, name in enumerate(item["agents"]):
        assert len(item["points"][row][0]) == 0
        past, present = (da.get_sample(da.scenario[0], name, frame) for frame in (2, 4))
        for column, sent in ((1, past), (2, present)):
            assert_allclose(
                item["points"][row][column][:, :3], da.load_point_cloud(sent, "ego").xyz, atol=1e-4
            )
            assert_allclose(
                item["ego_from_agent"][row, column], da.transform(sample, sent).matrix, atol=1e-4
            )
            assert_allclose(
                item["agent_from_past"][row, column], da.transform(present, sent).matrix, atol=1e-4
            )


def test_images_and_cameras_are_the_devkits(da: DeepAccident, sample: str) -> None:
    item = load_item(
        da,
        sample,
        agents="+infrastructure",
        images=ImageConfig(dtype="uint8"),
    )
    assert (item["images"].shape, item["images"].dtype) == (
        (2, 1, 6, 3, 36, 64),
        torch.uint8,
    )

    points = da.load_point_cloud(sample, "ego").xyz
    for column, channel in enumerate(CAMERAS):
        camera = f"{sample}/{channel}"
        assert_array_equal(
            item["images"][0, 0, column].permute(1, 2, 0),
            da.load_image(camera),
        )

        expected = da.project_to_image(points, sample, camera, frame="ego", colors=False)
        pixels, depths = project_points(item["image_from_ego"][0, 0, column], points)
        is_seen = expected.mask & (expected.depth > 0.5)
        assert_allclose(depths, expected.depth, atol=1e-3)
        assert_allclose(pixels[is_seen], expected.pixels[is_seen], atol=0.01)

        ego_from_camera = da.world_from(sample, "ego").inverse() @ da.world_from(sample, channel)
        assert_allclose(
            item["ego_from_camera"][0, 0, column],
            ego_from_camera.matrix,
            atol=1e-5,
        )
        assert_allclose(
            item["intrinsics"][0, 0, column],
            da.get_sample_data(camera)[2],
            atol=1e-4,
        )


def test_a_resized_and_cropped_image_hits_the_same_pixels(da: DeepAccident, sample: str) -> None:
    item = load_item(
        da,
        sample,
        images=ImageConfig(
            resize=(18, 48),
            crop=(3, 5, 12, 40),
            cameras=("Camera_Back", "Camera_Front"),
        ),
    )
    assert item["images"].shape == (1, 1, 2, 3, 12, 40)

    points = da.load_point_cloud(sample, "ego").xyz
    whole = da.project_to_image(points, sample, f"{sample}/Camera_Front", frame="ego", colors=False)
    is_seen = whole.mask & (whole.depth > 0.5)
    expected = whole.pixels * [48 / 64, 18 / 36] - [5, 3]
    camera_from_ego = item["ego_from_camera"][0, 0, 1].inverse()
    product = item["intrinsics"][0, 0, 1] @ camera_from_ego[:3]
    for image_from_ego in (item["image_from_ego"][0, 0, 1], product):
        pixels, _ = project_points(image_from_ego, points)
        assert_allclose(pixels[is_seen], expected[is_seen], atol=0.01)


def test_image_values_are_scaled_and_normalised(da: DeepAccident, sample: str) -> None:
    pixels, shares, normalised = (
        load_item(da, sample, points=False, boxes=None, images=images)["images"]
        for images in (
            ImageConfig(dtype="uint8"),
            ImageConfig(),
            ImageConfig(mean=(0.5, 0.4, 0.3), std=(0.2, 0.3, 0.4)),
        )
    )
    torch.testing.assert_close(shares, pixels / 255)
    mean, std = torch.tensor([[0.5, 0.4, 0.3], [0.2, 0.3, 0.4]])[..., None, None]
    torch.testing.assert_close(normalised, (shares - mean) / std, atol=1e-5, rtol=0)


@pytest.mark.parametrize("to_present", ["nearest", "bilinear", None])
def test_labels_are_the_devkits(da: DeepAccident, sample: str, to_present: str | None) -> None:
    item = load_item(da, sample, points=False, labels=LABELS, to_present=to_present)

    labels = motion_labels(da, sample, LABELS)
    if to_present is not None:
        labels = labels.to_present(centerness=to_present)
    for name in ("segmentation", "instance", "centerness", "offset", "flow", "label_valid"):
        assert_array_equal(item[name], getattr(labels, name), err_msg=name)
    assert_allclose(item["future_egomotion"], labels.future_egomotion, atol=1e-6)
    assert item["label_valid"].tolist() == [True, True, True, False]
    assert item["segmentation"].dtype == item["instance"].dtype == torch.int64


def test_items_are_indexed_like_a_list(da: DeepAccident, tokens: list[str]) -> None:
    data = V2XDataset(da, tokens, V2XConfig(points=False, boxes=None))
    assert len(data) == 20
    assert [item["token"] for item in data] == tokens
    assert data[-1]["token"] == tokens[-1]
    assert data[np.int64(3)]["token"] == data[torch.tensor(3)]["token"] == tokens[3]
    assert_raises((lambda: data[20], IndexError, ()), (lambda: data[0:2], TypeError, ()))


def test_impossible_samples_are_refused(da: DeepAccident, tokens: list[str]) -> None:
    no_list = (
        r"tokens: expected a list of samples, such as "
        r"da\.training_samples\('train'\) or \[sample\], found"
    )
    no_release = "dataset: expected an open release.*found 'release'"
    images = ImageConfig(crop=(30, 0, 10, 64))
    assert_raises(
        (lambda: V2XDataset(da, ["nowhere"]), TokenError, "nowhere"),
        (
            lambda: V2XDataset(da, tokens, V2XConfig(agents="everybody")),
            ChoiceError,
            "agents: expected one of",
        ),
        (lambda: V2XDataset(da, tokens[0]), ConfigError, no_list),
        (lambda: V2XDataset(da, da.sample[0]), ConfigError, no_list),
        (lambda: V2XDataset(da, "train"), ConfigError, no_list),
        (lambda: AllEgosDataset(da, "train"), ConfigError, no_list),
        (lambda: V2XDataset("release", tokens), ConfigError, no_release),
        (lambda: AllEgosDataset("release", tokens), ConfigError, no_release),
        (
            lambda: V2XDataset(da, tokens, {}),
            ConfigError,
            ("config: expected a V2XConfig", "found {}"),
        ),
        (
            lambda: load_item(da, tokens[0], images=images),
            ConfigError,
            "reach beyond an image of 36 × 64",
        ),
    )
    assert len(V2XDataset(da, [], V2XConfig(agents="all", labels=LABELS))) == 0


@pytest.mark.parametrize(
    ("fields", "sensor"),
    [
        ({"points": True}, "lidar01"),
        ({"images": ImageConfig()}, "Camera_Front"),
        ({"bev_segmentation": BevGrid()}, "BEV_instance_camera"),
    ],
)
def test_a_missing_file_is_named(da_b: DeepAccident, fields: dict[str, Any], sensor: str) -> None:
    data = V2XDataset(
        da_b,
        [da_b.sample[0]["token"]],
        V2XConfig(**{"points": False} | fields),
    )
    assert_raises((lambda: data[0], MissingFileError, f"{sensor}.*no such file"))


def test_broken_images_and_images_of_different_sizes_are_refused(
    da: DeepAccident, sample: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    data = V2XDataset(da, [sample], V2XConfig(points=False, images=ImageConfig()))
    path = tmp_path / "broken.jpg"
    path.write_bytes(b"no image")
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: path)
    assert_raises((lambda: data[0], SensorFileError, r"broken\.jpg: not a readable image"))

    def draw_image(_: DeepAccident, name: str) -> np.ndarray:
        width = 6 if name.endswith("Left") else 5
        return np.zeros((4, width, 3), "u1")

    monkeypatch.setattr(type(da), "load_image", draw_image)
    assert_raises(
        (lambda: data[0], ConfigError, r"different sizes, \(4, 5\) and \(4, 6\); choose resize=")
    )


def test_motion_labels_of_a_sample_without_a_label_file_are_refused(own_release: Path) -> None:
    folder = next(own_release.glob("*/*/ego_vehicle/label/*"))
    for path in folder.iterdir():
        path.unlink()
    da = DeepAccident("v1", own_release, verbose=False)
    token = next(record["token"] for record in da.sample if not record["labelled"])

    config = V2XConfig(labels=LABELS)
    assert_raises(
        (
            lambda: V2XDataset(da, [token], config),
            NotAvailableError,
            ("1 of the 1 samples have no label", token, "labels=None"),
        )
    )
    assert load_item(da, token, points=False)["boxes"].shape == (0, 9)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"past": 0}, "past: expected a whole number from 1, found 0"),
        ({"step": 0}, "step: expected a whole number from 1, found 0"),
        ({"seed": -1}, "seed: expected a whole number from 0"),
        ({"boxes": "all"}, "boxes: expected one of sample, cooperative, or None, found 'all'"),
        ({"visible": "all"}, "visible: expected one of camera, released, or None"),
        ({"to_present": "cubic"}, "to_present: expected one of nearest, bilinear, or None"),
        (
            {"labels": MotionLabelConfig(augmentation=Augmentation())},
            r"give only V2XConfig\(augmentation=…\)",
        ),
        (
            {"augmentation": 0.3},
            "augmentation: expected an Augmentation or a function that draws one, found 0.3",
        ),
        ({"link": "late"}, r"link: expected a Link, such as .*, found 'late'"),
        (
            {"images": (224, 400)},
            r"images: expected None or an ImageConfig, such as ImageConfig\(resize=",
        ),
        (
            {"labels": True},
            "labels: expected None or a MotionLabelConfig, or the name of a preset, found True",
        ),
        ({"labels": "released"}, "preset: expected one of deepaccident, .*, found 'released'"),
        ({"bev_segmentation": True}, "bev_segmentation: expected None or the BevGrid"),
        ({"points": "no"}, "points: expected True or False, found 'no'"),
        ({"past": "2"}, "past: expected a whole number from 1, found '2'"),
        ({"on_missing": "ignore"}, "on_missing: expected one of raise, skip, found 'ignore'"),
        ({"past": True}, "past: expected a whole number from 1, found True"),
    ],
)
def test_impossible_configurations_are_refused(fields: dict[str, object], message: str) -> None:
    assert_raises((lambda: V2XConfig(**fields), (ConfigError, ChoiceError), message))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"resize": (0, 5)}, r"resize: expected height and width in pixels, found \(0, 5\)"),
        ({"crop": (0, 0, 5)}, "crop: expected top, left, height and width"),
        (
            {"resize": (10, 20), "crop": (4, 0, 7, 20)},
            "rows 4 to 11 and columns 0 to 20 reach beyond an image of 10 × 20",
        ),
        ({"dtype": "float16"}, "dtype: expected one of float32, uint8"),
        ({"resize": 224}, "resize: expected height and width in pixels, found 224"),
        ({"resize": (224.0, 400.0)}, "resize: expected height and width in pixels, found"),
        ({"crop": "abcd"}, "crop: expected top, left, height and width in pixels, found 'abcd'"),
        ({"std": (1.0, 1.0, 0.0)}, "std: expected numbers above 0"),
        ({"mean": 0.5}, "mean: expected a number for each of R, G and B, found 0.5"),
        ({"std": "abc"}, "std: expected a number for each of R, G and B, found 'abc'"),
        ({"mean": (0.5, 0.5, np.nan)}, "mean: expected a number for each"),
        ({"dtype": "uint8", "mean": (0.5, 0.5, 0.5)}, "uint8 images are not scaled"),
        ({"cameras": ("Front",)}, "cameras: expected one of Camera_Front"),
        ({"cameras": "Front"}, "cameras: expected one of Camera_Front"),
        ({"cameras": 6}, "cameras: expected some of Camera_Front"),
        ({"cameras": ()}, "cameras: expected some of Camera_Front"),
        ({"cameras": ("Camera_Front", "Camera_Front")}, "cameras: expected each camera once"),
    ],
)
def test_impossible_image_configurations_are_refused(
    fields: dict[str, object], message: str
) -> None:
    assert_raises((lambda: ImageConfig(**fields), ConfigError, message))


def test_an_item_has_the_window_of_its_sample(da: DeepAccident) -> None:
    sample = da.get_sample(da.scenario[0], "other_vehicle", 3)["token"]
    config = WindowConfig(past=0.2, future=0.4, actors="any", agents="single", visible="camera")
    augmentation = Augmentation(rotation=0.3, scale=1.1, flip=True)

    item = load_item(da, sample, points=False, window=config, augmentation=augmentation)

    window = da.window(sample, 0.2, 0.4, agents="single", visible="camera", actors="any")
    expected = window.augmented(augmentation.matrix).arrays
    assert item["window"].keys() == expected.keys()
    for name, array in expected.items():
        assert_allclose(item["window"][name], array, rtol=1e-6, atol=1e-5)
    assert item["window"]["center"].dtype == torch.float32
    assert item["window"]["category"].dtype == torch.int64
    assert item["window"]["seen_by"].dtype == torch.uint8


def test_windows_are_a_list_in_a_batch(da: DeepAccident) -> None:
    tokens = [f"{da.scenario[0]['token']}/{agent}/003" for agent in AGENTS[:3]]
    config = V2XConfig(points=False, boxes=None, window=WindowConfig(past=0.1, future=0.1))
    dataset = V2XDataset(da, tokens, config)
    [batch] = DataLoader(dataset, batch_size=3, collate_fn=collate)
    assert [window["yaw"].shape[1] for window in batch["window"]] == [3, 3, 3]
    assert ", window" in repr(dataset)

    [moment] = DataLoader(AllEgosDataset(da, tokens, config), collate_fn=collate_all_egos)
    for one, other in zip(moment["window"], batch["window"], strict=True):
        assert_array_equal(one["center"], other["center"])


def test_a_window_of_another_type_is_refused() -> None:
    with pytest.raises(ConfigError, match="window: expected None or a WindowConfig"):
        V2XConfig(window=2.0)  # type: ignore[arg-type]
