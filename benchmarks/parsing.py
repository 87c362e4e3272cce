"""Measure reading label files to columns, against a reader that splits lines and calls float()."""

import random
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core, temporary_folder
from deepaccident_devkit.release import read_labels

FILES, LINES = 2000, 30


def measure() -> list[Figure]:
    with temporary_folder() as folder:
        paths = write_labels(folder)
        ours = FILES / best_of(7, lambda: read_labels(paths))
        with one_core():
            one_core_rate = FILES / best_of(7, lambda: read_labels(paths))
        plain = FILES / best_of(3, lambda: [read_plainly(path) for path in paths])
        expected = [row[1:4] for path in paths[:50] for row in read_plainly(path)[1]]
        centers = read_labels(paths[:50], raw=True).center.tolist()
        if list(map(tuple, centers)) != expected:
            raise AssertionError("the two readers disagree")
    return [
        Figure(
            "parsing_files_per_s",
            ours,
            "files/s",
            bound=30_000,
            higher_is_better=True,
        ),
        Figure(
            "parsing_files_per_s_one_core",
            one_core_rate,
            "files/s",
            bound=30_000,
            higher_is_better=True,
        ),
        Figure("parsing_plain_files_per_s", plain, "files/s"),
        Figure(
            "parsing_ratio",
            ours / plain,
            "times plain",
            bound=5,
            higher_is_better=True,
        ),
    ]


def write_labels(folder: Path) -> list[Path]:
    """Write files of 30 boxes; half of the numbers have three decimals, half have seventeen digits,
    as real files mix.
    """
    source = random.Random(0)  # noqa: S311

    def number(index: int) -> str:
        value = source.gauss(0, 30)
        return f"{value:.3f}" if index % 2 else repr(value)

    paths = []
    for file in range(FILES):
        lines = ["0.0034441 -5.6166797"]
        for line in range(LINES):
            numbers = " ".join(number(line + column) for column in range(9))
            points = source.randrange(300)
            lines.append(f"car {numbers} {1000 + line} {points} {line % 3 > 0}")
        path = folder / f"label_{file:04d}.txt"
        path.write_text("\n".join(lines) + "\n")
        paths.append(path)
    return paths


def read_plainly(path: Path) -> tuple[tuple[float, ...], list[tuple[object, ...]]]:
    """Read a label file as one writes it first: a loop over lines, `split`, `float`."""
    with path.open() as file:
        speed = tuple(map(float, file.readline().split()))
        rows = []
        for line in file:
            words = line.split()
            if len(words) > 1:
                numbers = map(float, words[1:10])
                counts = map(int, words[10:12])
                rows.append((words[0], *numbers, *counts, words[12] == "True"))
    return speed, rows
