"""Small releases: they are valid, they are small, and their files agree with each other."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import find_release, read_calib, read_image, read_label
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.validation import validate_release

pytestmark = pytest.mark.slow

WITHOUT_SENSORS = SmallRelease(channels=())
"""Only labels, calib and meta."""


def read_contents(root: Path) -> dict[str, bytes]:
    contents = {}
    for path in sorted(root.rglob("*")):
        if path.is_file() and ".deepaccident" not in path.parts:
            contents[path.relative_to(root).as_posix()] = path.read_bytes()
    return contents


@pytest.fixture(scope="session")
def da(deepaccident_release: Path) -> DeepAccident:
    return DeepAccident("v1", deepaccident_release, verbose=False)


def test_nothing_is_wrong_with_it(deepaccident_release: Path) -> None:
    """`validate` counts points and compares the top views, poses and velocities with the boxes."""
    report = validate_release(deepaccident_release, deep=True, workers=1)
    findings = {(finding.severity, finding.code) for finding in report.findings}
    assert findings == {("note", "unlabelled")}


def test_it_lies_in_the_layout_asked_for(
    deepaccident_release: Path, deepaccident_layout: str
) -> None:
    release = find_release(deepaccident_release)
    assert release.layout == deepaccident_layout
    folders = {"A": {""}, "B": {"train", "val", "test"}}[deepaccident_layout]
    assert {scenario.folder for scenario in release.scenarios} == folders


def test_the_splits_are_an_accident_and_its_twin_an_accident_and_an_unlabelled_one(
    da: DeepAccident,
) -> None:
    accident, twin = sorted(da.split_scenarios("train"))
    assert accident.split("/")[1] == twin.split("/")[1]
    assert da.split_scenarios("train_mini") == {accident, twin}
    (val_accident,) = da.split_scenarios("val")
    for token, accident_type in ((accident, 1), (twin, None), (val_accident, 7)):
        assert da.get("scenario", token)["accident_type"] == accident_type
    unlabelled = min(da.split_scenarios("test"))
    first_frame = da.get("scenario", unlabelled)["first_frame_token"]
    assert [sample["labelled"] for sample in da.samples_of(first_frame)] == [False] * 5


def test_the_pair_meets_in_the_last_frame_and_no_sooner_and_not_at_all_in_the_twin(
    da: DeepAccident,
) -> None:
    accident, twin = sorted(da.split_scenarios("train"))
    pair = da.get("scenario", accident)["collision"]["ids"]

    def gap(scenario: str, frame: int) -> float:
        boxes = da.boxes(f"{scenario}/infrastructure/{frame:03d}", frame="world")
        first, second = (boxes.select(boxes.actor_id == actor) for actor in pair)
        return float(first.distance_bev(second)[0, 0])

    assert gap(accident, 1) > gap(accident, 2) > gap(accident, 3) == 0
    assert min(gap(twin, frame) for frame in (1, 2, 3)) > 5


def test_the_pictures_show_the_boxes(make_deepaccident_release) -> None:
    """A near car is red in the middle of its box; the background is grey."""
    options = SmallRelease(frames=1, splits=("train",), image_size=(160, 90), channels=CAMERAS)
    da = DeepAccident("v1", make_deepaccident_release(options), verbose=False)
    sample = da.get_sample(min(da.split_scenarios("train")), "ego_vehicle_behind", 1)
    image = da.load_image(sample, "Camera_Front").astype(int)
    _, boxes, intrinsic = da.get_sample_data(sample, "Camera_Front")
    (ego,) = [box for box in boxes if box.actor_id == 1223]
    u, v = np.rint((intrinsic @ ego.center)[:2] / ego.center[2]).astype(int)
    assert np.ptp(image[-3, 5]) < 30
    assert image[v, u, 0] - image[v, u, 2] > 100


def test_the_same_options_give_the_same_values_and_another_seed_others(tmp_path: Path) -> None:
    options = {"frames": 1, "splits": ("val",), "channels": ("lidar01", BEV_CAMERA)}

    def write_and_read(name: str, seed: int) -> dict[str, bytes]:
        root = write_small_release(tmp_path / name, SmallRelease(seed=seed, **options))
        return read_contents(root)

    first = write_and_read("first", seed=4)
    assert write_and_read("again", seed=4) == first
    other = write_and_read("other", seed=5)
    assert first.keys() == other.keys()
    for name, content in first.items():
        if "/calib/" in name or "/meta/" in name:
            assert content != other[name], name


def test_options_choose_what_is_written(tmp_path: Path) -> None:
    agents = ("ego_vehicle", "infrastructure")
    options = SmallRelease(layout="B", frames=2, splits=("val",), agents=agents, channels=())
    root = write_small_release(tmp_path / "release", options)
    (scenario,) = find_release(root).scenarios
    assert scenario.agents == agents
    assert (root / "train.txt").read_bytes() == b""
    folders = {name.split("/")[3] for name in read_contents(root) if name.count("/") > 3}
    assert folders == {"label", "calib"}
    calib = read_calib(scenario.calib_path("infrastructure", 2))
    assert calib.ego_from_lidar.matrix.tolist() == np.eye(4).tolist()
    ego_labels, infrastructure_labels = (
        read_label(scenario.label_path(agent, 2)) for agent in agents
    )
    assert len(ego_labels) == len(infrastructure_labels)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"layout": "C"}, "layout: expected one of A, B, found 'C'"),
        (
            {"splits": ("train", "train_mini")},
            "splits: expected one of train, val, test, found 'train_mini'",
        ),
        ({"splits": ()}, "splits: expected some of train, val, test, found none"),
        ({"agents": ()}, "agents: expected some of .*, found none"),
        ({"agents": ("ego",)}, f"agents: expected one of {AGENTS[0]}.*found 'ego'"),
        ({"channels": ("Camera_Side",)}, "channels: expected one of .*found 'Camera_Side'"),
        ({"frames": 0}, "frames: expected 1 to 100, found 0"),
        ({"seed": -1}, "seed: expected a whole number from 0, found -1"),
        ({"channels": 1}, "channels: expected some of .*, found 1"),
        ({"image_size": 32}, "image_size: expected a tuple or a list, found 32"),
        ({"image_size": (32,)}, r"image_size: expected \(width, height\), found \(32,\)"),
        (
            {"image_size": (8, 9)},
            r"image_size: expected width and height from \(16, 9\) to \(1600, 900\)",
        ),
    ],
)
def test_options_that_cannot_be_carried_out(options, sentence) -> None:
    assert_raises((lambda: SmallRelease(**options), ConfigError, sentence))


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    message = ("exists and is not an empty folder; choose another folder",)
    assert_raises((lambda: write_small_release(tmp_path, WITHOUT_SENSORS), ConfigError, message))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_it_needs_neither_the_generator_nor_what_tests_need(tmp_path: Path) -> None:
    """It works where only the core is installed, without embreex, hypothesis and pytest."""
    absent = ["embreex", "hypothesis", "pytest", "deepaccident_devkit.plugins.synth"]
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({absent}));"
        "from pathlib import Path; from deepaccident_devkit.testing import "
        "SmallRelease, broken_release;"
        f"broken_release(Path({str(tmp_path / 'release')!r}), 'image-cut', "
        f"SmallRelease(frames=1, splits=('val',)))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    (path,) = (tmp_path / "release").glob("*/ego_vehicle/Camera_Front/*/*.jpg")
    assert_raises((lambda: read_image(path), ValueError, "not a readable image"))
