"""The nuScenes format: its settings, rows of each scenario, and the tables as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, get_args

from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.nuscenes.scenes import (
    CHANNEL_NAMES,
    LIDAR_CHANNEL,
    NUSCENES_CATEGORIES,
    NUSCENES_VERSION,
    AgentScene,
    LidarAxes,
    NuScenesRow,
    Van,
    box_rows,
    scenes_of,
    token,
    write_sensors,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset
    from deepaccident_devkit.export.bulk import Output

# Tables with rows of scenarios.
_SCENARIO_TABLES: Final = (
    *("log", "scene", "sample", "sample_data", "ego_pose", "calibrated_sensor"),
    *("instance", "sample_annotation"),
)
_ATTRIBUTES: Final = (
    *(
        "vehicle.moving",
        "vehicle.stopped",
        "vehicle.parked",
        "cycle.with_rider",
        "cycle.without_rider",
    ),
    *("pedestrian.moving", "pedestrian.standing", "pedestrian.sitting_lying_down"),
)
_VISIBILITIES: Final = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}


@dataclass(frozen=True, kw_only=True)
class NuScenes(Format):
    """Tables and sensor files for the nuScenes devkit 1.2 and all software that reads nuScenes.

    A scene is one agent's recording of a scenario. The last frame is a keyframe, and every fifth
    one before it; the frames between them are sweeps.

    Attributes:
        van: Vehicle of nuScenes that vans become, `car` or `truck`.
        lidar_axes: Axes of clouds and their calibration: `ego`, x forward and y left as everywhere
            in the devkit, or `nuscenes`, x right and y forward, which code made for nuScenes may
            rely on.
        sweeps: Whether the frames between keyframes are exported too.

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
        settle_choices(self, {"van": get_args(Van), "lidar_axes": get_args(LidarAxes)})

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the sensor files of a scenario, and its rows into its part."""
        rows_by_scene = []
        for scene in self.scenes(dataset, unit):
            files = write_sensors(scene, self.lidar_axes, output)
            rows_by_scene.append({**scene.rows(), **files, **box_rows(scene, self.van, output)})
            output.tally.samples += len(scene.frames)
            output.leave_out("frames between keyframes", scene.last - len(scene.frames))
        absent = len(self.agents) - len(rows_by_scene)
        output.leave_out("agents of scenarios that are not in this release", absent)
        for table in _SCENARIO_TABLES:
            lines = []
            for scene_rows in rows_by_scene:
                lines += [f"{json.dumps(row)}\n" for row in scene_rows[table]]
            write_bytes(output.parts / f"{table}.jsonl", "".join(lines).encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002 - for other formats
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Write the 13 tables, `splits.json` and masks of maps.

        Only rows of scenes and logs are all in memory at once.
        """
        folders = list(map(parts, units))
        for table in _SCENARIO_TABLES:
            _write_table(table, _lines(folders, table), output)
        scenes = list(map(json.loads, _lines(folders, "scene")))
        logs = list(map(json.loads, _lines(folders, "log")))
        for table, rows in {**_fixed_tables(), "map": _maps(logs)}.items():
            _write_table(table, map(json.dumps, rows), output)
        for row in _maps(logs):
            output.write(row["filename"], _blank_mask())
        splits: dict[str, list[str]] = {f"deepaccident_{split}": [] for split in SPLITS}
        for row in scenes:
            splits.setdefault(f"deepaccident_{row['split'] or 'unknown'}", []).append(row["name"])
        output.write(f"{NUSCENES_VERSION}/splits.json", json.dumps(splits, indent=1).encode())

    def scenes(self, dataset: Dataset, unit: Unit) -> list[AgentScene]:
        """Return the scenes of a unit."""
        scenes: list[AgentScene] = []
        for scenario in unit.scenarios:
            scenes += scenes_of(dataset, scenario, self.agents, sweeps=self.sweeps)
        return scenes


def _lines(folders: Iterable[Path], table: str) -> Iterator[str]:
    """Yield the rows of a table, which are JSON, from the units' folders of parts."""
    for folder in folders:
        yield from read_bytes(folder / f"{table}.jsonl", "bundle").decode().splitlines()


def _write_table(table: str, rows: Iterable[str], output: Output) -> None:
    """Write a table of rows that are JSON, one after another."""
    with (
        output.file(f"{NUSCENES_VERSION}/{table}.json") as path,
        path.open("w", encoding="utf-8") as file,
    ):
        separator = "[\n"
        for row in rows:
            file.write(f"{separator}{row}")
            separator = ",\n"
        file.write("\n]" if separator == ",\n" else "[]")


def _fixed_tables() -> dict[str, list[NuScenesRow]]:
    """Return the tables that are the same in every export."""
    sensors = []
    for name in CHANNEL_NAMES.values():
        modality = "lidar" if name == LIDAR_CHANNEL else "camera"
        sensors.append({"token": token("sensor", name), "channel": name, "modality": modality})
    visibilities = []
    for visibility, level in _VISIBILITIES.items():
        visibilities.append({"token": visibility, "level": level, "description": ""})
    return {
        "sensor": sensors,
        "category": [_word_row("category", name) for name in NUSCENES_CATEGORIES.values()],
        "attribute": [_word_row("attribute", name) for name in _ATTRIBUTES],
        "visibility": visibilities,
    }


def _word_row(table: str, name: str) -> NuScenesRow:
    return {"token": token(table, name), "name": name, "description": ""}


def _maps(logs: Sequence[NuScenesRow]) -> list[NuScenesRow]:
    """Return a map for each town, with all logs of the town.

    A reader stops at a log without a map.
    """
    towns: dict[str, list[str]] = {}
    for log in logs:
        towns.setdefault(log["location"], []).append(log["token"])
    return [
        {
            "token": token("map", town),
            "log_tokens": tokens,
            "category": "semantic_prior",
            "filename": f"maps/{token('map', town)}.png",
        }
        for town, tokens in sorted(towns.items())
    ]


def _blank_mask() -> bytes:
    """Return a map without roads.

    nuScenes' masks have no negative coordinates, but CARLA's towns do.
    """
    from PIL import Image

    content = BytesIO()
    Image.new("L", (1, 1)).save(content, "PNG")
    return content.getvalue()
