"""`ModelConfig`, all that a model is made of, and `V2XFormer`: what all agents see → the ego's future maps, boxes.

| step | from → to | where |
|---|---|---|
| the devkit's batch | tensors in the model's frame | `inputs` |
| images | features of each image | `images` |
| lift | features → a map from above, each frame of each agent | `lift` |
| pillars | LiDAR points → the same, where a model has both joined with it | `pillars` |
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


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """How a model sees with cameras.

    Attributes:
        images: how images are prepared; uint8.
        rows: of the images, once they are filled with black at the bottom; None for as they are.
        encoder: of images.
        lift: from image features to a map seen from above.
    """

    images: ImageConfig
    rows: int | None = None
    encoder: EncoderConfig
    lift: LiftConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """A V2XFormer; quirks of the release are fields of its parts.

    Attributes:
        cameras: how it sees with cameras; None for not at all.
        pillars: how it sees with LiDARs; None for not at all. The maps of both are joined.
        temporal: joins an agent's own frames.
        fusion: joins the agents.
        bev: the encoders before the heads.
        one_bev: whether both heads share one encoder, of the whole map; the release has one each.
        motion: the motion head.
        detection: the detection head.
        labels: the motion labels that it learns; their grid is the motion grid.
        handedness: of the model's frame, `left` in the release (`inputs`).
        motion_loss: weights of the motion losses.
        detection_loss: of the detection losses.
        targets: how detection targets are made.
        decoding: from detection maps to boxes.
    """

    cameras: CameraConfig | None = None
    pillars: PillarConfig | None = None
    temporal: TemporalConfig
    fusion: FusionConfig
    bev: BevEncodeConfig | BevUNetConfig
    one_bev: bool = False
    motion: MotionHeadConfig
    detection: DetectionConfig
    labels: MotionLabelConfig
    handedness: Handedness = "right"
    motion_loss: MotionLossConfig = field(default_factory=MotionLossConfig)
    detection_loss: DetectionLossConfig = field(default_factory=DetectionLossConfig)
    targets: TargetConfig = field(default_factory=TargetConfig)
    decoding: DecodingConfig = field(default_factory=DecodingConfig)

    def __post_init__(self) -> None:
        """Check what parts have to have in common; raises ConfigError."""
        cameras, pillars, channels = self.cameras, self.pillars, self.temporal.channels
        if cameras is None and pillars is None:
            raise ConfigError(
                "cameras, pillars: expected one of them or both; without, a model sees nothing"
            )
        pairs: list[tuple[str, Any, str, Any]] = [
            ("bev.in_channels", self.bev.in_channels, "temporal.channels", channels),
            (
                "motion.in_channels",
                self.motion.in_channels,
                "bev.out_channels",
                self.bev.out_channels,
            ),
            (
                "detection.in_channels",
                self.detection.in_channels,
                "bev.out_channels",
                self.bev.out_channels,
            ),
            (
                "motion.future_frames",
                self.motion.future_frames,
                "labels.future_frames",
                self.labels.future_frames,
            ),
            (
                "temporal.frames",
                self.temporal.frames,
                "labels.receptive_field",
                self.labels.receptive_field,
            ),
        ]
        if cameras is not None:
            pairs += [
                (
                    "images.dtype",
                    cameras.images.dtype,
                    "uint8, which the model scales itself",
                    "uint8",
                ),
                ("lift.channels", cameras.lift.channels, "temporal.channels", channels),
            ]
        if self.one_bev:
            pairs.append(
                (
                    "temporal.grid",
                    _extent(self.temporal.grid),
                    "the extent of labels.grid",
                    _extent(self.labels.grid),
                )
            )
        if pillars is not None:
            pairs += [
                ("pillars.channels", pillars.channels, "temporal.channels", channels),
                ("pillars.grid", pillars.grid, "temporal.grid", self.temporal.grid),
            ]
        for name, found, other, expected in pairs:
            if found != expected:
                raise ConfigError(f"{name}: expected {expected!r}, as {other}, found {found!r}")

    @property
    def grid(self) -> BevGrid:
        """The cells of the maps that are fused."""
        return self.temporal.grid

    @property
    def horizon(self) -> float:
        """Seconds that motion is predicted."""
        return self.labels.future_frames * self.labels.step * FRAME_PERIOD

    @property
    def labels_protocol(self) -> str | None:
        """The name of the labels' protocol, for results and evaluators; None for one of one's own."""
        return self.labels.protocol if isinstance(self.labels.protocol, str) else None

    def inputs(self, agents: Agents, *, link: Link | None = None, **changes: Any) -> V2XConfig:
        """What an item of a dataset needs for the model's inputs alone.

        Args:
            agents: who cooperates.
            link: what happens to the partners' data.
            changes: other fields of `V2XConfig`, such as those of targets.
        """
        seen = {
            "images": None if self.cameras is None else self.cameras.images,
            "points": self.pillars is not None,
        }
        given: dict[str, Any] = {**seen, "boxes": None, "on_missing": "skip", **changes}
        past, step = self.labels.receptive_field, self.labels.step
        return V2XConfig(agents=agents, link=link, past=past, step=step, **given)


_Input = TypeVar("_Input")
# Keys of encoders and decoders; the first two are the release's.
_DETECTION, _MOTION, _BOTH = "3dod", "motion", "shared"


class ModelPredictions(NamedTuple):
    """What the model says for G egos.

    Attributes:
        motion: maps of the present and the future frames, and the latent's distributions.
        detection: maps of each detection task.
    """

    motion: MotionOutputs
    detection: list[TaskMaps]


class V2XFormer(nn.Module):
    """The model that a configuration describes; its state dict has the release's names.

    Attributes:
        config: what it was made of.
        notes: what is known of its weights (`checkpoint.Weights.meta`).
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
            inputs: of B moments with A agents, G egos.
            targets: the egos' labels, for the posterior of a training step; None for a prediction.
            noise: of the latents (`motion.MotionHead`); drawn if None.
            generator: draws it.
        """
        return self.pts_bbox_head(
            self.fused(self.encoded(inputs), inputs), targets, noise=noise, generator=generator
        )

    def encoded(self, inputs: ModelInputs) -> Tensor:
        """Each agent's own map (B, A, C, H, W) of the present, in its own frame: what it would send."""
        agents = inputs.frame_valid.shape[:2]
        maps = self.temporal_model(
            self._seen(inputs),
            inputs.egomotion.flatten(0, 1),
            inputs.frame_valid.flatten(0, 1),
            inputs.bev_transform.repeat_interleave(agents[1], 0),
        )
        return maps.unflatten(0, agents)

    def _seen(self, inputs: ModelInputs) -> Tensor:
        """The maps (B · A, P, C, H, W) of all frames, each in its own; raises ConfigError if inputs lack something."""
        samples, frames = inputs.frame_valid.flatten(0, 1).shape
        seen: list[Tensor] = []
        if (cameras := self.config.cameras) is not None:
            images = _given("images", inputs.images).flatten(0, 3)
            if not images.is_floating_point():
                images = normalised(images)
            if cameras.rows is not None:
                images = functional.pad(images, (0, 0, 0, cameras.rows - images.shape[-2]))
            features = self.img_neck(self.img_backbone(images)).unflatten(0, (samples, frames, -1))
            seen.append(self.transformer(features, _given("images", inputs.cameras).flattened()))
        if self.config.pillars is not None:
            points, frame = _given("points", inputs.points), _given("points", inputs.point_frames)
            seen.append(
                self.pillars(points, frame, samples * frames).unflatten(0, (samples, frames))
            )
        if len(seen) == 1:
            return seen[0]
        return self.join(torch.cat(seen, 2).flatten(0, 1)).unflatten(0, (samples, frames))

    def fused(self, maps: Tensor, inputs: ModelInputs) -> Tensor:
        """One map (G, C, H, W) of each ego, in its own frame.

        Args:
            maps: (B, A, C, H, W) of `encoded`.
            inputs: who hears whom, and from where.
        """
        moment, agent = inputs.ego_rows.unbind(1)
        order = _ego_first(inputs.partners, agent)
        rows, egos = moment[:, None], torch.arange(len(order), device=order.device)[:, None]
        heard, ego_from_agent = inputs.partners[egos, order], inputs.ego_from_agent[egos, order]
        grid, warp = self.config.temporal.grid, self.config.temporal.warp
        mask = (
            agents_mask(heard, ego_from_agent, grid, warp=warp)
            if self.v2x_fusion.hides_outside
            else heard[:, :, None, None].expand(*heard.shape, *maps.shape[-2:])
        )
        return self.v2x_fusion(
            features_to_ego(maps[rows, order], ego_from_agent, grid, warp=warp),
            mask,
            inputs.is_infrastructure[rows, order],
            inputs.delay[rows, order],
        )

    def noise(self, egos: int, generator: torch.Generator) -> Tensor:
        """What the draws of a prediction need, (draws, egos, latent, rows, columns), on the generator's device."""
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
        names = (_BOTH,) if config.one_bev else (_DETECTION, _MOTION)
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
        """The predictions from fused maps (G, C, H, W); the other arguments are those of `V2XFormer.forward`."""
        detection, motion = self._features(fused)
        return ModelPredictions(
            motion=self.task_decoders[_MOTION](motion, targets, noise=noise, generator=generator),
            detection=self.task_decoders[_DETECTION](detection),
        )

    def _features(self, fused: Tensor) -> tuple[Tensor, Tensor]:
        config = self.config
        if config.one_bev:
            both = self.taskfeat_encoders[_BOTH](fused)
            return both, both
        motion_grid = config.labels.grid.with_orientation(config.grid.orientation)
        return (
            self.taskfeat_encoders[_DETECTION](fused),
            self.taskfeat_encoders[_MOTION](crop(fused, config.grid, motion_grid)),
        )


def _extent(grid: BevGrid) -> tuple[float, ...]:
    """Where a grid begins and ends along x and y."""
    return (*grid.x[:2], *grid.y[:2])


def _given(name: str, value: _Input | None) -> _Input:
    """An input that the model sees with; raises ConfigError if there is none."""
    if value is None:
        raise ConfigError(
            f"inputs: have no {name}, which this model sees with; make items by its config.inputs(…)"
        )
    return value


def _ego_first(partners: Tensor, agent: Tensor) -> Tensor:
    """For each ego, columns of agents (G, A'): itself, those that it hears, and others to fill up to the most heard."""
    own = torch.nn.functional.one_hot(agent, partners.shape[1])
    order = (2 * own + partners.long()).argsort(dim=1, descending=True, stable=True)
    most = int((partners | own.bool()).sum(1).max()) if len(partners) else 1
    return order[:, :most]
