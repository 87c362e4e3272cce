"""The infos that the released code's own converter makes, which its two dataset classes read.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.released_infos import ReleasedInfos

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/carla_infos", ReleasedInfos())

docs/exports.md lists what is left out, and where the classes look for files.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.release import Labels, ScenarioFolder, read_calib, read_label
from deepaccident_devkit.release.pickles import pickled_items, write_joined
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.tables.tokens import frame_token
from deepaccident_devkit.taxonomy import (
    AGENTS,
    BEV_CAMERA,
    CAMERAS,
    CATEGORIES,
    CHANNEL_FORMAT,
    CHANNELS,
    LIDAR,
)
from deepaccident_devkit.v2x.agents import agents_of

logger = logging.getLogger(__name__)

# Split with a file → version that the converter writes into it.
_SPLITS: Final[Mapping[str, str]] = {
    "train": "v1.0-trainval",
    "val": "v1.0-trainval",
    "train_mini": "v1.0-mini",
    "val_mini": "v1.0-mini",
}
_INFOS_SUFFIX: Final = ".infos"
_EMPTY_LIST: Final = "without_boxes.txt"
# Number of slashes before the scenario type in a path that the released code can read.
_PATH_DEPTH: Final = 2


@dataclass(frozen=True, kw_only=True)
class ReleasedInfos(Format):
    """`carla_infos_train.pkl`, `…_val.pkl`, and `…_mini.pkl` if the release has mini split files.

    Values are unchanged from the files, left-handed, except −yaw and −vy; two keyframes a second;
    all five agents.

    Attributes:
        root_prefix: Beginning of paths. The released classes find a scenario's meta file by the
            first four parts of a path, and the last of the four must be the scenario type: three
            parts, or, in a release with split folders, two.
        drop_empty: Leave out infos without boxes, at which both released classes stop.
            The converter retains them.

    Raises:
        ChoiceError: the prefix is no path, or only some agents are selected.
    """

    root_prefix: str = "./data/DeepAccident_data"
    drop_empty: bool = False
    name: ClassVar[str] = "released"
    channels: ClassVar[tuple[str, ...]] = ()
    nothing: ClassVar[str] = (
        "no scenario is in the split files train.txt or val.txt (which are in the root of the "
        "release or in split_txt_files) and has labels and all five agents; add these files, or "
        "choose other scenarios"
    )

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        if self.agents != AGENTS:
            raise ChoiceError("agents: the released classes need all five; leave this choice out")
        if not self.root_prefix.isprintable():
            raise ChoiceError(f"root_prefix: expected a path, found {self.root_prefix!r}")
        object.__setattr__(self, "root_prefix", self.root_prefix.rstrip("/"))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return the selected scenarios as units: one each.

        Raises:
            ChoiceError: the prefix has too many parts or too few.
        """
        folders = {dataset.get("scenario", token)["folder"] for token in scenarios}
        for folder in sorted(folders):
            start = "/".join(filter(None, (self.root_prefix, folder)))
            if start.count("/") != _PATH_DEPTH:
                fitting = "./DeepAccident" if folder else "./data/DeepAccident_data"
                raise ChoiceError(
                    "root_prefix: the released code finds meta files only if a path has three "
                    f"parts before the scenario type, found {start!r}; give {fitting}, or another "
                    "one with as many parts, and link the release there"
                )
        return super().units(dataset, scenarios)

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Make the infos of a scenario, one part for each agent."""
        token = unit.scenarios[0]
        fault = _fault(dataset, token)
        if fault:
            output.leave_out(fault)
            return
        record = dataset.get("scenario", token)
        folder = ScenarioFolder(
            dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
        )
        empty: list[str] = []
        for agent in AGENTS:
            infos = list(_infos(folder, agent, _keyframes(dataset, token), self.root_prefix))
            boxless = [info["lidar_prefix"] for info in infos if not len(info["gt_boxes"])]
            output.tally.samples += len(infos)
            if self.drop_empty:
                infos = [info for info in infos if len(info["gt_boxes"])]
                output.leave_out("infos without boxes", len(boxless))
            else:
                empty += boxless
            name = f"{folder.scenario_type}_{agent}_{folder.name}_{_INFOS_SUFFIX}"
            write_bytes(output.parts / name, pickled_items(infos))
        write_bytes(
            output.parts / _EMPTY_LIST, "".join([f"{prefix}\n" for prefix in empty]).encode()
        )

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Join the parts of each split, in the order of `lidar_prefix`."""
        for split, version in _SPLITS.items():
            try:
                scenarios = dataset.split_scenarios(split)
            except NotAvailableError:
                continue
            folders = [parts(unit) for unit in units if unit.scenarios[0] in scenarios]
            paths = [path for folder in folders for path in folder.glob(f"*{_INFOS_SUFFIX}")]
            paths.sort(key=lambda path: path.name)
            if paths:
                pieces = (read_bytes(path, "bundle") for path in paths)
                name = f"carla_infos_{split}.pkl"
                with output.file(name) as temporary, temporary.open("wb") as file:
                    write_joined(file, "infos", pieces, {"metadata": {"version": version}})
        list_paths = [parts(unit) / _EMPTY_LIST for unit in units]
        empty = b"".join(read_bytes(path, "bundle") for path in list_paths if path.exists())
        if empty:
            output.write(f"carla_infos_{_EMPTY_LIST}", empty)
            logger.warning(
                "%d infos have no boxes (carla_infos_%s lists them): the released classes stop at "
                "them; drop_empty (--drop-empty) leaves them out",
                empty.count(b"\n"),
                _EMPTY_LIST,
            )


def _keyframes(dataset: Dataset, scenario: str) -> range:
    return keyframes(dataset.get("scenario", scenario)["num_frames"])


def _fault(dataset: Dataset, scenario: str) -> str | None:
    """Return why the released code cannot use a scenario, as a plural; None if it can."""
    if dataset.get("scenario", scenario)["split"] not in _SPLITS:
        return "scenarios that are neither in train nor in val"
    if agents_of(dataset, scenario) != AGENTS:
        return "scenarios without all five agents"
    for number in _keyframes(dataset, scenario):
        for sample in dataset.samples_of(frame_token(scenario, number)):
            if not sample["labelled"]:
                return "scenarios without labels"
    return None


def _infos(
    folder: ScenarioFolder, agent: str, numbers: range, root_prefix: str
) -> Iterator[dict[str, Any]]:
    """Yield the infos of an agent's keyframes, with the converter's own keys."""
    calibs = [read_calib(folder.calib_path(agent, number), raw=True) for number in numbers]
    name_parts = folder.name.split("_")
    scene_name = f"{folder.scenario_type}_{name_parts[0]}_{name_parts[-1]}"
    parents = (root_prefix, folder.folder, folder.scenario_type)
    agent_path = f"{'/'.join(filter(None, parents))}/{agent}"
    for number, calib in zip(numbers, calibs, strict=True):
        stem = f"{folder.name}_{number:03d}"
        paths = {}
        for channel in CHANNELS:
            file_name = f"{stem}.{CHANNEL_FORMAT[channel]}"
            paths[channel] = f"{agent_path}/{channel}/{folder.name}/{file_name}"
        cameras = {}
        for camera in CAMERAS:
            cameras[camera] = {
                "image_path": paths[camera],
                "lidar_to_camera_matrix": calib[f"lidar_to_{camera}"],
                "camera_intrinsic_matrix": calib[f"intrinsic_{camera}"],
                "timestamp": number,
            }
        yield {
            "scenario_type": folder.scenario_type,
            "vehicle_name": agent,
            "scene_name": scene_name,
            "lidar_prefix": f"{folder.scenario_type}_{agent}_{stem}",
            "lidar_path": paths[LIDAR],
            "bev_path": paths[BEV_CAMERA],
            "timestamp": number,
            "scenario_length": numbers[-1],
            "cams": cameras,
            "lidar_to_ego_matrix": calib["lidar_to_ego"],
            "ego_to_world_matrix": calib["ego_to_world"],
            **_boxes(read_label(folder.label_path(agent, number), raw=True)),
        }


def _boxes(label: Labels) -> dict[str, Any]:
    speed_x, speed_y = label.agent_velocity[0].tolist()
    return {
        "vehicle_speed_x": speed_x,
        "vehicle_speed_y": speed_y,
        "gt_names": np.array([CATEGORIES[code] for code in label.category]),
        "gt_boxes": np.column_stack([label.center, label.size, -label.yaw]),
        "gt_velocity": label.velocity * (1, -1),
        "vehicle_id": label.actor_id,
        "num_lidar_pts": label.num_lidar_pts,
        "camera_visibility": label.camera_visible.astype(np.int64),
    }
