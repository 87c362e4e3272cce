"""Tokens ↔ rows, by arithmetic on how rows are ordered: without a dictionary except of scenarios.

Rows are ordered by scenario; within it samples by agent, then frame; sensor files by sample, then channel; boxes by
sample, then label row; instances by actor id; tracks by frame, then instance.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from deepaccident_devkit.errors import TokenError
from deepaccident_devkit.tables import tokens
from deepaccident_devkit.tables.store import damaged_value
from deepaccident_devkit.tables.tokens import Parts, parse_number, unknown_token
from deepaccident_devkit.taxonomy import AGENTS, CATEGORIES, CHANNEL_FORMAT, CHANNELS
from deepaccident_devkit.text import meant_text

Views = Mapping[str, Mapping[str, Any]]
"""Table → stored column → view of it."""


class Resolver:
    """Finds the row of a token and makes the token of a row, for every table."""

    def __init__(self, views: Views) -> None:
        """Note where each scenario's and agent's rows begin; `views` may open tables when asked for them."""
        self._views = views
        scenario, agent = views["scenario"], views["agent"]
        names = zip(scenario["scenario_type"].to_pylist(), scenario["name"].to_pylist(), strict=True)
        self.scenario_tokens = ["/".join(words) for words in names]
        self._scenario_rows = {token: row for row, token in enumerate(self.scenario_tokens)}
        self._num_frames: list[int] = scenario["num_frames"].tolist()
        self._first_frame: list[int] = scenario["first_frame_row"].tolist()
        self._agents: list[dict[str, int]] = [{} for _ in self.scenario_tokens]
        self._agent_scenario: list[int] = agent["scenario_row"].tolist()
        self._agent_names = [AGENTS[code] for code in agent["name"].tolist()]
        self._first_sample: list[int] = agent["first_sample_row"].tolist()
        for row, (scenario_row, name) in enumerate(zip(self._agent_scenario, self._agent_names, strict=True)):
            self._agents[scenario_row][name] = row
        self._row_finders: dict[str, Callable[[str], int]] = {
            "scenario": self._scenario_row,
            "agent": self._agent_row,
            "frame": self._frame_row,
            "sample": self._sample_row,
            "sample_data": self._sample_data_row,
            "sensor": self._sensor_row,
            "calibrated_sensor": self._calibrated_sensor_row,
            "ego_pose": self._sample_row,
            "instance": self._instance_row,
            "annotation": self._annotation_row,
            "track": self._track_row,
            "category": self._category_row,
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
            return self._row_finders[table](token)
        except IndexError as error:
            raise damaged_value(table) from error

    def token(self, table: str, row: int) -> str:
        """The token of a row."""
        return self.token_makers[table](row)

    def agents_of(self, scenario_row: int) -> Mapping[str, int]:
        """The agents of a scenario by name, in order, and their rows."""
        return self._agents[scenario_row]

    def num_frames(self, scenario_row: int) -> int:
        """Frames of a scenario."""
        return self._num_frames[scenario_row]

    def sample_at(self, agent_row: int, index: int) -> int:
        """The row of an agent's sample at frame number `index`, which must be one of the scenario's."""
        return self._first_sample[agent_row] + index - 1

    def filename(self, sample_data_row: int) -> str:
        """The path of a sensor file below the dataroot, with forward slashes."""
        sample, channel_code = divmod(sample_data_row, len(CHANNELS))
        agent, index = self._agent_and_index(sample)
        scenario = self._agent_scenario[agent]
        words = self._views["scenario"]
        folder, channel = words["folder"][scenario].as_py(), CHANNELS[channel_code]
        scenario_type, name = self.scenario_tokens[scenario].split("/")
        path = (
            f"{scenario_type}/{self._agent_names[agent]}/{channel}/{name}/{name}_{index:03d}.{CHANNEL_FORMAT[channel]}"
        )
        return f"{folder}/{path}" if folder else path

    def _agent_and_index(self, sample_row: int) -> tuple[int, int]:
        agent = self._views["sample"]["agent_row"].item(sample_row)
        return agent, sample_row - self._first_sample[agent] + 1

    def _agent_token(self, row: int) -> str:
        return tokens.agent_token(self.scenario_tokens[self._agent_scenario[row]], self._agent_names[row])

    def _frame_token(self, row: int) -> str:
        scenario = self._views["frame"]["scenario_row"].item(row)
        return tokens.frame_token(self.scenario_tokens[scenario], row - self._first_frame[scenario] + 1)

    def _sample_token(self, row: int) -> str:
        agent, index = self._agent_and_index(row)
        return tokens.sample_token(self.scenario_tokens[self._agent_scenario[agent]], self._agent_names[agent], index)

    def _sample_data_token(self, row: int) -> str:
        sample, channel = divmod(row, len(CHANNELS))
        return tokens.sample_data_token(self._sample_token(sample), CHANNELS[channel])

    def _calibrated_sensor_token(self, row: int) -> str:
        view = self._views["calibrated_sensor"]
        channel = CHANNELS[view["sensor_row"].item(row)]
        agent_token = self._agent_token(view["agent_row"].item(row))
        return tokens.calibrated_sensor_token(agent_token, channel, view["number"].item(row))

    def _instance_token(self, row: int) -> str:
        view = self._views["instance"]
        scenario = self.scenario_tokens[view["scenario_row"].item(row)]
        return tokens.instance_token(scenario, view["actor_id"].item(row))

    def _annotation_token(self, row: int) -> str:
        sample = self._views["annotation"]["sample_row"].item(row)
        first = self._views["sample"]["first_annotation_row"].item(sample)
        return tokens.annotation_token(self._sample_token(sample), row - first)

    def _track_token(self, row: int) -> str:
        view = self._views["track"]
        actor = self._views["instance"]["actor_id"].item(view["instance_row"].item(row))
        return tokens.track_token(self._frame_token(view["frame_row"].item(row)), actor)

    def _split(self, table: str, token: str) -> Parts:
        try:
            return tokens.split(table, token)
        except TokenError:
            why = self._lacks_its_type(token)
            if why:
                raise unknown_token(table, token, why) from None
            raise

    def _lacks_its_type(self, token: str) -> str:
        """What to write where a token begins with the name of a scenario; empty for all others."""
        name, slash, rest = token.partition("/")
        here = [f"'{scenario}{slash}{rest}'" for scenario in self.scenario_tokens if scenario.split("/")[1] == name]
        if not here:
            return ""
        shown = " or ".join(here[:3]) + (f" or one of {len(here) - 3} more" if len(here) > 3 else "")
        return f"a scenario's name is not unique, its token begins with its type; write {shown}"

    def _scenario_row(self, token: str) -> int:
        return self._scenario_of("scenario", token, token)

    def _scenario_of(self, table: str, token: str, scenario: str) -> int:
        row = self._scenario_rows.get(scenario)
        if row is None:
            why = self._lacks_its_type(token) or f"this release has no scenario '{scenario}' (see list_scenarios())"
            raise unknown_token(table, token, why)
        return row

    def _agent_of(self, table: str, token: str, scenario_row: int, agent: str) -> int:
        agents = self._agents[scenario_row]
        if agent not in agents:
            known = ", ".join(agents)
            raise unknown_token(table, token, f"the scenario's agents are {known}{meant_text(agent, agents)}")
        return agents[agent]

    def _index_of(self, table: str, token: str, scenario_row: int, word: str) -> int:
        index = parse_number(word, 3)
        if index is None or not 1 <= index <= self._num_frames[scenario_row]:
            last = self._num_frames[scenario_row]
            raise unknown_token(table, token, f"the scenario's frames are 001 to {last:03d}")
        return index

    def _agent_row(self, token: str) -> int:
        scenario, (agent,) = self._split("agent", token)
        return self._agent_of("agent", token, self._scenario_of("agent", token, scenario), agent)

    def _frame_row(self, token: str) -> int:
        scenario, (word,) = self._split("frame", token)
        scenario_row = self._scenario_of("frame", token, scenario)
        return self._first_frame[scenario_row] + self._index_of("frame", token, scenario_row, word) - 1

    def _sample_row(self, token: str) -> int:
        scenario, (agent, word) = self._split("sample", token)
        return self._sample_of("sample", token, scenario, agent, word)

    def _sample_of(self, table: str, token: str, scenario: str, agent: str, word: str) -> int:
        scenario_row = self._scenario_of(table, token, scenario)
        agent_row = self._agent_of(table, token, scenario_row, agent)
        return self.sample_at(agent_row, self._index_of(table, token, scenario_row, word))

    def _sample_data_row(self, token: str) -> int:
        scenario, (agent, word, channel) = self._split("sample_data", token)
        sample = self._sample_of("sample_data", token, scenario, agent, word)
        return sample * len(CHANNELS) + self._channel_code("sample_data", token, channel)

    def _channel_code(self, table: str, token: str, channel: str) -> int:
        if channel not in CHANNELS:
            raise unknown_token(table, token, f"the channels are {', '.join(CHANNELS)}{meant_text(channel, CHANNELS)}")
        return CHANNELS.index(channel)

    def _sensor_row(self, token: str) -> int:
        return self._channel_code("sensor", token, token)

    def _calibrated_sensor_row(self, token: str) -> int:
        table = "calibrated_sensor"
        scenario, (agent, channel, *rest) = self._split(table, token)
        agent_row = self._agent_of(table, token, self._scenario_of(table, token, scenario), agent)
        wanted = (self._channel_code(table, token, channel), parse_number(rest[0]) if rest else 1)
        view = self._views[table]
        first, last = np.searchsorted(view["agent_row"], (agent_row, agent_row + 1))
        found = zip(view["sensor_row"][first:last].tolist(), view["number"][first:last].tolist(), strict=True)
        for offset, values in enumerate(found):
            if values == wanted and rest != ["1"]:
                return int(first) + offset
        raise unknown_token(table, token, "this sensor has fewer distinct values")

    def _instance_row(self, token: str) -> int:
        scenario, (word, actor) = self._split("instance", token)
        return self._instance_of("instance", token, self._scenario_of("instance", token, scenario), word, actor)

    def _instance_of(self, table: str, token: str, scenario_row: int, word: str, actor: str) -> int:
        view, actor_id = self._views["instance"], parse_number(actor)
        if word != tokens.ACTOR or actor_id is None:
            raise unknown_token(table, token, f"expected the form {tokens.FORMS[table]}")
        first, last = np.searchsorted(view["scenario_row"], (scenario_row, scenario_row + 1))
        ids = view["actor_id"][first:last]
        position = int(np.searchsorted(ids, actor_id))
        if position == len(ids) or ids[position] != actor_id:
            raise unknown_token(table, token, f"the scenario has no actor {actor_id}")
        return int(first) + position

    def _annotation_row(self, token: str) -> int:
        scenario, (agent, word, row_word) = self._split("annotation", token)
        sample = self._sample_of("annotation", token, scenario, agent, word)
        row, count = parse_number(row_word), self._views["sample"]["num_annotations"].item(sample)
        if row is None or not 0 <= row < count:
            raise unknown_token("annotation", token, f"the sample has {count} annotations, counted from 0")
        first: int = self._views["sample"]["first_annotation_row"].item(sample)
        return first + row

    def _track_row(self, token: str) -> int:
        scenario, (frame, word, actor) = self._split("track", token)
        scenario_row = self._scenario_of("track", token, scenario)
        frame_row = self._first_frame[scenario_row] + self._index_of("track", token, scenario_row, frame) - 1
        instance = self._instance_of("track", token, scenario_row, word, actor)
        view = self._views["track"]
        first, last = np.searchsorted(view["frame_row"], (frame_row, frame_row + 1))
        position = int(first) + int(np.searchsorted(view["instance_row"][first:last], instance))
        if position == last or view["instance_row"][position] != instance:
            raise unknown_token("track", token, "nobody annotated this actor at that moment")
        return position

    def _category_row(self, token: str) -> int:
        if token not in CATEGORIES:
            known = ", ".join(CATEGORIES)
            raise unknown_token("category", token, f"the categories are {known}{meant_text(token, CATEGORIES)}")
        return CATEGORIES.index(token)
