"""Instance maps of motion labels and predictions, as coloured points: one point for each cell of an actor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from deepaccident_devkit.arrays import AnyArray, BoolArray
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.mcap.messages import COLORED_POINT, cloud_message, frame_id, rgb
from deepaccident_devkit.export.mcap.moment import Moment
from deepaccident_devkit.export.mcap.recording import Recording
from deepaccident_devkit.export.mcap.roles import Roles
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import OWN_BOX_ID, MotionLabelConfig, motion_labels
from deepaccident_devkit.render.colors import AGENT_COLORS, COLLIDER_COLOR, INSTANCE_COLORS

CELL_POINT: Final = np.dtype(
    [*((name, COLORED_POINT[name].str) for name in COLORED_POINT.names or ()), ("instance", "<i4"), ("frame", "<i4")]
)
"""A point of a map: `instance` is the map's id, `frame` counts from 0, the present."""
FRAME_HEIGHT: Final = 0.2
"""Metres from each future frame up to the next one, so that no frame hides another."""
_FADING: Final = 0.6
"""The share of its opacity that an instance has lost at the last frame."""


class MotionMaps:
    """Renders the motion labels of moments in the agents' ego frames."""

    def __init__(self, dataset: Dataset, scenario: str, config: MotionLabelConfig) -> None:
        """Prepare the labels of a scenario."""
        self._dataset, self._config = dataset, config
        self._roles = Roles(dataset, scenario)

    def write(self, moment: Moment, recording: Recording) -> None:
        """Write the motion labels of the samples of a moment that have labels."""
        for agent, sample in moment.samples.items():
            record = self._dataset.get("sample", sample)
            if record["labelled"]:
                own = self._dataset.get("agent", record["agent_token"])["actor_id"]
                points = self._points(sample, agent, own)
                message = cloud_message(points, frame_id(agent, "ego"), moment.index)
                recording.write(f"/{agent}/motion_labels/points", message, moment.index)

    def _points(self, sample: str, agent: str, own_actor: int | None) -> AnyArray:
        labels = motion_labels(self._dataset, sample, self._config).to_present()
        actors = {own_actor if actor == OWN_BOX_ID else actor: name for actor, name in labels.id_map.items()}
        colors = {name: AGENT_COLORS[agent] for actor, name in labels.id_map.items() if actor == OWN_BOX_ID}
        for actor, name in actors.items():
            if actor in self._roles.pair:
                colors[name] = COLLIDER_COLOR
            elif actor is not None and actor in self._roles.agents:
                colors[name] = AGENT_COLORS[self._roles.agents[actor]]
        return cell_points(labels.instance, labels.config.grid, labels.label_valid, colors)


def cell_points(
    instance: AnyArray, grid: BevGrid, valid: BoolArray | None = None, colors: Mapping[int, str] | None = None
) -> AnyArray:
    """The cells of instance maps as points (N,) of `CELL_POINT`, by frame; later frames are paler and higher.

    Args:
        instance: (T, H, W) ids from 1, 0 elsewhere, all frames in the present ego frame.
        grid: the cells of the maps.
        valid: (T,) which frames count; None for all.
        colors: id → colour; the other ids have the colours of a palette.
    """
    count = len(instance)
    shown = instance > 0
    if valid is not None:
        shown &= valid[:, None, None]
    frame, row, column = np.nonzero(shown)
    ids = instance[frame, row, column]
    names, which = np.unique(ids, return_inverse=True)
    points = np.zeros(len(ids), dtype=CELL_POINT)
    points["x"], points["y"] = grid.centers()[row, column].T
    points["z"] = frame * FRAME_HEIGHT
    table = _colors(names.tolist(), colors or {})[which.reshape(-1)]
    points["red"], points["green"], points["blue"] = table.T
    points["alpha"] = np.rint(255 * (1 - _FADING * frame / max(count - 1, 1)))
    points["instance"], points["frame"] = ids, frame
    return points


def _colors(names: Sequence[int], chosen: Mapping[int, str]) -> AnyArray:
    colors: Any = [rgb(chosen.get(name, INSTANCE_COLORS[name % len(INSTANCE_COLORS)])) for name in names]
    return np.array(colors, dtype=np.uint8).reshape(-1, 3)
