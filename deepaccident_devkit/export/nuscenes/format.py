"""The nuScenes format: its settings, and what each scenario becomes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, get_args

from deepaccident_devkit.export.bulk import Format, Output, Plan, Unit
from deepaccident_devkit.export.keyframes import keyframes
from deepaccident_devkit.export.nuscenes.boxes import Van, box_rows
from deepaccident_devkit.export.nuscenes.scenes import Scene, scenes_of
from deepaccident_devkit.export.nuscenes.sensors import POINT_BYTES, LidarAxes, write_sensors
from deepaccident_devkit.export.nuscenes.tables import write_part, write_tables
from deepaccident_devkit.export.sensor_files import points_in
from deepaccident_devkit.taxonomy import LIDAR
from deepaccident_devkit.text import choice

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

_FILE_ROW_BYTES: Final = 580
_BOX_ROW_BYTES: Final = 720
_FRAME_ROW_BYTES: Final = 360
"""JSON of a row, about."""


@dataclass(frozen=True, kw_only=True)
class NuScenes(Format):
    """Tables and sensor files for the nuScenes devkit 1.2 and all that reads nuScenes.

    A scene is what one agent recorded of a scenario. The last frame is a keyframe, and every fifth one before it; those
    between are sweeps.

    Attributes:
        van: vehicle of nuScenes that vans become, `car` or `truck`.
        lidar_axes: axes of clouds and their calibration: `ego`, x forward and y left as everywhere in the devkit, or
            `nuscenes`, x right and y forward, which code made for nuScenes may take for granted.
        sweeps: whether the frames between keyframes are exported too.

    Raises:
        ChoiceError: a setting is none of these.
    """

    van: Van = "car"
    lidar_axes: LidarAxes = "ego"
    sweeps: bool = True

    name: ClassVar[str] = "nuscenes"

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        object.__setattr__(self, "van", choice("van", self.van, get_args(Van)))
        object.__setattr__(self, "lidar_axes", choice("lidar_axes", self.lidar_axes, get_args(LidarAxes)))

    def plan(self, dataset: Dataset, unit: Unit) -> Plan:
        """About how much a scenario is, by the size of its first clouds."""
        return sum((_plan_of(scene) for scene in self.scenes(dataset, unit)), Plan())

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the sensor files of a scenario, and keep its rows."""
        rows = []
        for scene in self.scenes(dataset, unit):
            files = write_sensors(scene, self.lidar_axes, output)
            rows.append({**scene.rows(), **files, **box_rows(scene, self.van, output)})
            output.leave_out("frames between keyframes", scene.last - len(scene.frames))
        output.leave_out("agents of scenarios that are not in this release", len(self.agents) - len(rows))
        write_part(output.parts, rows)

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002 - for other formats
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Write the tables."""
        write_tables([parts(unit) for unit in units], output)

    def scenes(self, dataset: Dataset, unit: Unit) -> list[Scene]:
        """The scenes of a unit."""
        return [
            scene for token in unit.scenarios for scene in scenes_of(dataset, token, self.agents, sweeps=self.sweeps)
        ]


def _plan_of(scene: Scene) -> Plan:
    images = [size for channel, files in scene.files.items() if channel != LIDAR for _, size in files.values()]
    clouds, frames = scene.files[LIDAR], len(scene.frames)
    boxes = sum(scene.dataset.sample.get(scene.sample(number))["num_annotations"] for number in keyframes(scene.last))
    rows = (len(images) + len(clouds)) * _FILE_ROW_BYTES + boxes * _BOX_ROW_BYTES + frames * _FRAME_ROW_BYTES
    return Plan(
        samples=frames,
        files=len(clouds),
        bytes=points_in(clouds) * POINT_BYTES + rows,
        linked_files=len(images),
        linked_bytes=sum(images),
    )
