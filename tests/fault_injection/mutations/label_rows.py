"""Label files whose lines, ids or numbers of lines are wrong, though each line can be read."""

from collections.abc import Callable, Sequence

import numpy as np

from deepaccident_devkit.taxonomy import OWN_ACTOR_ID
from fault_injection.kinds import Group, of_actor
from fault_injection.place import FIELD, NEAR, Place, always, in_the_middle, once, one_of

GROUP = Group("label, lines and ids")
_ID, _POINTS, _VISIBLE = FIELD["id"], FIELD["num_lidar_pts"], FIELD["camera_visible"]
Damage = Callable[[Place, np.random.Generator, str, Sequence[int], int], None]
_EXCHANGED = {"car": "truck", "truck": "van", "van": "car", "cyclist": "motorcycle"}


def _set_id(place: Place, agent: str, frames: Sequence[int], actor: int, new: int) -> None:
    place.edit_rows(agent, frames, lambda row: row.__setitem__(_ID, str(new)), actor=actor)


def _renew_id(
    place: Place, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    """Give an actor an id that nobody has."""
    _set_id(
        place,
        agent,
        frames,
        actor,
        1 + max(actor for seen in place.sightings.values() for actor in seen),
    )


def _lose_id(
    place: Place, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    _set_id(place, agent, frames, actor, -1)


def _remove(
    place: Place, _: np.random.Generator, agent: str, frames: Sequence[int], actor: int
) -> None:
    place.remove_row(agent, frames, actor)


def _set_class(new: Callable[[str], str]) -> Damage:
    return lambda place, _, agent, frames, actor: place.edit_rows(
        agent, frames, lambda row: row.__setitem__(0, new(row[0])), actor=actor
    )


def _at_an_end(place: Place, rng: np.random.Generator) -> Sequence[int]:
    return [int(rng.choice([1, place.frames[-1]]))]


def _duplicate(place: Place, rng: np.random.Generator) -> None:
    agent, frame = place.any_agent(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    tracked = [row for row in rows[1:] if int(row[_ID]) > 0]
    place.write_rows(agent, frame, [*rows, tracked[rng.integers(len(tracked))]])


def _remove_boxes(place: Place, rng: np.random.Generator) -> None:
    agent, frame = place.any_agent(rng), place.middle_frame(rng)
    place.write_rows(agent, frame, place.rows(agent, frame)[:1])


def _exchange_ids(place: Place, rng: np.random.Generator, frames: Sequence[int]) -> None:
    agent, (one, other) = place.steady_ones(rng, 2, moving=True)
    new = {str(one): str(other), str(other): str(one)}
    place.edit_rows(agent, frames, lambda row: row.__setitem__(_ID, new.get(row[_ID], row[_ID])))


GROUP.add(
    {
        "line_removed": (
            (
                "A near actor that others see too is missing from one agent's label "
                "at one frame in the middle of the "
                "scenario."
            ),
            of_actor(_remove, in_the_middle, within=NEAR),
        ),
        "line_removed_at_an_end": (
            (
                "A near actor that others see too is missing from one agent's label at "
                "the first or last frame."
            ),
            of_actor(_remove, _at_an_end, within=NEAR),
        ),
        "line_removed_lone": (
            (
                "A near actor is missing at one frame in the middle of the scenario, and "
                "no other agent is there."
            ),
            of_actor(_remove, in_the_middle, lone=True),
        ),
        "actor_removed": (
            "A near actor that others see too is missing from all labels of one agent.",
            of_actor(_remove, always, within=NEAR),
        ),
        "line_duplicated": ("A line is there twice.", _duplicate),
        "boxes_removed": ("One label file has lost all boxes, but not its header.", _remove_boxes),
        "ids_exchanged": (
            "Two moving actors' ids are exchanged in one agent, at all frames.",
            lambda place, rng: _exchange_ids(place, rng, place.frames),
        ),
        "ids_exchanged_in_a_frame": (
            "Two moving actors' ids are exchanged in one agent, at one frame.",
            lambda place, rng: _exchange_ids(place, rng, [place.any_frame(rng)]),
        ),
        "id_changed": (
            "An actor that others see too has a new id in one agent, at all frames.",
            of_actor(_renew_id, always),
        ),
        "id_changed_in_a_frame": (
            "An actor that others see too has a new id in one agent, at one frame.",
            of_actor(_renew_id, once),
        ),
    },
)
GROUP.add(
    {
        "id_changed_lone": (
            "An actor has a new id at all frames, and no other agent is there.",
            of_actor(_renew_id, always, lone=True),
        ),
    },
    harmless="nothing else names that actor, so nothing contradicts the new id",
)


def _give_id_twice(place: Place, rng: np.random.Generator) -> None:
    (agent, (one, other)), frame = place.steady_ones(rng, 2), place.any_frame(rng)
    _set_id(place, agent, [frame], other, one)


def _give_odd_id(place: Place, rng: np.random.Generator) -> None:
    (_, actor), new = place.shared_actor(rng), int(rng.choice([-7, 0x7FFFFFFF]))
    for agent in place.agents:
        _set_id(place, agent, place.frames, actor, new)


def _lose_ids(place: Place, agent: str, frames: Sequence[int]) -> None:
    own = str(OWN_ACTOR_ID)
    place.edit_rows(
        agent, frames, lambda row: row.__setitem__(_ID, own if row[_ID] == own else "-1")
    )


GROUP.add(
    {
        "id_twice": ("Two boxes of one label file have the same id.", _give_id_twice),
        "id_odd": (
            "An actor's id is impossible in the format, in all labels of all agents.",
            _give_odd_id,
        ),
    },
)
GROUP.add(
    {
        "id_lost": (
            "A near actor that others track has the id of an untracked one (−1) at one frame.",
            of_actor(_lose_id, in_the_middle, within=NEAR),
        )
    },
    harmless="real labels are not always tracked either: one has an untracked row at 22 m",
)


def _duplicate_own(place: Place, rng: np.random.Generator) -> None:
    agent, frame = place.vehicle(rng), place.any_frame(rng)
    rows = place.rows(agent, frame)
    place.write_rows(agent, frame, [*rows, place.row_of(rows, OWN_ACTOR_ID)])


def _tell_own_id(place: Place, rng: np.random.Generator) -> None:
    agent = place.vehicle(rng)
    _set_id(place, agent, place.frames, OWN_ACTOR_ID, place.agent_ids()[place.agents.index(agent)])


def _give_the_pole_an_own_row(place: Place, rng: np.random.Generator) -> None:
    frame = place.any_frame(rng)
    _set_id(
        place,
        "infrastructure",
        [frame],
        one_of(sorted(place.steady("infrastructure")), rng),
        OWN_ACTOR_ID,
    )


def _contradict_size(place: Place, rng: np.random.Generator) -> None:
    _, actor = place.shared_actor(rng)
    first = (row for agent in place.agents for row in place.rows(agent, place.frames[0])[1:])
    old = next(row[0] for row in first if int(row[_ID]) == actor)
    new = "car" if old in ("pedestrian", "cyclist", "motorcycle") else "pedestrian"
    for agent in place.agents:
        place.edit_rows(agent, place.frames, lambda row: row.__setitem__(0, new), actor=actor)


def _exchange_frames(place: Place, rng: np.random.Generator) -> None:
    agent, frames = place.any_agent(rng), map(int, rng.choice(place.frames, size=2, replace=False))
    place.exchange(*(place.file(agent, "label", frame) for frame in frames))


GROUP.add(
    {
        "ids_lost": (
            "All other actors are untracked (−1) in one agent's labels.",
            lambda place, rng: _lose_ids(place, place.any_agent(rng), place.frames),
        ),
        "ids_lost_at_one_frame": (
            "All other actors are untracked (−1) in one label.",
            lambda place, rng: _lose_ids(place, place.any_agent(rng), [place.middle_frame(rng)]),
        ),
        "own_row_removed": (
            "The recording agent's own line is missing at one frame.",
            lambda place, rng: place.remove_row(
                place.vehicle(rng), [place.any_frame(rng)], OWN_ACTOR_ID
            ),
        ),
        "own_row_removed_always": (
            "The recording agent's own line is missing at all frames.",
            lambda place, rng: place.remove_row(place.vehicle(rng), place.frames, OWN_ACTOR_ID),
        ),
        "own_row_duplicated": ("The recording agent's own line is there twice.", _duplicate_own),
        "own_row_under_true_id": (
            "The recording agent's own line has its actor id instead of −100, at all frames.",
            _tell_own_id,
        ),
        "own_row_on_the_pole": (
            "The infrastructure's label has an own line (−100).",
            _give_the_pole_an_own_row,
        ),
        "class_exchanged": (
            "One line has another class of the same kind, such as truck for car.",
            of_actor(_set_class(lambda old: _EXCHANGED.get(old, "cyclist")), once),
        ),
        "class_exchanged_lone": (
            "An actor has another class at one frame, and no other agent is there.",
            of_actor(_set_class(lambda old: "truck" if old == "car" else "car"), once, lone=True),
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
            lambda place, rng: place.moving_takes_next(rng, "label"),
        ),
        "labels_shifted": (
            "All labels of a moving agent are one frame early; the last one is there twice.",
            lambda place, rng: place.one_frame_early(place.moving_agent(rng), "label"),
        ),
        "labels_shifted_on_the_pole": (
            (
                "All labels of the standing infrastructure are one frame early; the "
                "last one is there twice."
            ),
            lambda place, _: place.one_frame_early("infrastructure", "label"),
        ),
        "labels_of_two_frames_exchanged": (
            "Two frames' label files of an agent are exchanged.",
            _exchange_frames,
        ),
        "labels_of_two_agents_exchanged": (
            "Two agents' label files are exchanged at one frame.",
            lambda place, rng: place.exchange_agents(
                place.two_agents(rng), "label", [place.any_frame(rng)]
            ),
        ),
        "labels_of_two_agents_exchanged_always": (
            "Two agents' label files are exchanged at all frames.",
            lambda place, rng: place.exchange_agents(place.two_agents(rng), "label", place.frames),
        ),
    },
)
GROUP.add(
    {
        "points_changed": (
            "A box's number of LiDAR points is wrong.",
            lambda place, rng: place.edit_any_row(
                rng, lambda row: row.__setitem__(_POINTS, str(int(row[_POINTS]) * 2 + 30))
            ),
        ),
    },
    deep=True,
)
GROUP.add(
    {
        "points_negative": (
            "A box's number of LiDAR points is negative.",
            lambda place, rng: place.edit_any_row(rng, lambda row: row.__setitem__(_POINTS, "-3")),
        ),
    },
)
GROUP.add(
    {
        "visible_flipped": (
            "A box's camera_visible is wrong.",
            lambda place, rng: place.edit_any_row(
                rng, lambda row: row.__setitem__(_VISIBLE, str(row[_VISIBLE] != "True"))
            ),
        ),
    },
    harmless="no other file says what a camera sees; only a renderer could find it",
)
