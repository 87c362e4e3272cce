"""Small releases: nothing is wrong with them, they are small, and their files tell one story."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.release import find_release, read_calib, read_image, read_label
from deepaccident_devkit.taxonomy import AGENTS, BEV_CAMERA, CAMERAS
from deepaccident_devkit.testing import SmallRelease, write_small_release
from deepaccident_devkit.validation import validate_release

pytestmark = pytest.mark.slow

BARE = SmallRelease(channels=())
"""Labels, calib and meta alone."""


def contents(root: Path) -> dict[str, bytes]:
    files = (
        path
        for path in sorted(root.rglob("*"))
        if path.is_file() and ".deepaccident" not in path.parts
    )
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


@pytest.fixture(scope="session")
def opened(deepaccident_release: Path) -> DeepAccident:
    return DeepAccident("v1", deepaccident_release, verbose=False)


def test_nothing_is_wrong_with_it(deepaccident_release: Path) -> None:
    """Points are counted, top views show the boxes, poses and velocities agree: `validate` would
    say if not.
    """
    report = validate_release(deepaccident_release, deep=True, workers=1)
    assert {(finding.severity, finding.code) for finding in report.findings} == {
        ("note", "unlabelled")
    }


def test_it_lies_in_the_layout_asked_for(
    deepaccident_release: Path, deepaccident_layout: str
) -> None:
    layout = find_release(deepaccident_release)
    folders = {"A": {""}, "B": {"train", "val", "test"}}[deepaccident_layout]
    assert (layout.layout, {scenario.folder for scenario in layout.scenarios}) == (
        deepaccident_layout,
        folders,
    )


def test_the_splits_are_an_accident_and_its_twin_an_accident_and_an_unlabelled_one(
    opened: DeepAccident,
) -> None:
    splits = {
        split: sorted(opened.split_scenarios(split))
        for split in ("train", "val", "test", "train_mini")
    }
    accident, twin = splits["train"]
    assert (accident.split("/")[1], splits["train_mini"]) == (twin.split("/")[1], splits["train"])
    types = [
        opened.get("scenario", token)["accident_type"] for token in (accident, twin, *splits["val"])
    ]
    assert types == [1, None, 7]
    first_frame = opened.get("scenario", splits["test"][0])["first_frame_token"]
    assert [sample["labelled"] for sample in opened.samples_of(first_frame)] == [False] * 5


def test_the_pair_meets_in_the_last_frame_and_no_sooner_and_not_at_all_in_the_twin(
    opened: DeepAccident,
) -> None:
    accident, twin = sorted(opened.split_scenarios("train"))
    pair = opened.get("scenario", accident)["collision"]["ids"]

    def gap(scenario: str, frame: int) -> float:
        boxes = opened.boxes(f"{scenario}/infrastructure/{frame:03d}", frame="world")
        first, second = (boxes.select(boxes.actor_id == actor) for actor in pair)
        return float(first.distance_bev(second)[0, 0])

    assert gap(accident, 1) > gap(accident, 2) > gap(accident, 3) == 0
    assert min(gap(twin, frame) for frame in (1, 2, 3)) > 5


def test_the_pictures_show_the_boxes(make_deepaccident_release) -> None:
    """The colour in the middle of a near box is another one than that of the background: a car is
    red.
    """
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
    seeds = enumerate((4, 4, 5))
    first, again, other = (
        contents(write_small_release(tmp_path / str(number), SmallRelease(seed=seed, **options)))
        for number, seed in seeds
    )
    assert (first == again, first.keys()) == (True, other.keys())
    assert [
        name
        for name in first
        if first[name] == other[name] and ("/calib/" in name or "/meta/" in name)
    ] == []


def test_options_choose_what_is_written(tmp_path: Path) -> None:
    agents = ("ego_vehicle", "infrastructure")
    options = SmallRelease(layout="B", frames=2, splits=("val",), agents=agents, channels=())
    root = write_small_release(tmp_path / "release", options)
    (scenario,) = find_release(root).scenarios
    assert (scenario.agents, (root / "train.txt").read_bytes()) == (agents, b"")
    assert {name.split("/")[3] for name in contents(root) if name.count("/") > 3} == {
        "label",
        "calib",
    }
    assert (
        read_calib(scenario.calib_path("infrastructure", 2)).ego_from_lidar.matrix.tolist()
        == np.eye(4).tolist()
    )
    assert len({len(read_label(scenario.label_path(agent, 2))) for agent in agents}) == 1


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
    assert_refused((lambda: SmallRelease(**options), ConfigError, sentence))


def test_a_folder_that_holds_something_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    told = ("exists and is not an empty folder; choose another folder",)
    assert_refused((lambda: write_small_release(tmp_path, BARE), ConfigError, told))
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_it_needs_neither_the_generator_nor_what_tests_need(tmp_path: Path) -> None:
    """As where only the core is installed: no embreex, hypothesis, pytest."""
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
    assert_refused((lambda: read_image(path), ValueError, "not a readable image"))
