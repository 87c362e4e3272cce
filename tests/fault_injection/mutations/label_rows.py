"""Label files with wrong lines, ids or numbers of lines, though each line can be read."""

from collections.abc import Callable, Sequence

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.editor import (
    FIELD,
    NEAR_DISTANCE_M,
    UndoableEditor,
    all_frames,
    one_frame,
    one_middle_frame,
    one_of,
)
from fault_injection.kinds import DamageActor, Group, damage_actor

GROUP = Group("label, lines and ids")
_ID_FIELD, _POINTS_FIELD, _VISIBLE_FIELD = (
    FIELD["id"],
    FIELD["num_lidar_pts"],
    FIELD["camera_visible"],
)

_SIMILAR_CLASS = {"car": "truck", "truck": "van", "van": "car", "cyclist": "motorcycle"}


def _set_id(
    editor: UndoableEditor, agent: str, frames: Sequence[int], actor: int, new: int
) -> None:
    editor.edit_rows(agent, frames, lambda row: row.__setitem__(_ID_FIELD, str(new)), actor=actor)


def _give_new_id(
    editor: UndoableEditor, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    """Give an actor an id that no other actor has."""
    largest_id = max(map(max, editor.sightings.values()))
    _set_id(editor, agent, frames, actor, largest_id + 1)


def _remove_id(
    editor: UndoableEditor, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    _set_id(editor, agent, frames, actor, -1)


def _remove_row(
    editor: UndoableEditor, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    editor.remove_row(agent, frames, actor)


def _set_class(choose_class: Callable[[str], str]) -> DamageActor:
    def edit(row: list[str]) -> None:
        row[0] = choose_class(row[0])

    return lambda editor, _, agent, frames, actor: editor.edit_rows(
        agent, frames, edit, actor=actor
    )


def _first_or_last_frame(editor: UndoableEditor, rng: np.random.Generator) -> Sequence[int]:
    frame = rng.choice([1, editor.frames[-1]])
    return [int(frame)]


def _duplicate_row(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, frame = editor.any_agent(rng), editor.any_frame(rng)
    rows = editor.rows(agent, frame)
    tracked_rows = [row for row in rows[1:] if int(row[_ID_FIELD]) > 0]
    rows.append(tracked_rows[rng.integers(len(tracked_rows))])
    editor.write_rows(agent, frame, rows)


def _remove_boxes(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, frame = editor.any_agent(rng), editor.middle_frame(rng)
    header = editor.rows(agent, frame)[:1]
    editor.write_rows(agent, frame, header)


def _exchange_ids(editor: UndoableEditor, rng: np.random.Generator, frames: Sequence[int]) -> None:
    agent, (actor, other) = editor.steady_actors(rng, 2, moving=True)
    new_ids = {str(actor): str(other), str(other): str(actor)}

    def exchange(row: list[str]) -> None:
        row[_ID_FIELD] = new_ids.get(row[_ID_FIELD], row[_ID_FIELD])

    editor.edit_rows(agent, frames, exchange)


GROUP.add(
    {
        "line_removed": (
            (
                "A near actor that others see too is missing from one agent's label "
                "at one frame in the middle of the "
                "scenario."
            ),
            damage_actor(_remove_row, one_middle_frame, within=NEAR_DISTANCE_M),
        ),
        "line_removed_at_an_end": (
            (
                "A near actor that others see too is missing from one agent's label at "
                "the first or last frame."
            ),
            damage_actor(_remove_row, _first_or_last_frame, within=NEAR_DISTANCE_M),
        ),
        "line_removed_lone": (
            (
                "A near actor is missing at one frame in the middle of the scenario, and "
                "no other agent is there."
            ),
            damage_actor(_remove_row, one_middle_frame, lone=True),
        ),
        "actor_removed": (
            "A near actor that others see too is missing from all labels of one agent.",
            damage_actor(_remove_row, all_frames, within=NEAR_DISTANCE_M),
        ),
        "line_duplicated": ("A line appears twice.", _duplicate_row),
        "boxes_removed": ("One label file has lost all boxes, but not its header.", _remove_boxes),
        "ids_exchanged": (
            "Two moving actors' ids are exchanged in one agent, at all frames.",
            lambda editor, rng: _exchange_ids(editor, rng, editor.frames),
        ),
        "ids_exchanged_in_a_frame": (
            "Two moving actors' ids are exchanged in one agent, at one frame.",
            lambda editor, rng: _exchange_ids(editor, rng, [editor.any_frame(rng)]),
        ),
        "id_changed": (
            "An actor that others see too has a new id in one agent, at all frames.",
            damage_actor(_give_new_id, all_frames),
        ),
        "id_changed_in_a_frame": (
            "An actor that others see too has a new id in one agent, at one frame.",
            damage_actor(_give_new_id, one_frame),
        ),
    },
)
GROUP.add(
    {
        "id_changed_lone": (
            "An actor has a new id at all frames, and no other agent is there.",
            damage_actor(_give_new_id, all_frames, lone=True),
        ),
    },
    harmless="nothing else names that actor, so nothing contradicts the new id",
)


def _give_id_twice(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, (actor, other) = editor.steady_actors(rng, 2)
    _set_id(editor, agent, [editor.any_frame(rng)], other, actor)


def _give_impossible_id(editor: UndoableEditor, rng: np.random.Generator) -> None:
    _, actor = editor.shared_actor(rng)
    impossible_id = int(rng.choice([-7, 0x7FFFFFFF]))
    for agent in editor.agents:
        _set_id(editor, agent, editor.frames, actor, impossible_id)


def _remove_ids(editor: UndoableEditor, agent: str, frames: Sequence[int]) -> None:
    def remove(row: list[str]) -> None:
        if row[_ID_FIELD] != str(OWN_ACTOR_ID):
            row[_ID_FIELD] = "-1"

    editor.edit_rows(agent, frames, remove)


GROUP.add(
    {
        "id_twice": ("Two boxes of one label file have the same id.", _give_id_twice),
        "id_odd": (
            "An actor's id is impossible in the format, in all labels of all agents.",
            _give_impossible_id,
        ),
    },
)
GROUP.add(
    {
        "id_lost": (
            "A near actor that others track has the id of an untracked one (−1) at one frame.",
            damage_actor(_remove_id, one_middle_frame, within=NEAR_DISTANCE_M),
        )
    },
    harmless="real labels are not all_frames tracked either: one has an untracked row at 22 m",
)


def _duplicate_own_row(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent, frame = editor.any_vehicle(rng), editor.any_frame(rng)
    rows = editor.rows(agent, frame)
    rows.append(editor.row_of(rows, OWN_ACTOR_ID))
    editor.write_rows(agent, frame, rows)


def _give_own_row_true_id(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent = editor.any_vehicle(rng)
    true_id = editor.agent_ids()[editor.agents.index(agent)]
    _set_id(editor, agent, editor.frames, OWN_ACTOR_ID, true_id)


def _give_the_pole_an_own_row(editor: UndoableEditor, rng: np.random.Generator) -> None:
    frame = editor.any_frame(rng)
    actor = one_of(sorted(editor.actors_always_seen("infrastructure")), rng)
    _set_id(editor, "infrastructure", [frame], actor, OWN_ACTOR_ID)


def _contradict_size(editor: UndoableEditor, rng: np.random.Generator) -> None:
    _, actor = editor.shared_actor(rng)
    first_rows = [
        row for agent in editor.agents for row in editor.rows(agent, editor.frames[0])[1:]
    ]
    old_class = next(row[0] for row in first_rows if int(row[_ID_FIELD]) == actor)
    is_small = old_class in ("pedestrian", "cyclist", "motorcycle")
    new_class = "car" if is_small else "pedestrian"
    for agent in editor.agents:
        editor.edit_rows(
            agent, editor.frames, lambda row: row.__setitem__(0, new_class), actor=actor
        )


def _exchange_frames(editor: UndoableEditor, rng: np.random.Generator) -> None:
    agent = editor.any_agent(rng)
    frame, other = map(int, rng.choice(editor.frames, size=2, replace=False))
    editor.exchange(editor.file(agent, "label", frame), editor.file(agent, "label", other))


GROUP.add(
    {
        "ids_lost": (
            "All other actors are untracked (−1) in one agent's labels.",
            lambda editor, rng: _remove_ids(editor, editor.any_agent(rng), editor.frames),
        ),
        "ids_lost_at_one_frame": (
            "All other actors are untracked (−1) in one label.",
            lambda editor, rng: _remove_ids(
                editor, editor.any_agent(rng), [editor.middle_frame(rng)]
            ),
        ),
        "own_row_removed": (
            "The recording agent's own line is missing at one frame.",
            lambda editor, rng: editor.remove_row(
                editor.any_vehicle(rng), [editor.any_frame(rng)], OWN_ACTOR_ID
            ),
        ),
        "own_row_removed_always": (
            "The recording agent's own line is missing at all frames.",
            lambda editor, rng: editor.remove_row(
                editor.any_vehicle(rng), editor.frames, OWN_ACTOR_ID
            ),
        ),
        "own_row_duplicated": (
            "The recording agent's own line appears twice.",
            _duplicate_own_row,
        ),
        "own_row_under_true_id": (
            "The recording agent's own line has its actor id instead of −100, at all frames.",
            _give_own_row_true_id,
        ),
        "own_row_on_the_pole": (
            "The infrastructure's label has an own line (−100).",
            _give_the_pole_an_own_row,
        ),
        "class_exchanged": (
            "One line has another class of the same kind, such as truck for car.",
            damage_actor(
                _set_class(lambda old_class: _SIMILAR_CLASS.get(old_class, "cyclist")), one_frame
            ),
        ),
        "class_exchanged_lone": (
            "An actor has another class at one frame, and no other agent is there.",
            damage_actor(
                _set_class(lambda old_class: "truck" if old_class == "car" else "car"),
                one_frame,
                lone=True,
            ),
        ),
        "class_against_size": (
            (
                "Cars are pedestrians and pedestrians are cars in all labels of all "
                "agents; sizes do not change."
            ),
            _contradict_size,
        ),
        "label_of_next_frame": (
            "A moving agent's label file is replaced by the next frame's.",
            lambda editor, rng: editor.take_next_of_moving_agent(rng, "label"),
        ),
        "labels_shifted": (
            "All labels of a moving agent are one frame early; the last one appears twice.",
            lambda editor, rng: editor.shift_one_frame_early(editor.moving_agent(rng), "label"),
        ),
        "labels_shifted_on_the_pole": (
            (
                "All labels of the standing infrastructure are one frame early; the "
                "last one appears twice."
            ),
            lambda editor, _: editor.shift_one_frame_early("infrastructure", "label"),
        ),
        "labels_of_two_frames_exchanged": (
            "Two frames' label files of an agent are exchanged.",
            _exchange_frames,
        ),
        "labels_of_two_agents_exchanged": (
            "Two agents' label files are exchanged at one frame.",
            lambda editor, rng: editor.exchange_agents(
                editor.two_agents(rng), "label", [editor.any_frame(rng)]
            ),
        ),
        "labels_of_two_agents_exchanged_always": (
            "Two agents' label files are exchanged at all frames.",
            lambda editor, rng: editor.exchange_agents(
                editor.two_agents(rng), "label", editor.frames
            ),
        ),
    },
)
GROUP.add(
    {
        "points_changed": (
            "A box's number of LiDAR points is wrong.",
            lambda editor, rng: editor.edit_any_row(
                rng,
                lambda row: row.__setitem__(_POINTS_FIELD, str(int(row[_POINTS_FIELD]) * 2 + 30)),
            ),
        ),
    },
    deep=True,
)
GROUP.add(
    {
        "points_negative": (
            "A box's number of LiDAR points is negative.",
            lambda editor, rng: editor.edit_any_row(
                rng, lambda row: row.__setitem__(_POINTS_FIELD, "-3")
            ),
        ),
    },
)
GROUP.add(
    {
        "visible_flipped": (
            "A box's camera_visible is wrong.",
            lambda editor, rng: editor.edit_any_row(
                rng, lambda row: row.__setitem__(_VISIBLE_FIELD, str(row[_VISIBLE_FIELD] != "True"))
            ),
        ),
    },
    harmless="no other file says what a camera sees; only a renderer could find it",
)
