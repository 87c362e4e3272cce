"""`MotionProtocol`: the choices of the motion metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Final

from deepaccident_devkit.evaluation.metrics.motion.overlaps import VpqRules
from deepaccident_devkit.evaluation.metrics.trajectories import GATE, TrajectoryRules
from deepaccident_devkit.motion import LABEL_PROTOCOLS, POST_PROCESSING, PostProcessing
from deepaccident_devkit.text import choice, settle_choices

RANGES: Final[Mapping[str, float]] = MappingProxyType({"30x30": 30.0, "100x100": 100.0})
"""Name, as the released code prints it → metres: side of a square around the ego in which IoU and VPQ are counted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionProtocol:
    """The choices of the motion metrics; the defaults are the released ones.

    Sources: docs/released_code.md, Post-processing, IoU and VPQ, and Paths.

    Attributes:
        labels: protocol of the labels that are the truth, by name; others are refused. None for any labels.
        instances: how instances are read off heads for VPQ.
        paths: how they are read off heads, and off labels, for minADE, minFDE and miss rate. The released code has
            these errors from the accident evaluation, which links and cuts out instances by other rules.
        vpq: which matches count.
        accelerating_paths: the released quirk of `trajectories.padded`.
        gate: metres, as of `match_trajectories`.
        trajectories: what is a miss, and a quirk.
        nothing_is_zero: IoU and VPQ of samples with nothing to count are 0; else NaN.
    """

    labels: str | None = "released"
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
