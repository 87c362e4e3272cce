"""`MotionProtocol`: the choices of the motion metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

from deepaccident_devkit.evaluation.metrics.choices import with_others, with_parts
from deepaccident_devkit.evaluation.metrics.motion.overlaps import VpqRules
from deepaccident_devkit.evaluation.metrics.trajectories import GATE, TrajectoryRules
from deepaccident_devkit.motion import LABEL_PROTOCOLS, POST_PROCESSING, PostProcessing
from deepaccident_devkit.text import choice, settle_choices


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionProtocol:
    """The choices of the motion metrics; the defaults are the released ones.

    Sources: docs/released_code.md, Post-processing, IoU and VPQ, and Paths.

    Attributes:
        labels: protocol of the labels that are the truth, by name; others are refused. None for any labels.
        ranges: metres: sides of the squares around the ego in which IoU and VPQ are counted.
        instances: how instances are read off heads for VPQ.
        paths: how they are read off heads, and off labels, for minADE, minFDE and miss rate. The released code has
            these errors from the accident evaluation, which links and cuts out instances by other rules.
        vpq: which matches count.
        accelerating_paths: the released quirk of `trajectories.padded`.
        gate: metres, as of `match_trajectories`.
        trajectories: limits of the errors, and a quirk.
        nothing_is_zero: IoU and VPQ of samples with nothing to count are 0; else NaN.
    """

    labels: str | None = "released"
    ranges: tuple[float, ...] = (30.0, 100.0)
    instances: PostProcessing = POST_PROCESSING["motion"]
    paths: PostProcessing = field(default_factory=lambda: replace(POST_PROCESSING["accident"], redraw=False))
    vpq: VpqRules = field(default_factory=VpqRules)
    accelerating_paths: bool = True
    gate: float = GATE
    trajectories: TrajectoryRules = field(default_factory=TrajectoryRules)
    nothing_is_zero: bool = True

    def __post_init__(self) -> None:
        """Check the values; raises ChoiceError."""
        settle_choices(self, {"labels": (None, *LABEL_PROTOCOLS)})

    @property
    def range_names(self) -> tuple[str, ...]:
        """As the released code prints them: `30x30`, `100x100`."""
        return tuple(f"{extent:g}x{extent:g}" for extent in self.ranges)

    def variants(self) -> dict[str, MotionProtocol]:
        """These metrics with one choice changed, by `name=value`; for explanations.

        Those of a part have its name before theirs: `paths.link_distance=10.0`. Labels are no choice of the metrics:
        where those of other protocols are the truth, the truth is another one.
        """
        reading = {
            "foreground": ("argmax", "sigmoid"),
            "center_threshold": (0.1, 0.3),
            "max_centers": (20, 100),
            "scan": ("released", "fiery"),
            "link_distance": (3.0, 8.0, 10.0),
        }
        own: Mapping[str, tuple[Any, ...]] = {
            "accelerating_paths": (False, True),
            "gate": (2.0, GATE, math.inf),
            "nothing_is_zero": (False, True),
        }
        return {
            **self._part_variants("vpq", {"ids_must_stay": (False, True)}),
            **self._part_variants("instances", reading),
            **self._part_variants("paths", {**reading, "labels_bypass_sigmoid": (False, True)}),
            **with_others(self, own),
            **self._part_variants("trajectories", _TRAJECTORY_CHOICES),
        }

    def _part_variants(self, part: str, others: Mapping[str, Sequence[Any]]) -> dict[str, MotionProtocol]:
        return with_parts(self, part, with_others(getattr(self, part), others))


_TRAJECTORY_CHOICES: Final[Mapping[str, tuple[Any, ...]]] = {
    "ade_limit": (8.0, math.inf),
    "fde_limit": (10.0, math.inf),
    "miss_distance": (2.0, 5.0),
    "first_prediction_empty_ends": (False, True),
}
MOTION_PROTOCOLS: Final[Mapping[str, MotionProtocol]] = MappingProxyType(
    {"released": MotionProtocol(), "paper": MotionProtocol(nothing_is_zero=False)}
)
"""What the released code computes. The paper's text says no more of these metrics than their names, FIERY's and the
ranges: so `paper` is the released code, except that a number with nothing to count is NaN and not 0."""


def motion_protocol(protocol: str | MotionProtocol) -> MotionProtocol:
    """A protocol by its name, or as it is given; raises ChoiceError."""
    if isinstance(protocol, MotionProtocol):
        return protocol
    return MOTION_PROTOCOLS[choice("protocol", protocol, MOTION_PROTOCOLS)]
