"""Meta files."""

import numpy as np

from fault_injection.kinds import Group, cut, garbage
from fault_injection.place import Place

GROUP = Group("meta")


def _write(place: Place, lines: list[str]) -> None:
    place.write(place.scenario.meta_path, ("\n".join(lines) + "\n").encode("ascii"))


def _set_word(place: Place, number: int, word: str) -> str:
    """Replace a word of the first line."""
    lines = place.meta_lines()
    words = lines[0].split()
    old, words[number] = words[number], word
    _write(place, [" ".join(words), *lines[1:]])
    return f"{old} is {word}"


def _set_entry(place: Place, key: str, value: str) -> str:
    _write(place, [f" {key}: {value}" if line.split(":")[0].strip() == key else line for line in place.meta_lines()])
    return f"{key}: {value}"


@GROUP.kind()
def meta_removed(place: Place, rng: np.random.Generator) -> str:
    """A labelled scenario has no meta file."""
    place.remove(place.scenario.meta_path)
    return "removed"


@GROUP.kind()
def meta_cut(place: Place, rng: np.random.Generator) -> str:
    """The meta file ends at a random byte of its first three lines."""
    content = place.scenario.meta_path.read_bytes()
    end = sum(len(line) + 1 for line in place.meta_lines()[:3]) - 1
    shorter = cut(content, rng, end=end)
    place.write(place.scenario.meta_path, shorter)
    return f"ends in {shorter[-20:]!r}"


@GROUP.kind(harmless="real meta files can lack their last four lines too (docs/format.md, Meta)")
def meta_last_lines_removed(place: Place, rng: np.random.Generator) -> str:
    """The meta file ends after its third line."""
    _write(place, place.meta_lines()[:3])
    return "3 lines left"


@GROUP.kind()
def meta_emptied(place: Place, rng: np.random.Generator) -> str:
    """The meta file is empty."""
    place.write(place.scenario.meta_path, b"")
    return "empty"


@GROUP.kind()
def meta_garbage(place: Place, rng: np.random.Generator) -> str:
    """The meta file holds random bytes."""
    place.write(place.scenario.meta_path, garbage(rng, 200))
    return "200 bytes"


@GROUP.kind()
def meta_frames_changed(place: Place, rng: np.random.Generator) -> str:
    """The meta file counts one to three frames more or less."""
    frames = int(place.meta_lines()[0].split()[-1])
    return _set_word(place, 8, str(frames + int(rng.choice([-3, -2, -1, 1, 2, 3]))))


@GROUP.kind(only="accident")
def meta_pair_unknown(place: Place, rng: np.random.Generator) -> str:
    """A colliding actor's id is in no label."""
    return _set_word(place, int(rng.choice([1, 3])), "19876")


@GROUP.kind(only="accident")
def meta_pair_far_away(place: Place, rng: np.random.Generator) -> str:
    """A colliding actor's id is that of another actor, far from the collision."""
    number = int(rng.choice([1, 3]))
    last = place.frames[-1]
    near = place.position("ego_vehicle", last)
    others = [
        actor
        for actor, places in place.sightings["ego_vehicle"].items()
        if last in places and np.hypot(*(places[last] - near)[:2]) > 20
    ]
    return _set_word(place, number, str(rng.choice(others)))


@GROUP.kind(only="accident")
def meta_colliding_agents(place: Place, rng: np.random.Generator) -> str:
    """The colliding agents are not those of the colliding ids."""
    line = next(line for line in place.meta_lines() if "colliding agents:" in line)
    pairs = ["ego other", "ego_behind other_behind", "ego other_behind", "ego_behind other"]
    others = [pair for pair in pairs if set(pair.split()) != set(line.split(":")[1].split())]
    return _set_entry(place, "colliding agents", str(rng.choice(others)))


@GROUP.kind(only="accident")
def meta_class_changed(place: Place, rng: np.random.Generator) -> str:
    """A colliding actor has another class than in the labels."""
    number = int(rng.choice([2, 4]))
    others = {"pedestrian", "motorcycle"} - {place.meta_lines()[0].split()[number]}
    return _set_word(place, number, str(rng.choice(sorted(others))))


GROUP.add(
    {
        "meta_class_unknown": (
            "A colliding actor's class does not exist.",
            lambda place, rng: _set_word(place, int(rng.choice([2, 4])), "bus"),
        ),
        "meta_impact_nan": ("The impact is NaN.", lambda place, _: _set_word(place, 5, "nan")),
    },
    only="accident",
)


@GROUP.kind(only="accident", harmless="a scenario in an accident folder can have no collision (docs/format.md, Meta)")
def meta_collision_dropped(place: Place, rng: np.random.Generator) -> str:
    """The meta file of an accident names no collision."""
    words = place.meta_lines()[0].split()
    _write(
        place, [" ".join([words[0], *["-1"] * 7, words[8]]), " colliding agents: none none", *place.meta_lines()[2:]]
    )
    return "no collision"


@GROUP.kind(only="normal")
def meta_of_twin(place: Place, rng: np.random.Generator) -> str:
    """A normal scenario has the meta file of its accident twin."""
    twin = place.root / "type1_subtype1_accident" / "meta" / place.scenario.meta_path.name
    place.write(place.scenario.meta_path, twin.read_bytes())
    return "the twin's"


@GROUP.kind()
def meta_agent_ids_permuted(place: Place, rng: np.random.Generator) -> str:
    """The agents' ids are in another order."""
    ids = place.agent_ids()
    one, other = rng.choice(4, size=2, replace=False)
    ids[one], ids[other] = ids[other], ids[one]
    return _set_entry(place, "agents id", " ".join(map(str, ids)))


@GROUP.kind()
def meta_agent_id_changed(place: Place, rng: np.random.Generator) -> str:
    """An agent's id is a wrong number."""
    ids = place.agent_ids()
    ids[rng.integers(4)] += 700
    return _set_entry(place, "agents id", " ".join(map(str, ids)))


GROUP.add(
    {
        "meta_road_type": (
            "The road type does not exist.",
            lambda place, rng: _set_entry(
                place, "road_type", str(rng.choice(["five-way junction", "unknown", "four-way"]))
            ),
        ),
        "meta_weather": (
            "The weather and time of day do not exist.",
            lambda place, rng: _set_word(place, 0, str(rng.choice(["SnowNoon", "Rainy", "ClearMidnight", "wetnoon"]))),
        ),
    },
)


@GROUP.kind()
def meta_direction(place: Place, rng: np.random.Generator) -> str:
    """A direction does not exist."""
    key = str(rng.choice(["ego_vehicle_direction", "other_vehicle_direction", "another_vehicle_spawn_side"]))
    return _set_entry(place, key, "upwards")
