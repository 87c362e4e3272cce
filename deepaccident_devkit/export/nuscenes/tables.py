"""The nuScenes format: its settings, rows of each scenario, and the tables as files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, get_args

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
    find_scenes,
    make_box_rows,
    token,
    write_sensors,
)
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.text import settle_choices
from deepaccident_devkit.taxonomy import SPLITS

if TYPE_CHECKING:
    from deepaccident_devkit.dataset import Dataset

# Tables with rows that depend on the scenarios.
_SCENARIO_TABLES = (
    "log",
    "scene",
    "sample",
    "sample_data",
    "ego_pose",
    "calibrated_sensor",
    "instance",
    "sample_annotation",
)
_ATTRIBUTES = (
    "vehicle.moving",
    "vehicle.stopped",
    "vehicle.parked",
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.moving",
    "pedestrian.standing",
    "pedestrian.sitting_lying_down",
)
_VISIBILITIES = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}


@dataclass(frozen=True, kw_only=True)
class NuScenes(Format):
    """Tables and sensor files for the nuScenes devkit 1.2 and all software that reads nuScenes.

    A scene is one agent's recording of a scenario. The last frame is a keyframe, and so is every
    fifth frame before it; the frames between keyframes are sweeps. The tables contain:

    - Scene: its name is `<type>-<scenario>-<agent>`.
    - Samples: at 2 Hz, with our `deepaccident_token`, `agent` and `time_to_impact`.
    - Sweeps: other frames, with the keyframe after them.
    - Splits: `splits.json` lists `deepaccident_train` and others, and `deepaccident_unknown` for
      scenarios that no split file names.
    - Channels: cameras are `CAM_FRONT` to `CAM_BACK_RIGHT`, lidar01 is `LIDAR_TOP`.
    - Classes: a cyclist is `vehicle.bicycle`, a van what `van` sets; our class is
      `category_deepaccident`.
    - Instances: our actor is `actor_id`; an actor has a separate instance in each scene, and each
      untracked box is an instance of its own. The agent's own box is left out.
    - Visibility: 4 for an actor that a camera sees, otherwise 1.
    - Attributes: moving (above 0.2 m/s at 10 Hz), standing, or parked (id from 20000 on).
    - Velocity: none, as the nuScenes devkit derives it from neighbouring keyframes.

    Attributes:
        van: Vehicle of nuScenes that vans become, `car` or `truck`.
        lidar_axes: Axes of clouds and their calibration: `ego`, x forward and y left as everywhere
            in the devkit, or `nuscenes`, x right and y forward, which code made for nuScenes may
            rely on.
        sweeps: Whether to also export the frames between keyframes.

    Raises:
        ChoiceError: If a setting has none of these values.
    """

    van: Van = "car"
    lidar_axes: LidarAxes = "ego"
    sweeps: bool = True

    name: ClassVar[str] = "nuscenes"

    def __post_init__(self) -> None:
        """Raise ChoiceError unless all settings have one of their possible values."""
        super().__post_init__()
        settle_choices(self, {"van": get_args(Van), "lidar_axes": get_args(LidarAxes)})

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write the sensor files of a scenario, and its rows into its part."""
        rows_by_scene = []
        for scene in self.scenes(dataset, unit):
            files = write_sensors(scene, self.lidar_axes, output)
            rows_by_scene.append(
                {**scene.make_rows(), **files, **make_box_rows(scene, self.van, output)}
            )
            output.tally.samples += len(scene.frames)
            output.leave_out("frames between keyframes", scene.last_frame - len(scene.frames))
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
        """Write the 13 tables, `splits.json` and the masks of maps.

        Only the rows of scenes and logs are all in memory at once.
        """
        folders = list(map(parts, units))
        for table in _SCENARIO_TABLES:
            _write_table(table, _read_lines(folders, table), output)
        scenes = list(map(json.loads, _read_lines(folders, "scene")))
        logs = list(map(json.loads, _read_lines(folders, "log")))
        for table, rows in {**_make_fixed_tables(), "map": _make_maps(logs)}.items():
            _write_table(table, map(json.dumps, rows), output)
        for row in _make_maps(logs):
            output.write(row["filename"], _draw_blank_mask())
        splits: dict[str, list[str]] = {f"deepaccident_{split}": [] for split in SPLITS}
        for row in scenes:
            splits.setdefault(f"deepaccident_{row['split'] or 'unknown'}", []).append(row["name"])
        output.write(f"{NUSCENES_VERSION}/splits.json", json.dumps(splits, indent=1).encode())

    def scenes(self, dataset: Dataset, unit: Unit) -> list[AgentScene]:
        """Return the scenes of a unit, agent by agent."""
        scenes: list[AgentScene] = []
        for scenario in unit.scenarios:
            scenes += find_scenes(dataset, scenario, self.agents, sweeps=self.sweeps)
        return scenes


def _read_lines(folders: Iterable[Path], table: str) -> Iterator[str]:
    """Yield the rows of a table as JSON, from the units' part folders."""
    for folder in folders:
        yield from read_bytes(folder / f"{table}.jsonl", "bundle").decode().splitlines()


def _write_table(table: str, rows: Iterable[str], output: Output) -> None:
    """Write a table from its rows, which are JSON, one after the other."""
    with (
        output.file(f"{NUSCENES_VERSION}/{table}.json") as path,
        path.open("w", encoding="utf-8") as file,
    ):
        separator = "[\n"
        for row in rows:
            file.write(f"{separator}{row}")
            separator = ",\n"
        file.write("\n]" if separator == ",\n" else "[]")


def _make_fixed_tables() -> dict[str, list[NuScenesRow]]:
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
        "category": [_make_word_row("category", name) for name in NUSCENES_CATEGORIES.values()],
        "attribute": [_make_word_row("attribute", name) for name in _ATTRIBUTES],
        "visibility": visibilities,
    }


def _make_word_row(table: str, name: str) -> NuScenesRow:
    return {"token": token(table, name), "name": name, "description": ""}


def _make_maps(logs: Sequence[NuScenesRow]) -> list[NuScenesRow]:
    """Return a map for each town, to which all logs from the town refer.

    Readers fail on a log without a map.
    """
    log_tokens_by_town: dict[str, list[str]] = {}
    for log in logs:
        log_tokens_by_town.setdefault(log["location"], []).append(log["token"])
    rows = []
    for town, log_tokens in sorted(log_tokens_by_town.items()):
        map_token = token("map", town)
        rows.append(
            {
                "token": map_token,
                "log_tokens": log_tokens,
                "category": "semantic_prior",
                "filename": f"maps/{map_token}.png",
            }
        )
    return rows


def _draw_blank_mask() -> bytes:
    """Return a PNG of a map without roads.

    nuScenes' masks cannot represent negative coordinates, which CARLA's towns have.
    """
    from PIL import Image

    content = BytesIO()
    Image.new("L", (1, 1)).save(content, "PNG")
    return content.getvalue()
