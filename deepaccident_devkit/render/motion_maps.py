"""`MotionMaps`: what pictures show of motion, in one form for labels and for predictions."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray, FloatArray, FrozenArrays
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.predictions import MotionOutput
from deepaccident_devkit.evaluation.metrics.trajectories import instance_paths
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    OWN_BOX_ID,
    MotionHeads,
    MotionLabels,
    PostProcessing,
    predict_instances,
)
from deepaccident_devkit.motion.orientations import to_orientation
from deepaccident_devkit.render.colors import COLLIDER_COLOR, INSTANCE_COLORS, OWN_COLOR
from deepaccident_devkit.taxonomy import FRAME_PERIOD, OWN_ACTOR_ID

DrawnMap = Literal["instance", "centerness", "offset", "flow"]
MAPS: Final[tuple[DrawnMap, ...]] = get_args(DrawnMap)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MotionMaps(FrozenArrays):
    """Motion of T frames as it is rendered: rows of cells along y left, columns along x forward; arrays are read-only.

    Attributes:
        grid: the cells, in the devkit's orientation.
        step: seconds from frame to frame.
        at_present: whether all frames are in the present ego frame; if not, each is in its own.
        valid: (T,) bool: which frames exist.
        instance: (T, H, W) ids from 1, 0 elsewhere and in frames that do not exist.
        colors: (1 + ids, 3) red, green, blue of each id; white of 0.
        own: the id of the ego's own box; −1 if it is not known.
        centerness: (T, H, W) in [0, 1]; None if there are only instances.
        offset: (T, 2, H, W) cells to the left and forward, NaN outside instances; None if there are only instances.
        flow: (T, 2, H, W) as the offset; NaN also where it is not known.
    """

    grid: BevGrid
    step: float
    at_present: bool
    valid: BoolArray
    instance: AnyArray
    colors: FloatArray
    own: int = -1
    centerness: AnyArray | None = None
    offset: AnyArray | None = None
    flow: AnyArray | None = None

    @property
    def names(self) -> tuple[DrawnMap, ...]:
        """The names of the maps that are not None."""
        return tuple(name for name in MAPS if getattr(self, name) is not None)

    def vectors(self, name: DrawnMap) -> AnyArray:
        """`offset` or `flow`, (T, 2, H, W); raises ChoiceError if it is not there."""
        maps = getattr(self, name)
        if maps is None:
            raise ChoiceError(f"map: this prediction has only {', '.join(self.names)}, not {name}; give heads for it")
        chosen: AnyArray = maps
        return chosen

    def longest(self, name: DrawnMap) -> float:
        """The length of a map's longest vector in all frames, in cells, at least 1; 1 for maps without vectors."""
        if name not in ("offset", "flow"):
            return 1.0
        length = np.linalg.norm(self.vectors(name), axis=1)
        return max(1.0, float(np.nan_to_num(length).max(initial=0)))

    def paths(self) -> dict[int, FloatArray]:
        """Where the instances of the first frame go: id → (n, 2) x forward, y left, metres."""
        return instance_paths(self.instance[self.valid], self.grid) if self.valid[0] else {}


def maps_of_labels(labels: MotionLabels, marked: Collection[int] = ()) -> MotionMaps:
    """Labels as they are rendered; actors whose label ids are `marked` (the ego itself: −100) are red."""
    source, ignore = labels.config.grid.orientation, labels.config.ignore_index
    valid = labels.label_valid

    def lying(name: str, *, vectors: bool = False) -> AnyArray:
        return to_orientation(getattr(labels, name), vectors=vectors, source=source, target="devkit", ignore=ignore)

    instance = np.where(valid[:, None, None], lying("instance"), 0)
    known = instance[:, None] > 0
    offset, flow = (
        np.where(known & (maps != ignore).any(axis=1, keepdims=True), maps, np.nan)
        for maps in (lying("offset", vectors=True), lying("flow", vectors=True))
    )
    return MotionMaps(
        grid=labels.config.grid.with_orientation("devkit"),
        step=labels.config.step * FRAME_PERIOD,
        at_present=labels.at_present,
        valid=valid,
        instance=instance,
        colors=_label_colors(labels, instance, marked),
        own=labels.id_map.get(OWN_BOX_ID, -1),
        centerness=lying("centerness")[:, 0],
        offset=offset,
        flow=flow,
    )


def maps_of_output(
    output: MotionOutput,
    *,
    number: int = -1,
    step: float = 0.5,
    marked: Collection[int] = (),
    post_processing: PostProcessing | str = "motion",
) -> MotionMaps:
    """One prediction as it is rendered.

    Args:
        output: a model's output.
        number: which of its predictions; the last is the mean, in the released order.
        step: seconds from frame to frame.
        marked: ids of instances that are red.
        post_processing: how instances are found in heads.

    Raises:
        ChoiceError: no such prediction, or no such post-processing.
    """
    if number not in range(-len(output), len(output)):
        raise ChoiceError(f"prediction: expected a number from 0 to {len(output) - 1}, or from the end, found {number}")
    grid, heads = output.grid.with_orientation("devkit"), None if output.heads is None else output.heads[number]
    instance = _found(output, heads, number, post_processing)
    instance = np.maximum(output.grid.reorient(instance, "devkit"), 0)
    more = {} if heads is None else _head_maps(heads, instance)
    return MotionMaps(
        grid=grid,
        step=step,
        at_present=True,
        valid=np.ones(len(instance), dtype=bool),
        instance=instance,
        colors=_palette(int(instance.max(initial=0)), marked),
        centerness=more.get("centerness"),
        offset=more.get("offset"),
        flow=more.get("flow"),
    )


def _found(
    output: MotionOutput, heads: MotionHeads | None, number: int, post_processing: PostProcessing | str
) -> AnyArray:
    """(T, H, W) the instances of one prediction, in its own orientation."""
    if output.instances is not None:
        given: AnyArray = output.instances[number]
        return given
    if heads is None:  # only for the type checker: an output has one of them
        raise ChoiceError("prediction: has neither heads nor instances")
    return predict_instances(heads, post_processing).instance


def _head_maps(heads: MotionHeads, instance: AnyArray) -> dict[str, AnyArray]:
    lying = heads.in_orientation("devkit")
    ignored = [] if lying.ignore_index is None else [lying.ignore_index]
    known = instance[:, None] > 0
    offset, flow = (
        np.where(known & ~np.isin(maps, ignored).all(axis=1, keepdims=True), maps, np.nan)
        for maps in (lying.offset, lying.flow)
    )
    return {"centerness": lying.centerness[:, 0], "offset": offset, "flow": flow}


def _label_colors(labels: MotionLabels, instance: AnyArray, marked: Collection[int]) -> FloatArray:
    """The palette with red for marked actors, and a dark colour for the ego's own box if it is not marked."""
    from matplotlib.colors import to_rgb

    highest = max([int(instance.max(initial=0)), *labels.id_map.values()])
    named = {OWN_ACTOR_ID if actor == OWN_BOX_ID else actor: identity for actor, identity in labels.id_map.items()}
    colors = _palette(highest, [identity for actor, identity in named.items() if actor in marked])
    if OWN_ACTOR_ID in named and OWN_ACTOR_ID not in marked:
        colors[named[OWN_ACTOR_ID]] = to_rgb(OWN_COLOR)
    return colors


def _palette(highest: int, marked: Collection[int]) -> FloatArray:
    """(1 + ids, 3) white for the background, a colour of the palette for each id, red for some."""
    from matplotlib.colors import to_rgb

    shades = [to_rgb(color) for color in INSTANCE_COLORS]
    colors = np.array([shades[number % len(shades)] for number in range(1 + highest)])
    colors[0] = 1.0
    for identity in marked:
        if 0 < identity <= highest:
            colors[identity] = to_rgb(COLLIDER_COLOR)
    return colors
