"""A format of the tests' own that uses all that formats have; in a module that a spawned process
can import by name.
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

CAMERA = "Camera_Front"


@dataclass(frozen=True, kw_only=True)
class TinyFormat(Format):
    """Each scenario is a folder of linked pictures, two files and a count, which `finish` adds
    up.
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
        counts = {unit.name: int((parts(unit) / "count.txt").read_text()) for unit in units}
        output.write("counts.json", json.dumps(counts).encode())
        output.leave_out("maps")

    def pictures(self, dataset: Dataset, unit: Unit) -> dict[str, tuple[Path, int]]:
        """Name → path and bytes."""
        (scenario,) = unit.scenarios
        return {
            f"{sample['agent']}-{number}": found
            for sample in dataset.samples_of(frame_token(scenario, 1))
            if sample["agent"] in self.agents
            for number, found in sensor_files(dataset, scenario, sample["agent"], CAMERA).items()
        }


class KilledFormat(TinyFormat):
    """Its worker is killed, as by a system whose memory has run out."""

    def write(self, dataset: Dataset, unit: Unit, output: Output) -> None:  # noqa: ARG002
        with output.whole_folder(f"folders/{unit.name}") as folder:
            folder.write("names.json", b"[]")
            os.kill(os.getpid(), signal.SIGKILL)


def export_tiny(dataroot: str, folder: str, workers: int) -> None:
    """Export a release whole."""
    export_release(
        DeepAccident(dataroot=dataroot, verbose=False), folder, TinyFormat(), workers=workers
    )
