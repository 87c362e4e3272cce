from pathlib import Path

import pytest
from refusals import assert_refused

from deepaccident_devkit.errors import DatarootError, VersionError
from deepaccident_devkit.release import find_release
from deepaccident_devkit.release.layout import frame_numbers, left_aside
from deepaccident_devkit.release.store import open_dataroot

ACCIDENT, NORMAL = "type1_subtype1_accident", "type1_subtype2_normal"
NAME, OTHER = (
    "Town03_type001_subtype0001_scenario00024",
    "Town10HD_type001_subtype0001_scenario00014",
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A dataroot with a blank in its path."""
    path = tmp_path / "deep accident"
    path.mkdir()
    return path


def scenario(
    folder: Path, scenario_type: str = ACCIDENT, name: str = NAME, agents=("ego_vehicle",)
) -> None:
    for agent in agents:
        (folder / scenario_type / agent / "calib" / name).mkdir(parents=True)


def found(root: Path, version: str = "v1") -> list[tuple[str, str]]:
    return [(each.folder, each.token) for each in find_release(root, version).scenarios]


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
    """A scenario may stand in two splits."""
    for folder, kind, name in reversed(scenarios):
        scenario(root / folder, kind, name)
    release = find_release(root)
    assert (release.layout, release.version, release.root) == (layout, "v1", root)
    assert found(root) == [(folder, f"{kind}/{name}") for folder, kind, name in scenarios]


def test_mini_is_apart_unless_it_is_all_there_is(root: Path) -> None:
    scenario(root / "DeepAccident_mini")
    mini = [("DeepAccident_mini", f"{ACCIDENT}/{NAME}")]
    assert found(root) == found(root, "v1-mini") == mini
    scenario(root / "train", name=OTHER)
    assert (found(root), found(root, "v1-mini")) == ([("train", f"{ACCIDENT}/{OTHER}")], mini)
    inside = root / "DeepAccident_mini"
    assert found(inside) == found(inside, "v1-mini") == [("", f"{ACCIDENT}/{NAME}")]


@pytest.mark.parametrize("version", ["v1", "v1-mini"])
def test_no_release_there(root: Path, version: str) -> None:
    file, gone = root / "file.txt", root / "gone"
    file.write_text("")
    assert_refused(
        (
            lambda: find_release(gone, version),
            DatarootError,
            (f"{gone}: does not exist", "give the folder"),
        ),
        (
            lambda: find_release(file, version),
            DatarootError,
            (f"{file}: is a file", "give the folder"),
        ),
        (
            lambda: find_release(root, version),
            DatarootError,
            (f"{root}: no scenario found", "deepaccident synth OUT"),
        ),
    )
    # the shell of one: sensors and labels, but no calib; files where folders are expected
    (root / ACCIDENT / "ego_vehicle" / "label" / NAME).mkdir(parents=True)
    for name in (f"{ACCIDENT}/other_vehicle", NORMAL, "train"):
        (root / name).write_text("")
    assert_refused(
        (
            lambda: find_release(root, version),
            DatarootError if version == "v1" else VersionError,
            f"^{root}: ",
        )
    )
    scenario(root)
    of_type = root / ACCIDENT
    assert_refused(
        (
            lambda: find_release(of_type),
            DatarootError,
            f"{of_type}: no scenario found; .* type: give {root}; expected",
        ),
        (
            lambda: find_release(root, "v2"),
            VersionError,
            "unknown version 'v2'; known are v1, v1-mini",
        ),
        (
            lambda: find_release(root, "v1-mini"),
            VersionError,
            (f"{root}: holds no mini release", "version='v1'"),
        ),
    )


def test_agents_are_those_with_a_calib_folder_in_the_usual_order(root: Path) -> None:
    scenario(root, agents=("infrastructure", "other_vehicle", "ego_vehicle", "bystander"))
    (root / ACCIDENT / "ego_vehicle_behind" / "label" / NAME).mkdir(parents=True)
    assert find_release(root).scenarios[0].agents == (
        "ego_vehicle",
        "other_vehicle",
        "infrastructure",
    )


def test_what_else_lies_about_is_ignored(root: Path) -> None:
    scenario(root)
    for kind in (
        "type1_subtype1_accident_old",
        "my_notes",
        f"trainval/{ACCIDENT}",
        f".deepaccident/{ACCIDENT}",
    ):
        scenario(root, kind)
    (root / ACCIDENT / "ego_vehicle" / "calib" / ".cache").mkdir()
    (root / ACCIDENT / "ego_vehicle" / "calib" / "readme.txt").write_text("")
    assert found(root) == [("", f"{ACCIDENT}/{NAME}")]
    scenario(root, "type2_subtype1_accident")  # the reference code knows it
    assert found(root)[1:] == [("", f"type2_subtype1_accident/{NAME}")]


def test_split_files_in_the_root_win_over_those_in_their_folder(root: Path) -> None:
    scenario(root)
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


def test_frame_numbers_ascend_and_odd_names_are_told(tmp_path: Path) -> None:
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
    for name in [*odd, *good, f"{NAME}_003.txt~", f"{NAME}_009.pkl", f".{NAME}_011.txt", "README"]:
        (folder / name).write_text("")
    assert frame_numbers(folder, "txt") == ([2, 10, 100], sorted(odd))
    assert frame_numbers(folder, "pkl") == ([9], [])
    assert frame_numbers(tmp_path / "gone", "txt") == ([], [])


def test_links_that_lead_to_themselves_or_back_hold_nothing(root: Path) -> None:
    scenario(root)
    ego = root / ACCIDENT / "ego_vehicle"
    loops = [root / name for name in ("notes", "train.txt", "train", "type2_subtype1_accident")]
    loops += [root / ACCIDENT / "infrastructure", ego / "label"]
    for path in loops:
        path.symlink_to(path.name)
    back = {
        root / "val": root,
        root / "type1_subtype2_accident": root,
        root / ACCIDENT / "other_vehicle": ego.parent,
    }
    for path, end in back.items():
        path.symlink_to(end)
    assert found(root) == [("", f"{ACCIDENT}/{NAME}")]
    assert find_release(root).split_files == {"train": root / "train.txt"}
    with pytest.raises(DatarootError, match=r"label: cannot be listed"):  # told for each scenario
        frame_numbers(loops[-1], "txt")
    assert dict(left_aside(root)) == dict.fromkeys([*loops, *back])


@pytest.mark.parametrize("name", ["root", "root.zip"])
def test_a_dataroot_that_links_to_itself(root: Path, name: str) -> None:
    link = root / name
    link.symlink_to(name)
    assert_refused(
        (
            lambda: find_release(open_dataroot(link)),
            DatarootError,
            rf"{link}: is a link that leads nowhere; give the folder",
        ),
        (
            lambda: find_release(open_dataroot(root)),
            DatarootError,
            rf"{root}: no scenario found; {link} is a link",
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
    kinds = root / ACCIDENT / "ego_vehicle_behind"
    expected = {
        root / copy.format(NORMAL): NORMAL,
        root / "val" / copy.format(NORMAL): NORMAL,
        kinds.with_name(copy.format(kinds.name)): kinds.name,
        kinds.with_name(copy.format("meta")): "meta",
        kinds / copy.format("Camera_FrontLeft"): "Camera_FrontLeft",
        kinds / copy.format("calib"): "calib",
    }
    for folder in expected:
        folder.mkdir(parents=True)
    scenario(root / copy.format("train"))
    scenario(root / copy.format("DeepAccident_mini") / "DeepAccident_mini")
    expected |= {root / copy.format(name): name for name in ("train", "DeepAccident_mini")}
    with pytest.raises(
        DatarootError, match=rf"^{root}: no scenario found; {root}.* looks like .*: rename it"
    ):
        find_release(root)
    scenario(root, agents=("ego_vehicle_behind", "veh1"))
    (root / copy.format("test")).mkdir()  # holds no scenario
    aside = dict(left_aside(root))
    assert (aside.pop(root / ACCIDENT / "veh1") or "").startswith(
        "an agent, of which the release has ego_vehicle, ego"
    )
    assert aside == expected
