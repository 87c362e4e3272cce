"""Label files with wrong positions, angles, sizes or speeds."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.editor import (
    FIELD,
    FrameChoice,
    UndoableEditor,
    all_frames,
    one_frame,
    one_middle_frame,
)
from fault_injection.kinds import Apply, Group, damage_actor

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


def _draw_shift(rng: np.random.Generator, length: float) -> Edit:
    return _add("xy", _draw_vector(rng, length))


def _draw_vector(rng: np.random.Generator, length: float) -> tuple[float, float]:
    angle = rng.uniform(0, 2 * np.pi)
    return length * float(np.cos(angle)), length * float(np.sin(angle))


def _swap_length_and_width(row: list[str]) -> None:
    length, width = FIELD["l"], FIELD["w"]
    row[length], row[width] = row[width], row[length]


def _lower_to_the_ground(row: list[str]) -> None:
    height = float(row[FIELD["h"]])
    _add("z", [-height / 2])(row)


def _turn_velocity(row: list[str]) -> None:
    vx, vy = FIELD["vx"], FIELD["vy"]
    negated_vy = repr(-float(row[vy]))
    row[vx], row[vy] = negated_vy, row[vx]


def _edit_box(
    draw_edit: Callable[[np.random.Generator], Edit],
    choose_frames: FrameChoice = one_frame,
    **criteria: Any,
) -> Apply:
    """Edit an actor's box in one agent's label of the chosen frames."""
    return damage_actor(
        lambda editor, rng, agent, frames, actor: editor.edit_rows(
            agent, frames, draw_edit(rng), actor=actor
        ),
        choose_frames,
        **criteria,
    )


def _edit_agent(edit: Edit) -> Apply:
    """Edit all boxes of one agent."""
    return lambda editor, rng: editor.edit_rows(editor.any_agent(rng), editor.frames, edit)


def _edit_all_agents(edit: Edit) -> Apply:
    """Edit all boxes of all agents."""

    def apply(editor: UndoableEditor, _: np.random.Generator) -> None:
        for agent in editor.agents:
            editor.edit_rows(agent, editor.frames, edit)

    return apply


def _swap_axes_of_a_vehicle(editor: UndoableEditor, rng: np.random.Generator) -> None:
    category = "pedestrian"
    while category == "pedestrian":  # a pedestrian is as wide as long
        agent, actor = editor.shared_actor(rng)
        first_rows = editor.rows(agent, editor.frames[0])
        category = editor.row_of(first_rows, actor)[0]
    editor.edit_rows(agent, editor.frames, _swap_length_and_width, actor=actor)


GROUP.add(
    {
        "x_sign": ("A box's x has the other sign at one frame.", _edit_box(lambda _: _scale("x"))),
        "size_negative": (
            "A length, width or height is negative.",
            _edit_box(lambda rng: _scale(str(rng.choice(["l", "w", "h"])))),
        ),
        "y_flipped_in_a_frame": (
            "All y of one label file have the other sign.",
            lambda editor, rng: editor.edit_rows(
                editor.any_agent(rng), [editor.any_frame(rng)], _scale("y")
            ),
        ),
        "y_flipped": ("All y of an agent have the other sign.", _edit_agent(_scale("y"))),
        "yaw_flipped": ("All yaws of an agent have the other sign.", _edit_agent(_scale("yaw"))),
        "labels_right_handed": (
            "An agent's labels are right-handed: y, yaw and vy have the other sign.",
            _edit_agent(_scale("y", "yaw", "vy")),
        ),
        "all_labels_right_handed": (
            "All agents' labels are right-handed, but the poses are not.",
            _edit_all_agents(_scale("y", "yaw", "vy")),
        ),
        "yaw_in_degrees": (
            "An agent's yaws are degrees.",
            _edit_agent(_scale("yaw", by=180 / np.pi)),
        ),
        "yaw_turned": (
            "A box is turned by 90° at one frame.",
            _edit_box(lambda _: _add(["yaw"], [np.pi / 2])),
        ),
        "yaw_turned_lone": (
            "A vehicle is turned by 90° at one frame, and no other agent is there.",
            _edit_box(
                lambda _: _add(["yaw"], [np.pi / 2]), one_middle_frame, lone=True, vehicle=True
            ),
        ),
        "size_axes_swapped": (
            "A vehicle's length and width are exchanged in one agent.",
            _swap_axes_of_a_vehicle,
        ),
        "all_size_axes_swapped": (
            "Length and width are exchanged in all labels of all agents.",
            _edit_all_agents(_swap_length_and_width),
        ),
        "size_scaled": (
            "An actor is a quarter larger in one agent.",
            _edit_box(lambda _: _scale("l", "w", "h", by=1.25), all_frames),
        ),
        "size_halved_in_a_frame": (
            "A box has half its size (as if the file had half lengths) at one frame.",
            _edit_box(lambda _: _scale("l", "w", "h", by=0.5)),
        ),
    },
)
GROUP.add(
    {
        "all_sizes_halved": (
            "All boxes of all agents have half their size.",
            _edit_all_agents(_scale("l", "w", "h", by=0.5)),
        )
    },
    deep=True,
)


def _shift_agent(length: float) -> Apply:
    return lambda editor, rng: editor.edit_rows(
        editor.any_agent(rng), editor.frames, _draw_shift(rng, length)
    )


def _move_lone_box(editor: UndoableEditor, rng: np.random.Generator) -> None:
    frame = editor.middle_frame(rng)
    _edit_box(lambda rng: _draw_shift(rng, 2.0), lambda *_: [frame], lone=True)(editor, rng)


GROUP.add(
    {
        "positions_offset": (
            "All boxes of an agent are 0.3 m too far to one side.",
            _shift_agent(0.3),
        ),
        "positions_offset_by_a_metre": (
            "All boxes of an agent are 1 m too far to one side.",
            _shift_agent(1.0),
        ),
        "heights_of_the_ground": (
            "z of an agent's boxes is at their bottom, not at their centre.",
            _edit_agent(_lower_to_the_ground),
        ),
        "box_moved": (
            "A box is 2 m too far to one side at one frame.",
            _edit_box(lambda rng: _draw_shift(rng, 2.0)),
        ),
        "box_moved_lone": (
            (
                "A box is 2 m too far to one side at one frame in the middle of the "
                "scenario, and no other agent is there."
            ),
            _move_lone_box,
        ),
    },
)
GROUP.add(
    {
        "box_moved_lone_at_the_end": (
            "A box is 2 m too far to one side at the last frame, and no other agent is there.",
            _edit_box(
                lambda rng: _draw_shift(rng, 2.0), lambda editor, _: [editor.frames[-1]], lone=True
            ),
        ),
    },
    beyond="a collision may move actors suddenly in the last frames, and no other agent saw them",
)


def _change_speeds(
    editor: UndoableEditor,
    agent: str,
    frames: Sequence[int],
    change: tuple[float, float],
    *,
    own_row: bool,
) -> None:
    for frame in frames:
        rows = editor.rows(agent, frame)
        rows[0] = [repr(float(word) + amount) for word, amount in zip(rows[0], change, strict=True)]
        if own_row:
            _add(("vx", "vy"), change)(editor.row_of(rows, OWN_ACTOR_ID))
        editor.write_rows(agent, frame, rows)


def _freeze_actor(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, actor = editor.shared_actor(rng, moving=True)
    frame = int(rng.choice(editor.frames[1:]))
    calib = editor.calib(agent, frame)
    world_from_lidar = calib["ego_to_world"] @ calib["lidar_to_ego"]
    old_position = [*editor.sightings[agent][actor][frame - 1], 1.0]
    position = np.linalg.inv(world_from_lidar) @ old_position
    words = [repr(float(value)) for value in position[:3]]
    editor.edit_rows(agent, [frame], lambda row: row.__setitem__(slice(1, 4), words), actor=actor)


GROUP.add(
    {
        "box_lifted": (
            "A box is 1.5 m too high at one frame.",
            _edit_box(lambda _: _add("z", [1.5])),
        ),
        "own_row_moved": (
            "The recording agent's own box is 3 m away from its place at all frames.",
            lambda editor, rng: editor.edit_rows(
                editor.any_vehicle(rng), editor.frames, _draw_shift(rng, 3.0), actor=OWN_ACTOR_ID
            ),
        ),
        "speed_changed": (
            "The header's speed is wrong by 5 m/s at one frame.",
            lambda editor, rng: _change_speeds(
                editor,
                editor.any_vehicle(rng),
                [editor.any_frame(rng)],
                _draw_vector(rng, 5.0),
                own_row=False,
            ),
        ),
        "speeds_changed": (
            "The speed in header and own line of an agent is wrong by 5 m/s at all frames.",
            lambda editor, rng: _change_speeds(
                editor, editor.any_vehicle(rng), editor.frames, _draw_vector(rng, 5.0), own_row=True
            ),
        ),
        "velocity_reversed": (
            "A moving actor's velocity has the other sign in one agent.",
            _edit_box(lambda _: _scale("vx", "vy"), all_frames, moving=True),
        ),
        "velocities_in_another_frame": (
            "All velocities of an agent are turned by 90°.",
            _edit_agent(_turn_velocity),
        ),
        "track_frozen": (
            "A moving actor stays where it was for two frames in one agent's labels, in the world.",
            _freeze_actor,
        ),
    },
)
