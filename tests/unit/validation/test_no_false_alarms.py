"""Values that docs/format.md calls normal are no findings; unreadable files end no run."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from support import tiny_release

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.validation import validate_release


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make labels of one accident that are long enough for tracks."""
    root = tmp_path_factory.mktemp("healthy") / "release"
    return make_release(
        root, SynthConfig(scenarios=2, frames=12, seed=11, sensors=False, designed=True), workers=1
    )


@pytest.fixture
def release(healthy: Path, tmp_path: Path) -> Path:
    root = tmp_path / "release"
    shutil.copytree(healthy, root)
    return root


LABEL_PATTERN = "*/*/label/*/*.txt"


def collect_codes(root: Path, *, deep: bool = False) -> set[str]:
    report = validate_release(root, deep=deep, workers=1)
    return {finding.code for finding in report.findings if finding.severity != "note"}


LabelRows = list[list[str]]


def rewrite_labels(paths: Iterable[Path], change: Callable[[int, LabelRows], LabelRows]) -> None:
    """Change the rows of numbered label files."""
    for number, path in enumerate(sorted(paths)):
        first_line, *lines = path.read_text().splitlines()
        rows = change(number, [line.split() for line in lines])
        new_lines = [first_line, *(" ".join(row) for row in rows)]
        path.write_text("\n".join(new_lines) + "\n")


def is_visible(row: list[str]) -> bool:
    return bool(int(row[11])) or row[12] == "True" or row[10] == "-100"


def distance_m(row: list[str]) -> float:
    return float(np.hypot(float(row[1]), float(row[2])))


def remove_ids(rows: LabelRows, is_untracked: Callable[[int, list[str]], bool]) -> LabelRows:
    """Write −1 instead of the ids of some actors, never of the agent itself."""
    new_rows = []
    for index, row in enumerate(rows):
        if row[10] != "-100" and is_untracked(index, row):
            new_rows.append([*row[:10], "-1", *row[11:]])
        else:
            new_rows.append(row)
    return new_rows


@pytest.mark.parametrize(
    "change",
    [
        lambda _, rows: [
            [row[0], *(f"{float(word):.3f}" for word in row[1:10]), *row[10:]] for row in rows
        ],
        lambda _, rows: [row for row in rows if is_visible(row)],
        lambda _, rows: [row for row in rows if distance_m(row) < 33],
        lambda number, rows: remove_ids(
            rows, lambda index, row: (number + index) % 5 == 0 and abs(float(row[1])) > 15
        ),
        lambda _, rows: remove_ids(rows, lambda _, row: distance_m(row) >= 20),
    ],
    ids=[
        "three decimals",
        "only visible actors",
        "a small radius",
        "tracking that comes and goes",
        "far ones untracked",
    ],
)
def test_normal_variations_of_labels_are_no_findings(
    release: Path, change: Callable[[int, LabelRows], LabelRows]
) -> None:
    """An id of −1 is normal where it begins at a distance, even if other actors are nearer
    (docs/format.md, Label).
    """
    rewrite_labels(release.glob(LABEL_PATTERN), change)
    assert collect_codes(release) == set()


def test_actors_hidden_from_one_agent_must_be_in_the_labels_of_the_others(release: Path) -> None:
    """All labels of a scenario are written by one rule."""
    labels = [path for path in release.glob(LABEL_PATTERN) if "infrastructure" not in path.parts]
    rewrite_labels(labels, lambda _, rows: [row for row in rows if is_visible(row)])
    assert {"actor-missing"} <= collect_codes(release) <= {"actor-missing", "track-gap"}


def test_a_release_of_only_one_agent_has_no_findings(release: Path) -> None:
    for folder in release.glob("*/*"):
        if folder.name not in ("meta", "infrastructure"):
            shutil.rmtree(folder)
    assert collect_codes(release) == set()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_scenarios_have_no_findings(tmp_path: Path, frames: int) -> None:
    config = SynthConfig(scenarios=1, frames=frames, seed=3, sensors=False)
    assert collect_codes(make_release(tmp_path / "release", config, workers=1)) == set()


def test_labels_without_boxes(tmp_path: Path) -> None:
    root = tiny_release.write_tiny_release(tmp_path, lines_of=lambda _agent, _frame: ["0.0 0.0"])
    assert collect_codes(root, deep=True) >= {"own-row-missing"}


@pytest.mark.parametrize(("word", "code"), [("1e7", "odd-position"), ("1e300", "label-unreadable")])
def test_absurd_numbers_are_findings_and_end_no_run(release: Path, word: str, code: str) -> None:
    def change_first_x(_: int, rows: LabelRows) -> LabelRows:
        rows[0][1] = word
        return rows

    rewrite_labels([next(release.glob(LABEL_PATTERN))], change_first_x)
    assert code in collect_codes(release)


def test_an_only_agent_that_tracks_nobody_is_a_finding(own_release: Path) -> None:
    """The finding needs two or more vehicles seen from within 15 m."""

    def is_near_vehicle(row: list[str]) -> bool:
        is_other_vehicle = row[0] in ("car", "truck", "van") and row[10] != "-100"
        return is_other_vehicle and distance_m(row) < 15 and is_visible(row)

    for folder in own_release.glob("*/*/*"):
        if folder.name not in ("meta", "ego_vehicle"):
            shutil.rmtree(folder)
    expected = set()
    for folder in own_release.glob("*/*/ego_vehicle/label/*"):
        lines = [line for path in folder.iterdir() for line in path.read_text().splitlines()[1:]]
        if sum(is_near_vehicle(line.split()) for line in lines) >= 2:
            expected.add(str(folder))

    labels = own_release.glob("*/" + LABEL_PATTERN)
    rewrite_labels(labels, lambda _, rows: remove_ids(rows, lambda *_: True))
    findings = validate_release(own_release, workers=1).findings
    assert expected
    assert {finding.where for finding in findings if finding.code == "ids-untracked"} == expected
