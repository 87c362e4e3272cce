"""A scenario as it will be exported: its agents, their files, and what is left out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.bulk import Output
from deepaccident_devkit.export.sensor_files import sensor_files
from deepaccident_devkit.release.store import ReleasePath
from deepaccident_devkit.taxonomy import BEV_CAMERA, CAMERAS, CHANNELS, INFRASTRUCTURE, LIDAR, VEHICLE_AGENTS
from deepaccident_devkit.v2x.configurations import agents_of

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord


class Recording:
    """A scenario's agents, their folders and their sensor files.

    Attributes:
        dataset: the release.
        token: the scenario's.
        record: the scenario's.
        agents: that are written; without a point cloud in the whole scenario an agent is not.
        frames: numbers of those that are written. Loaders look up the moments of one agent in all of them, and a cloud
            that is not there is for them one without points. So all have a frame, and its cloud, or none has.
        folders: agent → name of its folder; loaders sort them as words and take the first for the ego.
        files: agent → channel → frame → path and bytes of what is there and written.
        samples: agents at moments that the release has.
        written: how many of them are written: not all if clouds are missing.
    """

    def __init__(self, dataset: Dataset, token: str, agents: Sequence[str], ego: str, without_clouds: bool) -> None:  # noqa: FBT001
        """Look which files of these agents are there, and choose what is written. Raises TokenError."""
        self.dataset, self.token = dataset, token
        self.record: ScenarioRecord = dataset.scenario[dataset.getind("scenario", token)]
        numbers = range(1, self.record["num_frames"] + 1)
        self._there: dict[str, dict[str, dict[int, tuple[ReleasePath, int]]]] = {
            agent: {channel: sensor_files(dataset, token, agent, channel) for channel in CHANNELS}
            for agent in agents_of(dataset, token)
            if agent in agents
        }
        self._absent, self.samples = len(agents) - len(self._there), len(self._there) * len(numbers)
        moments = {agent: set(numbers if without_clouds else files[LIDAR]) for agent, files in self._there.items()}
        self.agents = [agent for agent in self._there if moments[agent]]
        common = set(numbers).intersection(*(moments[agent] for agent in self.agents))
        self.frames = sorted(common) if self.agents else []
        self.written = len(self.agents) * len(self.frames)
        self.files = {
            agent: {
                channel: {number: found[number] for number in self.frames if number in found}
                for channel, found in self._there[agent].items()
            }
            for agent in self.agents
        }
        order = sorted(VEHICLE_AGENTS, key=lambda agent: agent != ego)
        self.folders: dict[str, str] = {
            **{agent: str(number) for number, agent in enumerate(order, 1)},
            INFRASTRUCTURE: "-1",
        }

    def protocol(self) -> dict[str, Any]:
        """Where the scenario comes from; no loader reads it."""
        actors = {agent: self.dataset.get("agent", f"{self.token}/{agent}")["actor_id"] for agent in self.agents}
        return {
            "source": "DeepAccident",
            "scenario": self.token,
            "agents": {self.folders[agent]: {"name": agent, "actor_id": actor} for agent, actor in actors.items()},
        }

    def count(self, output: Output) -> None:
        """Count the samples, and what of the scenario is not written; boxes are counted moment by moment."""
        output.tally.samples += self.written
        images = sum(map(self._count, CAMERAS))
        output.leave_out("agents of scenarios that are not in this release", self._absent)
        output.leave_out("images that are not in this release", len(CAMERAS) * self.samples - images)
        output.leave_out("point clouds that are not in this release", self.samples - self._count(LIDAR))
        output.leave_out("samples of agents or moments without point clouds", self.samples - self.written)
        output.leave_out("files of the BEV camera", self._count(BEV_CAMERA))

    def _count(self, channel: str) -> int:
        return sum(len(files[channel]) for files in self._there.values())
