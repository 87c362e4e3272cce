"""`TrackWindow`: the tracks of a sample's actors before and after it, as arrays of fixed shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    GeometryError,
    NotAvailableError,
)
from deepaccident_devkit.support.arrays import (
    AnyArray,
    BoolArray,
    FloatArray,
    FrozenArrays,
    IntArray,
    checked,
)
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.text import PathType, counted, path_of
from deepaccident_devkit.support.values import NamedValues
from deepaccident_devkit.taxonomy import CATEGORIES, FRAME_PERIOD

# Kind of an array's type → its value where a padded batch has no actor; 0 for all others.
_PADDING: Final = {"f": np.nan, "i": -1}
# Category → Argoverse's type of object; the other categories are vehicles.
_OBJECT_TYPES: Final = {
    "cyclist": "cyclist",
    "motorcycle": "motorcyclist",
    "pedestrian": "pedestrian",
}
_FRAME_PERIOD_NS: Final = round(FRAME_PERIOD * 1e9)
# Argoverse's categories of tracks; 0 is a track that is not valid at the present.
_AT_PRESENT, _TO_THE_END, _FOCAL = 1, 2, 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackWindow(FrozenArrays):
    """The tracks of N actors in T steps around a sample; arrays are read-only.

    Nothing is interpolated: where an actor is not `valid`, numbers are NaN. Steps outside the
    recording are there, but not valid.

    Attributes:
        sample: Token of the sample.
        frame: Coordinate frame at the sample's time: `world`, `ego`, `lidar`, a channel, or
            `actor`. In `actor`, each actor is relative to its own centre and heading at the
            sample's time; an actor that is not valid then has NaN positions.
        own_actor_id: Actor id of the sample's agent; None if it has none.
        present: Index of the step that is the sample's time.
        time: Seconds after the sample, shape (T,), float64; negative before it.
        index: Frame numbers, shape (T,), int64; below 1 or too large outside the recording.
        instance: Tokens of the N actors, by ascending actor id.
        actor_id: CARLA ids, shape (N,), int64.
        category: Class indices, shape (N,), int8, at the sample's time, or otherwise at the
            actor's first valid step.
        center: Box centres, shape (N, T, 3), float64, metres.
        yaw: Headings about z of the frame, shape (N, T), float64, radians in (−π, π].
        speed: Lengths of the labels' velocities over the ground, shape (N, T), float64, m/s. They
            are not differences of positions.
        velocity: The labels' velocities, along the axes of the frame, shape (N, T, 3), float64,
            m/s.
        size: Length, width, height, shape (N, T, 3), float64, metres.
        valid: Whether one of the chosen agents has a box of the actor, shape (N, T), bool.
        seen_by: Bit masks over `taxonomy.AGENTS`, shape (N, T), uint8: all agents, chosen or not,
            that see the actor under the released rule.
        annotated_by: Bit masks like `seen_by`: all agents whose label contains the actor.
    """

    sample: str
    frame: str
    own_actor_id: int | None
    present: int
    time: FloatArray
    index: IntArray
    instance: tuple[str, ...]
    actor_id: IntArray
    category: AnyArray
    center: FloatArray
    yaw: FloatArray
    speed: FloatArray
    velocity: FloatArray
    size: FloatArray
    valid: BoolArray
    seen_by: AnyArray
    annotated_by: AnyArray

    def __len__(self) -> int:
        """Return the number of actors."""
        return len(self.instance)

    def write_av2(self, path: PathType, focal: int | str | None = None) -> Path:
        """Write the window, in the frame `world`, as a scenario of Argoverse 2.

        av2's `load_argoverse_scenario_parquet` reads the file (docs/exports.md, Argoverse 2).

        Args:
            path: Path of the Parquet file.
            focal: Actor id or instance token of the track to forecast; None for the sample's agent.

        Returns:
            The path.

        Raises:
            ConfigError: The window is in another frame.
            NotAvailableError: The window has no actors, because av2 cannot read a file without
                rows.
            ChoiceError: The focal actor is not in the window.
        """
        from pyarrow.parquet import write_table

        table = argoverse_table(self, focal)
        target = path_of(path)
        with replacing(target) as temporary:
            write_table(table, temporary)
        return target

    @property
    def arrays(self) -> dict[str, AnyArray]:
        """All arrays by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    def augmented(self, matrix: ArrayLike) -> TrackWindow:
        """Return the window with an augmentation of its frame applied to all actors.

        As in `V2XDataset`, sizes and speeds scale too, and a flip mirrors headings.

        Args:
            matrix: Rotation about z, scale and flip, shape (4, 4), such as
                `motion.Augmentation.matrix`.

        Raises:
            GeometryError: The matrix has another shape.
        """
        affine = checked("matrix", matrix, (4, 4))
        linear = affine[:3, :3]
        scale = float(np.linalg.norm(linear[0]))
        heading = np.stack([np.cos(self.yaw), np.sin(self.yaw)], axis=-1) @ linear[:2, :2].T
        return replace(
            self,
            center=self.center @ linear.T + affine[:3, 3],
            yaw=np.arctan2(heading[..., 1], heading[..., 0]),
            speed=self.speed * scale,
            velocity=self.velocity @ linear.T,
            size=self.size * scale,
        )


def stack_windows(windows: Sequence[TrackWindow]) -> dict[str, AnyArray]:
    """Return B windows of the same steps as one batch, padded to the largest number of actors.

    Padding is not `valid`: its numbers are NaN, its masks 0, its ids and classes −1.

    Returns:
        Name → array, as in `TrackWindow`, with a first axis of B windows; for example `center` is
            (B, N, T, 3) and `time` (B, T).

    Raises:
        GeometryError: There are no windows, or their frames or steps differ.
    """
    kinds = {(window.frame, *window.time.tolist()) for window in windows}
    if len(kinds) != 1:
        raise GeometryError(
            "windows: expected at least one window, all with the same frame, past, future and "
            f"step, found {counted(len(windows), 'window')} of {counted(len(kinds), 'kind')}"
        )
    arrays_of_windows = [window.arrays for window in windows]
    batch = {}
    for name, first in arrays_of_windows[0].items():
        arrays = [window_arrays[name] for window_arrays in arrays_of_windows]
        blank = _PADDING.get(first.dtype.kind, 0)
        shape = (len(windows), max(map(len, arrays)), *first.shape[1:])
        batch[name] = np.full(shape, blank, dtype=first.dtype)
        for row, array in zip(batch[name], arrays, strict=True):
            row[: len(array)] = array
    return batch


def argoverse_table(window: TrackWindow, focal: int | str | None = None) -> Any:
    """Return a window as a `pyarrow.Table` with the columns of Argoverse 2, one row a valid cell.

    `track_id` is the actor id, `scenario_id` the sample's token and `city` the town. Times are
    nanoseconds since the recording's first frame, negative before it. The arguments and errors are
    as in `TrackWindow.write_av2`.
    """
    import pyarrow as pa

    if window.frame != "world":
        raise ConfigError(
            f"window: Argoverse's positions are in world, found frame {window.frame!r}; make the "
            "window with frame='world'"
        )
    if not window.valid.any():
        raise NotAvailableError(
            f"{window.sample}: the window has no actors, and av2 cannot read a file without rows; "
            "choose another sample"
        )
    focal_id = _find_focal(window, focal)
    actors, steps = np.nonzero(window.valid)
    object_types = [_OBJECT_TYPES.get(name, "vehicle") for name in CATEGORIES]
    track_ids = window.actor_id.astype(str)
    scenario_name = window.sample.split("/")[1]
    start, end = (window.index[[0, -1]] - 1) * _FRAME_PERIOD_NS
    columns: NamedValues = {
        "observed": steps <= window.present,
        "track_id": track_ids[actors],
        "object_type": np.array(object_types)[window.category[actors]],
        "object_category": _track_categories(window, focal_id)[actors],
        "timestep": steps,
        "position_x": window.center[actors, steps, 0],
        "position_y": window.center[actors, steps, 1],
        "heading": window.yaw[actors, steps],
        "velocity_x": window.velocity[actors, steps, 0],
        "velocity_y": window.velocity[actors, steps, 1],
    }
    constants = {
        "scenario_id": window.sample,
        "start_timestamp": start,
        "end_timestamp": end,
        "num_timestamps": len(window.time),
        "focal_track_id": str(focal_id),
        "city": scenario_name.split("_")[0],
    }
    for name, value in constants.items():
        columns[name] = np.full(len(steps), value)
    return pa.table(columns)


def _find_focal(window: TrackWindow, focal: int | str | None) -> int:
    """Return the actor id of the focal track; raise ChoiceError if it is not in the window."""
    actor_ids: list[int] = window.actor_id.tolist()
    names = {str(actor_id): actor_id for actor_id in actor_ids}
    names |= dict(zip(window.instance, actor_ids, strict=True))
    choices = ", ".join(map(str, actor_ids))
    if focal is None and window.own_actor_id is None:
        raise ChoiceError(
            f"focal: {window.sample} has no vehicle of its own; choose one of {choices}"
        )
    name = str(window.own_actor_id if focal is None else focal)
    if name not in names:
        raise ChoiceError(f"focal: expected one of {choices}, found {name}")
    return names[name]


def _track_categories(window: TrackWindow, focal_id: int) -> IntArray:
    """Return Argoverse's category of each track, shape (N,)."""
    at_present = window.valid[:, window.present]
    to_the_end = at_present & window.valid[:, -1]
    categories = np.where(to_the_end, _TO_THE_END, at_present * _AT_PRESENT)
    categories[window.actor_id == focal_id] = _FOCAL
    return categories
