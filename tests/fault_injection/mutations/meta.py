"""Meta files."""

from collections.abc import Sequence

import numpy as np

from fault_injection.editor import UndoableEditor, ground_length
from fault_injection.kinds import Group, cut, garbage

GROUP = Group("meta")
FRAME_COUNT_WORD, IMPACT_WORD = 8, 5
ID_WORDS, CLASS_WORDS = (1, 3), (2, 4)
"""Indices of words of the first line."""


def _write(editor: UndoableEditor, lines: Sequence[str]) -> None:
    content = "".join(f"{line}\n" for line in lines)
    editor.write(editor.scenario.meta_path, content.encode("ascii"))


def _read_first_words(editor: UndoableEditor) -> list[str]:
    return editor.meta_lines()[0].split()


def _set_word(editor: UndoableEditor, index: int, word: object) -> None:
    """Replace a word of the first line."""
    words = _read_first_words(editor)
    words[index] = str(word)
    _write(editor, [" ".join(words), *editor.meta_lines()[1:]])


def _set_entry(editor: UndoableEditor, key: str, value: object) -> None:
    lines = editor.meta_lines()
    for index, line in enumerate(lines):
        if line.split(":")[0].strip() == key:
            lines[index] = f" {key}: {value}"
    _write(editor, lines)


def _set_ids(editor: UndoableEditor, ids: Sequence[int]) -> None:
    _set_entry(editor, "agents id", " ".join(map(str, ids)))


def _cut_in_first_lines(editor: UndoableEditor, rng: np.random.Generator) -> None:
    path = editor.scenario.meta_path
    end = len("\n".join(editor.meta_lines()[:3]))
    editor.write(path, cut(path.read_bytes(), rng, end=end))


def _change_frame_count(editor: UndoableEditor, rng: np.random.Generator) -> None:
    num_frames = int(_read_first_words(editor)[-1])
    difference = int(rng.choice([-3, -2, -1, 1, 2, 3]))
    _set_word(editor, FRAME_COUNT_WORD, num_frames + difference)


GROUP.add(
    {
        "meta_removed": (
            "A labelled scenario has no meta file.",
            lambda editor, _: editor.remove(editor.scenario.meta_path),
        ),
        "meta_cut": (
            "The meta file ends at a random byte of its first three lines.",
            _cut_in_first_lines,
        ),
    },
)
GROUP.add(
    {
        "meta_last_lines_removed": (
            "The meta file ends after its third line.",
            lambda editor, _: _write(editor, editor.meta_lines()[:3]),
        ),
    },
    harmless="real meta files can lack their last four lines too (docs/format.md, Meta)",
)
GROUP.add(
    {
        "meta_emptied": (
            "The meta file is empty.",
            lambda editor, _: editor.write(editor.scenario.meta_path, b""),
        ),
        "meta_garbage": (
            "The meta file holds random bytes.",
            lambda editor, rng: editor.write(editor.scenario.meta_path, garbage(bytes(200), rng)),
        ),
        "meta_frames_changed": (
            "The meta file counts one to three frames more or less.",
            _change_frame_count,
        ),
    },
)


def _set_distant_id(editor: UndoableEditor, rng: np.random.Generator) -> None:
    index = int(rng.choice(ID_WORDS))
    last_frame = editor.frames[-1]
    ego_position = editor.position("ego_vehicle", last_frame)
    distant_actors = [
        actor
        for actor, positions in editor.sightings["ego_vehicle"].items()
        if last_frame in positions and ground_length(positions[last_frame] - ego_position) > 20
    ]
    _set_word(editor, index, rng.choice(distant_actors))


def _set_other_pair(editor: UndoableEditor, rng: np.random.Generator) -> None:
    line = next(line for line in editor.meta_lines() if "colliding agents:" in line)
    true_agents = set(line.split(":")[1].split())
    pairs = ["ego other", "ego_behind other_behind", "ego other_behind", "ego_behind other"]
    other_pairs = [pair for pair in pairs if set(pair.split()) != true_agents]
    _set_entry(editor, "colliding agents", rng.choice(other_pairs))


def _set_other_class(editor: UndoableEditor, rng: np.random.Generator) -> None:
    index = int(rng.choice(CLASS_WORDS))
    true_class = _read_first_words(editor)[index]
    other_classes = sorted({"pedestrian", "motorcycle"} - {true_class})
    _set_word(editor, index, rng.choice(other_classes))


def _remove_collision(editor: UndoableEditor, rng: np.random.Generator) -> None:
    words = _read_first_words(editor)
    words[1:8] = ["-1"] * 7
    other_lines = editor.meta_lines()[2:]
    _write(editor, [" ".join(words), " colliding agents: none none", *other_lines])


def _set_new_collision_words(editor: UndoableEditor, _: np.random.Generator) -> None:
    _set_word(editor, 6, "across")
    _set_word(editor, 7, "left_side")


def _set_unknown_id(editor: UndoableEditor, rng: np.random.Generator) -> None:
    words = _read_first_words(editor)
    agent_ids = editor.agent_ids()
    candidates = [index for index in ID_WORDS if int(words[index]) in agent_ids]
    _set_word(editor, int(rng.choice(candidates)), "19876")


GROUP.add(
    {
        "meta_pair_unknown": ("A colliding agent's id is in no label.", _set_unknown_id),
        "meta_pair_far_away": (
            "A colliding actor's id is that of another actor, far from the collision.",
            _set_distant_id,
        ),
        "meta_colliding_agents": (
            "The colliding agents are not those of the colliding ids.",
            _set_other_pair,
        ),
        "meta_class_changed": (
            "A colliding actor has another class than in the labels.",
            _set_other_class,
        ),
        "meta_class_unknown": (
            "A colliding actor's class does not exist.",
            lambda editor, rng: _set_word(editor, int(rng.choice(CLASS_WORDS)), "bus"),
        ),
        "meta_impact_nan": (
            "The impact is NaN.",
            lambda editor, _: _set_word(editor, IMPACT_WORD, "nan"),
        ),
    },
    only="accident",
)
GROUP.add(
    {
        "meta_collision_dropped": (
            "The meta file of an accident names no collision.",
            _remove_collision,
        )
    },
    only="accident",
    harmless="a scenario in an accident folder can have no collision (docs/format.md, Meta)",
)
GROUP.add(
    {
        "meta_pair_0": (
            "A colliding actor's id is 0.",
            lambda editor, rng: _set_word(editor, int(rng.choice(ID_WORDS)), "0"),
        ),
        "meta_nobody_named": (
            "The colliding agents are 'none none'.",
            lambda editor, _: _set_entry(editor, "colliding agents", "none none"),
        ),
        "meta_collision_words": (
            "The words of the collision are new ones.",
            _set_new_collision_words,
        ),
    },
    only="accident",
    harmless="the release has such pairs, and perhaps other words (docs/format.md, Meta)",
)


def _take_meta_of_twin(editor: UndoableEditor, rng: np.random.Generator) -> None:
    twin = editor.root / "type1_subtype1_accident" / "meta" / editor.scenario.meta_path.name
    editor.write(editor.scenario.meta_path, twin.read_bytes())


GROUP.add(
    {
        "meta_of_twin": (
            "A normal scenario has the meta file of its accident twin.",
            _take_meta_of_twin,
        )
    },
    only="normal",
)


def _permute_ids(editor: UndoableEditor, rng: np.random.Generator) -> None:
    ids = editor.agent_ids()
    agent, other = rng.choice(4, size=2, replace=False)
    ids[agent], ids[other] = ids[other], ids[agent]
    _set_ids(editor, ids)


def _change_id(editor: UndoableEditor, rng: np.random.Generator) -> None:
    ids = editor.agent_ids()
    ids[rng.integers(4)] += 700
    _set_ids(editor, ids)


_DIRECTIONS = ("ego_vehicle_direction", "other_vehicle_direction", "another_vehicle_spawn_side")
GROUP.add(
    {
        "meta_agent_ids_permuted": ("The agents' ids are in another order.", _permute_ids),
        "meta_agent_id_changed": ("An agent's id is a wrong number.", _change_id),
        "meta_road_type": (
            "The road type does not exist.",
            lambda editor, rng: _set_entry(
                editor, "road_type", rng.choice(["five-way junction", "unknown", "four-way"])
            ),
        ),
        "meta_weather": (
            "The weather and time of day do not exist.",
            lambda editor, rng: _set_word(
                editor, 0, rng.choice(["SnowNoon", "Rainy", "ClearMidnight", "wetnoon"])
            ),
        ),
        "meta_direction": (
            "A direction does not exist.",
            lambda editor, rng: _set_entry(editor, str(rng.choice(_DIRECTIONS)), "upwards"),
        ),
    },
)
