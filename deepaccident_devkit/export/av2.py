"""Track windows as scenarios of Argoverse 2, one Parquet file for each sample.

docs/exports.md describes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from deepaccident_devkit.export.bulk import Format, Output, Unit, flat_name
from deepaccident_devkit.export.format import README, format_readme
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.tables.tokens import sample_token
from deepaccident_devkit.taxonomy import FRAME_PERIOD
from deepaccident_devkit.v2x.agents import agents_of
from deepaccident_devkit.v2x.windows import WindowConfig, configured_window, count_units

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

_NOTES = """\
`<scenario>/<agent>/<NNN>/scenario_<id>.parquet` is one sample, for av2's \
`load_argoverse_scenario_parquet`. The focal track is
the agent's own vehicle, positions are in world, and `city` is the town. Labels of all agents are \
merged. Steps outside of the
recording have no rows. There are no maps.
"""


@dataclass(frozen=True, kw_only=True)
class Av2(Format):
    """Scenarios for av2 and models for Argoverse 2, at 10 Hz.

    A scenario is a sample: the tracks of all actors that are annotated at its moment, by any agent.

    Attributes:
        past: Seconds before the present.
        future: Seconds after the present.
        every: Seconds between the presents of two samples, counted back from the end.

    Raises:
        ConfigError: If a time is not a multiple of 0.1 s, or too short.
    """

    past: float = 4.9
    future: float = 6.0
    every: float = 0.5

    name: ClassVar[str] = "av2"
    channels: ClassVar[tuple[str, ...]] = ()
    empty_reason: ClassVar[str] = (
        "none of the chosen agents is a vehicle with labels; choose other agents or scenarios"
    )

    def __post_init__(self) -> None:
        """Check the settings; raise ConfigError if a time does not fit."""
        super().__post_init__()
        WindowConfig(past=self.past, future=self.future)
        self._count_frames()

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the samples of a scenario whose agents have a track of their own."""
        (scenario,) = unit.scenarios
        config = WindowConfig(past=self.past, future=self.future)
        recorded_agents = agents_of(dataset, scenario)
        agents = [agent for agent in self.agents if agent in recorded_agents]
        absent = len(self.agents) - len(agents)
        output.leave_out("agents of scenarios that are not in this release", absent)
        num_frames = dataset.scenario.get(scenario)["num_frames"]
        numbers = keyframes(num_frames, self._count_frames())
        for agent, number in product(agents, numbers):
            token = sample_token(scenario, agent, number)
            if not dataset.sample.get(token)["labelled"]:
                output.leave_out("samples without labels")
                continue
            window = configured_window(dataset, token, config, "world")
            if window.own_actor_id not in window.actor_id:
                output.leave_out("samples of agents without a track of their own")
                continue
            path = f"{unit.name}/{agent}/{number:03d}/scenario_{flat_name(token)}.parquet"
            with output.file(path) as temporary:
                window.write_av2(temporary)
            output.tally.samples += 1

    def _count_frames(self) -> int:
        """Return the frames from one sample to the next; raise ConfigError if it is wrong."""
        return count_units("every", self.every, FRAME_PERIOD, minimum=FRAME_PERIOD)

    def finish(
        self,
        dataset: Dataset,
        units: Sequence[Unit],  # noqa: ARG002
        output: Output,
        parts: Callable[[Unit], Path],  # noqa: ARG002 - units are complete files
    ) -> None:
        """Write README.md."""
        title = f"DeepAccident {dataset.version}: Argoverse 2 scenarios"
        output.write(README, format_readme(self, dataset, title, {}, _NOTES))
