"""A scene, what one agent recorded of a scenario: its frames that are exported, its files, and its own rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.export.keyframes import keyframe_after, keyframes
from deepaccident_devkit.export.nuscenes.names import CHANNEL_NAMES, scene_name, timestamp, token
from deepaccident_devkit.export.sensor_files import sensor_files
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.tables.tokens import agent_token, sample_token
from deepaccident_devkit.v2x.configurations import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

Row = dict[str, Any]
Rows = Mapping[str, Sequence[Row]]
"""Table → rows in their order."""


@dataclass(frozen=True)
class Scene:
    """One agent's recording of a scenario.

    Attributes:
        dataset: the release.
        scenario: token.
        agent: name.
        sweeps: whether the frames between keyframes are exported too.
    """

    dataset: Dataset
    scenario: str
    agent: str
    sweeps: bool

    @property
    def name(self) -> str:
        """As in the table `scene` and in `splits.json`."""
        return scene_name(self.scenario, self.agent)

    @cached_property
    def last(self) -> int:
        """The number of the last frame."""
        count: int = self.dataset.scenario.get(self.scenario)["num_frames"]
        return count

    @cached_property
    def frames(self) -> range:
        """The numbers of the frames that are exported."""
        return range(1, self.last + 1) if self.sweeps else keyframes(self.last)

    @cached_property
    def files(self) -> Mapping[str, Mapping[int, tuple[ReleasePath, int]]]:
        """Channel → number of an exported frame → path and bytes of the file, where it is there."""
        files = {}
        for channel in CHANNEL_NAMES:
            there = sensor_files(self.dataset, self.scenario, self.agent, channel)
            files[channel] = {number: there[number] for number in self.frames if number in there}
        return files

    def is_key(self, number: int) -> bool:
        """Whether a frame is a keyframe."""
        return keyframe_after(number, self.last) == number

    def key_of(self, number: int) -> str:
        """The devkit's token of the sample that a frame belongs to: the keyframe's that it leads to.

        The nuScenes devkit interpolates boxes of a sweep from the keyframe before its sample to its sample.
        """
        return self.sample(keyframe_after(number, self.last))

    def sample(self, number: int) -> str:
        """The devkit's token of a frame's sample."""
        return sample_token(self.scenario, self.agent, number)

    def stamp(self, number: int) -> int:
        """Microseconds of a frame."""
        return timestamp(self.dataset.getind("scenario", self.scenario), self.agent, number)

    def rows(self) -> Rows:
        """The rows of `scene`, `log`, `sample` and `ego_pose`."""
        about = self.dataset.scenario.get(self.scenario)
        scene, log = (token(table, agent_token(self.scenario, self.agent)) for table in ("scene", "log"))
        samples = linked([self._sample_row(number, scene) for number in keyframes(self.last)])
        facts = (about["town"], about["weather"], about["time_of_day"], about["road_type"])
        scene_row = {
            "token": scene,
            "log_token": log,
            "nbr_samples": len(samples),
            "first_sample_token": samples[0]["token"],
            "last_sample_token": samples[-1]["token"],
            "name": self.name,
            "description": ", ".join(filter(None, (*facts, "collision" if about["collision"] else None))),
            "agent": self.agent,
            "split": about["split"],
        }
        log_row = {
            "token": log,
            "logfile": self.scenario,
            "vehicle": self.agent,
            "date_captured": "",
            "location": about["town"],
        }
        poses = [self._pose_row(number) for number in self.frames]
        return {"scene": [scene_row], "log": [log_row], "sample": samples, "ego_pose": poses}

    def _sample_row(self, number: int, scene: str) -> Row:
        sample = self.sample(number)
        return {
            "token": token("sample", sample),
            "timestamp": self.stamp(number),
            "scene_token": scene,
            "agent": self.agent,
            "time_to_impact": self.dataset.sample.get(sample)["time_to_impact"],
            "deepaccident_token": sample,
        }

    def _pose_row(self, number: int) -> Row:
        pose = self.dataset.ego_pose.get(self.sample(number))
        return {
            "token": token("ego_pose", self.sample(number)),
            "timestamp": self.stamp(number),
            "translation": pose["translation"],
            "rotation": pose["rotation"],
        }


def scenes_of(dataset: Dataset, scenario: str, agents: Sequence[str], *, sweeps: bool) -> Iterator[Scene]:
    """The scenes of those of the agents that recorded a scenario."""
    return (Scene(dataset, scenario, agent, sweeps) for agent in agents_of(dataset, scenario) if agent in agents)


def linked(rows: list[Row]) -> list[Row]:
    """The same rows, each with the tokens of the one before and after it as `prev` and `next`; "" at the ends."""
    tokens = ["", *(row["token"] for row in rows), ""]
    for row, before, after in zip(rows, tokens, tokens[2:], strict=False):
        row["prev"], row["next"] = before, after
    return rows
