"""Functions that tests run in other processes: in a module that a spawned process can import by name."""

from deepaccident_devkit import DeepAccident


def num_boxes(release: DeepAccident, row: int) -> int:
    return len(release.boxes(release.sample[row]))
