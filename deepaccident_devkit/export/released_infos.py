"""Info files as the released code's converter writes them, for its two dataset classes.

    from deepaccident_devkit import DeepAccident
    from deepaccident_devkit.export.bulk import export_release
    from deepaccident_devkit.export.released_infos import ReleasedInfos

    da = DeepAccident(dataroot="data/DeepAccident")
    export_release(da, "data/carla_infos", ReleasedInfos())

docs/exports.md lists what is left out, and where the classes look for files.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError, NotAvailableError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.frames import keyframes
from deepaccident_devkit.release import Labels, ScenarioFolder, read_calib, read_label
from deepaccident_devkit.release.pickles import pickled_items, write_joined
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.support.reading import read_bytes
from deepaccident_devkit.support.values import NamedValues
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

# Version that the converter writes into the file of each split.
_SPLITS = {
    "train": "v1.0-trainval",
    "val": "v1.0-trainval",
    "train_mini": "v1.0-mini",
    "val_mini": "v1.0-mini",
}
_INFOS_SUFFIX = ".infos"
_EMPTY_LIST = "without_boxes.txt"
# Number of slashes before the scenario type in each path that the released code can read.
_PATH_DEPTH = 2


@dataclass(frozen=True, kw_only=True)
class ReleasedInfos(Format):
    """The files `carla_infos_train.pkl`, `…_val.pkl` and, with mini split files, `…_mini.pkl`.

    They have two keyframes a second and all five agents. Values are taken from the release's files,
    and so left-handed, except −yaw and −vy.

    Attributes:
        root_prefix: Beginning of paths. The released classes find the meta file of a scenario by
            the first four parts of a path, and the fourth must be the scenario type. So this has
            three parts or, in a release with split folders, two.
        drop_empty: Whether to exclude infos without boxes, which the released converter writes
            but both released classes fail on.

    Raises:
        ChoiceError: If the prefix is not a path, or only some agents are selected.
    """

    root_prefix: str = "./data/DeepAccident_data"
    drop_empty: bool = False
    name: ClassVar[str] = "released"
    channels: ClassVar[tuple[str, ...]] = ()
    empty_reason: ClassVar[str] = (
        "no scenario is in the split files train.txt or val.txt (which are in the root of the "
        "release or in split_txt_files) and has labels and all five agents; add these files, or "
        "choose other scenarios"
    )

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        if self.agents != AGENTS:
            raise ChoiceError("agents: the released classes need all five; remove this choice")
        if not self.root_prefix.isprintable():
            raise ChoiceError(f"root_prefix: expected a path, found {self.root_prefix!r}")
        object.__setattr__(self, "root_prefix", self.root_prefix.rstrip("/"))

    def units(self, dataset: Dataset, scenarios: Sequence[str]) -> list[Unit]:
        """Return the selected scenarios as units of one scenario each.

        Raises:
            ChoiceError: If the prefix has too many or too few parts.
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
        """Write the infos of a scenario, with one part for each agent."""
        token = unit.scenarios[0]
        fault = _find_fault(dataset, token)
        if fault:
            output.leave_out(fault)
            return
        record = dataset.get("scenario", token)
        folder = ScenarioFolder(
            dataset.dataroot, record["folder"], record["scenario_type"], record["name"], AGENTS
        )
        numbers = keyframes(record["num_frames"])
        empty_infos: list[str] = []
        for agent in AGENTS:
            infos = list(_make_infos(folder, agent, numbers, self.root_prefix))
            output.tally.samples += len(infos)
            prefixes = [info["lidar_prefix"] for info in infos if not len(info["gt_boxes"])]
            if self.drop_empty:
                infos = [info for info in infos if len(info["gt_boxes"])]
                output.leave_out("infos without boxes", len(prefixes))
            else:
                empty_infos += prefixes
            name = f"{folder.scenario_type}_{agent}_{folder.name}_{_INFOS_SUFFIX}"
            write_bytes(output.parts / name, pickled_items(infos))
        lines = [f"{prefix}\n" for prefix in empty_infos]
        write_bytes(output.parts / _EMPTY_LIST, "".join(lines).encode())

    def finish(
        self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]
    ) -> None:
        """Join the parts of each split in the order of `lidar_prefix`; list infos without boxes."""
        for split, version in _SPLITS.items():
            try:
                scenarios = dataset.split_scenarios(split)
            except NotAvailableError:
                continue
            paths: list[Path] = []
            for unit in units:
                if unit.scenarios[0] in scenarios:
                    paths += parts(unit).glob(f"*{_INFOS_SUFFIX}")
            paths.sort(key=lambda path: path.name)
            if paths:
                pieces = (read_bytes(path, "bundle") for path in paths)
                name = f"carla_infos_{split}.pkl"
                with output.file(name) as temporary, temporary.open("wb") as file:
                    write_joined(file, "infos", pieces, {"metadata": {"version": version}})
        list_paths = [parts(unit) / _EMPTY_LIST for unit in units]
        empty_infos = b"".join(read_bytes(path, "bundle") for path in list_paths if path.exists())
        if empty_infos:
            output.write(f"carla_infos_{_EMPTY_LIST}", empty_infos)
            logger.warning(
                "%d infos have no boxes (carla_infos_%s lists them): the released classes stop at "
                "them; drop_empty (--drop-empty) excludes them",
                empty_infos.count(b"\n"),
                _EMPTY_LIST,
            )


def _find_fault(dataset: Dataset, scenario: str) -> str | None:
    """Name the kind of unusable scenario that this is; None if the released code can use it."""
    record = dataset.get("scenario", scenario)
    if record["split"] not in _SPLITS:
        return "scenarios that are neither in train nor in val"
    if agents_of(dataset, scenario) != AGENTS:
        return "scenarios without all five agents"
    for number in keyframes(record["num_frames"]):
        for sample in dataset.samples_of(frame_token(scenario, number)):
            if not sample["labelled"]:
                return "scenarios without labels"
    return None


def _make_infos(
    folder: ScenarioFolder, agent: str, numbers: range, root_prefix: str
) -> Iterator[NamedValues]:
    """Yield the infos of an agent's keyframes, with the keys that the converter uses."""
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
            **_make_box_columns(read_label(folder.label_path(agent, number), raw=True)),
        }


def _make_box_columns(label: Labels) -> NamedValues:
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
