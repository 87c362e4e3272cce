"""Tokens: readable, stable names derived from the names on disk, and the rows they identify.

Only scenarios need a dictionary. Rows are ordered by scenario; within it samples by agent, then
frame; sensor files by sample, then channel; boxes by sample, then label row; instances by actor id;
tracks by frame, then instance.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.support.text import counted, meant_text
from deepaccident_devkit.support.values import ReadOnlyValues
from deepaccident_devkit.tables.arrow_files import damaged_value
from deepaccident_devkit.taxonomy import ACTOR, AGENTS, CATEGORIES, CHANNEL_FORMAT, CHANNELS

FORMS = {
    "scenario": "<scenario_type>/<name>",
    "agent": "<scenario>/<agent>",
    "frame": "<scenario>/<NNN>",
    "sample": "<scenario>/<agent>/<NNN>",
    "sample_data": "<scenario>/<agent>/<NNN>/<channel>",
    "sensor": "<channel>",
    "calibrated_sensor": "<scenario>/<agent>/<channel>[/<n>]",
    "ego_pose": "<scenario>/<agent>/<NNN>",
    "instance": "<scenario>/actor/<actor_id>",
    "annotation": "<scenario>/<agent>/<NNN>/<row>",
    "track": "<scenario>/<NNN>/actor/<actor_id>",
    "category": "<name>",
}
"""Table → the form of its tokens; `<scenario>` stands for `<scenario_type>/<name>`."""
ColumnViews = Mapping[str, ReadOnlyValues]
"""Table → stored column → view of it."""
_NUM_WORDS = {
    table: form.replace("<scenario>", "<scenario_type>/<name>").count("/") + 1
    for table, form in FORMS.items()
}


def agent_token(scenario: str, agent: str) -> str:
    """Return the token of an agent."""
    return f"{scenario}/{agent}"


def frame_token(scenario: str, index: int) -> str:
    """Return the token of a frame."""
    return f"{scenario}/{index:03d}"


def sample_token(scenario: str, agent: str, index: int) -> str:
    """Return the token of a sample, and of its ego pose."""
    return f"{scenario}/{agent}/{index:03d}"


def sample_data_token(sample: str, channel: str) -> str:
    """Return the token of a sensor file."""
    return f"{sample}/{channel}"


def instance_token(scenario: str, actor_id: int) -> str:
    """Return the token of an actor."""
    return f"{scenario}/{ACTOR}/{actor_id}"


def annotation_token(sample: str, row: int) -> str:
    """Return the token of a box, given its row in the sample's label."""
    return f"{sample}/{row}"


def parse_number(word: str, width: int = 1) -> int | None:
    """Return the number that a word of a token spells; None if it is not spelt like one.

    Numbers in tokens have no sign except −, and no superfluous zeros.
    """
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdigit()):
        return None
    number = int(word)
    if f"{number:0{width}d}" == word:
        return number
    return None


class Resolver:
    """Finds the row of a token and makes the token of a row, for every table."""

    def __init__(self, views: ColumnViews) -> None:
        """Find where the rows of each scenario and agent begin; `views` may open tables lazily."""
        self._views = views
        scenario = views["scenario"]
        agent = views["agent"]
        names = zip(
            scenario["scenario_type"].to_pylist(), scenario["name"].to_pylist(), strict=True
        )
        self.scenario_tokens = ["/".join(words) for words in names]
        self._scenario_rows = {token: row for row, token in enumerate(self.scenario_tokens)}
        self._num_frames: list[int] = scenario["num_frames"].tolist()
        self._first_frame: list[int] = scenario["first_frame_row"].tolist()
        self._first_sample: list[int] = agent["first_sample_row"].tolist()
        self._agents: list[dict[str, int]] = [{} for _ in self.scenario_tokens]
        self._agent_scenario: list[int] = agent["scenario_row"].tolist()
        self._agent_names = [AGENTS[code] for code in agent["name"].tolist()]
        agents = zip(self._agent_scenario, self._agent_names, strict=True)
        for row, (scenario_row, name) in enumerate(agents):
            self._agents[scenario_row][name] = row
        self._row_finders: dict[str, Callable[..., int]] = {
            "scenario": self._find_scenario_row,
            "agent": self._find_agent_row,
            "frame": self._find_frame_row,
            "sample": self._find_sample_row,
            "sample_data": self._find_sample_data_row,
            "sensor": _find_channel_code,
            "calibrated_sensor": self._find_calibrated_sensor_row,
            "ego_pose": self._find_sample_row,
            "instance": self._find_instance_row,
            "annotation": self._find_annotation_row,
            "track": self._find_track_row,
            "category": partial(_find_code, "categories", CATEGORIES),
        }
        self.token_makers: dict[str, Callable[[int], str]] = {
            "scenario": self.scenario_tokens.__getitem__,
            "agent": self._make_agent_token,
            "frame": self._make_frame_token,
            "sample": self._make_sample_token,
            "sample_data": self._make_sample_data_token,
            "sensor": CHANNELS.__getitem__,
            "calibrated_sensor": self._make_calibrated_sensor_token,
            "ego_pose": self._make_sample_token,
            "instance": self._make_instance_token,
            "annotation": self._make_annotation_token,
            "track": self._make_track_token,
            "category": CATEGORIES.__getitem__,
        }

    def row(self, table: str, token: str) -> int:
        """Return the row with a token; raise TokenError if unknown, IndexStoreError if damaged."""
        find_row = self._row_finders[table]
        try:
            return find_row(*_split_token(table, token))
        except _UnknownError as error:
            hint = self._suggest_scenarios(token)
            reason = hint or str(error) or f"expected the form {FORMS[table]}"
            raise TokenError(f"table '{table}' has no token '{token}': {reason}") from None
        except IndexError as error:
            raise damaged_value(table) from error

    def token(self, table: str, row: int) -> str:
        """Return the token of a row."""
        make_token = self.token_makers[table]
        return make_token(row)

    def agents_of(self, scenario_row: int) -> Mapping[str, int]:
        """Return agent name → row in the agent table, for a scenario's agents in order."""
        return self._agents[scenario_row]

    def sample_at(self, agent_row: int, index: int) -> int:
        """Return the row of an agent's sample in frame number `index`."""
        return self._first_sample[agent_row] + index - 1

    def filename(self, sample_data_row: int) -> str:
        """Return the path of a sensor file in the dataroot, with forward slashes."""
        sample, code = divmod(sample_data_row, len(CHANNELS))
        scenario_type, name, agent, number = self._make_sample_token(sample).split("/")
        scenario_row = self._views["sample"]["scenario_row"].item(sample)
        folder = self._views["scenario"]["folder"][scenario_row].as_py()
        channel = CHANNELS[code]
        path = f"{scenario_type}/{agent}/{channel}/{name}/{name}_{number}.{CHANNEL_FORMAT[channel]}"
        if folder:
            return f"{folder}/{path}"
        return path

    def _make_agent_token(self, row: int) -> str:
        scenario = self.scenario_tokens[self._agent_scenario[row]]
        return f"{scenario}/{self._agent_names[row]}"

    def _make_frame_token(self, row: int) -> str:
        scenario = self._views["frame"]["scenario_row"].item(row)
        number = row - self._first_frame[scenario] + 1
        return f"{self.scenario_tokens[scenario]}/{number:03d}"

    def _make_sample_token(self, row: int) -> str:
        agent = self._views["sample"]["agent_row"].item(row)
        number = row - self._first_sample[agent] + 1
        return f"{self._make_agent_token(agent)}/{number:03d}"

    def _make_sample_data_token(self, row: int) -> str:
        sample, channel = divmod(row, len(CHANNELS))
        return f"{self._make_sample_token(sample)}/{CHANNELS[channel]}"

    def _make_calibrated_sensor_token(self, row: int) -> str:
        view = self._views["calibrated_sensor"]
        agent = self._make_agent_token(view["agent_row"].item(row))
        channel = CHANNELS[view["sensor_row"].item(row)]
        token = f"{agent}/{channel}"
        number = view["number"].item(row)
        if number == 1:
            return token
        return f"{token}/{number}"

    def _make_instance_token(self, row: int) -> str:
        view = self._views["instance"]
        scenario = self.scenario_tokens[view["scenario_row"].item(row)]
        return instance_token(scenario, view["actor_id"].item(row))

    def _make_annotation_token(self, row: int) -> str:
        sample = self._views["annotation"]["sample_row"].item(row)
        start = self._views["sample"]["first_annotation_row"].item(sample)
        return f"{self._make_sample_token(sample)}/{row - start}"

    def _make_track_token(self, row: int) -> str:
        view = self._views["track"]
        instance = view["instance_row"].item(row)
        actor = self._views["instance"]["actor_id"].item(instance)
        frame = self._make_frame_token(view["frame_row"].item(row))
        return f"{frame}/{ACTOR}/{actor}"

    def _suggest_scenarios(self, token: str) -> str:
        """Return a hint if a token starts with the name of a scenario, otherwise an empty text."""
        name, slash, words = token.partition("/")
        scenarios = [token for token in self.scenario_tokens if token.split("/")[1] == name]
        candidates = [f"'{scenario}{slash}{words}'" for scenario in scenarios]
        if not candidates:
            return ""
        listed = " or ".join(candidates[:3])
        if len(candidates) > 3:
            listed += f" or one of {len(candidates) - 3} more"
        return f"a scenario's name is not unique, so a token begins with its type; write {listed}"

    def _find_scenario_row(self, scenario: str) -> int:
        if scenario not in self._scenario_rows:
            raise _UnknownError(f"this release has no scenario '{scenario}' (see list_scenarios())")
        return self._scenario_rows[scenario]

    def _find_agent_row(self, scenario: str, agent: str) -> int:
        agents = self._agents[self._find_scenario_row(scenario)]
        if agent not in agents:
            remedy = "; unpack its archive"
            if agent not in AGENTS:
                remedy = meant_text(agent, agents)
            raise _UnknownError(f"the scenario's agents are {', '.join(agents)}{remedy}")
        return agents[agent]

    def _parse_frame_number(self, scenario: str, word: str) -> int:
        number = parse_number(word, 3)
        num_frames = self._num_frames[self._find_scenario_row(scenario)]
        if number is None or not 1 <= number <= num_frames:
            raise _UnknownError(f"the scenario's frames are 001 to {num_frames:03d}")
        return number

    def _find_frame_row(self, scenario: str, number: str) -> int:
        first_row = self._first_frame[self._find_scenario_row(scenario)]
        return first_row + self._parse_frame_number(scenario, number) - 1

    def _find_sample_row(self, scenario: str, agent: str, number: str) -> int:
        first_row = self._first_sample[self._find_agent_row(scenario, agent)]
        return first_row + self._parse_frame_number(scenario, number) - 1

    def _find_sample_data_row(self, scenario: str, agent: str, number: str, channel: str) -> int:
        sample = self._find_sample_row(scenario, agent, number)
        return sample * len(CHANNELS) + _find_channel_code(channel)

    def _find_calibrated_sensor_row(
        self, scenario: str, agent: str, channel: str, number: str = ""
    ) -> int:
        agent_row = self._find_agent_row(scenario, agent)
        channel_code = _find_channel_code(channel)
        setup = (channel_code, parse_number(number) if number else 1)
        view = self._views["calibrated_sensor"]
        start, stop = np.searchsorted(view["agent_row"], (agent_row, agent_row + 1))
        channels = view["sensor_row"][start:stop]
        numbers = view["number"][start:stop]
        setups = list(zip(channels.tolist(), numbers.tolist(), strict=True))
        # The token of a sensor's first setup has no number.
        if setup not in setups or number == "1":
            raise _UnknownError("this sensor has fewer distinct calibrations")
        return int(start) + setups.index(setup)

    def _find_instance_row(self, scenario: str, word: str, actor: str) -> int:
        scenario_row = self._find_scenario_row(scenario)
        actor_id = parse_number(actor)
        if word != ACTOR or actor_id is None:
            raise _UnknownError
        view = self._views["instance"]
        start, stop = np.searchsorted(view["scenario_row"], (scenario_row, scenario_row + 1))
        actor_ids = view["actor_id"][start:stop]
        return int(start) + _find_sorted(
            actor_ids, actor_id, f"the scenario has no actor {actor_id}"
        )

    def _find_annotation_row(self, scenario: str, agent: str, number: str, word: str) -> int:
        sample = self._find_sample_row(scenario, agent, number)
        row = parse_number(word)
        view = self._views["sample"]
        count = view["num_annotations"].item(sample)
        if row is None or not 0 <= row < count:
            annotations = counted(count, "annotation")
            raise _UnknownError(f"the sample has {annotations}, counted from 0")
        first_row: int = view["first_annotation_row"].item(sample)
        return first_row + row

    def _find_track_row(self, scenario: str, number: str, word: str, actor: str) -> int:
        frame = self._find_frame_row(scenario, number)
        instance = self._find_instance_row(scenario, word, actor)
        view = self._views["track"]
        start, stop = np.searchsorted(view["frame_row"], (frame, frame + 1))
        instances = view["instance_row"][start:stop]
        return int(start) + _find_sorted(
            instances, instance, "no agent annotated this actor at that moment"
        )


class _UnknownError(Exception):
    """The reason why a token identifies no row; its text is empty if the token is malformed."""


def _split_token(table: str, token: str) -> list[str]:
    """Split a token into words; the scenario's type and name are one word."""
    words = token.split("/")
    num_words = _NUM_WORDS[table]
    is_short = table == "calibrated_sensor" and len(words) == num_words - 1
    if len(words) != num_words and not is_short:
        remedy = ""
        if table == "sample" and len(words) == 5 and words[-1] in CHANNELS:
            remedy = f"; this is the token of a sensor file: remove '/{words[-1]}'"
        elif table == "sample_data" and len(words) == 4 and parse_number(words[-1], 3) is not None:
            remedy = f"; this is the token of a sample: add a channel, such as '/{CHANNELS[0]}'"
        raise _UnknownError(f"expected the form {FORMS[table]}{remedy}")
    if num_words == 1:
        return words
    return ["/".join(words[:2]), *words[2:]]


def _find_sorted(values: Any, value: int, missing_text: str) -> int:
    """Return the index of a value in sorted values; raise _UnknownError with the text if absent."""
    index = int(np.searchsorted(values, value))
    if index == len(values) or values[index] != value:
        raise _UnknownError(missing_text)
    return index


def _find_channel_code(channel: str) -> int:
    return _find_code("channels", CHANNELS, channel)


def _find_code(kind: str, words: Sequence[str], word: str) -> int:
    """Return the index of a word in `words`; raise _UnknownError if it is absent."""
    if word not in words:
        raise _UnknownError(f"the {kind} are {', '.join(words)}{meant_text(word, words)}")
    return words.index(word)
