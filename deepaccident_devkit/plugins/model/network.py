"""`ModelConfig`, the configuration of a model, and `V2XFormer`: sensors → the ego's maps and boxes.

| step | from → to | where |
|---|---|---|
| the devkit's batch | tensors in the model's frame | `inputs` |
| images | features of each image | `images` |
| lift | features → a map from above, each frame of each agent | `lift` |
| pillars | LiDAR points → the same; a model with both joins them | `pillars` |
| time | P frames → one map of each agent | `temporal` |
| placement | agents' maps → the ego's frame | `warps` |
| fusion | agents' maps → one | `fusion` |
| heads | crop, encoder, decoder of each task | `bev`, `motion`, `detection` |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.plugins.model.bev import (
    BevEncode,
    BevEncodeConfig,
    BevUNet,
    BevUNetConfig,
    crop,
)
from deepaccident_devkit.plugins.model.detection import (
    CenterHead,
    DecodingConfig,
    DetectionConfig,
    DetectionLossConfig,
    TargetConfig,
    TaskMaps,
)
from deepaccident_devkit.plugins.model.fusion import FusionConfig, fusion
from deepaccident_devkit.plugins.model.images import EncoderConfig, image_encoder, normalised
from deepaccident_devkit.plugins.model.inputs import Handedness, ModelInputs
from deepaccident_devkit.plugins.model.lift import LiftConfig, LiftSplat
from deepaccident_devkit.plugins.model.motion import (
    MotionHead,
    MotionHeadConfig,
    MotionLossConfig,
    MotionOutputs,
    MotionTargets,
)
from deepaccident_devkit.plugins.model.pillars import PillarConfig, PillarEncoder
from deepaccident_devkit.plugins.model.temporal import TemporalConfig, temporal_model
from deepaccident_devkit.plugins.model.warps import agents_mask, features_to_ego
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.training.torch import V2XConfig
from deepaccident_devkit.v2x import Agents, Link

# Keys of encoders and decoders; the first two are the release's.
_DETECTION, _MOTION, _SHARED = "3dod", "motion", "shared"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """A model's processing of cameras.

    Attributes:
        images: Preparation of images; uint8.
        rows: Rows of the images after filling them with black at the bottom; None for no filling.
        encoder: Encoder of images.
        lift: Lift from image features to a map seen from above.
    """

    images: ImageConfig
    rows: int | None = None
    encoder: EncoderConfig
    lift: LiftConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """A V2XFormer; quirks of the release are fields of its parts.

    Attributes:
        cameras: Processing of cameras; None without cameras.
        pillars: Processing of LiDARs; None without LiDARs. The maps of both are joined.
        temporal: Join of an agent's own frames.
        fusion: Join of the agents.
        bev: Encoders before the heads.
        one_bev: Whether both heads share one encoder of the complete map; the release has one each.
        motion: The motion head.
        detection: The detection head.
        labels: Motion labels that it learns; their grid is the motion grid.
        handedness: Handedness of the model's frame, `left` in the release (`inputs`).
        motion_loss: Weights of the motion losses.
        detection_loss: Weights of the detection losses.
        targets: Rules for detection targets.
        decoding: Rules for reading boxes from detection maps.
    """

    # Sensors.
    cameras: CameraConfig | None = None
    pillars: PillarConfig | None = None
    # Joins of frames and agents.
    temporal: TemporalConfig
    fusion: FusionConfig
    # Encoders and heads.
    bev: BevEncodeConfig | BevUNetConfig
    one_bev: bool = False
    motion: MotionHeadConfig
    detection: DetectionConfig
    # Frame and labels.
    labels: MotionLabelConfig
    handedness: Handedness = "right"
    # Training and decoding.
    motion_loss: MotionLossConfig = field(default_factory=MotionLossConfig)
    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    decoding: DecodingConfig = field(default_factory=DecodingConfig)

    def __post_init__(self) -> None:
        """Check that the parts fit together; raises ConfigError."""
        cameras, pillars = self.cameras, self.pillars
        if cameras is None and pillars is None:
            raise ConfigError(
                "cameras, pillars: expected one of them or both; without, a model sees nothing"
            )
        channels = self.temporal.channels
        bev_channels = self.bev.out_channels
        future_frames = self.labels.future_frames
        frames = self.labels.receptive_field
        # Name, value, name of the value that it must equal, and this value.
        pairs: list[tuple[str, Any, str, Any]] = [
            ("bev.in_channels", self.bev.in_channels, "temporal.channels", channels),
            ("motion.in_channels", self.motion.in_channels, "bev.out_channels", bev_channels),
            ("detection.in_channels", self.detection.in_channels, "bev.out_channels", bev_channels),
            (
                "motion.future_frames",
                self.motion.future_frames,
                "labels.future_frames",
                future_frames,
            ),
            ("temporal.frames", self.temporal.frames, "labels.receptive_field", frames),
        ]
        if cameras is not None:
            dtype = cameras.images.dtype
            pairs += [
                ("images.dtype", dtype, "uint8, which the model scales itself", "uint8"),
                ("lift.channels", cameras.lift.channels, "temporal.channels", channels),
            ]
        if self.one_bev:
            extent, labels_extent = _extent(self.temporal.grid), _extent(self.labels.grid)
            pairs.append(("temporal.grid", extent, "the extent of labels.grid", labels_extent))
        if pillars is not None:
            pairs += [
                ("pillars.channels", pillars.channels, "temporal.channels", channels),
                ("pillars.grid", pillars.grid, "temporal.grid", self.temporal.grid),
            ]
        for name, value, expected_name, expected in pairs:
            if value != expected:
                raise ConfigError(
                    f"{name}: expected {expected!r}, as {expected_name}, found {value!r}"
                )

    @property
    def grid(self) -> BevGrid:
        """The cells of the fused maps."""
        return self.temporal.grid

    @property
    def horizon(self) -> float:
        """Seconds of motion that are predicted."""
        return self.labels.future_frames * self.labels.step * FRAME_PERIOD

    @property
    def labels_protocol(self) -> str | None:
        """The name of the labels' protocol, for results and evaluators; None for a custom one."""
        return self.labels.protocol if isinstance(self.labels.protocol, str) else None

    def inputs(self, agents: Agents, *, link: Link | None = None, **changes: Any) -> V2XConfig:
        """Return the config of a dataset with the model's inputs and nothing else.

        Args:
            agents: The cooperating agents.
            link: Degradation of the partners' data.
            **changes: Other fields of `V2XConfig`, such as fields of targets.
        """
        options: dict[str, Any] = {
            "images": None if self.cameras is None else self.cameras.images,
            "points": self.pillars is not None,
            "boxes": None,
            "on_missing": "skip",
            **changes,
        }
        past, step = self.labels.receptive_field, self.labels.step
        return V2XConfig(agents=agents, link=link, past=past, step=step, **options)


_Input = TypeVar("_Input")


class ModelPredictions(NamedTuple):
    """The outputs of the model for G egos.

    Attributes:
        motion: Maps of the present and the future frames, and the latent's distributions.
        detection: Maps of each detection task.
    """

    motion: MotionOutputs
    detection: list[TaskMaps]


class V2XFormer(nn.Module):
    """The model that a configuration describes; its state dict has the release's names.

    Attributes:
        config: The configuration.
        notes: Notes on its weights (`checkpoint.Weights.meta`).
    """

    notes: Mapping[str, Any]

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.notes = {}
        if config.cameras is not None:
            self.img_backbone, self.img_neck = image_encoder(config.cameras.encoder)
            self.transformer = LiftSplat(config.cameras.lift)
        if config.pillars is not None:
            self.pillars = PillarEncoder(config.pillars)
        if config.cameras is not None and config.pillars is not None:
            self.join = nn.Conv2d(2 * config.temporal.channels, config.temporal.channels, 1)
        self.temporal_model = temporal_model(config.temporal)
        self.v2x_fusion = fusion(config.fusion)
        self.pts_bbox_head = TaskHeads(config)

    def forward(
        self,
        inputs: ModelInputs,
        targets: MotionTargets | None = None,
        *,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> ModelPredictions:
        """Predict for each ego.

        Args:
            inputs: Inputs of B moments with A agents, G egos.
            targets: The egos' labels, for the posterior of a training step; None for a prediction.
            noise: Noise of the latents (`motion.MotionHead`); drawn if None.
            generator: Generator of the noise.
        """
        maps = self.fused(self.encoded(inputs), inputs)
        return self.pts_bbox_head(maps, targets, noise=noise, generator=generator)

    def encoded(self, inputs: ModelInputs) -> Tensor:
        """Return each agent's own map of the present, which it would send, (B, A, C, H, W).

        It is in the agent's own frame.
        """
        agents = inputs.frame_valid.shape[:2]
        maps = self.temporal_model(
            self._frame_maps(inputs),
            inputs.egomotion.flatten(0, 1),
            inputs.frame_valid.flatten(0, 1),
            inputs.bev_transform.repeat_interleave(agents[1], 0),
        )
        return maps.unflatten(0, agents)

    def _frame_maps(self, inputs: ModelInputs) -> Tensor:
        """Return the maps of all frames, each in its own frame, (B · A, P, C, H, W).

        Raises ConfigError if inputs are missing.
        """
        samples, frames = inputs.frame_valid.flatten(0, 1).shape
        maps: list[Tensor] = []
        cameras = self.config.cameras
        if cameras is not None:
            images = _required("images", inputs.images).flatten(0, 3)
            if not images.is_floating_point():
                images = normalised(images)
            if cameras.rows is not None:
                images = functional.pad(images, (0, 0, 0, cameras.rows - images.shape[-2]))
            features = self.img_neck(self.img_backbone(images)).unflatten(0, (samples, frames, -1))
            geometry = _required("images", inputs.cameras).flattened()
            maps.append(self.transformer(features, geometry))
        if self.config.pillars is not None:
            points = _required("points", inputs.points)
            point_frames = _required("points", inputs.point_frames)
            point_maps = self.pillars(points, point_frames, samples * frames)
            maps.append(point_maps.unflatten(0, (samples, frames)))
        if len(maps) == 1:
            return maps[0]
        return self.join(torch.cat(maps, 2).flatten(0, 1)).unflatten(0, (samples, frames))

    def fused(self, maps: Tensor, inputs: ModelInputs) -> Tensor:
        """Return one map of each ego, in its own frame, (G, C, H, W).

        Args:
            maps: Maps of `encoded`, shape (B, A, C, H, W).
            inputs: The same inputs, which have the egos' partners and poses.
        """
        moment, agent = inputs.ego_rows.unbind(1)
        order = _ego_first(inputs.partners, agent)
        rows, egos = moment[:, None], torch.arange(len(order), device=order.device)[:, None]
        heard, ego_from_agent = inputs.partners[egos, order], inputs.ego_from_agent[egos, order]
        grid, warp = self.config.temporal.grid, self.config.temporal.warp
        if self.v2x_fusion.hides_outside:
            mask = agents_mask(heard, ego_from_agent, grid, warp=warp)
        else:
            mask = heard[:, :, None, None].expand(*heard.shape, *maps.shape[-2:])
        return self.v2x_fusion(
            features_to_ego(maps[rows, order], ego_from_agent, grid, warp=warp),
            mask,
            inputs.is_infrastructure[rows, order],
            inputs.delay[rows, order],
        )

    def noise(self, egos: int, generator: torch.Generator) -> Tensor:
        """Draw the noise of a prediction, (draws, egos, latent, rows, columns).

        It is on the generator's device.
        """
        motion = self.config.motion
        cells = [-(-size // motion.upsample // 4) for size in self.config.labels.grid.shape]
        return torch.randn(
            motion.samples,
            egos,
            motion.latent,
            *cells,
            generator=generator,
            device=generator.device,
        )


class TaskHeads(nn.Module):
    """Crop, encoder and decoder of each task."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        kind = BevEncode if isinstance(config.bev, BevEncodeConfig) else BevUNet
        names = (_SHARED,) if config.one_bev else (_DETECTION, _MOTION)
        self.config = config
        self.taskfeat_encoders = nn.ModuleDict({name: kind(config.bev) for name in names})  # type: ignore[arg-type]
        self.task_decoders = nn.ModuleDict(
            {_DETECTION: CenterHead(config.detection), _MOTION: MotionHead(config.motion)}
        )

    def forward(
        self,
        fused: Tensor,
        targets: MotionTargets | None = None,
        *,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> ModelPredictions:
        """Predict from fused maps (G, C, H, W); other arguments as in `V2XFormer.forward`."""
        detection, motion = self._features(fused)
        return ModelPredictions(
            motion=self.task_decoders[_MOTION](motion, targets, noise=noise, generator=generator),
            detection=self.task_decoders[_DETECTION](detection),
        )

    def _features(self, fused: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features for detection and for motion."""
        config = self.config
        if config.one_bev:
            features = self.taskfeat_encoders[_SHARED](fused)
            return features, features
        motion_grid = config.labels.grid.with_orientation(config.grid.orientation)
        detection_features = self.taskfeat_encoders[_DETECTION](fused)
        motion_map = crop(fused, config.grid, motion_grid)
        return detection_features, self.taskfeat_encoders[_MOTION](motion_map)


def _extent(grid: BevGrid) -> tuple[float, ...]:
    """Return the start and the end of a grid along x and y."""
    return (*grid.x[:2], *grid.y[:2])


def _required(name: str, value: _Input | None) -> _Input:
    """Return an input that the model needs; raises ConfigError if there is none."""
    if value is None:
        raise ConfigError(
            f"inputs: have no {name}, which this model sees with; make items by its "
            "config.inputs(…)"
        )
    return value


def _ego_first(partners: Tensor, agent: Tensor) -> Tensor:
    """Return columns of agents for each ego, (G, A'): itself, heard agents, and others.

    The others fill rows up to the largest number of heard agents.
    """
    is_ego = torch.nn.functional.one_hot(agent, partners.shape[1])
    order = (2 * is_ego + partners.long()).argsort(dim=1, descending=True, stable=True)
    max_count = int((partners | is_ego.bool()).sum(1).max()) if len(partners) else 1
    return order[:, :max_count]
