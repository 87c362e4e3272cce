"""Label files whose positions, angles, sizes or speeds are wrong."""

from collections.abc import Callable, Sequence

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.kinds import Group
from fault_injection.place import FIELD, Place

GROUP = Group("label, geometry")
Edit = Callable[[list[str]], None]


def _scale(*names: str, by: float = -1.0) -> Edit:
    def edit(row: list[str]) -> None:
        for name in names:
            row[FIELD[name]] = repr(float(row[FIELD[name]]) * by)

    return edit


def _add(names: Sequence[str], amounts: Sequence[float]) -> Edit:
    def edit(row: list[str]) -> None:
        for name, amount in zip(names, amounts, strict=True):
            row[FIELD[name]] = repr(float(row[FIELD[name]]) + float(amount))

    return edit


def _way(rng: np.random.Generator, length: float) -> tuple[float, float]:
    angle = rng.uniform(0, 2 * np.pi)
    return length * float(np.cos(angle)), length * float(np.sin(angle))


def _of_box(place: Place, rng: np.random.Generator, edit: Edit) -> str:
    """Edit an actor's box in one agent's label of one frame."""
    (agent, actor), frame = place.shared_actor(rng), place.any_frame(rng)
    place.edit_rows(agent, [frame], edit, actor=actor)
    return f"{agent} {frame}: {actor}"


def _of_actor(place: Place, rng: np.random.Generator, edit: Edit, *, moving: bool = False) -> str:
    """Edit an actor's boxes in all labels of one agent."""
    agent, actor = place.shared_actor(rng, moving=moving)
    place.edit_rows(agent, place.frames, edit, actor=actor)
    return f"{agent}: {actor}"


def _of_agent(place: Place, rng: np.random.Generator, edit: Edit) -> str:
    """Edit all boxes of one agent."""
    agent = place.any_agent(rng)
    place.edit_rows(agent, place.frames, edit)
    return agent


def _of_all(place: Place, edit: Edit) -> str:
    """Edit all boxes of all agents."""
    for agent in place.agents:
        place.edit_rows(agent, place.frames, edit)
    return "all agents"


@GROUP.kind()
def x_sign(place: Place, rng: np.random.Generator) -> str:
    """A box's x has the other sign at one frame."""
    return _of_box(place, rng, _scale("x"))


@GROUP.kind()
def size_negative(place: Place, rng: np.random.Generator) -> str:
    """A length, width or height is negative."""
    (agent, actor), frame = place.shared_actor(rng), place.any_frame(rng)
    name = str(rng.choice(["l", "w", "h"]))
    place.edit_rows(agent, [frame], _scale(name), actor=actor)
    return f"{agent} {frame}: {actor} {name}"


@GROUP.kind()
def y_flipped_in_a_frame(place: Place, rng: np.random.Generator) -> str:
    """All y of one label file have the other sign."""
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    place.edit_rows(agent, [frame], _scale("y"))
    return f"{agent} {frame}"


GROUP.add(
    {
        "y_flipped": ("All y of an agent have the other sign.", lambda place, rng: _of_agent(place, rng, _scale("y"))),
        "yaw_flipped": (
            "All yaws of an agent have the other sign.",
            lambda place, rng: _of_agent(place, rng, _scale("yaw")),
        ),
        "labels_right_handed": (
            "An agent's labels are right-handed: y, yaw and vy have the other sign.",
            lambda place, rng: _of_agent(place, rng, _scale("y", "yaw", "vy")),
        ),
        "all_labels_right_handed": (
            "All agents' labels are right-handed, but the poses are not.",
            lambda place, _: _of_all(place, _scale("y", "yaw", "vy")),
        ),
        "yaw_in_degrees": (
            "An agent's yaws are degrees.",
            lambda place, rng: _of_agent(place, rng, _scale("yaw", by=180 / np.pi)),
        ),
        "yaw_turned": (
            "A box is turned by 90° at one frame.",
            lambda place, rng: _of_box(place, rng, _add(["yaw"], [np.pi / 2])),
        ),
    },
)


@GROUP.kind()
def yaw_turned_lone(place: Place, rng: np.random.Generator) -> str:
    """A vehicle is turned by 90° at one frame, and no other agent is there."""
    (agent, actor), frame = place.lone_actor(rng, vehicle=True), place.middle_frame(rng)
    place.edit_rows(agent, [frame], _add(["yaw"], [np.pi / 2]), actor=actor)
    return f"{agent} {frame}: {actor}"


@GROUP.kind()
def size_axes_swapped(place: Place, rng: np.random.Generator) -> str:
    """A vehicle's length and width are exchanged in one agent."""
    agent, actor = _shared_vehicle(place, rng)
    place.edit_rows(agent, place.frames, _swap_axes, actor=actor)
    return f"{agent}: {actor}"


@GROUP.kind()
def all_size_axes_swapped(place: Place, rng: np.random.Generator) -> str:
    """Length and width are exchanged in all labels of all agents."""
    return _of_all(place, _swap_axes)


def _swap_axes(row: list[str]) -> None:
    length, width = FIELD["l"], FIELD["w"]
    row[length], row[width] = row[width], row[length]


def _shared_vehicle(place: Place, rng: np.random.Generator) -> tuple[str, int]:
    """A pedestrian is as wide as long."""
    while True:
        agent, actor = place.shared_actor(rng)
        if place.row_of(place.rows(agent, place.frames[0]), actor)[0] != "pedestrian":
            return agent, actor


GROUP.add(
    {
        "size_scaled": (
            "An actor is a quarter larger in one agent.",
            lambda place, rng: _of_actor(place, rng, _scale("l", "w", "h", by=1.25)),
        ),
        "size_halved_in_a_frame": (
            "A box has half its size (as if the file had half lengths) at one frame.",
            lambda place, rng: _of_box(place, rng, _scale("l", "w", "h", by=0.5)),
        ),
    },
)


@GROUP.kind(deep=True)
def all_sizes_halved(place: Place, rng: np.random.Generator) -> str:
    """All boxes of all agents have half their size."""
    return _of_all(place, _scale("l", "w", "h", by=0.5))


@GROUP.kind()
def positions_offset(place: Place, rng: np.random.Generator) -> str:
    """All boxes of an agent are 0.3 m too far to one side."""
    agent, way = place.any_agent(rng), _way(rng, 0.3)
    place.edit_rows(agent, place.frames, _add("xy", way))
    return f"{agent}: {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def positions_offset_by_a_metre(place: Place, rng: np.random.Generator) -> str:
    """All boxes of an agent are 1 m too far to one side."""
    agent, way = place.any_agent(rng), _way(rng, 1.0)
    place.edit_rows(agent, place.frames, _add("xy", way))
    return f"{agent}: {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def heights_of_the_ground(place: Place, rng: np.random.Generator) -> str:
    """z of an agent's boxes is at their bottom, not at their centre."""

    def edit(row: list[str]) -> None:
        row[FIELD["z"]] = repr(float(row[FIELD["z"]]) - float(row[FIELD["h"]]) / 2)

    return _of_agent(place, rng, edit)


@GROUP.kind()
def box_moved(place: Place, rng: np.random.Generator) -> str:
    """A box is 2 m too far to one side at one frame."""
    (agent, actor), frame = place.shared_actor(rng), place.any_frame(rng)
    way = _way(rng, 2.0)
    place.edit_rows(agent, [frame], _add("xy", way), actor=actor)
    return f"{agent} {frame}: {actor} {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def box_moved_lone(place: Place, rng: np.random.Generator) -> str:
    """A box is 2 m too far to one side at one frame in the middle of the scenario, and no other agent is there."""
    return _move_lone(place, rng, place.middle_frame(rng))


@GROUP.kind(beyond="a collision may move actors suddenly in the last frames, and no other agent saw them")
def box_moved_lone_at_the_end(place: Place, rng: np.random.Generator) -> str:
    """A box is 2 m too far to one side at the last frame, and no other agent is there."""
    return _move_lone(place, rng, place.frames[-1])


def _move_lone(place: Place, rng: np.random.Generator, frame: int) -> str:
    (agent, actor), way = place.lone_actor(rng), _way(rng, 2.0)
    place.edit_rows(agent, [frame], _add("xy", way), actor=actor)
    return f"{agent} {frame}: {actor} {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def box_lifted(place: Place, rng: np.random.Generator) -> str:
    """A box is 1.5 m too high at one frame."""
    return _of_box(place, rng, _add("z", [1.5]))


@GROUP.kind()
def own_row_moved(place: Place, rng: np.random.Generator) -> str:
    """The recording agent's own box is 3 m away from its place at all frames."""
    agent, way = place.vehicle(rng), _way(rng, 3.0)
    place.edit_rows(agent, place.frames, _add("xy", way), actor=OWN_ACTOR_ID)
    return f"{agent}: {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def speed_changed(place: Place, rng: np.random.Generator) -> str:
    """The header's speed is wrong by 5 m/s at one frame."""
    agent, frame = place.vehicle(rng), place.any_frame(rng)
    way = _way(rng, 5.0)
    _change_speeds(place, agent, [frame], way, own_row=False)
    return f"{agent} {frame}: {way[0]:.2f} {way[1]:.2f}"


@GROUP.kind()
def speeds_changed(place: Place, rng: np.random.Generator) -> str:
    """The speed in header and own line of an agent is wrong by 5 m/s at all frames."""
    agent, way = place.vehicle(rng), _way(rng, 5.0)
    _change_speeds(place, agent, place.frames, way, own_row=True)
    return f"{agent}: {way[0]:.2f} {way[1]:.2f}"


def _change_speeds(place: Place, agent: str, frames: list[int], way: tuple[float, float], *, own_row: bool) -> None:
    for frame in frames:
        rows = place.rows(agent, frame)
        rows[0] = [repr(float(word) + more) for word, more in zip(rows[0], way, strict=True)]
        if own_row:
            _add(("vx", "vy"), way)(place.row_of(rows, OWN_ACTOR_ID))
        place.write_rows(agent, frame, rows)


@GROUP.kind()
def velocity_reversed(place: Place, rng: np.random.Generator) -> str:
    """A moving actor's velocity has the other sign in one agent."""
    return _of_actor(place, rng, _scale("vx", "vy"), moving=True)


@GROUP.kind()
def velocities_in_another_frame(place: Place, rng: np.random.Generator) -> str:
    """All velocities of an agent are turned by 90°."""

    def edit(row: list[str]) -> None:
        vx, vy = FIELD["vx"], FIELD["vy"]
        row[vx], row[vy] = repr(-float(row[vy])), row[vx]

    return _of_agent(place, rng, edit)


@GROUP.kind()
def track_frozen(place: Place, rng: np.random.Generator) -> str:
    """A moving actor stays where it was for two frames in one agent's labels, in the world."""
    agent, actor = place.shared_actor(rng, moving=True)
    frame = int(rng.choice(place.frames[1:]))
    world = place.sightings[agent][actor][frame - 1]
    calib = place.calib(agent, frame)
    there = np.linalg.inv(calib["ego_to_world"] @ calib["lidar_to_ego"]) @ [*world, 1.0]

    def edit(row: list[str]) -> None:
        row[1:4] = [repr(float(value)) for value in there[:3]]

    place.edit_rows(agent, [frame], edit, actor=actor)
    return f"{agent} {frame}: {actor}"
