"""`ModelConfig`: all that a model is made of. The presets are in `presets`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.export.images import ImageConfig
from deepaccident_devkit.export.torch import V2XConfig
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.model.bev import BevEncodeConfig, BevUNetConfig
from deepaccident_devkit.model.detection import DecodingConfig, DetectionConfig, DetectionLossConfig, TargetConfig
from deepaccident_devkit.model.entry import Handedness
from deepaccident_devkit.model.fusion import FusionConfig
from deepaccident_devkit.model.images import EncoderConfig
from deepaccident_devkit.model.lift import LiftConfig
from deepaccident_devkit.model.motion import MotionHeadConfig, MotionLossConfig
from deepaccident_devkit.model.temporal import TemporalConfig
from deepaccident_devkit.motion import MotionLabelConfig
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x import Agents, Link


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelConfig:
    """A V2XFormer; quirks of the release are fields of its parts.

    Attributes:
        images: how images are prepared; uint8.
        rows: of the images, once they are filled with black at the bottom; None for as they are.
        encoder: of images.
        lift: from image features to a map seen from above.
        temporal: joins an agent's own frames.
        fusion: joins the agents.
        bev: the encoders before the heads.
        one_bev: whether both heads share one encoder; the release has one each.
        motion: the motion head.
        detection: the detection head.
        labels: the motion labels that it learns; their grid is the motion grid.
        handedness: of the model's frame, `left` in the release (`entry`).
        motion_loss: weights of the motion losses.
        detection_loss: of the detection losses.
        targets: how detection targets are made.
        decoding: from detection maps to boxes.
    """

    images: ImageConfig
    rows: int | None = None
    encoder: EncoderConfig
    lift: LiftConfig
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
        pairs = (
            ("images.dtype", self.images.dtype, "uint8, which the model scales itself", "uint8"),
            ("temporal.channels", self.temporal.channels, "lift.channels", self.lift.channels),
            ("bev.in_channels", self.bev.in_channels, "lift.channels", self.lift.channels),
            ("motion.in_channels", self.motion.in_channels, "bev.out_channels", self.bev.out_channels),
            ("detection.in_channels", self.detection.in_channels, "bev.out_channels", self.bev.out_channels),
            ("motion.future_frames", self.motion.future_frames, "labels.future_frames", self.labels.future_frames),
            ("temporal.frames", self.temporal.frames, "labels.receptive_field", self.labels.receptive_field),
        )
        for name, found, other, expected in pairs:
            if found != expected:
                raise ConfigError(f"{name}: expected {expected!r}, as {other}, found {found!r}")

    @property
    def grid(self) -> BevGrid:
        """The cells of the maps that are fused."""
        return BevGrid(x=self.temporal.grid.x, y=self.temporal.grid.y)

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
        given: dict[str, Any] = {"points": False, "boxes": None, "on_missing": "skip", **changes}
        past, step = self.labels.receptive_field, self.labels.step
        return V2XConfig(agents=agents, link=link, past=past, step=step, images=self.images, **given)
