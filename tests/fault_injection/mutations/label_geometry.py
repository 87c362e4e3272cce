"""Label files whose positions, angles, sizes or speeds are wrong."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.kinds import Apply, Group, of_actor
from fault_injection.place import FIELD, Frames, Place, always, in_the_middle, once

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


def _move(rng: np.random.Generator, length: float) -> Edit:
    return _add("xy", _way(rng, length))


def _way(rng: np.random.Generator, length: float) -> tuple[float, float]:
    angle = rng.uniform(0, 2 * np.pi)
    return length * float(np.cos(angle)), length * float(np.sin(angle))


def _swap_axes(row: list[str]) -> None:
    length, width = FIELD["l"], FIELD["w"]
    row[length], row[width] = row[width], row[length]


def _to_the_ground(row: list[str]) -> None:
    row[FIELD["z"]] = repr(float(row[FIELD["z"]]) - float(row[FIELD["h"]]) / 2)


def _turn_velocity(row: list[str]) -> None:
    vx, vy = FIELD["vx"], FIELD["vy"]
    row[vx], row[vy] = repr(-float(row[vy])), row[vx]


def _of_box(
    edit_by: Callable[[np.random.Generator], Edit], when: Frames = once, **which: Any
) -> Apply:
    """Edit an actor's box in one agent's label of one frame, or of others."""
    return of_actor(
        lambda place, rng, agent, frames, actor: place.edit_rows(
            agent, frames, edit_by(rng), actor=actor
        ),
        when,
        **which,
    )


def _of_agent(edit: Edit) -> Apply:
    """Edit all boxes of one agent."""
    return lambda place, rng: place.edit_rows(place.any_agent(rng), place.frames, edit)


def _of_all(edit: Edit) -> Apply:
    """Edit all boxes of all agents."""

    def apply(place: Place, _: np.random.Generator) -> None:
        for agent in place.agents:
            place.edit_rows(agent, place.frames, edit)

    return apply


def _swap_a_vehicles_axes(place: Place, rng: np.random.Generator) -> None:
    while True:  # a pedestrian is as wide as long
        agent, actor = place.shared_actor(rng)
        if place.row_of(place.rows(agent, place.frames[0]), actor)[0] != "pedestrian":
            break
    place.edit_rows(agent, place.frames, _swap_axes, actor=actor)


GROUP.add(
    {
        "x_sign": ("A box's x has the other sign at one frame.", _of_box(lambda _: _scale("x"))),
        "size_negative": (
            "A length, width or height is negative.",
            _of_box(lambda rng: _scale(str(rng.choice(["l", "w", "h"])))),
        ),
        "y_flipped_in_a_frame": (
            "All y of one label file have the other sign.",
            lambda place, rng: place.edit_rows(
                place.any_agent(rng), [place.any_frame(rng)], _scale("y")
            ),
        ),
        "y_flipped": ("All y of an agent have the other sign.", _of_agent(_scale("y"))),
        "yaw_flipped": ("All yaws of an agent have the other sign.", _of_agent(_scale("yaw"))),
        "labels_right_handed": (
            "An agent's labels are right-handed: y, yaw and vy have the other sign.",
            _of_agent(_scale("y", "yaw", "vy")),
        ),
        "all_labels_right_handed": (
            "All agents' labels are right-handed, but the poses are not.",
            _of_all(_scale("y", "yaw", "vy")),
        ),
        "yaw_in_degrees": (
            "An agent's yaws are degrees.",
            _of_agent(_scale("yaw", by=180 / np.pi)),
        ),
        "yaw_turned": (
            "A box is turned by 90° at one frame.",
            _of_box(lambda _: _add(["yaw"], [np.pi / 2])),
        ),
        "yaw_turned_lone": (
            "A vehicle is turned by 90° at one frame, and no other agent is there.",
            _of_box(lambda _: _add(["yaw"], [np.pi / 2]), in_the_middle, lone=True, vehicle=True),
        ),
        "size_axes_swapped": (
            "A vehicle's length and width are exchanged in one agent.",
            _swap_a_vehicles_axes,
        ),
        "all_size_axes_swapped": (
            "Length and width are exchanged in all labels of all agents.",
            _of_all(_swap_axes),
        ),
        "size_scaled": (
            "An actor is a quarter larger in one agent.",
            _of_box(lambda _: _scale("l", "w", "h", by=1.25), always),
        ),
        "size_halved_in_a_frame": (
            "A box has half its size (as if the file had half lengths) at one frame.",
            _of_box(lambda _: _scale("l", "w", "h", by=0.5)),
        ),
    },
)
GROUP.add(
    {
        "all_sizes_halved": (
            "All boxes of all agents have half their size.",
            _of_all(_scale("l", "w", "h", by=0.5)),
        )
    },
    deep=True,
)


def _offset(length: float) -> Apply:
    return lambda place, rng: place.edit_rows(
        place.any_agent(rng), place.frames, _move(rng, length)
    )


def _lone_moved(place: Place, rng: np.random.Generator) -> None:
    frame = place.middle_frame(rng)
    _of_box(lambda rng: _move(rng, 2.0), lambda *_: [frame], lone=True)(place, rng)


GROUP.add(
    {
        "positions_offset": ("All boxes of an agent are 0.3 m too far to one side.", _offset(0.3)),
        "positions_offset_by_a_metre": (
            "All boxes of an agent are 1 m too far to one side.",
            _offset(1.0),
        ),
        "heights_of_the_ground": (
            "z of an agent's boxes is at their bottom, not at their centre.",
            _of_agent(_to_the_ground),
        ),
        "box_moved": (
            "A box is 2 m too far to one side at one frame.",
            _of_box(lambda rng: _move(rng, 2.0)),
        ),
        "box_moved_lone": (
            (
                "A box is 2 m too far to one side at one frame in the middle of the "
                "scenario, and no other agent is there."
            ),
            _lone_moved,
        ),
    },
)
GROUP.add(
    {
        "box_moved_lone_at_the_end": (
            "A box is 2 m too far to one side at the last frame, and no other agent is there.",
            _of_box(lambda rng: _move(rng, 2.0), lambda place, _: [place.frames[-1]], lone=True),
        ),
    },
    beyond="a collision may move actors suddenly in the last frames, and no other agent saw them",
)


def _change_speeds(
    place: Place, agent: str, frames: Sequence[int], way: tuple[float, float], *, own_row: bool
) -> None:
    for frame in frames:
        rows = place.rows(agent, frame)
        rows[0] = [repr(float(word) + more) for word, more in zip(rows[0], way, strict=True)]
        if own_row:
            _add(("vx", "vy"), way)(place.row_of(rows, OWN_ACTOR_ID))
        place.write_rows(agent, frame, rows)


def _freeze(place: Place, rng: np.random.Generator) -> None:
    agent, actor = place.shared_actor(rng, moving=True)
    frame = int(rng.choice(place.frames[1:]))
    calib = place.calib(agent, frame)
    world = [*place.sightings[agent][actor][frame - 1], 1.0]
    there = np.linalg.inv(calib["ego_to_world"] @ calib["lidar_to_ego"]) @ world
    words = [repr(float(value)) for value in there[:3]]
    place.edit_rows(agent, [frame], lambda row: row.__setitem__(slice(1, 4), words), actor=actor)


GROUP.add(
    {
        "box_lifted": (
            "A box is 1.5 m too high at one frame.",
            _of_box(lambda _: _add("z", [1.5])),
        ),
        "own_row_moved": (
            "The recording agent's own box is 3 m away from its place at all frames.",
            lambda place, rng: place.edit_rows(
                place.vehicle(rng), place.frames, _move(rng, 3.0), actor=OWN_ACTOR_ID
            ),
        ),
        "speed_changed": (
            "The header's speed is wrong by 5 m/s at one frame.",
            lambda place, rng: _change_speeds(
                place, place.vehicle(rng), [place.any_frame(rng)], _way(rng, 5.0), own_row=False
            ),
        ),
        "speeds_changed": (
            "The speed in header and own line of an agent is wrong by 5 m/s at all frames.",
            lambda place, rng: _change_speeds(
                place, place.vehicle(rng), place.frames, _way(rng, 5.0), own_row=True
            ),
        ),
        "velocity_reversed": (
            "A moving actor's velocity has the other sign in one agent.",
            _of_box(lambda _: _scale("vx", "vy"), always, moving=True),
        ),
        "velocities_in_another_frame": (
            "All velocities of an agent are turned by 90°.",
            _of_agent(_turn_velocity),
        ),
        "track_frozen": (
            "A moving actor stays where it was for two frames in one agent's labels, in the world.",
            _freeze,
        ),
    },
)
