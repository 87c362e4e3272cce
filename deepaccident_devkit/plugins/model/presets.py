"""The presets: `released`, the release's model with its quirks, and models for laptops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, get_args

import msgspec

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.images import ImageConfig, VirtualCamera
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.model.bev import BevEncodeConfig, BevUNetConfig
from deepaccident_devkit.plugins.model.checkpoint import load_weights, read_weights
from deepaccident_devkit.plugins.model.detection import (
    ONE_TASK,
    RELEASED_CLASS_SLOTS,
    RELEASED_NMS,
    DecodingConfig,
    DetectionConfig,
    TargetConfig,
)
from deepaccident_devkit.plugins.model.fusion import (
    CobevtConfig,
    DiscoNetConfig,
    FusionConfig,
    PoolFusionConfig,
    ReleasedFusionConfig,
    V2XViTConfig,
)
from deepaccident_devkit.plugins.model.images import SmallConvConfig, SwinConfig
from deepaccident_devkit.plugins.model.lift import LiftConfig
from deepaccident_devkit.plugins.model.motion import MotionHeadConfig, MotionLossConfig
from deepaccident_devkit.plugins.model.network import CameraConfig, ModelConfig, V2XFormer
from deepaccident_devkit.plugins.model.pillars import PillarConfig
from deepaccident_devkit.plugins.model.temporal import TemporalConfig
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.text import PathType, settle_choices
from deepaccident_devkit.support.text import choice as checked_choice
from deepaccident_devkit.taxonomy import FRAME_PERIOD, ModelFusion, ModelPreset

# Exclusive limit of a horizon in frames, and its tolerated deviation from an integer.
_MAX_HORIZON_FRAMES = 100
_FRAME_TOLERANCE = 1e-6
# Maps with fewer channels than this get small fusions.
_MIN_CHANNELS_OF_LARGE_FUSION = 64


class _ChoiceNotes(msgspec.Struct):
    """A `ModelChoice` as stored in the notes of weights; all fields must be present."""

    preset: ModelPreset
    fusion: ModelFusion | None
    horizon: Annotated[float, msgspec.Meta(gt=0, lt=1000)] | None
    focal: Annotated[float, msgspec.Meta(gt=0, lt=10_000)] | None = None
    labels: Literal["fiery"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelChoice:
    """A preset and its changes: everything that is needed to rebuild a model.

    Attributes:
        preset: `released`, `tiny`, `tiny_lidar` or `tiny_both`.
        fusion: Fusion of the agents; None for the preset's.
        horizon: Seconds of motion that are predicted; None for 2.
        focal: Focal length in pixels of the virtual camera that images are converted to; None to
            keep the images' own cameras.
        labels: `fiery` for motion labels by FIERY's rules, which are used to evaluate on nuScenes;
            None for the preset's.
    """

    preset: ModelPreset = "tiny"
    fusion: ModelFusion | None = None
    horizon: float | None = None
    focal: float | None = None
    labels: Literal["fiery"] | None = None

    def __post_init__(self) -> None:
        """Check the choice; raise ChoiceError or ConfigError if it is not valid."""
        words = {
            "preset": get_args(ModelPreset),
            "fusion": (None, *get_args(ModelFusion)),
            "labels": (None, "fiery"),
        }
        settle_choices(self, words)
        self.config  # noqa: B018 - raises if settings do not fit together

    @property
    def config(self) -> ModelConfig:
        """The complete configuration."""
        config = MODEL_PRESETS[self.preset]()
        if self.fusion is not None:
            fusion = fusion_config(self.fusion, config.temporal.channels)
            config = replace(config, fusion=fusion)
        if self.horizon is not None:
            frames = self._count_horizon_frames(config)
            motion = replace(config.motion, future_frames=frames)
            labels = replace(config.labels, future_frames=frames)
            config = replace(config, motion=motion, labels=labels)
        if self.labels is not None:
            config = replace(config, labels=self._make_fiery_labels(config))
        if self.focal is not None:
            config = replace(config, cameras=self._make_virtual_cameras(config.cameras))
        return config

    def as_dict(self) -> dict[str, Any]:
        """Return the choice in JSON types."""
        choice = {"preset": self.preset, "fusion": self.fusion, "horizon": self.horizon}
        for name in ("focal", "labels"):  # older runs' notes lack these
            value = getattr(self, name)
            if value is not None:
                choice[name] = value
        return choice

    @classmethod
    def from_dict(cls, notes: Mapping[str, Any], path: Path) -> ModelChoice:
        """Read the choice from the notes that are stored with weights.

        Raises:
            ConfigError: The notes do not describe a choice.
        """
        try:
            choice = as_record(notes, _ChoiceNotes)
            return cls(**msgspec.structs.asdict(choice))
        except ValueError as error:
            raise ConfigError(
                f"{path}: does not say which model its weights are for ({error}); give weights "
                "that deepaccident train wrote, or train from these weights with deepaccident "
                "train --from"
            ) from error

    def _make_fiery_labels(self, config: ModelConfig) -> MotionLabelConfig:
        """Return the configuration of FIERY's labels for the model's grid and frames."""
        labels = config.labels
        return MotionLabelConfig.preset(
            "fiery",
            grid=labels.grid,
            orientation=labels.grid.orientation,
            receptive_field=labels.receptive_field,
            future_frames=labels.future_frames,
        )

    def _make_virtual_cameras(self, cameras: CameraConfig | None) -> CameraConfig:
        """Use the virtual camera for all images; raise ConfigError if the model has no cameras."""
        if cameras is None:
            raise ConfigError("focal: the model has no cameras; remove this option")
        images = cameras.images
        size = images.resize or (0, 0)
        if images.crop is not None:
            size = images.crop[2:]
        virtual_camera = VirtualCamera(self.focal or 0, *size)
        images = replace(images, resize=None, crop=None, virtual_camera=virtual_camera)
        return replace(cameras, images=images)

    def _count_horizon_frames(self, config: ModelConfig) -> int:
        """Return the number of frames in the horizon; raise ConfigError if it is not an integer."""
        step = config.labels.step * FRAME_PERIOD
        frames = (self.horizon or 0.0) / step
        is_in_range = 1 <= frames < _MAX_HORIZON_FRAMES
        if not is_in_range or abs(frames - round(frames)) >= _FRAME_TOLERANCE:
            raise ConfigError(
                f"horizon: {self.horizon!r} s is not a multiple of {step:g} s; choose 0.5, 1, "
                "1.5, …"
            )
        return round(frames)


def load_model(path: PathType) -> V2XFormer:
    """Load a model from a run's folder, or from a file of the devkit's weights, onto the CPU.

    Raises:
        ConfigError: There are no weights, they were not written by the devkit, or they do not match
            their notes.
    """
    weights = read_weights(path)
    model = V2XFormer(ModelChoice.from_dict(weights.meta, weights.path).config)
    load_weights(model, weights, whole=True)
    model.notes = dict(weights.meta)
    return model


def fusion_config(name: str, channels: int) -> FusionConfig:
    """Return a fusion's config, sized for the number of channels.

    `released` is the fusion in the released code. `disconet`, `cobevt` and `v2xvit` appear in the
    DeepAccident paper's table, but not in the released code; they are implemented from their
    original papers. Raise ChoiceError if there is no such fusion.
    """
    name = checked_choice("fusion", name, get_args(ModelFusion))
    is_small = channels < _MIN_CHANNELS_OF_LARGE_FUSION
    config: FusionConfig = PoolFusionConfig()
    if name == "max":
        config = PoolFusionConfig(by="max")
    elif name == "released":
        config = ReleasedFusionConfig(channels=channels)
    elif name == "disconet":
        config = DiscoNetConfig(channels=channels)
    elif name == "cobevt" and is_small:
        config = CobevtConfig(channels=channels, depth=1, window=5)
    elif name == "cobevt":
        config = CobevtConfig(channels=channels)
    elif name == "v2xvit" and is_small:
        config = V2XViTConfig(channels=channels, depth=1, windows=(5, 10, 20))
    elif name == "v2xvit":
        config = V2XViTConfig(channels=channels)
    return config


def released() -> ModelConfig:
    """Return the config of BEVerse-tiny with the released fusion.

    It has 83 million parameters, images of 704 × 256 pixels and 200 × 200 cells of 0.5 m. Images
    are cropped as in the released tests, even in training: the release's random scales, flips and
    rotations of images are left out. So are two of its mistakes: a separate augmentation for each
    agent, and a mixed order of agents in batches.
    """
    axis = (-51.2, 51.2, 0.8)
    return ModelConfig(
        cameras=CameraConfig(
            images=ImageConfig(resize=(432, 768), crop=(176, 32, 256, 704), dtype="uint8"),
            encoder=SwinConfig(checkpointing=True),
            lift=LiftConfig(
                in_channels=512,
                channels=64,
                depth=(1.0, 60.0, 1.0),
                x=axis,
                y=axis,
                z=(-30.0, 30.0, 60.0),
                image_size=(256, 704),
                stride=16,
                frustum="corners",
                voxel_rounding="trunc",
            ),
        ),
        temporal=TemporalConfig(
            channels=64,
            grid=BevGrid(x=axis, y=axis),
            frames=3,
            warp="stretched",
            chain="released",
            egomotion_input="raw",
        ),
        fusion=ReleasedFusionConfig(channels=64),
        bev=BevEncodeConfig(),
        motion=MotionHeadConfig(posterior_ignore="keep", hidden_warp="none"),
        detection=DetectionConfig(class_slots=RELEASED_CLASS_SLOTS, x=axis, y=axis),
        targets=TargetConfig(unknown_velocity="zero"),
        decoding=DecodingConfig(nms=RELEASED_NMS),
        labels=MotionLabelConfig.preset("deepaccident", orientation="released"),
        handedness="left",
    )


def tiny() -> ModelConfig:
    """Return the config for 160 × 90 pixel images, feature cells of 1 m and label cells of 0.5 m.

    The labels are `clean`, and the model has none of the quirks. Only points near the road are
    pooled, by their mean, so that depths need not be learned from scratch. The label cells are
    finer than the feature cells, so the decoders output more channels instead of finer maps.
    docs/model.md lists its scores.
    """
    axis = (-50.0, 50.0, 1.0)
    return ModelConfig(
        cameras=CameraConfig(
            images=ImageConfig(resize=(90, 160), dtype="uint8", decode="scaled"),
            rows=96,
            encoder=SmallConvConfig(),
            lift=LiftConfig(
                in_channels=48,
                channels=32,
                depth=(2.0, 50.0, 2.0),
                x=axis,
                y=axis,
                z=(-10.0, 10.0, 20.0),
                image_size=(96, 160),
                stride=8,
                band=(-0.5, 2.5),
                pooling="mean",
            ),
        ),
        temporal=TemporalConfig(channels=32, grid=BevGrid(x=axis, y=axis), frames=2, kind="concat"),
        fusion=PoolFusionConfig(),
        bev=BevUNetConfig(),
        one_bev=True,
        motion=MotionHeadConfig(
            in_channels=32,
            latent=8,
            decoders="shuffled",
            hidden=48,
            upsample=4,
            samples=0,
            detach=False,
        ),
        motion_loss=MotionLossConfig(offset=0.5, flow=0.5),  # vectors are in cells of half a metre
        detection=DetectionConfig(
            in_channels=32,
            shared_channels=24,
            class_slots=ONE_TASK,
            x=axis,
            y=axis,
            branches="joint",
            upsample=2,
        ),
        labels=MotionLabelConfig(grid=BevGrid(), receptive_field=2, protocol="clean"),
    )


def tiny_both() -> ModelConfig:
    """Return `tiny` with LiDARs in addition to cameras."""
    config = tiny()
    pillars = PillarConfig(channels=config.temporal.channels, grid=config.grid)
    return replace(config, pillars=pillars)


def tiny_lidar() -> ModelConfig:
    """Return `tiny` with LiDARs instead of cameras."""
    return replace(tiny_both(), cameras=None)


MODEL_PRESETS: Final[Mapping[str, Callable[[], ModelConfig]]] = MappingProxyType(
    {"released": released, "tiny": tiny, "tiny_lidar": tiny_lidar, "tiny_both": tiny_both}
)
