"""Windows of tracks: all actors of a sample in fixed steps before and after it.

A cell (actor, step) is the actor's row of `cooperative_view` at that time.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import VISIBLE, Dataset, RowArgument, Visible
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.geometry import SE3, quaternions
from deepaccident_devkit.support.arrays import (
    AnyArray,
    IntArray,
    checked_setting,
)
from deepaccident_devkit.support.text import choice, settle_choices
from deepaccident_devkit.tables.tokens import instance_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    CHANNELS,
    FRAME_PERIOD,
    OWN_ACTOR_ID,
    AgentName,
    Frame,
)
from deepaccident_devkit.v2x.agents import Agents, agents_of, checked_agents, cooperating_agents
from deepaccident_devkit.v2x.label_rows import label_rows, seen_mask, world_vectors
from deepaccident_devkit.v2x.track_window import TrackWindow, stack_windows

WindowActors = Literal["present", "any"]
"""Actors of a window: valid at the sample's time, or at any step."""
ACTOR_FRAME: Final = "actor"
_WINDOW_FRAMES = (*get_args(Frame), *CHANNELS, ACTOR_FRAME)
# Longest past and future; the longest recordings take 20 s.
_MAX_SECONDS = 60.0
# Largest difference between a quotient of two times and a whole number.
_UNIT_TOLERANCE = 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowConfig:
    """The steps and actors of a window.

    Attributes:
        past: Seconds before the sample, from 0, a multiple of `step`.
        future: Seconds after the sample, from 0, a multiple of `step`.
        step: Seconds from one step to the next, a multiple of 0.1.
        agents: Agents whose labels give the positions (`v2x.Agents`); None for all available ones.
        visible: Boxes that count: None for all, `camera` or `released` as in `cooperative_boxes`.
        actors: `present` for the actors that are valid at the sample's time, `any` for those that
            are valid at any step.

    Raises:
        ConfigError: A time is out of range, or not a multiple.
        ChoiceError: A choice does not exist.
    """

    past: float = 2.0
    future: float = 3.0
    step: float = FRAME_PERIOD
    agents: Agents = None
    visible: Visible | None = None
    actors: WindowActors = "present"

    def __post_init__(self) -> None:
        """Check the values."""
        _ = self.offsets  # checks the times
        checked_agents(self.agents)
        settle_choices(self, {"visible": VISIBLE, "actors": get_args(WindowActors)})

    @property
    def offsets(self) -> IntArray:
        """Frames from the sample to each step, shape (T,), ascending."""
        step = count_units("step", self.step, FRAME_PERIOD, minimum=FRAME_PERIOD)
        num_past = count_units("past", self.past, self.step)
        num_future = count_units("future", self.future, self.step)
        return np.arange(-num_past, num_future + 1) * step


def count_units(name: str, value: float, unit: float, minimum: float = 0.0) -> int:
    """Return how many times a time contains `unit`, in seconds.

    Raises:
        ConfigError: The time is out of range, or not a multiple.
    """
    expected = f"a multiple of {unit:g} s from {minimum:g} to {_MAX_SECONDS:g}"
    count = checked_setting(name, value, expected, minimum, _MAX_SECONDS) / unit
    nearest = round(count)
    if abs(count - nearest) > _UNIT_TOLERANCE:
        nearest_time = nearest * unit
        raise ConfigError(
            f"{name}: expected {expected}, found {value!r}; the nearest is {nearest_time:g}"
        )
    return nearest


def window(  # noqa: PLR0913, PLR0917 - each is a choice that stands on its own in a notebook
    dataset: Dataset,
    sample: RowArgument,
    past: float = 2.0,
    future: float = 3.0,
    step: float = FRAME_PERIOD,
    agents: Agents = None,
    visible: Visible | None = None,
    frame: str = "ego",
    actors: WindowActors = "present",
) -> TrackWindow:
    """Return the tracks of a sample's actors before and after it, as arrays of fixed shape.

    Each step has what `v2x.cooperative_view` returns at that time. Untracked rows (−1) are left
    out. The sample's agent is one of the actors if a label contains it.

    Args:
        dataset: The release.
        sample: Token or record of a sample; its agent is the ego.
        past: Seconds before the sample, a multiple of `step`.
        future: Seconds after the sample, a multiple of `step`.
        step: Seconds from one step to the next, a multiple of 0.1.
        agents: Agents whose labels give the positions, as for `v2x.cooperating_agents`; None for
            all available ones.
        visible: Boxes that count: None for all, `camera` or `released` as in `cooperative_boxes`.
        frame: Coordinate frame at the sample's time: `ego`, `world`, `lidar`, a camera channel, or
            `actor` for each actor's own centre and heading.
        actors: `present` for the actors that are valid at the sample's time, `any` for those that
            are valid at any step.

    Raises:
        TokenError: The sample is unknown.
        NotAvailableError: The sample is not labelled, or an agent is not in this (partial) release.
        ChoiceError: An agent, the configuration, the frame or another choice is unknown.
        ConfigError: A time is out of range, or not a multiple.
    """
    config = WindowConfig(
        past=past, future=future, step=step, agents=agents, visible=visible, actors=actors
    )
    return configured_window(dataset, sample, config, frame)


def windows(
    dataset: Dataset, samples: Iterable[RowArgument], **settings: Any
) -> dict[str, AnyArray]:
    """Return the windows of several samples as one batch of arrays (`stack_windows`).

    Args:
        dataset: The release.
        samples: Tokens or records of samples.
        **settings: Arguments of `window` by name, such as `past=1.0`.

    Raises:
        GeometryError: There are no samples. The other errors are as in `window`.
    """
    return stack_windows([window(dataset, sample, **settings) for sample in samples])


def configured_window(
    dataset: Dataset, sample: RowArgument, config: WindowConfig, frame: str = "ego"
) -> TrackWindow:
    """Return the window that a configuration describes; the errors are as in `window`."""
    record = dataset.get("sample", sample)
    frame = choice("frame", frame, _WINDOW_FRAMES)
    world_from_frame = None
    if frame != ACTOR_FRAME:
        frame = dataset.frame_name(frame)
        world_from_frame = dataset.world_from(record, frame)
    if not record["labelled"]:
        raise NotAvailableError(
            f"{record['token']}: has no label (the test split ships without labels), so there "
            "are no tracks; choose a labelled sample"
        )
    scenario = record["scenario_token"]
    offsets = config.offsets
    present = int(offsets.searchsorted(0))
    index = offsets + int(record["token"].rsplit("/", 1)[1])
    agents = cooperating_agents(dataset, sample, config.agents)
    instances, cells, seen_by, annotated_by = _find_cells(
        dataset, scenario, agents, index, config.visible
    )
    is_listed = (cells >= 0).any(axis=1)
    if config.actors == "present":
        is_listed = cells[:, present] >= 0
    cells = cells[is_listed]
    actor_ids = dataset.columns("instance")["actor_id"][instances[is_listed]]
    return TrackWindow(
        sample=record["token"],
        frame=frame,
        own_actor_id=dataset.get("agent", record["agent_token"])["actor_id"],
        present=present,
        time=offsets / 10,
        index=index,
        instance=tuple([instance_token(scenario, actor) for actor in actor_ids.tolist()]),
        actor_id=actor_ids,
        valid=cells >= 0,
        seen_by=seen_by[is_listed],
        annotated_by=annotated_by[is_listed],
        **_states(dataset, cells, present, world_from_frame),
    )


def _find_cells(
    dataset: Dataset,
    scenario: str,
    agents: Sequence[AgentName],
    index: IntArray,
    visible: Visible | None,
) -> tuple[IntArray, IntArray, AnyArray, AnyArray]:
    """Merge the labels of all agents at several moments of a scenario.

    Args:
        dataset: The release.
        scenario: Token of the scenario.
        agents: The agents whose boxes count, the preferred one first.
        index: Frame numbers of the moments, shape (T,).
        visible: The boxes that count, as in `window`.

    Returns:
        Rows of all I annotated actors in the instance table, ascending, shape (I,); rows of the
            boxes that represent their cells in the annotation table, −1 for none, shape (I, T);
            and `seen_by` and `annotated_by` as in `TrackWindow`, shape (I, T).
    """
    all_agents = dict.fromkeys((*agents, *agents_of(dataset, scenario)))
    rows, step = label_rows(dataset, scenario, all_agents, index)
    boxes = dataset.columns("annotation")
    instances, actor = np.unique(boxes["instance_row"][rows], return_inverse=True)
    cell = actor * len(index) + step
    agent = dataset.columns("sample")["agent"][boxes["sample_row"][rows]]
    is_own = boxes["actor_id"][rows] == OWN_ACTOR_ID
    is_seen = seen_mask(dataset, rows, agent)
    is_chosen = np.isin(agent, [AGENTS.index(name) for name in agents])
    if visible is not None:
        is_chosen &= is_seen if visible == "released" else boxes["camera_visible"][rows]
    cells = np.full((len(instances), len(index)), -1)
    # Of the rows of a cell, the last one that is written stays: the first agent's box that is not
    # its own.
    for group in (is_chosen & is_own, is_chosen & ~is_own):
        candidates = np.flatnonzero(group)[::-1]
        cells.reshape(-1)[cell[candidates]] = rows[candidates]
    seen_by, annotated_by = np.zeros((2, *cells.shape), dtype=np.uint8)
    bits = np.left_shift(1, agent, dtype=np.uint8, casting="unsafe")
    np.bitwise_or.at(annotated_by.reshape(-1), cell, bits)
    np.bitwise_or.at(seen_by.reshape(-1), cell[is_seen], bits[is_seen])
    return instances, cells, seen_by, annotated_by


def _states(
    dataset: Dataset, cells: IntArray, present: int, world_from_frame: SE3 | None
) -> dict[str, AnyArray]:
    """Return the arrays of a window that come from the boxes of its cells.

    Args:
        dataset: The release.
        cells: Rows of the annotation table, shape (N, T); −1 where not valid.
        present: Index of the step that is the sample's time.
        world_from_frame: Pose of the window's frame; None for the actors' own frames.
    """
    boxes = dataset.columns("annotation")
    is_valid = cells >= 0
    category_step = np.where(is_valid[:, present], present, is_valid.argmax(axis=1))
    vectors = world_vectors(dataset, cells)
    vectors[:, ~is_valid] = np.nan
    size = boxes["size"][cells]
    size[~is_valid] = np.nan
    centers, headings, velocities = vectors
    speed = np.hypot(velocities[..., 0], velocities[..., 1])
    if world_from_frame is None:
        origin = centers[:, [present]]
        yaw = np.arctan2(headings[:, present, 1], headings[:, present, 0])
        rotation = quaternions.to_matrix(quaternions.from_yaw(yaw))
    else:
        origin = world_from_frame.translation
        rotation = world_from_frame.inverse().rotation.T
    center, heading, velocity = np.stack([centers - origin, headings, velocities]) @ rotation
    return {
        "category": boxes["category"][cells[np.arange(len(cells)), category_step]],
        "center": center,
        "yaw": np.arctan2(heading[..., 1], heading[..., 0]),
        "speed": speed,
        "velocity": velocity,
        "size": size,
    }
