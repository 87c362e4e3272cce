from pathlib import Path

import pytest
from support.expected_errors import assert_raises

from deepaccident_devkit.errors import DatarootError, VersionError
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.layout import find_ignored_paths, frame_numbers
from deepaccident_devkit.release.store import open_dataroot

ACCIDENT = "type1_subtype1_accident"
NORMAL = "type1_subtype2_normal"
NAME = "Town03_type001_subtype0001_scenario00024"
OTHER = "Town10HD_type001_subtype0001_scenario00014"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Make a dataroot with a blank in its path."""
    path = tmp_path / "deep accident"
    path.mkdir()
    return path


def make_scenario(
    folder: Path, scenario_type: str = ACCIDENT, name: str = NAME, agents=("ego_vehicle",)
) -> None:
    for agent in agents:
        (folder / scenario_type / agent / "calib" / name).mkdir(parents=True)


def find_scenarios(root: Path, version: str = "v1") -> list[tuple[str, str]]:
    """Find the scenarios' folders and tokens."""
    release = find_release(root, version)
    return [(scenario.folder, scenario.token) for scenario in release.scenarios]


@pytest.mark.parametrize(
    ("layout", "scenarios"),
    [
        ("A", [("", ACCIDENT, NAME), ("", ACCIDENT, OTHER), ("", NORMAL, NAME)]),
        ("B", [("train", ACCIDENT, NAME), ("val", ACCIDENT, NAME), ("test", NORMAL, NAME)]),
        ("A+B", [("val", ACCIDENT, NAME), ("", ACCIDENT, OTHER)]),
    ],
)
def test_layouts_in_the_order_of_tokens(
    root: Path, layout: str, scenarios: list[tuple[str, str, str]]
) -> None:
    """A scenario may be in two splits."""
    for folder, scenario_type, name in reversed(scenarios):
        make_scenario(root / folder, scenario_type, name)

    release = find_release(root)

    assert release.layout == layout
    assert release.version == "v1"
    assert release.root == root
    expected = [(folder, f"{scenario_type}/{name}") for folder, scenario_type, name in scenarios]
    assert find_scenarios(root) == expected


def test_mini_is_apart_unless_nothing_else_is_in_the_root(root: Path) -> None:
    make_scenario(root / "DeepAccident_mini")
    mini = [("DeepAccident_mini", f"{ACCIDENT}/{NAME}")]
    assert find_scenarios(root) == mini
    assert find_scenarios(root, "v1-mini") == mini

    make_scenario(root / "train", name=OTHER)
    assert find_scenarios(root) == [("train", f"{ACCIDENT}/{OTHER}")]
    assert find_scenarios(root, "v1-mini") == mini

    inside = root / "DeepAccident_mini"
    assert find_scenarios(inside) == [("", f"{ACCIDENT}/{NAME}")]
    assert find_scenarios(inside, "v1-mini") == [("", f"{ACCIDENT}/{NAME}")]


@pytest.mark.parametrize("version", ["v1", "v1-mini"])
def test_places_without_a_release_are_refused(root: Path, version: str) -> None:
    gone = root / "gone"
    file = root / "file.txt"
    file.write_text("")
    assert_raises(
        (
            lambda: find_release(gone, version),
            DatarootError,
            (f"{gone}: does not exist", "pass the folder"),
        ),
        (
            lambda: find_release(file, version),
            DatarootError,
            (f"{file}: is a file", "pass the folder"),
        ),
        (
            lambda: find_release(root, version),
            DatarootError,
            (f"{root}: no scenario found", "deepaccident synth OUT"),
        ),
    )
    # the shell of a release: sensors and labels, but no calib; files where folders are expected
    (root / ACCIDENT / "ego_vehicle" / "label" / NAME).mkdir(parents=True)
    for name in (f"{ACCIDENT}/other_vehicle", NORMAL, "train"):
        (root / name).write_text("")
    assert_raises(
        (
            lambda: find_release(root, version),
            DatarootError if version == "v1" else VersionError,
            f"^{root}: ",
        )
    )

    make_scenario(root)
    type_folder = root / ACCIDENT
    assert_raises(
        (
            lambda: find_release(type_folder),
            DatarootError,
            f"{type_folder}: no scenario found; .* type: give {root}; expected",
        ),
        (
            lambda: find_release(root, "v2"),
            VersionError,
            "unknown version 'v2'; expected v1, v1-mini",
        ),
        (
            lambda: find_release(root, "v1-mini"),
            VersionError,
            (f"{root}: contains no mini release", "version='v1'"),
        ),
    )


def test_agents_with_a_calib_folder_come_in_the_usual_order(root: Path) -> None:
    make_scenario(root, agents=("infrastructure", "other_vehicle", "ego_vehicle", "bystander"))
    (root / ACCIDENT / "ego_vehicle_behind" / "label" / NAME).mkdir(parents=True)
    (scenario,) = find_release(root).scenarios

    assert scenario.agents == ("ego_vehicle", "other_vehicle", "infrastructure")


def test_other_files_and_folders_are_ignored(root: Path) -> None:
    make_scenario(root)
    for folder in (
        "type1_subtype1_accident_old",
        "my_notes",
        f"trainval/{ACCIDENT}",
        f".deepaccident/{ACCIDENT}",
    ):
        make_scenario(root, folder)
    calib = root / ACCIDENT / "ego_vehicle" / "calib"
    (calib / ".cache").mkdir()
    (calib / "readme.txt").write_text("")
    assert find_scenarios(root) == [("", f"{ACCIDENT}/{NAME}")]

    make_scenario(root, "type2_subtype1_accident")  # the reference code knows it
    assert find_scenarios(root)[1:] == [("", f"type2_subtype1_accident/{NAME}")]


def test_split_files_in_the_root_win_over_those_in_their_folder(root: Path) -> None:
    make_scenario(root)
    folder = root / "split_txt_files"
    folder.mkdir()
    (root / "val.txt").write_text("")
    (root / "notes.txt").write_text("")
    (root / "test.txt").mkdir()
    for name in ("train", "val", "val_mini"):
        (folder / f"{name}.txt").write_text("")
    assert find_release(root).split_files == {
        "train": folder / "train.txt",
        "val": root / "val.txt",
        "val_mini": folder / "val_mini.txt",
    }


def test_frame_numbers_ascend_and_odd_names_are_reported(tmp_path: Path) -> None:
    folder = tmp_path / NAME
    folder.mkdir()
    odd = [
        f"{OTHER}_004.txt",
        f"{NAME}_05.txt",
        f"{NAME}_0007.txt",
        f"{NAME}_٠٠٩.txt",
        f"{NAME}_abc.txt",
        "notes.txt",
        f"{NAME}_006.old.txt",
        f"{NAME}007.txt",
    ]
    good = [f"{NAME}_010.txt", f"{NAME}_002.txt", f"{NAME}_100.txt"]
    ignored = [f"{NAME}_003.txt~", f"{NAME}_009.pkl", f".{NAME}_011.txt", "README"]
    for name in [*odd, *good, *ignored]:
        (folder / name).write_text("")
    assert frame_numbers(folder, "txt") == ([2, 10, 100], sorted(odd))
    assert frame_numbers(folder, "pkl") == ([9], [])
    assert frame_numbers(tmp_path / "gone", "txt") == ([], [])


def test_links_that_lead_to_themselves_or_back_hold_nothing(root: Path) -> None:
    make_scenario(root)
    accident = root / ACCIDENT
    ego = accident / "ego_vehicle"
    label = ego / "label"
    loops = [
        root / "notes",
        root / "train.txt",
        root / "train",
        root / "type2_subtype1_accident",
        accident / "infrastructure",
        label,
    ]
    for path in loops:
        path.symlink_to(path.name)
    links_back = {
        root / "val": root,
        root / "type1_subtype2_accident": root,
        accident / "other_vehicle": accident,
    }
    for path, target in links_back.items():
        path.symlink_to(target)

    assert find_scenarios(root) == [("", f"{ACCIDENT}/{NAME}")]
    assert find_release(root).split_files == {"train": root / "train.txt"}
    with pytest.raises(DatarootError, match=r"label: cannot be listed"):  # for each scenario
        frame_numbers(label, "txt")
    assert dict(find_ignored_paths(root)) == dict.fromkeys([*loops, *links_back])


@pytest.mark.parametrize("name", ["root", "root.zip"])
def test_a_dataroot_that_links_to_itself(root: Path, name: str) -> None:
    link = root / name
    link.symlink_to(name)
    assert_raises(
        (
            lambda: find_release(open_dataroot(link)),
            DatarootError,
            rf"{link}: is a broken link; pass the folder",
        ),
        (
            lambda: find_release(open_dataroot(root)),
            DatarootError,
            rf"{root}: no scenario found; {link} is a broken link",
        ),
    )


COPIES = (
    "{}-001",
    "{} (1)",
    "{} 2",
    "{}-20240101T000000Z-001",
    "{} - Copy",
    "Copy of {}",
    "{}_old",
    "{}.1",
)


@pytest.mark.parametrize("copy", COPIES)
def test_folders_that_look_like_those_of_a_release_are_named(root: Path, copy: str) -> None:
    agent = root / ACCIDENT / "ego_vehicle_behind"
    expected = {
        root / copy.format(NORMAL): NORMAL,
        root / "val" / copy.format(NORMAL): NORMAL,
        agent.with_name(copy.format(agent.name)): agent.name,
        agent.with_name(copy.format("meta")): "meta",
        agent / copy.format("Camera_FrontLeft"): "Camera_FrontLeft",
        agent / copy.format("calib"): "calib",
    }
    for folder in expected:
        folder.mkdir(parents=True)
    for name in ("train", "DeepAccident_mini"):
        expected[root / copy.format(name)] = name
    make_scenario(root / copy.format("train"))
    make_scenario(root / copy.format("DeepAccident_mini") / "DeepAccident_mini")
    with pytest.raises(
        DatarootError, match=rf"^{root}: no scenario found; {root}.* looks like .*: rename it"
    ):
        find_release(root)

    make_scenario(root, agents=("ego_vehicle_behind", "veh1"))
    (root / copy.format("test")).mkdir()  # holds no scenario
    ignored = dict(find_ignored_paths(root))
    reason = ignored.pop(root / ACCIDENT / "veh1") or ""
    assert reason.startswith("an agent (the agents are ego_vehicle, ego")
    assert ignored == expected
