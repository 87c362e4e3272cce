"""A meta file in words (docs/format.md, meta)."""

from collections.abc import Sequence
from pathlib import Path

from deepaccident_devkit.reading import shortened
from deepaccident_devkit.release.meta import Meta, read_meta
from deepaccident_devkit.taxonomy import META_AGENTS, UNTRACKED_ID, VEHICLE_AGENTS, WARM_UP_FRAMES
from deepaccident_devkit.text import columns_text

_TEXTS = {
    "road_type": ("road type", "how many ways meet"),
    "another_vehicle_spawn_side": ("spawn side", "where the other vehicle comes from"),
    "ego_vehicle_direction": ("direction of ego", "where the ego vehicle goes at the junction"),
    "other_vehicle_direction": ("direction of other", "where the other vehicle goes at the junction"),
}
_WIDEST = 120
_NOBODY = str(UNTRACKED_ID)
_AFTERWORD = "In Python: release.read_meta(path), with raw=True for its lines."


def meta_text(path: Path) -> str:
    """What a meta file says, token by token; raises as `read_meta` does."""
    meta = read_meta(path)
    numbered = [(number, line.strip()) for number, line in enumerate(read_meta(path, raw=True), start=1)]
    (first, words), *others = [(number, line) for number, line in numbered if line]
    rows = [["line", "token", "name", "meaning"]]
    rows += [[str(first), *map(_cell, cells)] for cells in _first_line(meta, words.split())]
    for number, line in others:
        key, _, value = line.partition(":")
        rows += [[str(number), *map(_cell, cells)] for cells in _entry(meta, key.strip(), value.strip())]
    return (
        f"A meta file: how a scenario was set up and how it ended. {_ending(meta)}\n\n"
        f"{columns_text(rows, left=4)}\n\n{_AFTERWORD}"
    )


def _cell(text: str) -> str:
    return shortened(text, _WIDEST)


def _ending(meta: Meta) -> str:
    if meta.collision is None:
        return "It ended without a collision."
    return (
        f"It ended with a collision of a {' and a '.join(map(shortened, meta.collision.classes))}, at its last frame."
    )


def _first_line(meta: Meta, words: Sequence[str]) -> list[tuple[str, str, str]]:
    time = "" if meta.time_of_day is None else f"; time of day: {meta.time_of_day}"
    recorded = meta.recorded_frames
    none = "none: there was no collision"
    meanings = [
        ("weather and time", f"weather: {meta.weather}{time}"),
        ("first id", _who(meta, words[1])),
        ("first class", "class of the first one"),
        ("second id", _who(meta, words[3])),
        ("second class", "class of the second one"),
        ("impact", "the simulator's impulse of the contact; the release names no unit (CARLA's is N·s)"),
        ("spawn relation", "how the two were set out; the release does not say what its words mean"),
        ("contact side", "where the contact was"),
        ("simulated frames", f"{recorded} recorded ones and {WARM_UP_FRAMES} of warm-up before them, at 10 Hz"),
    ]
    collided = meta.collision is not None
    return [
        (word, name, meaning if collided or word != _NOBODY else none)
        for word, (name, meaning) in zip(words, meanings, strict=True)
    ]


def _entry(meta: Meta, key: str, value: str) -> list[tuple[str, str, str]]:
    """The tokens of a later line."""
    words = value.split()
    if key == "colliding agents" and len(words) == 2:  # of a key that stands twice, only the last line was checked
        pair = "of those who collided" if meta.collision else "of those who were to collide"
        return [
            (word, f"{which} {pair}", META_AGENTS.get(word) or "a road user that records nothing, or nobody")
            for word, which in zip(words, ("first", "second"), strict=True)
        ]
    if key == "agents id" and len(words) == len(VEHICLE_AGENTS):
        return [
            (word, f"actor id of {agent}", "its rows in the other agents' labels have this id")
            for word, agent in zip(words, VEHICLE_AGENTS, strict=True)
        ]
    name, meaning = _TEXTS.get(key, (key, "a line that the devkit does not know"))
    return [(value or "–", name, meaning if value else "unsaid")]


def _who(meta: Meta, word: str) -> str:
    ids = [str(actor_id) for actor_id in meta.agent_ids or ()]
    if word in ids:
        return f"actor id of {VEHICLE_AGENTS[ids.index(word)]}"
    return "actor id" + (" of a road user that records nothing" if ids else "")
