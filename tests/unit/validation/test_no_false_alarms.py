"""What docs/format.md calls normal is no finding, and what cannot be read ends no run."""

import shutil
from pathlib import Path

import pytest
import tiny

from deepaccident_devkit.synth import SynthConfig, make_release
from deepaccident_devkit.validation import validate_release


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Labels of one accident, long enough for tracks."""
    root = tmp_path_factory.mktemp("healthy") / "release"
    return make_release(root, SynthConfig(scenarios=2, frames=12, seed=11, sensors=False))


@pytest.fixture
def release(healthy: Path, tmp_path: Path) -> Path:
    root = tmp_path / "release"
    shutil.copytree(healthy, root)
    return root


def told(root: Path, *, deep: bool = False) -> set[str]:
    report = validate_release(root, deep=deep, workers=1)
    return {finding.code for finding in report.findings if finding.severity != "note"}


def rows_of(path: Path) -> tuple[str, list[list[str]]]:
    first, *lines = path.read_text().splitlines()
    return first, [line.split() for line in lines]


def write(path: Path, first: str, rows: list[list[str]]) -> None:
    path.write_text("\n".join([first, *(" ".join(row) for row in rows)]) + "\n")


def labels(root: Path) -> list[Path]:
    return sorted(root.glob("*/*/label/*/*.txt"))


@pytest.mark.slow
def test_numbers_with_three_decimals(release: Path) -> None:
    for path in labels(release):
        first, rows = rows_of(path)
        write(path, first, [[row[0], *(f"{float(word):.3f}" for word in row[1:10]), *row[10:]] for row in rows])
    assert told(release) == set()


def test_labels_of_visible_actors_alone(release: Path) -> None:
    for path in labels(release):
        first, rows = rows_of(path)
        write(path, first, [row for row in rows if int(row[11]) or row[12] == "True" or row[10] == "-100"])
    assert told(release) == set()


def test_labels_of_a_small_radius(release: Path) -> None:
    for path in labels(release):
        first, rows = rows_of(path)
        write(path, first, [row for row in rows if float(row[1]) ** 2 + float(row[2]) ** 2 < 33**2])
    assert told(release) == set()


def test_hidden_actors_in_one_agents_labels_tell_of_those_missing_in_anothers(release: Path) -> None:
    """All labels of a scenario are written by one rule."""
    for path in labels(release):
        first, rows = rows_of(path)
        if "infrastructure" not in path.parts:
            write(path, first, [row for row in rows if int(row[11]) or row[12] == "True" or row[10] == "-100"])
    assert told(release) <= {"actor-missing", "track-gap"}
    assert "actor-missing" in told(release)


def test_tracking_that_comes_and_goes(release: Path) -> None:
    for number, path in enumerate(labels(release)):
        first, rows = rows_of(path)
        for place, row in enumerate(rows):
            if row[10] != "-100" and (number + place) % 5 == 0 and abs(float(row[1])) > 15:
                row[10] = "-1"
        write(path, first, rows)
    assert told(release) == set()


def test_a_scenario_without_meta_lacks_its_meta_alone(release: Path) -> None:
    shutil.rmtree(next(release.glob("*_accident/meta")))
    assert told(release) == {"meta-missing"}


def test_one_agent_alone(release: Path) -> None:
    for folder in release.glob("*/*"):
        if folder.name not in ("meta", "infrastructure"):
            shutil.rmtree(folder)
    assert told(release) == set()


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_short_scenarios(tmp_path: Path, frames: int) -> None:
    root = make_release(tmp_path / "release", SynthConfig(scenarios=1, frames=frames, seed=2, sensors=False))
    assert told(root) == set()


def test_labels_without_boxes(tmp_path: Path) -> None:
    root = tiny.write_tiny_release(tmp_path, lines_of=lambda _agent, _frame: ["0.0 0.0"])
    assert told(root, deep=True) >= {"own-row-missing"}


def test_unlabelled_scenarios(tmp_path: Path) -> None:
    root = tiny.write_tiny_release(tmp_path, labelled=False, meta=None)
    assert told(root, deep=True) == set()


def test_absurd_numbers_are_findings_and_end_nothing(release: Path) -> None:
    path = labels(release)[0]
    first, rows = rows_of(path)
    for word, code in (("1e7", "odd-position"), ("1e300", "label-unreadable")):
        rows[3][1] = word
        write(path, first, rows)
        assert code in told(release)


def test_a_folder_in_an_images_place_ends_nothing(release_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "release"
    of_type = next(release_root.glob("*_accident"))
    for kind in ("calib", "label", "Camera_Front", "lidar01"):
        shutil.copytree(of_type / "ego_vehicle" / kind, root / of_type.name / "ego_vehicle" / kind)
    (image,) = root.glob("*/*/Camera_Front/*/*_002.jpg")
    image.unlink()
    image.mkdir()
    (cloud,) = root.glob("*/*/lidar01/*/*_003.npz")
    cloud.unlink()
    cloud.symlink_to("nowhere")
    report = validate_release(root, deep=True, workers=1)
    assert any(
        finding.code == "sensor-unreadable" and finding.where.startswith(str(image)) for finding in report.findings
    )
    assert any(str(cloud) in finding.where for finding in report.findings)


def test_some_scenarios_alone_say_nothing_of_the_whole(release: Path) -> None:
    token = "/".join((release / "train.txt").read_text().split()[:2])
    report = validate_release(release, scenarios=[token])
    assert {each.scenario for each in report.findings} <= {token}


def test_split_files_against_folders(own_release: Path) -> None:
    line = (own_release / "train.txt").read_text().splitlines()[0]
    for split, keep in (("train", False), ("val", True)):
        path = own_release / f"{split}.txt"
        lines = [other for other in path.read_text().splitlines() if other != line] + [line] * keep
        path.write_text("\n".join(lines) + "\n")
    assert told(own_release) == {"splits-contradict"}
