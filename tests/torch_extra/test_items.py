"""Items without an augmentation: what the devkit's own calls give, as tensors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from refusals import assert_refused

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
from deepaccident_devkit.training.torch import AllEgosDataset, ImageConfig, V2XConfig, V2XDataset
from deepaccident_devkit.v2x import AGENT_CONFIGS, cooperating_agents

LABELS = MotionLabelConfig(receptive_field=2, future_frames=3, step=1)


def test_a_sample_alone(da: DeepAccident, sample: str) -> None:
    [item] = list(V2XDataset(da, [sample]))
    assert (item["token"], item["agents"], item["agent_valid"].tolist()) == (
        sample,
        ("ego_vehicle",),
        [[True]],
    )
    assert_array_equal(item["ego_from_agent"], np.eye(4)[None, None])
    assert_array_equal(item["augmentation"], np.eye(4))
    assert_allclose(item["world_from_ego"], da.world_from(sample, "ego").matrix)
    assert_array_equal(
        item["points"][0][0], da.load_point_cloud(sample, "ego").points.astype(np.float32)
    )


def test_boxes_are_the_devkits_with_zero_for_an_unknown_velocity(
    da: DeepAccident, sample: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That of the first of them."""
    boxes = da.boxes(sample, "ego", "released")
    known = np.arange(len(boxes)) > 0
    velocity = np.where(known[:, None], boxes.velocity, np.nan)
    monkeypatch.setattr(type(da), "boxes", lambda *_: replace(boxes, velocity=velocity))
    [item] = V2XDataset(da, [sample], V2XConfig(points=False))
    rows = np.column_stack([boxes.center, boxes.size, boxes.yaw, np.nan_to_num(velocity[:, :2])])
    assert_allclose(item["boxes"], rows, atol=1e-4)
    for key, expected in {
        "velocity_known": known,
        "categories": boxes.category,
        "actor_ids": boxes.actor_id,
    }.items():
        assert_array_equal(item[key], expected)


@pytest.mark.parametrize("agents", [*AGENT_CONFIGS, ["infrastructure", "other_vehicle"], None])
@pytest.mark.parametrize("ego", AGENTS)
def test_each_agent_sends_its_own_frame(
    da: DeepAccident, ego: str, agents: str | list[str] | None
) -> None:
    token = f"{da.scenario[1]['token']}/{ego}/004"
    item = V2XDataset(da, [token], V2XConfig(agents=agents, boxes="cooperative"))[0]
    assert item["agents"] == tuple(dict.fromkeys([ego, *cooperating_agents(da, token, agents)]))
    for a, name in enumerate(item["agents"]):
        other = da.get_sample(da.scenario[1], name, 4)
        assert_allclose(item["ego_from_agent"][a, 0], da.transform(token, other).matrix, atol=1e-4)
        assert_allclose(
            item["points"][a][0][:, :3], da.load_point_cloud(other, "ego").xyz, atol=1e-4
        )
    boxes = da.cooperative_boxes(token, agents=item["agents"], frame="ego", visible="released")
    assert_allclose(item["boxes"][:, :3], boxes.center, atol=1e-4)
    assert_array_equal(item["actor_ids"], boxes.actor_id)


def test_past_frames_end_with_the_present(da: DeepAccident, sample: str) -> None:
    item = V2XDataset(
        da, [sample], V2XConfig(past=3, step=2, agents="+other", images=ImageConfig(resize=(9, 16)))
    )[0]
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
    for a, name in enumerate(item["agents"]):
        assert len(item["points"][a][0]) == 0
        then, now = (da.get_sample(da.scenario[0], name, frame) for frame in (2, 4))
        for p, sent in ((1, then), (2, now)):
            assert_allclose(
                item["points"][a][p][:, :3], da.load_point_cloud(sent, "ego").xyz, atol=1e-4
            )
            assert_allclose(
                item["ego_from_agent"][a, p], da.transform(sample, sent).matrix, atol=1e-4
            )
            assert_allclose(
                item["agent_from_past"][a, p], da.transform(now, sent).matrix, atol=1e-4
            )


def test_images_and_cameras_are_the_devkits(da: DeepAccident, sample: str) -> None:
    item = V2XDataset(
        da, [sample], V2XConfig(agents="+infrastructure", images=ImageConfig(dtype="uint8"))
    )[0]
    assert (item["images"].shape, item["images"].dtype) == ((2, 1, 6, 3, 36, 64), torch.uint8)
    points = da.load_point_cloud(sample, "ego").xyz
    for c, channel in enumerate(CAMERAS):
        camera = f"{sample}/{channel}"
        assert_array_equal(item["images"][0, 0, c].permute(1, 2, 0), da.load_image(camera))
        expected = da.project_to_image(points, sample, camera, frame="ego", colors=False)
        pixels, depth = projected(item["image_from_ego"][0, 0, c], points)
        seen = expected.mask & (expected.depth > 0.5)
        assert_allclose(depth, expected.depth, atol=1e-3)
        assert_allclose(pixels[seen], expected.pixels[seen], atol=0.01)
        optical = da.world_from(sample, "ego").inverse() @ da.world_from(sample, channel)
        assert_allclose(item["ego_from_camera"][0, 0, c], optical.matrix, atol=1e-5)
        assert_allclose(item["intrinsics"][0, 0, c], da.get_sample_data(camera)[2], atol=1e-4)


def test_a_resized_and_cropped_image_hits_the_same_pixels(da: DeepAccident, sample: str) -> None:
    config = ImageConfig(
        resize=(18, 48), crop=(3, 5, 12, 40), cameras=("Camera_Back", "Camera_Front")
    )
    item = V2XDataset(da, [sample], V2XConfig(images=config))[0]
    assert item["images"].shape == (1, 1, 2, 3, 12, 40)
    points = da.load_point_cloud(sample, "ego").xyz
    whole = da.project_to_image(points, sample, f"{sample}/Camera_Front", frame="ego", colors=False)
    seen = whole.mask & (whole.depth > 0.5)
    expected = whole.pixels * [48 / 64, 18 / 36] - [5, 3]
    by_parts = item["intrinsics"][0, 0, 1] @ item["ego_from_camera"][0, 0, 1].inverse()[:3]
    for matrix in (item["image_from_ego"][0, 0, 1], by_parts):
        assert_allclose(projected(matrix, points)[0][seen], expected[seen], atol=0.01)


def test_values_of_images(da: DeepAccident, sample: str) -> None:
    raw, plain, scaled = (
        V2XDataset(da, [sample], V2XConfig(points=False, boxes=None, images=config))[0]["images"]
        for config in (
            ImageConfig(dtype="uint8"),
            ImageConfig(),
            ImageConfig(mean=(0.5, 0.4, 0.3), std=(0.2, 0.3, 0.4)),
        )
    )
    torch.testing.assert_close(plain, raw / 255)
    mean, std = torch.tensor([[0.5, 0.4, 0.3], [0.2, 0.3, 0.4]])[..., None, None]
    torch.testing.assert_close(scaled, (plain - mean) / std, atol=1e-5, rtol=0)


@pytest.mark.parametrize("to_present", ["nearest", "bilinear", None])
def test_labels_are_the_devkits(da: DeepAccident, sample: str, to_present: str | None) -> None:
    item = V2XDataset(da, [sample], V2XConfig(points=False, labels=LABELS, to_present=to_present))[
        0
    ]
    labels = motion_labels(da, sample, LABELS)
    if to_present is not None:
        labels = labels.to_present(centerness=to_present)
    for name in ("segmentation", "instance", "centerness", "offset", "flow", "label_valid"):
        assert_array_equal(item[name], getattr(labels, name), err_msg=name)
    assert_allclose(item["future_egomotion"], labels.future_egomotion, atol=1e-6)
    assert item["label_valid"].tolist() == [True, True, True, False]
    assert item["segmentation"].dtype == item["instance"].dtype == torch.int64


def test_items_are_counted_as_a_sequences(da: DeepAccident, tokens: list[str]) -> None:
    data = V2XDataset(da, tokens, V2XConfig(points=False, boxes=None))
    assert ([item["token"] for item in data], len(data)) == (tokens, 20)
    assert [data[at]["token"] for at in (-1, np.int64(3), torch.tensor(3))] == [
        tokens[-1],
        tokens[3],
        tokens[3],
    ]
    assert_refused((lambda: data[20], IndexError, ()), (lambda: data[0:2], TypeError, ()))


def test_samples_that_cannot_be(da: DeepAccident, tokens: list[str]) -> None:
    one_alone = (
        r"tokens: expected a list of samples, such as "
        r"da\.training_samples\('train'\) or \[sample\], found"
    )
    beyond = V2XConfig(images=ImageConfig(crop=(30, 0, 10, 64)))
    assert_refused(
        (lambda: V2XDataset(da, ["nowhere"]), TokenError, "nowhere"),
        (
            lambda: V2XDataset(da, tokens, V2XConfig(agents="everybody")),
            ChoiceError,
            "agents: expected one of",
        ),
        (lambda: V2XDataset(da, tokens[0]), ConfigError, one_alone),
        (lambda: V2XDataset(da, da.sample[0]), ConfigError, one_alone),
        *[
            (lambda of=of: of(da, "train"), ConfigError, one_alone)
            for of in (V2XDataset, AllEgosDataset)
        ],
        *[
            (
                lambda of=of: of("release", tokens),
                ConfigError,
                "dataset: expected an open release.*found 'release'",
            )
            for of in (V2XDataset, AllEgosDataset)
        ],
        (
            lambda: V2XDataset(da, tokens, {}),
            ConfigError,
            ("config: expected a V2XConfig", "found {}"),
        ),
        (
            lambda: V2XDataset(da, tokens, beyond)[0],
            ConfigError,
            "reach beyond an image of 36 × 64",
        ),
    )
    assert len(V2XDataset(da, [], V2XConfig(agents="all", labels=LABELS))) == 0


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"points": True}, "lidar01"),
        ({"images": ImageConfig()}, "Camera_Front"),
        ({"bev_segmentation": BevGrid()}, "BEV_instance_camera"),
    ],
)
def test_a_missing_file_is_named(da_b: DeepAccident, fields: dict[str, Any], named: str) -> None:
    data = V2XDataset(da_b, [da_b.sample[0]["token"]], V2XConfig(**{"points": False} | fields))
    assert_refused((lambda: data[0], MissingFileError, f"{named}.*no such file"))


def test_images_that_are_none_or_of_different_sizes_are_refused(
    da: DeepAccident, sample: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    monkeypatch.setattr(type(da), "sensor_path", lambda *_: tmp_path / "broken.jpg")
    data = V2XDataset(da, [sample], V2XConfig(points=False, images=ImageConfig()))
    assert_refused((lambda: data[0], SensorFileError, r"broken\.jpg: not a readable image"))
    monkeypatch.setattr(
        type(da), "load_image", lambda _, name: np.zeros((4, 5 + name.endswith("Left"), 3), "u1")
    )
    assert_refused(
        (lambda: data[0], ConfigError, r"different sizes, \(4, 5\) and \(4, 6\); choose resize=")
    )


def test_labels_of_a_sample_without(own_release: Path) -> None:
    for label in next(own_release.glob("*/*/ego_vehicle/label/*")).iterdir():
        label.unlink()
    da = DeepAccident("v1", own_release, verbose=False)
    token = next(record["token"] for record in da.sample if not record["labelled"])
    named = ("1 of the 1 samples have no label", token, "labels=None")
    assert_refused(
        (lambda: V2XDataset(da, [token], V2XConfig(labels=LABELS)), NotAvailableError, named)
    )
    assert V2XDataset(da, [token], V2XConfig(points=False))[0]["boxes"].shape == (0, 9)


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
            r"give V2XConfig\(augmentation=…\) alone",
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
def test_configurations_that_cannot_be(fields: dict[str, object], message: str) -> None:
    assert_refused((lambda: V2XConfig(**fields), (ConfigError, ChoiceError), message))


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
def test_image_configurations_that_cannot_be(fields: dict[str, object], message: str) -> None:
    assert_refused((lambda: ImageConfig(**fields), ConfigError, message))


def projected(image_from_ego: torch.Tensor, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and depths (N,) of points of the ego frame."""
    matrix = image_from_ego.double().numpy()
    scaled = points @ matrix[:3, :3].T + matrix[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return scaled[:, :2] / scaled[:, 2:], scaled[:, 2]
