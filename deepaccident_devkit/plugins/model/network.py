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
from deepaccident_devkit.plugins.model.images import EncoderConfig, image_encoder, normalise_images
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
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.training.torch import V2XConfig
from deepaccident_devkit.v2x import Agents, Link

# Keys of encoders and decoders; the first two are the release's.
_DETECTION = "3dod"
_MOTION = "motion"
_SHARED = "shared"
# Cells of the states along a cell of the latent.
_LATENT_STRIDE = 4

_Input = TypeVar("_Input")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """How a model processes cameras.

    Attributes:
        images: Preparation of images; uint8.
        rows: Rows of the images after padding them with black at the bottom; None for no padding.
        encoder: Encoder of images.
        lift: Lift from image features to a BEV map.
    """

    images: ImageConfig
    rows: int | None = None
    encoder: EncoderConfig
    lift: LiftConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """Sizes and rules of a V2XFormer; quirks of the release are fields of its parts.

    Attributes:
        cameras: Processing of cameras; None without cameras.
        pillars: Processing of LiDARs; None without LiDARs. A model with both merges their maps.
        temporal: Temporal model, which merges an agent's frames.
        fusion: Fusion of the agents' maps.
        bev: Encoders before the heads.
        one_bev: Whether both heads share one encoder of the complete map; in the release, each head
            has its own encoder.
        motion: The motion head.
        detection: The detection head.
        labels: Motion labels that the model learns; their grid is the motion grid.
        handedness: Handedness of the model's frame, `left` in the release (`inputs`).
        motion_loss: Weights of the motion losses.
        detection_loss: Weights of the detection losses.
        targets: Rules for detection targets.
        decoding: Rules for reading boxes from detection maps.
    """

    # Sensors.
    cameras: CameraConfig | None = None
    pillars: PillarConfig | None = None
    # Merging of frames and agents.
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
        """Raise ConfigError unless the parts fit together."""
        cameras = self.cameras
        pillars = self.pillars
        if cameras is None and pillars is None:
            raise ConfigError(
                "cameras, pillars: expected cameras, pillars or both, as a model "
                "without inputs sees nothing"
            )
        temporal = self.temporal
        labels = self.labels
        detection_channels = self.detection.in_channels
        future_frames = self.motion.future_frames
        bev_channels = ("bev.out_channels", self.bev.out_channels)
        temporal_channels = ("temporal.channels", temporal.channels)
        _check_equal("bev.in_channels", self.bev.in_channels, *temporal_channels)
        _check_equal("motion.in_channels", self.motion.in_channels, *bev_channels)
        _check_equal("detection.in_channels", detection_channels, *bev_channels)
        _check_equal(
            "motion.future_frames", future_frames, "labels.future_frames", labels.future_frames
        )
        _check_equal(
            "temporal.frames", temporal.frames, "labels.receptive_field", labels.receptive_field
        )
        if cameras is not None:
            dtype = cameras.images.dtype
            _check_equal("images.dtype", dtype, "uint8, which the model scales itself", "uint8")
            _check_equal("lift.channels", cameras.lift.channels, *temporal_channels)
        if self.one_bev:
            extent = _measure_extent(temporal.grid)
            labels_extent = _measure_extent(labels.grid)
            _check_equal("temporal.grid", extent, "the extent of labels.grid", labels_extent)
        if pillars is not None:
            _check_equal("pillars.channels", pillars.channels, *temporal_channels)
            _check_equal("pillars.grid", pillars.grid, "temporal.grid", temporal.grid)

    @property
    def grid(self) -> BevGrid:
        """The cells of the fused maps."""
        return self.temporal.grid

    @property
    def horizon(self) -> float:
        """Time over which motion is predicted, seconds."""
        labels = self.labels
        return labels.future_frames * labels.step * FRAME_PERIOD

    @property
    def labels_protocol(self) -> str | None:
        """The name of the labels' protocol, for results and evaluators; None for a custom one."""
        protocol = self.labels.protocol
        if isinstance(protocol, str):
            return protocol
        return None

    def inputs(self, agents: Agents, *, link: Link | None = None, **changes: Any) -> V2XConfig:
        """Return the config of a dataset that yields exactly the model's inputs.

        Args:
            agents: The cooperating agents.
            link: Degradation of the partners' data.
            **changes: Other fields of `V2XConfig`, such as fields of targets.
        """
        options: NamedValues = {
            "images": None,
            "points": self.pillars is not None,
            "boxes": None,
            "on_missing": "skip",
        }
        if self.cameras is not None:
            options["images"] = self.cameras.images
        options.update(changes)
        past = self.labels.receptive_field
        step = self.labels.step
        return V2XConfig(agents=agents, link=link, past=past, step=step, **options)


class ModelPredictions(NamedTuple):
    """The outputs of the model for G egos.

    Attributes:
        motion: Maps of the present and the future frames, and the latent's distributions.
        detection: Maps of each detection task.
    """

    motion: MotionOutputs
    detection: list[TaskMaps]


class V2XFormer(nn.Module):
    """The model that a configuration describes; its state-dict keys are the release's names.

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
            channels = config.temporal.channels
            self.join = nn.Conv2d(2 * channels, channels, 1)
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
        """Predict motion and boxes for each ego.

        Args:
            inputs: Inputs of B moments with A agents, G egos.
            targets: The egos' labels, for the posterior of a training step; None for a prediction.
            noise: Noise of the latents (`motion.MotionHead`); drawn if None.
            generator: Generator of the noise.
        """
        maps = self.fused(self.encoded(inputs), inputs)
        return self.pts_bbox_head(maps, targets, noise=noise, generator=generator)

    def encoded(self, inputs: ModelInputs) -> Tensor:
        """Return each agent's map of the present, which it would send, (B, A, C, H, W).

        Each map is in its agent's frame.
        """
        moments, agents, _ = inputs.frame_valid.shape
        frame_maps = self._map_frames(inputs)
        egomotion = inputs.egomotion.flatten(0, 1)
        frame_valid = inputs.frame_valid.flatten(0, 1)
        bev_transform = inputs.bev_transform.repeat_interleave(agents, 0)
        maps = self.temporal_model(frame_maps, egomotion, frame_valid, bev_transform)
        return maps.unflatten(0, (moments, agents))

    def _map_frames(self, inputs: ModelInputs) -> Tensor:
        """Return the maps of all frames, each in its own frame, (B · A, P, C, H, W).

        Raise ConfigError if the inputs lack images or points that the model needs.
        """
        frame_shape = inputs.frame_valid.flatten(0, 1).shape
        maps = []
        cameras = self.config.cameras
        if cameras is not None:
            images = _require("images", inputs.images).flatten(0, 3)
            if not images.is_floating_point():
                images = normalise_images(images)
            if cameras.rows is not None:
                black_rows = cameras.rows - images.shape[-2]
                images = functional.pad(images, (0, 0, 0, black_rows))
            features = self.img_neck(self.img_backbone(images))
            features = features.unflatten(0, (*frame_shape, -1))
            geometry = _require("images", inputs.cameras).flattened()
            maps.append(self.transformer(features, geometry))
        if self.config.pillars is not None:
            points = _require("points", inputs.points)
            point_frames = _require("points", inputs.point_frames)
            point_maps = self.pillars(points, point_frames, frame_shape.numel())
            maps.append(point_maps.unflatten(0, frame_shape))
        if len(maps) == 1:
            return maps[0]
        sensor_maps = torch.cat(maps, 2).flatten(0, 1)
        return self.join(sensor_maps).unflatten(0, frame_shape)

    def fused(self, maps: Tensor, inputs: ModelInputs) -> Tensor:
        """Return one map of each ego, in its own frame, (G, C, H, W).

        Args:
            maps: Maps from `encoded`, shape (B, A, C, H, W).
            inputs: Inputs that `encoded` had; they contain the egos' partners and poses.
        """
        moment, ego_agent = inputs.ego_rows.unbind(1)
        moment = moment[:, None]
        agents = _order_agents(inputs.partners, ego_agent)
        ego = torch.arange(len(agents), device=agents.device)[:, None]
        is_partner = inputs.partners[ego, agents]
        ego_from_agent = inputs.ego_from_agent[ego, agents]
        grid = self.config.temporal.grid
        warp = self.config.temporal.warp
        if self.v2x_fusion.hides_outside:
            mask = agents_mask(is_partner, ego_from_agent, grid, warp=warp)
        else:
            mask = is_partner[:, :, None, None].expand(-1, -1, *maps.shape[-2:])
        agent_maps = features_to_ego(maps[moment, agents], ego_from_agent, grid, warp=warp)
        is_infrastructure = inputs.is_infrastructure[moment, agents]
        delay = inputs.delay[moment, agents]
        return self.v2x_fusion(agent_maps, mask, is_infrastructure, delay)

    def noise(self, egos: int, generator: torch.Generator) -> Tensor:
        """Draw the noise of a prediction, (draws, egos, latent, rows, columns).

        It is on the generator's device.
        """
        motion = self.config.motion
        latent_shape = []
        for label_cells in self.config.labels.grid.shape:
            # Both divisions together are rounded up.
            latent_shape.append(-(-label_cells // motion.upsample // _LATENT_STRIDE))
        shape = (motion.samples, egos, motion.latent, *latent_shape)
        return torch.randn(shape, generator=generator, device=generator.device)


class TaskHeads(nn.Module):
    """Crop, encoder and decoder of each task."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        self.taskfeat_encoders = nn.ModuleDict()
        names = (_SHARED,) if config.one_bev else (_DETECTION, _MOTION)
        for name in names:
            if isinstance(config.bev, BevEncodeConfig):
                self.taskfeat_encoders[name] = BevEncode(config.bev)
            else:
                self.taskfeat_encoders[name] = BevUNet(config.bev)
        detection_head = CenterHead(config.detection)
        motion_head = MotionHead(config.motion)
        self.task_decoders = nn.ModuleDict({_DETECTION: detection_head, _MOTION: motion_head})

    def forward(
        self,
        fused: Tensor,
        targets: MotionTargets | None = None,
        *,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> ModelPredictions:
        """Predict from fused maps (G, C, H, W); other arguments as in `V2XFormer.forward`."""
        detection_features, motion_features = self._encode_tasks(fused)
        motion_head = self.task_decoders[_MOTION]
        motion = motion_head(motion_features, targets, noise=noise, generator=generator)
        detection = self.task_decoders[_DETECTION](detection_features)
        return ModelPredictions(motion, detection)

    def _encode_tasks(self, fused: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features for detection and for motion."""
        config = self.config
        if config.one_bev:
            features = self.taskfeat_encoders[_SHARED](fused)
            return features, features
        motion_grid = config.labels.grid.with_orientation(config.grid.orientation)
        detection_features = self.taskfeat_encoders[_DETECTION](fused)
        motion_map = crop(fused, config.grid, motion_grid)
        return detection_features, self.taskfeat_encoders[_MOTION](motion_map)


def _check_equal(name: str, value: Any, expected_name: str, expected: Any) -> None:
    """Raise ConfigError unless a value equals the one that another part of the config expects."""
    if value != expected:
        raise ConfigError(f"{name}: expected {expected!r}, as {expected_name}, found {value!r}")


def _measure_extent(grid: BevGrid) -> tuple[float, ...]:
    """Return the start and the end of a grid along x and along y."""
    x_start, x_end, _ = grid.x
    y_start, y_end, _ = grid.y
    return x_start, x_end, y_start, y_end


def _require(name: str, value: _Input | None) -> _Input:
    """Return an input that the model needs; raise ConfigError if it is None."""
    if value is None:
        raise ConfigError(
            f"inputs: have no {name}, which this model needs; make items with its config.inputs(…)"
        )
    return value


def _order_agents(partners: Tensor, ego_agent: Tensor) -> Tensor:
    """Order the agents of each ego, (G, A'): itself, the ones that it hears, and then others.

    The others fill the rows up to the largest number of agents that an ego hears.

    Args:
        partners: Whether each ego hears each agent, shape (G, A).
        ego_agent: Agent that each ego is, shape (G,).
    """
    is_ego = functional.one_hot(ego_agent, partners.shape[1])
    priority = 2 * is_ego + partners.long()
    agents = priority.argsort(dim=1, descending=True, stable=True)
    max_count = 1
    if len(partners):
        max_count = int((priority > 0).sum(1).max())
    return agents[:, :max_count]
