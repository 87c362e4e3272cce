"""Label files whose lines, ids or numbers of lines are wrong, though each line can be read."""

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.kinds import Group
from fault_injection.place import FIELD, NEAR, Place, one_of

GROUP = Group("label, lines and ids")
_ID = FIELD["id"]


def _set_id(row: list[str], actor: int) -> None:
    row[_ID] = str(actor)


def _new_id(place: Place) -> int:
    return 1 + max(actor for seen in place.sightings.values() for actor in seen)


@GROUP.kind()
def line_removed(place: Place, rng: np.random.Generator) -> str:
    """A near actor that others see too is missing from one agent's label at one frame in the middle of the scenario."""
    (agent, actor), frame = place.shared_actor(rng, within=NEAR), place.middle_frame(rng)
    return _remove_line(place, agent, frame, actor)


@GROUP.kind()
def line_removed_at_an_end(place: Place, rng: np.random.Generator) -> str:
    """A near actor that others see too is missing from one agent's label at the first or last frame."""
    (agent, actor), frame = place.shared_actor(rng, within=NEAR), int(rng.choice([1, place.frames[-1]]))
    return _remove_line(place, agent, frame, actor)


@GROUP.kind()
def line_removed_lone(place: Place, rng: np.random.Generator) -> str:
    """A near actor is missing at one frame in the middle of the scenario, and no other agent is there."""
    (agent, actor), frame = place.lone_actor(rng), place.middle_frame(rng)
    return _remove_line(place, agent, frame, actor)


def _remove_line(place: Place, agent: str, frame: int, actor: int) -> str:
    rows = place.rows(agent, frame)
    rows.remove(place.row_of(rows, actor))
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}: actor {actor} removed"


@GROUP.kind()
def actor_removed(place: Place, rng: np.random.Generator) -> str:
    """A near actor that others see too is missing from all labels of one agent."""
    agent, actor = place.shared_actor(rng, within=NEAR)
    for frame in place.frames:
        _remove_line(place, agent, frame, actor)
    return f"{agent}: actor {actor} removed"


@GROUP.kind()
def line_duplicated(place: Place, rng: np.random.Generator) -> str:
    """A line is there twice."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    tracked = [row for row in rows[1:] if int(row[_ID]) > 0]
    row = tracked[rng.integers(len(tracked))]
    place.write_rows(agent, frame, [*rows, row])
    return f"{agent} {frame}: {' '.join(row)[:50]}"


@GROUP.kind()
def boxes_removed(place: Place, rng: np.random.Generator) -> str:
    """One label file has lost all boxes, but not its header."""
    agent, frame = place.any_agent(rng), place.middle_frame(rng)
    place.write_rows(agent, frame, place.rows(agent, frame)[:1])
    return f"{agent} {frame}"


GROUP.add(
    {
        "ids_exchanged": (
            "Two moving actors' ids are exchanged in one agent, at all frames.",
            lambda place, rng: _exchange_ids(place, rng, place.frames),
        ),
        "ids_exchanged_in_a_frame": (
            "Two moving actors' ids are exchanged in one agent, at one frame.",
            lambda place, rng: _exchange_ids(place, rng, [place.any_frame(rng)]),
        ),
    },
)


def _exchange_ids(place: Place, rng: np.random.Generator, frames: list[int]) -> str:
    agent, (one, other) = place.steady_ones(rng, 2, moving=True)
    new = {str(one): str(other), str(other): str(one)}
    place.edit_rows(agent, frames, lambda row: row.__setitem__(_ID, new.get(row[_ID], row[_ID])))
    return f"{agent} {frames[0]}..{frames[-1]}: {one} and {other}"


@GROUP.kind()
def id_changed(place: Place, rng: np.random.Generator) -> str:
    """An actor that others see too has a new id in one agent, at all frames."""
    agent, actor = place.shared_actor(rng)
    new = _new_id(place)
    place.edit_rows(agent, place.frames, lambda row: _set_id(row, new), actor=actor)
    return f"{agent}: {actor} is {new}"


@GROUP.kind()
def id_changed_in_a_frame(place: Place, rng: np.random.Generator) -> str:
    """An actor that others see too has a new id in one agent, at one frame."""
    (agent, actor), frame = place.shared_actor(rng), place.any_frame(rng)
    new = _new_id(place)
    place.edit_rows(agent, [frame], lambda row: _set_id(row, new), actor=actor)
    return f"{agent} {frame}: {actor} is {new}"


@GROUP.kind(harmless="nothing else names that actor, so nothing contradicts the new id")
def id_changed_lone(place: Place, rng: np.random.Generator) -> str:
    """An actor has a new id at all frames, and no other agent is there."""
    agent, actor = place.lone_actor(rng)
    new = _new_id(place)
    place.edit_rows(agent, place.frames, lambda row: _set_id(row, new), actor=actor)
    return f"{agent}: {actor} is {new}"


@GROUP.kind()
def id_twice(place: Place, rng: np.random.Generator) -> str:
    """Two boxes of one label file have the same id."""
    (agent, (one, other)), frame = place.steady_ones(rng, 2), place.any_frame(rng)
    place.edit_rows(agent, [frame], lambda row: _set_id(row, one), actor=other)
    return f"{agent} {frame}: {other} is {one} too"


@GROUP.kind()
def id_odd(place: Place, rng: np.random.Generator) -> str:
    """An actor's id is impossible in the format, in all labels of all agents."""
    (_, actor), new = place.shared_actor(rng), int(rng.choice([-7, 0x7FFFFFFF]))
    for agent in place.agents:
        place.edit_rows(agent, place.frames, lambda row: _set_id(row, new), actor=actor)
    return f"{actor} is {new}"


@GROUP.kind(harmless="real labels are not always tracked either: one has an untracked row at 22 m")
def id_lost(place: Place, rng: np.random.Generator) -> str:
    """A near actor that others track has the id of an untracked one (−1) at one frame."""
    (agent, actor), frame = place.shared_actor(rng, within=NEAR), place.middle_frame(rng)
    place.edit_rows(agent, [frame], lambda row: _set_id(row, -1), actor=actor)
    return f"{agent} {frame}: {actor} is -1"


GROUP.add(
    {
        "ids_lost": (
            "All other actors are untracked (−1) in one agent's labels.",
            lambda place, rng: _lose_ids(place, place.any_agent(rng), list(place.frames)),
        ),
        "ids_lost_at_one_frame": (
            "All other actors are untracked (−1) in one label.",
            lambda place, rng: _lose_ids(place, place.any_agent(rng), [place.middle_frame(rng)]),
        ),
    },
)


def _lose_ids(place: Place, agent: str, frames: list[int]) -> str:
    def lose(row: list[str]) -> None:
        if row[_ID] != str(OWN_ACTOR_ID):
            _set_id(row, -1)

    place.edit_rows(agent, frames, lose)
    return f"{agent}: all ids are -1 at {len(frames)} frames"


@GROUP.kind()
def own_row_removed(place: Place, rng: np.random.Generator) -> str:
    """The recording agent's own line is missing at one frame."""
    agent, frame = place.vehicle(rng), place.any_frame(rng)
    return _remove_line(place, agent, frame, OWN_ACTOR_ID)


@GROUP.kind()
def own_row_removed_always(place: Place, rng: np.random.Generator) -> str:
    """The recording agent's own line is missing at all frames."""
    agent = place.vehicle(rng)
    for frame in place.frames:
        _remove_line(place, agent, frame, OWN_ACTOR_ID)
    return agent


@GROUP.kind()
def own_row_duplicated(place: Place, rng: np.random.Generator) -> str:
    """The recording agent's own line is there twice."""
    agent, frame = place.vehicle(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    place.write_rows(agent, frame, [*rows, place.row_of(rows, OWN_ACTOR_ID)])
    return f"{agent} {frame}"


@GROUP.kind()
def own_row_under_true_id(place: Place, rng: np.random.Generator) -> str:
    """The recording agent's own line has its actor id instead of −100, at all frames."""
    agent = place.vehicle(rng)
    actor = place.agent_ids()[place.agents.index(agent)]
    place.edit_rows(agent, place.frames, lambda row: _set_id(row, actor), actor=OWN_ACTOR_ID)
    return f"{agent}: {actor}"


@GROUP.kind()
def own_row_on_the_pole(place: Place, rng: np.random.Generator) -> str:
    """The infrastructure's label has an own line (−100)."""
    agent, frame = "infrastructure", place.any_frame(rng)
    actor = one_of(sorted(place.steady(agent)), rng)
    place.edit_rows(agent, [frame], lambda row: _set_id(row, OWN_ACTOR_ID), actor=actor)
    return f"{agent} {frame}: {actor} is -100"


@GROUP.kind()
def class_exchanged(place: Place, rng: np.random.Generator) -> str:
    """One line has another class of the same kind, such as truck for car."""
    (agent, actor), frame = place.shared_actor(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    row = place.row_of(rows, actor)
    old = row[0]
    row[0] = {"car": "truck", "truck": "van", "van": "car", "cyclist": "motorcycle"}.get(old, "cyclist")
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}: {actor}, {old} is {row[0]}"


@GROUP.kind()
def class_exchanged_lone(place: Place, rng: np.random.Generator) -> str:
    """An actor has another class at one frame, and no other agent is there."""
    (agent, actor), frame = place.lone_actor(rng), place.any_frame(rng)
    old = place.row_of(place.rows(agent, frame), actor)[0]
    new = "truck" if old == "car" else "car"
    place.edit_rows(agent, [frame], lambda row: row.__setitem__(0, new), actor=actor)
    return f"{agent} {frame}: {actor}, {old} is {new}"


@GROUP.kind()
def class_against_size(place: Place, rng: np.random.Generator) -> str:
    """Cars are pedestrians and pedestrians are cars in all labels of all agents; sizes do not change."""
    _, actor = place.shared_actor(rng)
    old = next(
        row[0] for agent in place.agents for row in place.rows(agent, place.frames[0])[1:] if int(row[_ID]) == actor
    )
    new = "car" if old in ("pedestrian", "cyclist", "motorcycle") else "pedestrian"
    for agent in place.agents:
        place.edit_rows(agent, place.frames, lambda row: row.__setitem__(0, new), actor=actor)
    return f"{actor}: {old} is {new}"


@GROUP.kind()
def label_of_next_frame(place: Place, rng: np.random.Generator) -> str:
    """A moving agent's label file is replaced by the next frame's."""
    frame = int(rng.choice(place.frames[:-1]))
    return place.take_next(place.moving_agent(rng, frame), "label", frame)


@GROUP.kind()
def labels_shifted(place: Place, rng: np.random.Generator) -> str:
    """All labels of a moving agent are one frame early; the last one is there twice."""
    return place.one_frame_early(place.moving_agent(rng), "label")


@GROUP.kind()
def labels_shifted_on_the_pole(place: Place, rng: np.random.Generator) -> str:
    """All labels of the standing infrastructure are one frame early; the last one is there twice."""
    return place.one_frame_early("infrastructure", "label")


@GROUP.kind()
def labels_of_two_frames_exchanged(place: Place, rng: np.random.Generator) -> str:
    """Two frames' label files of an agent are exchanged."""
    agent = place.any_agent(rng)
    one, other = map(int, rng.choice(place.frames, size=2, replace=False))
    place.exchange(place.file(agent, "label", one), place.file(agent, "label", other))
    return f"{agent}: {one} and {other}"


@GROUP.kind()
def labels_of_two_agents_exchanged(place: Place, rng: np.random.Generator) -> str:
    """Two agents' label files are exchanged at one frame."""
    (one, other), frame = place.two_agents(rng), place.any_frame(rng)
    place.exchange(place.file(one, "label", frame), place.file(other, "label", frame))
    return f"{one} and {other} {frame}"


@GROUP.kind()
def labels_of_two_agents_exchanged_always(place: Place, rng: np.random.Generator) -> str:
    """Two agents' label files are exchanged at all frames."""
    one, other = place.two_agents(rng)
    for frame in place.frames:
        place.exchange(place.file(one, "label", frame), place.file(other, "label", frame))
    return f"{one} and {other}"


@GROUP.kind(deep=True)
def points_changed(place: Place, rng: np.random.Generator) -> str:
    """A box's number of LiDAR points is wrong."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    row = place.any_row(rng, rows)
    old, place_of = int(row[FIELD["num_lidar_pts"]]), FIELD["num_lidar_pts"]
    row[place_of] = str(old * 2 + 30)
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}: {row[_ID]}, {old} is {row[place_of]} points"


@GROUP.kind()
def points_negative(place: Place, rng: np.random.Generator) -> str:
    """A box's number of LiDAR points is negative."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    place.any_row(rng, rows)[FIELD["num_lidar_pts"]] = "-3"
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}"


@GROUP.kind(harmless="no other file says what a camera sees; only a renderer could find it")
def visible_flipped(place: Place, rng: np.random.Generator) -> str:
    """A box's camera_visible is wrong."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    row = place.any_row(rng, rows)
    row[FIELD["camera_visible"]] = "False" if row[FIELD["camera_visible"]] == "True" else "True"
    place.write_rows(agent, frame, rows)
    return f"{agent} {frame}: {row[_ID]}"
