"""The nuScenes format: its settings, what each scenario becomes, and the tables as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
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

_OF_UNITS: Final = (
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
        settle_choices(self, {"van": get_args(Van), "lidar_axes": get_args(LidarAxes)})

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the sensor files of a scenario, and keep its rows."""
        rows = []
        for scene in self.scenes(dataset, unit):
            files = write_sensors(scene, self.lidar_axes, output)
            rows.append({**scene.rows(), **files, **box_rows(scene, self.van, output)})
            output.tally.samples += len(scene.frames)
            output.leave_out("frames between keyframes", scene.last - len(scene.frames))
        output.leave_out(
            "agents of scenarios that are not in this release", len(self.agents) - len(rows)
        )
        for table in _OF_UNITS:
            lines = "".join(
                f"{json.dumps(row)}\n" for scene_rows in rows for row in scene_rows[table]
            )
            write_bytes(output.parts / f"{table}.jsonl", lines.encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002 - for other formats
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        """Write the 13 tables, `splits.json` and masks of maps; only rows of scenes and logs are in memory at once."""
        folders = [parts(unit) for unit in units]
        for table in _OF_UNITS:
            _write_table(
                table, (line for folder in folders for line in _lines(folder, table)), output
            )
        scenes, logs = (
            [json.loads(line) for folder in folders for line in _lines(folder, each)]
            for each in ("scene", "log")
        )
        for table, rows in {**_fixed_tables(), "map": _maps(logs)}.items():
            _write_table(table, map(json.dumps, rows), output)
        for row in _maps(logs):
            output.write(row["filename"], _blank_mask())
        splits: dict[str, list[str]] = {f"deepaccident_{split}": [] for split in SPLITS}
        for row in scenes:
            splits.setdefault(f"deepaccident_{row['split'] or 'unknown'}", []).append(row["name"])
        output.write(f"{NUSCENES_VERSION}/splits.json", json.dumps(splits, indent=1).encode())

    def scenes(self, dataset: Dataset, unit: Unit) -> list[AgentScene]:
        """The scenes of a unit."""
        return [
            scene
            for token in unit.scenarios
            for scene in scenes_of(dataset, token, self.agents, sweeps=self.sweeps)
        ]


def _lines(folder: Path, table: str) -> list[str]:
    return read_bytes(folder / f"{table}.jsonl", "bundle").decode().splitlines()


def _write_table(table: str, rows: Iterable[str], output: Output) -> None:
    """Write a table of rows that are JSON, as they come."""
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
    """The tables that are the same in every export."""
    sensors = {
        name: "lidar" if name == LIDAR_CHANNEL else "camera" for name in CHANNEL_NAMES.values()
    }
    return {
        "sensor": [
            {"token": token("sensor", name), "channel": name, "modality": kind}
            for name, kind in sensors.items()
        ],
        "category": [_word("category", name) for name in NUSCENES_CATEGORIES.values()],
        "attribute": [_word("attribute", name) for name in _ATTRIBUTES],
        "visibility": [
            {"token": key, "level": level, "description": ""}
            for key, level in _VISIBILITIES.items()
        ],
    }


def _word(table: str, name: str) -> NuScenesRow:
    return {"token": token(table, name), "name": name, "description": ""}


def _maps(logs: Sequence[NuScenesRow]) -> list[NuScenesRow]:
    """A map for each town, with all logs of the town: a reader stops at a log that is in no map."""
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
    """A map without roads: nuScenes' masks have no negative coordinates, CARLA's towns do."""
    from PIL import Image

    content = BytesIO()
    Image.new("L", (1, 1)).save(content, "PNG")
    return content.getvalue()
