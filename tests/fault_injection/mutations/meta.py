"""Meta files."""

from collections.abc import Sequence

import numpy as np

from fault_injection.kinds import Group, cut, garbage
from fault_injection.place import Place

GROUP = Group("meta")
NUMBER_OF_FRAMES, IMPACT = 8, 5
IDS, CLASSES = (1, 3), (2, 4)
"""Words of the first line."""


def _write(place: Place, lines: Sequence[str]) -> None:
    place.write(place.scenario.meta_path, ("\n".join(lines) + "\n").encode("ascii"))


def _set_word(place: Place, number: int, word: object) -> None:
    """Replace a word of the first line."""
    first, *others = place.meta_lines()
    words = first.split()
    _write(place, [" ".join([*words[:number], str(word), *words[number + 1 :]]), *others])


def _set_entry(place: Place, key: str, value: object) -> None:
    _write(
        place,
        [
            f" {key}: {value}" if line.split(":")[0].strip() == key else line
            for line in place.meta_lines()
        ],
    )


def _set_ids(place: Place, ids: Sequence[int]) -> None:
    _set_entry(place, "agents id", " ".join(map(str, ids)))


def _cut(place: Place, rng: np.random.Generator) -> None:
    path, end = place.scenario.meta_path, sum(len(line) + 1 for line in place.meta_lines()[:3]) - 1
    place.write(path, cut(path.read_bytes(), rng, end=end))


def _count_other_frames(place: Place, rng: np.random.Generator) -> None:
    _set_word(
        place,
        NUMBER_OF_FRAMES,
        int(place.meta_lines()[0].split()[-1]) + int(rng.choice([-3, -2, -1, 1, 2, 3])),
    )


GROUP.add(
    {
        "meta_removed": (
            "A labelled scenario has no meta file.",
            lambda place, _: place.remove(place.scenario.meta_path),
        ),
        "meta_cut": ("The meta file ends at a random byte of its first three lines.", _cut),
    },
)
GROUP.add(
    {
        "meta_last_lines_removed": (
            "The meta file ends after its third line.",
            lambda place, _: _write(place, place.meta_lines()[:3]),
        ),
    },
    harmless="real meta files can lack their last four lines too (docs/format.md, Meta)",
)
GROUP.add(
    {
        "meta_emptied": (
            "The meta file is empty.",
            lambda place, _: place.write(place.scenario.meta_path, b""),
        ),
        "meta_garbage": (
            "The meta file holds random bytes.",
            lambda place, rng: place.write(place.scenario.meta_path, garbage(bytes(200), rng)),
        ),
        "meta_frames_changed": (
            "The meta file counts one to three frames more or less.",
            _count_other_frames,
        ),
    },
)


def _id_from_afar(place: Place, rng: np.random.Generator) -> None:
    number, last = int(rng.choice(IDS)), place.frames[-1]
    near = place.position("ego_vehicle", last)
    others = [
        actor
        for actor, places in place.sightings["ego_vehicle"].items()
        if last in places and np.hypot(*(places[last] - near)[:2]) > 20
    ]
    _set_word(place, number, rng.choice(others))


def _other_pair(place: Place, rng: np.random.Generator) -> None:
    line = next(line for line in place.meta_lines() if "colliding agents:" in line)
    pairs = ["ego other", "ego_behind other_behind", "ego other_behind", "ego_behind other"]
    others = [pair for pair in pairs if set(pair.split()) != set(line.split(":")[1].split())]
    _set_entry(place, "colliding agents", rng.choice(others))


def _other_class(place: Place, rng: np.random.Generator) -> None:
    number = int(rng.choice(CLASSES))
    _set_word(
        place,
        number,
        rng.choice(sorted({"pedestrian", "motorcycle"} - {place.meta_lines()[0].split()[number]})),
    )


def _no_collision(place: Place, rng: np.random.Generator) -> None:
    first, _, *others = place.meta_lines()
    words = first.split()
    _write(
        place,
        [" ".join([words[0], *["-1"] * 7, words[8]]), " colliding agents: none none", *others],
    )


def _other_id(place: Place, rng: np.random.Generator) -> None:
    words, agents = place.meta_lines()[0].split(), place.agent_ids()
    _set_word(
        place, int(rng.choice([number for number in IDS if int(words[number]) in agents])), "19876"
    )


GROUP.add(
    {
        "meta_pair_unknown": ("A colliding agent's id is in no label.", _other_id),
        "meta_pair_far_away": (
            "A colliding actor's id is that of another actor, far from the collision.",
            _id_from_afar,
        ),
        "meta_colliding_agents": (
            "The colliding agents are not those of the colliding ids.",
            _other_pair,
        ),
        "meta_class_changed": (
            "A colliding actor has another class than in the labels.",
            _other_class,
        ),
        "meta_class_unknown": (
            "A colliding actor's class does not exist.",
            lambda place, rng: _set_word(place, int(rng.choice(CLASSES)), "bus"),
        ),
        "meta_impact_nan": ("The impact is NaN.", lambda place, _: _set_word(place, IMPACT, "nan")),
    },
    only="accident",
)
GROUP.add(
    {"meta_collision_dropped": ("The meta file of an accident names no collision.", _no_collision)},
    only="accident",
    harmless="a scenario in an accident folder can have no collision (docs/format.md, Meta)",
)
GROUP.add(
    {
        "meta_pair_0": (
            "A colliding actor's id is 0.",
            lambda place, rng: _set_word(place, int(rng.choice(IDS)), "0"),
        ),
        "meta_nobody_named": (
            "The colliding agents are 'none none'.",
            lambda place, _: _set_entry(place, "colliding agents", "none none"),
        ),
        "meta_collision_words": (
            "The words of the collision are new ones.",
            lambda place, _: (_set_word(place, 6, "across"), _set_word(place, 7, "left_side"))[0],
        ),
    },
    only="accident",
    harmless="the release has such pairs, and perhaps other words (docs/format.md, Meta)",
)


def _twins_own(place: Place, rng: np.random.Generator) -> None:
    twin = place.root / "type1_subtype1_accident" / "meta" / place.scenario.meta_path.name
    place.write(place.scenario.meta_path, twin.read_bytes())


GROUP.add(
    {"meta_of_twin": ("A normal scenario has the meta file of its accident twin.", _twins_own)},
    only="normal",
)


def _permute_ids(place: Place, rng: np.random.Generator) -> None:
    ids, (one, other) = place.agent_ids(), rng.choice(4, size=2, replace=False)
    ids[one], ids[other] = ids[other], ids[one]
    _set_ids(place, ids)


def _change_id(place: Place, rng: np.random.Generator) -> None:
    ids = place.agent_ids()
    ids[rng.integers(4)] += 700
    _set_ids(place, ids)


_DIRECTIONS = ("ego_vehicle_direction", "other_vehicle_direction", "another_vehicle_spawn_side")
GROUP.add(
    {
        "meta_agent_ids_permuted": ("The agents' ids are in another order.", _permute_ids),
        "meta_agent_id_changed": ("An agent's id is a wrong number.", _change_id),
        "meta_road_type": (
            "The road type does not exist.",
            lambda place, rng: _set_entry(
                place, "road_type", rng.choice(["five-way junction", "unknown", "four-way"])
            ),
        ),
        "meta_weather": (
            "The weather and time of day do not exist.",
            lambda place, rng: _set_word(
                place, 0, rng.choice(["SnowNoon", "Rainy", "ClearMidnight", "wetnoon"])
            ),
        ),
        "meta_direction": (
            "A direction does not exist.",
            lambda place, rng: _set_entry(place, str(rng.choice(_DIRECTIONS)), "upwards"),
        ),
    },
)
