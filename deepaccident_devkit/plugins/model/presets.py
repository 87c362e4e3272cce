"""The presets: `released`, the model of the release with its quirks, and models for laptops."""

from __future__ import annotations

import os
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
from deepaccident_devkit.support.text import choice as checked_choice
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import FRAME_PERIOD, ModelFusion, ModelPreset


class _ChoiceNotes(msgspec.Struct):
    """A `ModelChoice` in the notes of weights; all of it must be present."""

    preset: ModelPreset
    fusion: ModelFusion | None
    horizon: Annotated[float, msgspec.Meta(gt=0, lt=1000)] | None
    focal: Annotated[float, msgspec.Meta(gt=0, lt=10_000)] | None = None
    labels: Literal["fiery"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelChoice:
    """A preset and its changes: everything that is needed to build a model again.

    Attributes:
        preset: `released`, `tiny`, `tiny_lidar` or `tiny_both`.
        fusion: Fusion of the agents; None for the preset's.
        horizon: Seconds of motion that are predicted; None for 2.
        focal: Focal length, in pixels, of the virtual camera that images are converted to; None for
            their own camera.
        labels: `fiery` for motion labels by FIERY's rules, which nuScenes is evaluated with; None
            for the preset's.
    """

    preset: ModelPreset = "tiny"
    fusion: ModelFusion | None = None
    horizon: float | None = None
    focal: float | None = None
    labels: Literal["fiery"] | None = None

    def __post_init__(self) -> None:
        """Check the choice; raises ChoiceError or ConfigError."""
        settle_choices(
            self, {"preset": get_args(ModelPreset), "fusion": (None, *get_args(ModelFusion))}
        )
        settle_choices(self, {"labels": (None, "fiery")})
        self.config  # noqa: B018 - refuses settings that do not go together

    @property
    def config(self) -> ModelConfig:
        """The complete configuration."""
        config = MODEL_PRESETS[self.preset]()
        if self.fusion is not None:
            config = replace(config, fusion=fusion_config(self.fusion, config.temporal.channels))
        if self.horizon is not None:
            frames = self._horizon_frames(config)
            config = replace(
                config,
                motion=replace(config.motion, future_frames=frames),
                labels=replace(config.labels, future_frames=frames),
            )
        if self.labels is not None:
            config = replace(config, labels=self._fiery_labels(config))
        if self.focal is not None:
            config = replace(config, cameras=self._virtual_cameras(config.cameras))
        return config

    def as_dict(self) -> dict[str, Any]:
        """Return the choice as JSON holds it."""
        choice = {"preset": self.preset, "fusion": self.fusion, "horizon": self.horizon}
        for name in ("focal", "labels"):  # notes of older runs lack these
            value = getattr(self, name)
            if value is not None:
                choice[name] = value
        return choice

    @classmethod
    def from_dict(cls, described: Mapping[str, Any], path: Path) -> ModelChoice:
        """Return the choice that the notes of a file's weights describe.

        Raises:
            ConfigError: The notes describe no choice.
        """
        try:
            return cls(**msgspec.structs.asdict(as_record(described, _ChoiceNotes)))
        except ValueError as error:
            raise ConfigError(
                f"{path}: does not say which model its weights are of ({error}); give weights of "
                "deepaccident train, or begin a training from these: deepaccident train --from"
            ) from error

    def _fiery_labels(self, config: ModelConfig) -> MotionLabelConfig:
        labels = config.labels
        return MotionLabelConfig.preset(
            "fiery",
            grid=labels.grid,
            orientation=labels.grid.orientation,
            receptive_field=labels.receptive_field,
            future_frames=labels.future_frames,
        )

    def _virtual_cameras(self, cameras: CameraConfig | None) -> CameraConfig:
        if cameras is None:
            raise ConfigError("focal: the model has no cameras; leave it out")
        images = cameras.images
        size = images.crop[2:] if images.crop is not None else images.resize or (0, 0)
        virtual = VirtualCamera(self.focal or 0, *size)
        return replace(
            cameras, images=replace(images, resize=None, crop=None, virtual_camera=virtual)
        )

    def _horizon_frames(self, config: ModelConfig) -> int:
        step = config.labels.step * FRAME_PERIOD
        frames = (self.horizon or 0.0) / step
        if not (1 <= frames < 100 and abs(frames - round(frames)) < 1e-6):
            raise ConfigError(
                f"horizon: {self.horizon!r} s is no number of steps of {step:g} s; choose 0.5, 1, "
                "1.5, …"
            )
        return round(frames)


def load_model(path: str | os.PathLike[str]) -> V2XFormer:
    """Load the model of a run's folder, or of a file of our own weights, on the CPU.

    Raises:
        ConfigError: There are no weights, they are not the devkit's, or they do not fit their
            notes.
    """
    weights = read_weights(path)
    model = V2XFormer(ModelChoice.from_dict(weights.meta, weights.path).config)
    load_weights(model, weights, whole=True)
    model.notes = dict(weights.meta)
    return model


def fusion_config(name: str, channels: int) -> FusionConfig:
    """Return the config of a fusion, in a size that suits the number of channels.

    The release's own fusion is `released`. `disconet`, `cobevt` and `v2xvit` are written from the
    papers of these models: the paper's table names them, and the release has none of them. Raises
    ChoiceError.
    """
    is_small = channels < 64
    constructors: Mapping[str, Callable[[], FusionConfig]] = {
        "mean": PoolFusionConfig,
        "max": lambda: PoolFusionConfig(by="max"),
        "released": lambda: ReleasedFusionConfig(channels=channels),
        "disconet": lambda: DiscoNetConfig(channels=channels),
        "cobevt": lambda: (
            CobevtConfig(channels=channels, depth=1, window=5)
            if is_small
            else CobevtConfig(channels=channels)
        ),
        "v2xvit": lambda: (
            V2XViTConfig(channels=channels, depth=1, windows=(5, 10, 20))
            if is_small
            else V2XViTConfig(channels=channels)
        ),
    }
    return constructors[checked_choice("fusion", name, get_args(ModelFusion))]()


def released() -> ModelConfig:
    """Return BEVerse-tiny with the released fusion.

    It has 83 million parameters, images of 704 × 256 pixels and 200 × 200 cells of 0.5 m. Images
    are cut as in the released tests, in training too: the release's random scales, flips and
    rotations of images are left out, and so are its separate augmentation for each agent and its
    mixed order of agents in batches, which are mistakes.
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
    """Return the config of images of 160 × 90 pixels, features in cells of 1 m, labels of 0.5 m.

    The labels are `clean`; the model has none of the quirks. Only points near the road count, and a
    cell has their mean, so that depths need not be learned from scratch. The decoders have more
    channels instead of finer maps, because the cells of the labels are finer. docs/model.md has its
    numbers.
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
        motion_loss=MotionLossConfig(offset=0.5, flow=0.5),  # vectors count cells of half a metre
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
    return replace(
        config, pillars=PillarConfig(channels=config.temporal.channels, grid=config.grid)
    )


def tiny_lidar() -> ModelConfig:
    """Return `tiny` with LiDARs instead of cameras."""
    return replace(tiny_both(), cameras=None)


MODEL_PRESETS: Final[Mapping[str, Callable[[], ModelConfig]]] = MappingProxyType(
    {"released": released, "tiny": tiny, "tiny_lidar": tiny_lidar, "tiny_both": tiny_both}
)
