"""The sensor files of a recording that are there, with their sizes, by one look into their folder."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import DatarootError
from deepaccident_devkit.reading import fault_text
from deepaccident_devkit.release import read_lidar
from deepaccident_devkit.release.store import ReleasePath, listed
from deepaccident_devkit.tables.tokens import sample_token


def sensor_files(dataset: Dataset, scenario: str, agent: str, channel: str) -> dict[int, tuple[ReleasePath, int]]:
    """Frame number → path and bytes of the files of a channel that are in this (partial) release.

    Raises:
        TokenError: no such scenario, agent or channel.
        DatarootError: their folder cannot be listed.
    """
    count = dataset.scenario[dataset.getind("scenario", scenario)]["num_frames"]
    first = dataset.sensor_path(f"{sample_token(scenario, agent, 1)}/{channel}")
    folder, (stem, ending) = first.parent, first.name.rsplit("_001.", 1)
    sizes: dict[str, int] = {}
    try:
        with suppress(FileNotFoundError, NotADirectoryError):
            for entry in listed(folder):
                with suppress(OSError):  # a link to nothing is a file that is not there
                    sizes[entry.name] = entry.stat().st_size
    except OSError as error:
        raise DatarootError(f"{folder}: {fault_text(error)}; unpack its archive again, or make it readable") from error
    names = ((number, f"{stem}_{number:03d}.{ending}") for number in range(1, count + 1))
    return {number: (folder / name, sizes[name]) for number, name in names if name in sizes}


def points_in(files: Mapping[int, tuple[ReleasePath, int]]) -> int:
    """About how many points LiDAR files have together: as many in each as in the first.

    Raises:
        SensorFileError: that file cannot be read.
    """
    first = next(iter(files.values()), None)
    return 0 if first is None else len(read_lidar(first[0], raw=True)) * len(files)
