"""Tokens: readable, stable, and made of the names on disk; tokens ↔ rows without a dictionary except of scenarios.

Rows are ordered by scenario; within it samples by agent, then frame; sensor files by sample, then channel; boxes by
sample, then label row; instances by actor id; tracks by frame, then instance.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.support.text import meant_text
from deepaccident_devkit.tables.arrow_files import damaged_value
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, CHANNEL_FORMAT, CHANNELS

ACTOR = "actor"
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
ColumnViews = Mapping[str, Mapping[str, Any]]
"""Table → stored column → view of it."""
_NUM_WORDS = {
    table: form.replace("<scenario>", "<scenario_type>/<name>").count("/") + 1
    for table, form in FORMS.items()
}


def agent_token(scenario: str, agent: str) -> str:
    """Token of an agent."""
    return f"{scenario}/{agent}"


def frame_token(scenario: str, index: int) -> str:
    """Token of a frame."""
    return f"{scenario}/{index:03d}"


def sample_token(scenario: str, agent: str, index: int) -> str:
    """Token of a sample, and of its ego pose."""
    return f"{scenario}/{agent}/{index:03d}"


def sample_data_token(sample: str, channel: str) -> str:
    """Token of a sensor file."""
    return f"{sample}/{channel}"


def instance_token(scenario: str, actor_id: int) -> str:
    """Token of an actor."""
    return f"{scenario}/{ACTOR}/{actor_id}"


def annotation_token(sample: str, row: int) -> str:
    """Token of a box: its row in the label."""
    return f"{sample}/{row}"


def parse_number(word: str, width: int = 1) -> int | None:
    """The number a word writes the way tokens do (no sign but −, no superfluous zeros), else None."""
    digits = word.removeprefix("-")
    if not (digits.isascii() and digits.isdigit()):
        return None
    number = int(word)
    return number if f"{number:0{width}d}" == word else None


class Resolver:
    """Finds the row of a token and makes the token of a row, for every table."""

    def __init__(self, views: ColumnViews) -> None:
        """Note where each scenario's and agent's rows begin; `views` may open tables when asked for them."""
        self._views = views
        scenario, agent = views["scenario"], views["agent"]
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
        for row, (scenario_row, name) in enumerate(
            zip(self._agent_scenario, self._agent_names, strict=True)
        ):
            self._agents[scenario_row][name] = row
        self._row_finders: dict[str, Callable[..., int]] = {
            "scenario": self._scenario_row,
            "agent": self._agent_row,
            "frame": self._frame_row,
            "sample": self._sample_row,
            "sample_data": self._sample_data_row,
            "sensor": _channel_code,
            "calibrated_sensor": self._calibrated_sensor_row,
            "ego_pose": self._sample_row,
            "instance": self._instance_row,
            "annotation": self._annotation_row,
            "track": self._track_row,
            "category": _category_code,
        }
        self.token_makers: dict[str, Callable[[int], str]] = {
            "scenario": self.scenario_tokens.__getitem__,
            "agent": self._agent_token,
            "frame": self._frame_token,
            "sample": self._sample_token,
            "sample_data": self._sample_data_token,
            "sensor": CHANNELS.__getitem__,
            "calibrated_sensor": self._calibrated_sensor_token,
            "ego_pose": self._sample_token,
            "instance": self._instance_token,
            "annotation": self._annotation_token,
            "track": self._track_token,
            "category": CATEGORIES.__getitem__,
        }

    def row(self, table: str, token: str) -> int:
        """The row of a token; raises TokenError, and IndexStoreError if the index is damaged."""
        try:
            return self._row_finders[table](*_words(table, token))
        except _UnknownError as error:
            why = self._lacks_its_type(token) or str(error) or f"expected the form {FORMS[table]}"
            raise TokenError(f"table '{table}' has no token '{token}': {why}") from None
        except IndexError as error:
            raise damaged_value(table) from error

    def token(self, table: str, row: int) -> str:
        """The token of a row."""
        return self.token_makers[table](row)

    def agents_of(self, scenario_row: int) -> Mapping[str, int]:
        """The agents of a scenario by name, in order, and their rows."""
        return self._agents[scenario_row]

    def sample_at(self, agent_row: int, index: int) -> int:
        """The row of an agent's sample at frame number `index`, which must be one of the scenario's."""
        return self._first_sample[agent_row] + index - 1

    def filename(self, sample_data_row: int) -> str:
        """The path of a sensor file below the dataroot, with forward slashes."""
        sample, code = divmod(sample_data_row, len(CHANNELS))
        scenario_type, name, agent, number = self._sample_token(sample).split("/")
        folder = self._views["scenario"]["folder"][
            self._views["sample"]["scenario_row"].item(sample)
        ].as_py()
        channel = CHANNELS[code]
        path = f"{scenario_type}/{agent}/{channel}/{name}/{name}_{number}.{CHANNEL_FORMAT[channel]}"
        return f"{folder}/{path}" if folder else path

    def _agent_token(self, row: int) -> str:
        return f"{self.scenario_tokens[self._agent_scenario[row]]}/{self._agent_names[row]}"

    def _frame_token(self, row: int) -> str:
        scenario = self._views["frame"]["scenario_row"].item(row)
        return f"{self.scenario_tokens[scenario]}/{row - self._first_frame[scenario] + 1:03d}"

    def _sample_token(self, row: int) -> str:
        agent = self._views["sample"]["agent_row"].item(row)
        return f"{self._agent_token(agent)}/{row - self._first_sample[agent] + 1:03d}"

    def _sample_data_token(self, row: int) -> str:
        sample, channel = divmod(row, len(CHANNELS))
        return f"{self._sample_token(sample)}/{CHANNELS[channel]}"

    def _calibrated_sensor_token(self, row: int) -> str:
        view = self._views["calibrated_sensor"]
        number = view["number"].item(row)
        token = f"{self._agent_token(view['agent_row'].item(row))}/{CHANNELS[view['sensor_row'].item(row)]}"
        return token if number == 1 else f"{token}/{number}"

    def _instance_token(self, row: int) -> str:
        view = self._views["instance"]
        return instance_token(
            self.scenario_tokens[view["scenario_row"].item(row)], view["actor_id"].item(row)
        )

    def _annotation_token(self, row: int) -> str:
        sample = self._views["annotation"]["sample_row"].item(row)
        return f"{self._sample_token(sample)}/{row - self._views['sample']['first_annotation_row'].item(sample)}"

    def _track_token(self, row: int) -> str:
        view = self._views["track"]
        actor = self._views["instance"]["actor_id"].item(view["instance_row"].item(row))
        return f"{self._frame_token(view['frame_row'].item(row))}/{ACTOR}/{actor}"

    def _lacks_its_type(self, token: str) -> str:
        """What to write where a token begins with the name of a scenario; empty for all others."""
        name, slash, rest = token.partition("/")
        here = [
            f"'{scenario}{slash}{rest}'"
            for scenario in self.scenario_tokens
            if scenario.split("/")[1] == name
        ]
        if not here:
            return ""
        shown = " or ".join(here[:3]) + (
            f" or one of {len(here) - 3} more" if len(here) > 3 else ""
        )
        return f"a scenario's name is not unique, its token begins with its type; write {shown}"

    def _scenario_row(self, scenario: str) -> int:
        if scenario not in self._scenario_rows:
            raise _UnknownError(f"this release has no scenario '{scenario}' (see list_scenarios())")
        return self._scenario_rows[scenario]

    def _agent_row(self, scenario: str, agent: str) -> int:
        agents = self._agents[self._scenario_row(scenario)]
        if agent not in agents:
            remedy = "; unpack its archive" if agent in AGENTS else meant_text(agent, agents)
            raise _UnknownError(f"the scenario's agents are {', '.join(agents)}{remedy}")
        return agents[agent]

    def _index(self, scenario: str, word: str) -> int:
        index, last = parse_number(word, 3), self._num_frames[self._scenario_row(scenario)]
        if index is None or not 1 <= index <= last:
            raise _UnknownError(f"the scenario's frames are 001 to {last:03d}")
        return index

    def _frame_row(self, scenario: str, number: str) -> int:
        return self._first_frame[self._scenario_row(scenario)] + self._index(scenario, number) - 1

    def _sample_row(self, scenario: str, agent: str, number: str) -> int:
        return (
            self._first_sample[self._agent_row(scenario, agent)] + self._index(scenario, number) - 1
        )

    def _sample_data_row(self, scenario: str, agent: str, number: str, channel: str) -> int:
        return self._sample_row(scenario, agent, number) * len(CHANNELS) + _channel_code(channel)

    def _calibrated_sensor_row(
        self, scenario: str, agent: str, channel: str, number: str = ""
    ) -> int:
        agent_row = self._agent_row(scenario, agent)
        wanted = _channel_code(channel), parse_number(number) if number else 1
        view = self._views["calibrated_sensor"]
        first, last = np.searchsorted(view["agent_row"], (agent_row, agent_row + 1))
        found = list(
            zip(
                view["sensor_row"][first:last].tolist(),
                view["number"][first:last].tolist(),
                strict=True,
            )
        )
        if wanted not in found or number == "1":  # the first value's token has no number
            raise _UnknownError("this sensor has fewer distinct values")
        return int(first) + found.index(wanted)

    def _instance_row(self, scenario: str, word: str, actor: str) -> int:
        scenario_row, actor_id = self._scenario_row(scenario), parse_number(actor)
        if word != ACTOR or actor_id is None:
            raise _UnknownError
        view = self._views["instance"]
        first, last = np.searchsorted(view["scenario_row"], (scenario_row, scenario_row + 1))
        return int(first) + _place(
            view["actor_id"][first:last], actor_id, f"the scenario has no actor {actor_id}"
        )

    def _annotation_row(self, scenario: str, agent: str, number: str, place: str) -> int:
        sample, row = self._sample_row(scenario, agent, number), parse_number(place)
        view = self._views["sample"]
        count = view["num_annotations"].item(sample)
        if row is None or not 0 <= row < count:
            raise _UnknownError(f"the sample has {count} annotations, counted from 0")
        first: int = view["first_annotation_row"].item(sample)
        return first + row

    def _track_row(self, scenario: str, number: str, word: str, actor: str) -> int:
        frame, instance = (
            self._frame_row(scenario, number),
            self._instance_row(scenario, word, actor),
        )
        view = self._views["track"]
        first, last = np.searchsorted(view["frame_row"], (frame, frame + 1))
        return int(first) + _place(
            view["instance_row"][first:last], instance, "nobody annotated this actor at that moment"
        )


class _UnknownError(Exception):
    """Why a token names no row; without words if it has another form."""


def _words(table: str, token: str) -> list[str]:
    """A token cut up: its scenario (type and name), and the words that follow."""
    words, wanted = token.split("/"), _NUM_WORDS[table]
    if len(words) != wanted and not (table == "calibrated_sensor" and len(words) == wanted - 1):
        remedy = ""
        if table == "sample" and len(words) == 5 and words[-1] in CHANNELS:
            remedy = f"; it names a sensor file: leave out '/{words[-1]}'"
        elif table == "sample_data" and len(words) == 4 and parse_number(words[-1], 3) is not None:
            remedy = f"; it names a sample: add a channel, such as '/{CHANNELS[0]}'"
        raise _UnknownError(f"expected the form {FORMS[table]}{remedy}")
    return words if wanted == 1 else ["/".join(words[:2]), *words[2:]]


def _place(values: Any, wanted: int, why: str) -> int:
    """Where a number is among others that are sorted."""
    place = int(np.searchsorted(values, wanted))
    if place == len(values) or values[place] != wanted:
        raise _UnknownError(why)
    return place


def _channel_code(channel: str) -> int:
    return _code("channels", channel, CHANNELS)


def _category_code(category: str) -> int:
    return _code("categories", category, CATEGORIES)


def _code(kind: str, word: str, known: Sequence[str]) -> int:
    if word not in known:
        raise _UnknownError(f"the {kind} are {', '.join(known)}{meant_text(word, known)}")
    return known.index(word)
