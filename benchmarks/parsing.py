"""Label files to columns, against a reader that splits lines and calls float()."""

import random
import tempfile
from pathlib import Path

from benchmarks.measure import Figure, best_of, one_core
from deepaccident_devkit.release import read_labels

FILES, LINES = 2000, 30


def measure() -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        paths = write_labels(Path(folder))
        ours = FILES / best_of(7, lambda: read_labels(paths))
        with one_core():
            alone = FILES / best_of(7, lambda: read_labels(paths))
        plain = FILES / best_of(3, lambda: [read_plainly(path) for path in paths])
        expected = [
            value for path in paths[:50] for row in read_plainly(path)[1] for value in row[1:4]
        ]
        read = read_labels(paths[:50], raw=True).center.reshape(-1).tolist()
        if read != expected:
            raise AssertionError("the two readers disagree")
    return [
        Figure(
            name="parsing_files_per_s",
            value=ours,
            unit="files/s",
            bound=30_000,
            higher_is_better=True,
        ),
        Figure(
            name="parsing_files_per_s_one_core",
            value=alone,
            unit="files/s",
            bound=30_000,
            higher_is_better=True,
        ),
        Figure(name="parsing_plain_files_per_s", value=plain, unit="files/s"),
        Figure(
            name="parsing_ratio",
            value=ours / plain,
            unit="times plain",
            bound=5,
            higher_is_better=True,
        ),
    ]


def write_labels(folder: Path) -> list[Path]:
    """Files of 30 boxes; half of the numbers with three decimals, half with seventeen digits, as
    real files mix.
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
            lines.append(f"car {numbers} {1000 + line} {source.randrange(300)} {line % 3 > 0}")
        path = folder / f"label_{file:04d}.txt"
        path.write_text("\n".join(lines) + "\n")
        paths.append(path)
    return paths


def read_plainly(path: Path) -> tuple[tuple[float, ...], list[tuple[object, ...]]]:
    """What one writes first: a loop over lines, `split`, `float`."""
    with path.open() as file:
        speed = tuple(map(float, file.readline().split()))
        rows = []
        for line in file:
            words = line.split()
            if len(words) > 1:
                numbers = map(float, words[1:10])
                rows.append(
                    (words[0], *numbers, int(words[10]), int(words[11]), words[12] == "True")
                )
    return speed, rows
