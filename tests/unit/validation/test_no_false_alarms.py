"""What docs/format.md calls normal is no finding, and what cannot be read ends no run."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
import tiny

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.validation import validate_release


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Labels of one accident, long enough for tracks."""
    root = tmp_path_factory.mktemp("healthy") / "release"
    return make_release(
        root, SynthConfig(scenarios=2, frames=12, seed=11, sensors=False, designed=True), workers=1
    )


@pytest.fixture
def release(healthy: Path, tmp_path: Path) -> Path:
    root = tmp_path / "release"
    shutil.copytree(healthy, root)
    return root


LABELS = "*/*/label/*/*.txt"


def told(root: Path, *, deep: bool = False) -> set[str]:
    report = validate_release(root, deep=deep, workers=1)
    return {finding.code for finding in report.findings if finding.severity != "note"}


Rows = list[list[str]]


def rewrite(paths: Iterable[Path], change: Callable[[int, Rows], Rows]) -> None:
    """Change the box lines of labels, each with its number."""
    for number, path in enumerate(sorted(paths)):
        first, *lines = path.read_text().splitlines()
        rows = change(number, [line.split() for line in lines])
        path.write_text("\n".join([first, *(" ".join(row) for row in rows)]) + "\n")


def seen(row: list[str]) -> bool:
    return bool(int(row[11])) or row[12] == "True" or row[10] == "-100"


def distance(row: list[str]) -> float:
    return float(np.hypot(float(row[1]), float(row[2])))


def untracked(rows: Rows, which: Callable[[int, list[str]], bool]) -> Rows:
    """Write −1 for the ids of some others."""
    return [
        [*row[:10], "-1", *row[11:]] if row[10] != "-100" and which(place, row) else row
        for place, row in enumerate(rows)
    ]


@pytest.mark.parametrize(
    "change",
    [
        lambda _, rows: [
            [row[0], *(f"{float(word):.3f}" for word in row[1:10]), *row[10:]] for row in rows
        ],
        lambda _, rows: [row for row in rows if seen(row)],
        lambda _, rows: [row for row in rows if distance(row) < 33],
        lambda number, rows: untracked(
            rows, lambda place, row: (number + place) % 5 == 0 and abs(float(row[1])) > 15
        ),
        lambda _, rows: untracked(rows, lambda _, row: distance(row) >= 20),
    ],
    ids=[
        "three decimals",
        "visible alone",
        "a small radius",
        "tracking that comes and goes",
        "far ones untracked",
    ],
)
def test_what_labels_may_be_like(release: Path, change: Callable[[int, Rows], Rows]) -> None:
    """−1 is normal where it begins at a distance, whoever else is nearer (docs/format.md,
    Label).
    """
    rewrite(release.glob(LABELS), change)
    assert told(release) == set()


def test_hidden_actors_in_one_agents_labels_tell_of_those_missing_in_anothers(
    release: Path,
) -> None:
    """All labels of a scenario are written by one rule."""
    others = [path for path in release.glob(LABELS) if "infrastructure" not in path.parts]
    rewrite(others, lambda _, rows: [row for row in rows if seen(row)])
    assert {"actor-missing"} <= told(release) <= {"actor-missing", "track-gap"}


def test_one_agent_alone(release: Path) -> None:
    for folder in release.glob("*/*"):
        if folder.name not in ("meta", "infrastructure"):
            shutil.rmtree(folder)
    assert told(release) == set()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_scenarios(tmp_path: Path, frames: int) -> None:
    root = make_release(
        tmp_path / "release",
        SynthConfig(scenarios=1, frames=frames, seed=3, sensors=False),
        workers=1,
    )
    assert told(root) == set()


def test_labels_without_boxes(tmp_path: Path) -> None:
    root = tiny.write_tiny_release(tmp_path, lines_of=lambda _agent, _frame: ["0.0 0.0"])
    assert told(root, deep=True) >= {"own-row-missing"}


@pytest.mark.parametrize(("word", "code"), [("1e7", "odd-position"), ("1e300", "label-unreadable")])
def test_absurd_numbers_are_findings_and_end_nothing(release: Path, word: str, code: str) -> None:
    rewrite(
        [next(release.glob(LABELS))], lambda _, rows: [[rows[0][0], word, *rows[0][2:]], *rows[1:]]
    )
    assert code in told(release)


def test_one_agent_alone_that_tracks_nobody(own_release: Path) -> None:
    """It is told where two vehicles or more were seen from within 15 m."""

    def near(row: list[str]) -> bool:
        return (
            row[0] in ("car", "truck", "van")
            and row[10] != "-100"
            and distance(row) < 15
            and seen(row)
        )

    for folder in own_release.glob("*/*/*"):
        if folder.name not in ("meta", "ego_vehicle"):
            shutil.rmtree(folder)
    folders = [*own_release.glob("*/*/ego_vehicle/label/*")]
    texts = {
        str(each): [path.read_text().splitlines()[1:] for path in each.iterdir()]
        for each in folders
    }
    counts = {
        where: sum(near(line.split()) for lines in labels for line in lines)
        for where, labels in texts.items()
    }
    rewrite(own_release.glob("*/" + LABELS), lambda _, rows: untracked(rows, lambda *_: True))
    found = {
        one.where
        for one in validate_release(own_release, workers=1).findings
        if one.code == "ids-untracked"
    }
    assert found == {where for where, count in counts.items() if count >= 2} != set()
