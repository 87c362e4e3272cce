"""The export itself: which scenarios, agents and frames, and which file is what."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.export.bulk import Format, Output, Unit
from deepaccident_devkit.export.opencood.cloud import pcd_bytes
from deepaccident_devkit.export.opencood.moments import CAMERA_NAMES, Moments
from deepaccident_devkit.export.opencood.recording import Recording
from deepaccident_devkit.files import write_bytes
from deepaccident_devkit.json_text import parsed_json
from deepaccident_devkit.reading import read_bytes
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.taxonomy import CATEGORIES, LIDAR, VEHICLE_AGENTS
from deepaccident_devkit.text import choice

logger = logging.getLogger(__name__)

_SPLITS: Final[Mapping[str | None, str]] = {"train": "train", "val": "validate", "test": "test", None: "unknown"}
"""Our split → their folder."""
_AGENTS: Final = "agents.json"


@dataclass(frozen=True, kw_only=True)
class OpenCood(Format):
    """OPV2V's folders. Loaders take the first vehicle by name for the ego; agents are therefore 1 to 4, the pole −1.

    Attributes:
        classes: which boxes are vehicles; OpenCOOD has one class, so all of these become it.
        ego: the vehicle that is 1; the others follow in their usual order.
        without_clouds: whether to write agents and moments that lack a point cloud, too, for models of cameras alone.
            Loaders of clouds take them for moments at which nothing was hit, with true boxes.
    """

    classes: tuple[str, ...] = ("car", "truck", "van")
    ego: str = "ego_vehicle"
    without_clouds: bool = False
    name: ClassVar[str] = "opencood"
    nothing: ClassVar[str] = (
        "no moment of these scenarios and agents has its point clouds; unpack the archives of lidar01, leave out the "
        "agents without it (agents, --agents), or write images alone (without_clouds, --without-clouds)"
    )

    def __post_init__(self) -> None:
        """Check the choices."""
        super().__post_init__()
        chosen = {choice("classes", each, CATEGORIES) for each in self.classes}
        if not chosen:
            raise ChoiceError(f"classes: expected some of {', '.join(CATEGORIES)}, found none")
        object.__setattr__(self, "classes", tuple(each for each in CATEGORIES if each in chosen))
        object.__setattr__(self, "ego", choice("ego", self.ego, VEHICLE_AGENTS))

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        """Write a scenario's folder, which appears when it is whole."""
        recording = Recording(dataset, unit.scenarios[0], self.agents, self.ego, self.without_clouds)
        recording.count(output)
        if recording.frames:  # loaders stop at a scenario without agents
            with output.whole_folder(f"{_SPLITS[recording.record['split']]}/{unit.name}") as folder:
                folder.write("data_protocol.yaml", _yaml(recording.protocol()))
                for agent in recording.agents:
                    self._write_agent(recording, agent, folder)
        folders = [recording.folders[agent] for agent in recording.agents] if recording.frames else []
        facts = {"folders": folders, "written": recording.written, "samples": recording.samples}
        write_bytes(output.parts / _AGENTS, json.dumps(facts).encode())

    def finish(self, dataset: Dataset, units: Sequence[Unit], output: Output, parts: Callable[[Unit], Path]) -> None:  # noqa: ARG002 - others need the release
        """Write HEAL's assignment, by which all agents have the same sensors."""
        facts = {unit.name: parsed_json(read_bytes(parts(unit) / _AGENTS, "bundle")) for unit in units}
        found = {name: dict.fromkeys(each["folders"], "m1") for name, each in facts.items() if each["folders"]}
        output.write("heter_modality_assign.json", f"{json.dumps(found, indent=1)}\n".encode())

        written, samples = (sum(each[name] for each in facts.values()) for name in ("written", "samples"))
        if 2 * written < samples:
            logger.warning(
                "%d of %d samples, most of the export, are left out for lack of point clouds; unpack the archives of "
                "lidar01, leave out the agents without it (agents, --agents), or write images alone "
                "(without_clouds, --without-clouds)",
                samples - written,
                samples,
            )

    def _write_agent(self, recording: Recording, agent: str, output: Output) -> None:
        moments = Moments(recording, agent, self.classes)
        files = recording.files[agent]
        for number in recording.frames:
            stem, facts = f"{recording.folders[agent]}/{number:06d}", moments.facts(number, output)
            output.write(f"{stem}.yaml", _yaml(facts))
            output.write(f"{stem}.json", json.dumps(facts).encode())  # CoAlign and HEAL read it in place of the yaml
            if number in files[LIDAR]:
                output.write(f"{stem}.pcd", pcd_bytes(read_lidar(files[LIDAR][number][0], raw=True)))
            for camera, name in CAMERA_NAMES.items():
                if number in files[camera]:
                    output.link(files[camera][number][0], f"{stem}_{name}.png")


def _yaml(content: Mapping[str, Any]) -> bytes:
    import yaml

    dumper = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # the one in C is there with most builds
    return str(yaml.dump(content, Dumper=dumper, default_flow_style=None)).encode()
