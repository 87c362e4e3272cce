"""A small export format for tests that uses every part of the format interface.

It has a module of its own so that a spawned process can import it by name.
"""

import json
import os
import signal
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.export.bulk import Format, Output, Unit, export_release
from deepaccident_devkit.export.frames import sensor_files
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.tables.tokens import frame_token

CAMERA_NAME = "Camera_Front"


@dataclass(frozen=True, kw_only=True)
class TinyFormat(Format):
    """Writes linked pictures, text files and a count for each scenario; `finish` collects the
    counts.
    """

    greeting: str = "hello"
    name: ClassVar[str] = "tiny"

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:
        pictures = self.pictures(dataset, unit)
        record = dataset.scenario[dataset.getind("scenario", unit.scenarios[0])]
        with output.whole_folder(f"folders/{unit.name}") as folder:
            for name, (path, _) in pictures.items():
                folder.link(path, f"pictures/{name}.jpg")
            folder.write("names.json", json.dumps(list(pictures)).encode())
        for number in range(1, record["num_frames"] + 1):
            output.write(f"frames/{unit.name}/{number}.txt", self.greeting.encode())
        with output.file(f"weather/{unit.name}.txt") as path:
            path.write_text(str(record["weather"]))
        output.tally.samples += len(pictures)
        output.leave_out("clouds", len(pictures))
        write_bytes(output.parts / "count.txt", str(len(pictures)).encode())

    def finish(
        self,
        dataset: Dataset,  # noqa: ARG002
        units: Sequence[Unit],
        output: Output,
        parts: Callable[[Unit], Path],
    ) -> None:
        counts = {}
        for unit in units:
            counts[unit.name] = int((parts(unit) / "count.txt").read_text())
        output.write("counts.json", json.dumps(counts).encode())
        output.leave_out("maps")

    def pictures(self, dataset: Dataset, unit: Unit) -> dict[str, tuple[Path, int]]:
        """Return the path and size in bytes of each picture, by its name in the export."""
        (scenario,) = unit.scenarios
        pictures = {}
        for sample in dataset.samples_of(frame_token(scenario, 1)):
            agent = sample["agent"]
            if agent in self.agents:
                files = sensor_files(dataset, scenario, agent, CAMERA_NAME)
                for number, path_and_size in files.items():
                    pictures[f"{agent}-{number}"] = path_and_size
        return pictures


class KilledFormat(TinyFormat):
    """Kills its own worker, as the system does when memory runs out."""

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:  # noqa: ARG002
        with output.whole_folder(f"folders/{unit.name}") as folder:
            folder.write("names.json", b"[]")
            os.kill(os.getpid(), signal.SIGKILL)


def export_tiny(dataroot: str, folder: str, workers: int) -> None:
    dataset = DeepAccident(dataroot=dataroot, verbose=False)
    export_release(dataset, folder, TinyFormat(), workers=workers)
