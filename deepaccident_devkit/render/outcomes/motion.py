"""Predicted instances against the true ones, frame by frame: found, false and missed, as trails."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from deepaccident_devkit.arrays import AnyArray, IntArray, ShortRepr
from deepaccident_devkit.evaluation.metrics.motion import MotionProtocol
from deepaccident_devkit.evaluation.metrics.motion.evaluator import RANGES, motion_protocol
from deepaccident_devkit.evaluation.metrics.motion.overlaps import vpq_matches
from deepaccident_devkit.evaluation.metrics.predictions import (
    MotionOutput,
    cells_within,
    frames_there,
    labels_at_present,
)
from deepaccident_devkit.motion import MotionLabels
from deepaccident_devkit.render.axes import axes_or_new, titled_from_above
from deepaccident_devkit.render.colors import BEYOND_COLOR, OUTCOME_COLORS
from deepaccident_devkit.render.layers import Layer, layers_of
from deepaccident_devkit.render.legends import draw_legend_of_fills
from deepaccident_devkit.render.motion_cells import draw_trail_of
from deepaccident_devkit.render.motion_maps import MotionMaps, maps_of_labels, maps_of_output
from deepaccident_devkit.render.styles import in_own_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Side = Literal["true", "predicted"]
MOTION_LAYERS: Final[tuple[Layer, ...]] = ("labels", "trajectories", "ids", "grid")
_SHOWN: Final[tuple[Layer, ...]] = ("labels", "trajectories", "grid")
_RIGHT, _WRONG, _UNCOUNTED = 1, 2, 3
_WORDS: Final[dict[Side, tuple[str, str]]] = {"true": ("found", "missed"), "predicted": ("right", "false")}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionOutcome(ShortRepr):
    """The true and the predicted instances of the evaluated frames, and which of them match.

    Attributes:
        true: the labels' instances.
        predicted: the last prediction's.
        matches: (N, 3) int64: frame from 0, predicted id and true id of the true positives.
        extent: metres: side of the square around the ego in which instances are matched, the protocol's widest.
    """

    true: MotionMaps
    predicted: MotionMaps
    matches: IntArray
    extent: float

    def outcomes(self, side: Side) -> AnyArray:
        """(T, H, W) 1 for instances matched in that frame, 2 for unmatched ones, 3 beyond the range, 0 elsewhere."""
        maps = self.true if side == "true" else self.predicted
        result = np.zeros(maps.instance.shape, dtype=np.int64)
        within = cells_within(maps.grid, self.extent)
        for frame, instance in enumerate(maps.instance):
            found = self.matches[self.matches[:, 0] == frame, 2 if side == "true" else 1]
            result[frame][instance > 0] = _UNCOUNTED
            result[frame][(instance > 0) & np.isin(instance, instance[within])] = _WRONG
            result[frame][np.isin(instance, found)] = _RIGHT
        return result

    def judged(self, side: Side, frame: int) -> dict[str, IntArray]:
        """Ids of a frame's instances by `right` and `false`, or of true ones by `right` and `missed`; not those beyond.

        The keys are those of `OUTCOME_COLORS`.
        """
        maps, kinds = (self.true if side == "true" else self.predicted).instance[frame], self.outcomes(side)[frame]
        named = {"right": _RIGHT, "missed" if side == "true" else "false": _WRONG}
        return {name: np.unique(maps[kinds == kind]).astype(np.int64) for name, kind in named.items()}


def motion_outcome(
    prediction: MotionOutput, label: MotionLabels, protocol: str | MotionProtocol = "released"
) -> MotionOutcome:
    """Which instances match by a motion protocol's VPQ, in its widest range.

    Args:
        prediction: a model's output; of several predictions the last one is taken.
        label: the truth on the same grid; frames in their own ego frames are warped to the present.
        protocol: name, or a protocol.

    Raises:
        ChoiceError: no such protocol.
        EvaluationError: the present is not recorded.
    """
    rules, frames = motion_protocol(protocol), frames_there(label)
    true = _cut(maps_of_labels(labels_at_present(label)), frames)
    predicted = maps_of_output(prediction, step=true.step, post_processing=rules.instances)
    predicted = _cut(predicted, frames)
    extent = max(RANGES.values())
    within = (slice(None), *cells_within(true.grid, extent))
    matches = vpq_matches(predicted.instance[within], true.instance[within], rules.vpq)
    return MotionOutcome(true=true, predicted=predicted, matches=matches, extent=extent)


@in_own_settings
def draw_motion_side(
    outcome: MotionOutcome, side: Side, *, layers: Iterable[Layer] | None = None, ax: Axes | None = None
) -> Axes:
    """Render `true` instances as found or missed, or `predicted` ones as right or false; later frames are paler.

    Args:
        outcome: from `motion_outcome`.
        side: which.
        layers: `labels` (the cells), `trajectories` and `grid` are the default; also `ids`.
        ax: axes to render on; new ones if None.

    Returns:
        The axes, in metres of the present ego frame; the title counts instances over all frames.

    Raises:
        ChoiceError: no such layer.
    """
    shown = layers_of(layers, _SHOWN, MOTION_LAYERS)
    ax = axes_or_new(ax, (6, 6.4))
    maps = outcome.true if side == "true" else outcome.predicted
    right, wrong = _WORDS[side]
    colors = {right: OUTCOME_COLORS["right"], wrong: OUTCOME_COLORS["missed" if side == "true" else "false"]}
    draw_trail_of(_recolored(maps, outcome.outcomes(side), [*colors.values()]), shown & {"labels"}, ax)
    draw_trail_of(_recolored(maps, maps.instance, []), shown - {"labels", "grid"}, ax)
    half = outcome.extent / 2
    ax.plot(np.array([-1, 1, 1, -1, -1]) * half, np.array([-1, -1, 1, 1, -1]) * half, ":", color="black", linewidth=0.8)
    draw_legend_of_fills(ax, colors)
    total = sum(np.unique(frame[frame > 0]).size for frame in _counted(maps, outcome.extent))
    found = len(outcome.matches)
    return titled_from_above(ax, f"{side} instances: {found} {right}, {total - found} {wrong}", grid="grid" in shown)


def _counted(maps: MotionMaps, extent: float) -> AnyArray:
    counted: AnyArray = maps.instance[(slice(None), *cells_within(maps.grid, extent))]
    return counted


def _cut(maps: MotionMaps, frames: int) -> MotionMaps:
    return replace(maps, valid=maps.valid[:frames], instance=maps.instance[:frames])


def _recolored(maps: MotionMaps, instance: AnyArray, colors: list[str]) -> MotionMaps:
    """The maps with other ids in their cells and a colour for each; without colours, for black paths."""
    from matplotlib.colors import to_rgb

    chosen = ["white", *colors, BEYOND_COLOR] if colors else ["white", *["black"] * int(instance.max(initial=0))]
    return replace(maps, instance=instance, colors=np.array([to_rgb(color) for color in chosen]), own=-1)
