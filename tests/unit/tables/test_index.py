"""Making, finding, refreshing, refusing and clearing indexes."""

import errno
import json
import logging
import os
import pickle
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from click.testing import CliRunner
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release_index import (
    INDEX_FOLDER,
    OTHER_SCENARIO,
    THIRD_SCENARIO,
    folder_contents,
    label_path,
    open_release,
    remove_last_box,
)

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import (
    BrokenReleaseError,
    ChoiceError,
    DatarootError,
    IndexStoreError,
    NotAvailableError,
)
from deepaccident_devkit.tables import clear_index, indexing
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.tables.index import MANIFEST_FILE, SCHEMA_VERSION
from deepaccident_devkit.validation import validate_release


def calib_path(root: Path, agent: str = "ego_vehicle", frame: int = 2) -> Path:
    return (
        root
        / tiny_release.SCENARIO_TYPE
        / agent
        / "calib"
        / tiny_release.SCENARIO_NAME
        / f"{tiny_release.SCENARIO_NAME}_{frame:03d}.pkl"
    )


def write_calib(path: Path, **changes: object) -> None:
    """Write a calib file with changed entries; an entry that is None is left out."""
    entries = tiny_release.make_calib(tiny_release.pose(), height=0) | changes
    known_entries = {key: value for key, value in entries.items() if value is not None}
    path.write_bytes(tiny_release.old_pickle(known_entries))


def edit_text(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def remove_infrastructure_frame(root: Path) -> None:
    label_path(root, "infrastructure", 3).unlink()
    calib_path(root, "infrastructure", 3).unlink()


def copy_a_label(root: Path) -> None:
    label = label_path(root)
    shutil.copy(label, label.with_name("copy of a label.txt"))


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated label": (
        lambda root: label_path(root).write_text("0 0\ncar 1 2 3"),
        r"_002\.txt:2: expected 13 fields, found 4: 'car 1 2 3'; restore",
    ),
    "12 fields": (
        lambda root: edit_text(label_path(root), " 12 True", " True"),
        r"_002\.txt:3: expected 13 fields, found 12",
    ),
    "NaN": (
        lambda root: edit_text(label_path(root), "30.0 -1.5", "nan -1.5"),
        r"_002\.txt:4: x is 'nan', expected a finite",
    ),
    "calib without a key": (
        lambda root: write_calib(calib_path(root), intrinsic_Camera_Back=None),
        r"_002\.pkl: lacks intrinsic_Camera_Back; restore",
    ),
    "calib of a wrong shape": (
        lambda root: write_calib(calib_path(root), ego_to_world=np.eye(3)),
        r"_002\.pkl: ego_to_world: expected numbers of shape \(4, 4\), found \(3, 3\)",
    ),
    "calib that is code": (
        lambda root: calib_path(root).write_bytes(pickle.dumps(print)),
        (
            r"_002\.pkl: not a readable calibration \(.*the pickle asks for "
            r"builtins\.print, which is not allowed\)"
        ),
    ),
    "meta with a word missing": (
        lambda root: edit_text(
            root / tiny_release.SCENARIO_TYPE / "meta" / f"{tiny_release.SCENARIO_NAME}.txt",
            "same ",
            "",
        ),
        r"scenario00024\.txt:1: expected 9 words .* found 8",
    ),
    "a frame of an agent missing": (
        remove_infrastructure_frame,
        r"infrastructure/calib/.*: missing frames: 3 \(expected 1 to 4\); unpack its archive again",
    ),
    "last label missing": (
        lambda root: label_path(root, frame=4).unlink(),
        r"ego_vehicle/label/.*: missing frames: 4 \(expected 1 to 4\)",
    ),
    "a file with an odd name": (
        copy_a_label,
        r"copy of a label\.txt: expected a name .*_<NNN>\.txt; rename it",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_scenario_is_named_and_never_hides_the_good_one(
    root: Path, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    damage_release, message = FAULTS[fault]
    damage_release(root)
    assert_raises(
        (lambda: open_release(root), BrokenReleaseError, message),
        (
            lambda: open_release(root),
            BrokenReleaseError,
            ("errors in 1 of 2 scenarios", "--on-error skip"),
        ),
    )
    with caplog.at_level(logging.WARNING):
        release = open_release(root, on_error="skip")
    assert [scenario["name"] for scenario in release.scenario] == [OTHER_SCENARIO]
    assert [problem.scenario for problem in release.problems] == [tiny_release.SCENARIO_TOKEN]
    assert f"excluded {tiny_release.SCENARIO_TOKEN}" in caplog.text
    # an index made with skip does not hide it afterwards
    assert_raises((lambda: open_release(root), BrokenReleaseError, "1 of 2 scenarios"))


def test_all_broken_scenarios_are_listed_at_once(root: Path) -> None:
    label_path(root).write_text("0 0\ncar")
    label_path(root, name=OTHER_SCENARIO).write_text("")
    edit_text(label_path(root, frame=3), "van", "lorry")
    message = (
        "errors in 2 of 2 scenarios",
        f"{OTHER_SCENARIO}_002.txt:1: ",
        "found an empty file",
        f"{tiny_release.SCENARIO_NAME}_003.txt:3: class is 'lorry'",
    )
    assert_raises(
        (lambda: open_release(root), BrokenReleaseError, message),
        (
            lambda: open_release(root, on_error="skip"),
            BrokenReleaseError,
            "2 of 2",
        ),  # nothing is left to open
    )


def test_the_same_scenario_in_two_split_files_or_folders(own_release: Path) -> None:
    first_line = (own_release / "train.txt").read_text().splitlines()[0]
    with (own_release / "val.txt").open("a") as file:
        file.write(f"{first_line}  \r\n\n")
    assert_raises(
        (
            lambda: open_release(own_release),
            BrokenReleaseError,
            ("in two splits", "train.txt and ", "val.txt; rem"),
        )
    )
    assert len(open_release(own_release, on_error="skip").scenario) == 5
    shutil.copytree(own_release / "train", own_release / "val", dirs_exist_ok=True)
    assert_raises(
        (
            lambda: open_release(own_release),
            BrokenReleaseError,
            ("in two folders", "train and ", "val; remove one"),
        )
    )


def test_splits_come_from_files_else_folders_else_are_unknown(own_release: Path) -> None:
    release_with_files = open_release(own_release)
    train = release_with_files.split_scenarios("train")
    lines = (own_release / "train.txt").read_text().splitlines()
    assert train == {"/".join(line.split()) for line in lines}
    assert release_with_files.split_scenarios("train_mini") <= train

    for file in own_release.glob("*.txt"):
        file.unlink()
    release_with_folders = open_release(own_release)
    assert release_with_folders.split_scenarios("train") == train
    assert_raises(
        (
            lambda: release_with_folders.split_scenarios("train_mini"),
            NotAvailableError,
            r"has no train_mini\.txt",
        )
    )

    flat_root = own_release.parent / "flat"
    for split in ("train", "val", "test"):
        shutil.copytree(own_release / split, flat_root, dirs_exist_ok=True)
    flat_release = open_release(flat_root)
    assert {scenario["split"] for scenario in flat_release.scenario} == {None}
    remedy = f"deepaccident split {flat_root} --out mine.txt"
    assert_raises(
        (lambda: flat_release.split_scenarios("train"), NotAvailableError, (remedy,)),
        (lambda: flat_release.split_scenarios("unknown"), ChoiceError, (remedy, "train, val")),
    )


def test_split_files_win_over_folders(own_release: Path) -> None:
    train = (own_release / "train.txt").read_text()
    val = (own_release / "val.txt").read_text()
    (own_release / "train.txt").write_text(val)
    (own_release / "val.txt").write_text(train)
    release = open_release(own_release)
    val_scenarios = [scenario for scenario in release.scenario if scenario["split"] == "val"]
    assert {scenario["folder"] for scenario in val_scenarios} == {"train"}


@pytest.mark.parametrize("missing", ["labels", "infrastructure", "meta", "labels of one agent"])
def test_partial_releases_are_indexed_as_what_they_are(tmp_path: Path, missing: str) -> None:
    agents = tiny_release.AGENTS[:4] if missing == "infrastructure" else tiny_release.AGENTS
    meta = None if missing == "meta" else tiny_release.META_TEXT
    root = tiny_release.write_tiny_release(
        tmp_path, agents=agents, labelled=missing != "labels", meta=meta
    )
    if missing == "labels of one agent":
        shutil.rmtree(root / tiny_release.SCENARIO_TYPE / "other_vehicle" / "label")
    release = open_release(root)
    samples = release.samples_of(f"{tiny_release.SCENARIO_TOKEN}/001")
    assert [sample["agent"] for sample in samples] == list(agents)
    agents_without_labels = {"labels": set(agents), "labels of one agent": {"other_vehicle"}}
    for sample in samples:
        labelled = sample["agent"] not in agents_without_labels.get(missing, ())
        assert sample["labelled"] == labelled
        assert (sample["velocity"] is not None) == labelled
        assert (len(release.get_boxes(sample)) > 0) == labelled
        assert (len(release.boxes(sample)) > 0) == labelled
        assert len(release.boxes(sample, "ego", visible="released")) == int(labelled)
    scenario = release.scenario[0]
    if missing == "meta":
        for field in ("weather", "collision", "accident_type"):
            assert scenario[field] is None
        annotation = release.get("annotation", f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/001/0")
        assert annotation["instance_token"] is None
        assert annotation["time_to_impact"] is None
        assert annotation["next"] == f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/002/0"
    if missing == "infrastructure":
        assert_raises(
            (
                lambda: release.get_sample(scenario, "infrastructure", 1),
                KeyError,
                "other_vehicle_behind; ",
            )
        )


@pytest.mark.parametrize("impossible", ["pyarrow.memory_map", "mmap.mmap"])
def test_an_index_is_made_and_read_where_files_cannot_be_mapped(
    root: Path, tmp_path: Path, impossible: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapped = open_release(root, tmp_path / "other")
    for name in {"pyarrow.memory_map", impossible}:
        monkeypatch.setattr(name, Mock(side_effect=OSError(errno.ENODEV, "No such device")))
    unmapped = open_release(root)
    files = folder_contents(unmapped.tables_folder)
    assert files.keys() == folder_contents(mapped.tables_folder).keys()
    for table in ("sample", "annotation"):
        assert list(getattr(unmapped, table)) == list(getattr(mapped, table))


def test_a_refresh_reads_just_what_was_edited_added_or_removed(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Mock(wraps=indexing.read_scenario)
    monkeypatch.setattr(indexing, "read_scenario", read)

    def refresh_index(*arguments: str) -> tuple[int, list[str]]:
        """Return the number of annotations and the names of the scenarios that were read."""
        read.reset_mock()
        assert CliRunner().invoke(deepaccident, [*arguments, str(root)]).exit_code == 0
        names = sorted(call.args[0].name for call in read.call_args_list)

        fresh_folder = root.parent / "fresh"
        shutil.rmtree(fresh_folder, ignore_errors=True)
        count = len(open_release(root, fresh_folder).annotation)
        assert folder_contents(root / INDEX_FOLDER.parent) == folder_contents(fresh_folder)
        return count, names

    count, names = refresh_index("index")
    assert names == [tiny_release.SCENARIO_NAME, OTHER_SCENARIO]
    assert refresh_index("check", "index") == (count, [])

    remove_last_box(root, OTHER_SCENARIO)
    assert refresh_index("check", "index") == (count - 1, [OTHER_SCENARIO])

    tiny_release.write_tiny_release(
        root, scenario_type="type1_subtype2_accident", name=THIRD_SCENARIO
    )
    assert refresh_index("index")[1] == [THIRD_SCENARIO]

    shutil.rmtree(root / "type1_subtype2_accident")
    assert refresh_index("index") == (count - 1, [])


@pytest.mark.slow
def test_workers_and_executors_write_the_same_bytes(release_root_b: Path, tmp_path: Path) -> None:
    release = open_release(release_root_b, tmp_path / "one", workers=1)
    assert len(list(release.tables_folder.iterdir())) == 12
    open_release(release_root_b, tmp_path / "two", workers=2)
    with ThreadPoolExecutor(3) as threads:
        open_release(release_root_b, tmp_path / "threads", executor=threads)
    assert (
        folder_contents(tmp_path / "one")
        == folder_contents(tmp_path / "two")
        == folder_contents(tmp_path / "threads")
    )


def test_a_read_only_dataroot_gets_its_index_in_the_cache(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    is_writable_folder = index_module.is_writable_folder
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(
        index_module,
        "is_writable_folder",
        lambda path: root not in path.parents and is_writable_folder(path),
    )

    assert cache in open_release(root).tables_folder.parents
    assert not (root / ".deepaccident").exists()
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "read_scenario", lambda *_: pytest.fail("made again"))
        assert len(open_release(root).scenario) == 2

    monkeypatch.setattr(index_module, "is_writable_folder", lambda _path: False)
    third_root = tiny_release.write_tiny_release(tmp_path / "third")
    assert_raises(
        (
            lambda: open_release(third_root),
            IndexStoreError,
            ("no place to write the index", "index_dir="),
        )
    )


def test_a_relative_dataroot_survives_chdir_and_a_home_folder_is_found(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root.parent)
    release = open_release(root.name, "index")
    pickled = pickle.dumps(release)
    monkeypatch.chdir("/")
    path = release.get_sample_data_path(f"{tiny_release.SCENARIO_TOKEN}/ego_vehicle/001/lidar01")
    assert path.parent.parent.is_relative_to(root)
    assert len(pickle.loads(pickled).track) == len(release.track) > 0
    monkeypatch.setenv("HOME", str(root.parent))
    assert len(open_release(f"~/{root.name}").scenario) == 2


@pytest.mark.parametrize(
    ("folder", "message", "good_scenarios"),
    [
        (
            f"{tiny_release.SCENARIO_TYPE}/ego_vehicle/label/{tiny_release.SCENARIO_NAME}",
            ("1 of 3", "cannot be listed"),
            [THIRD_SCENARIO, OTHER_SCENARIO],
        ),
        (
            f"{tiny_release.SCENARIO_TYPE}/other_vehicle",
            ("2 of 3", "other_vehicle", "Not a directory"),
            [THIRD_SCENARIO],
        ),
    ],
)
def test_a_file_instead_of_a_folder_breaks_only_the_scenarios_of_the_folder(
    root: Path,
    caplog: pytest.LogCaptureFixture,
    folder: str,
    message: tuple[str, ...],
    good_scenarios: list[str],
) -> None:
    """The folder holds one scenario's labels, or an agent of all scenarios of a type."""
    tiny_release.write_tiny_release(
        root, scenario_type="type1_subtype2_accident", name=THIRD_SCENARIO
    )
    shutil.rmtree(root / folder)
    (root / folder).write_text("")
    assert_raises(
        (lambda: open_release(root), BrokenReleaseError, ("errors in ", "scenarios:", *message))
    )
    release = open_release(root, on_error="skip")
    assert {scenario["name"] for scenario in release.scenario} == set(good_scenarios)
    assert f"excluded {tiny_release.SCENARIO_TOKEN}" in caplog.text


def test_a_scenario_whose_name_is_no_utf8_is_broken_and_hides_no_other(root: Path) -> None:
    """A file system allows such a name, but Arrow cannot store it.

    It is the name of the scenario's folders and stands in a split file.
    """
    odd_name = os.fsdecode(b"Town03_type001_subtype0001_\xff\xfe")
    odd_token = f"{tiny_release.SCENARIO_TYPE}/{odd_name}"
    tiny_release.write_tiny_release(root, name=odd_name)
    split_lines = f"{tiny_release.SCENARIO_TOKEN}\n{odd_token}\n".replace("/", " ")
    (root / "train.txt").write_bytes(os.fsencode(split_lines))
    message = (
        "errors in 1 of 3 scenarios",
        r"Town03_type001_subtype0001_\udcff\udcfe",
        "not UTF-8; rename its folders",
    )
    assert_raises((lambda: open_release(root), BrokenReleaseError, message))

    release = open_release(root, on_error="skip")
    names = [scenario["name"] for scenario in release.scenario]
    assert names == [tiny_release.SCENARIO_NAME, OTHER_SCENARIO]
    assert release.split_scenarios("train") == {tiny_release.SCENARIO_TOKEN}

    report = validate_release(root, workers=1)
    (finding,) = [finding for finding in report.findings if finding.code == "odd-name"]
    assert finding.severity == "error"
    assert finding.scenario == odd_token


def test_an_open_release_outlives_a_new_index(root: Path) -> None:
    release = open_release(root)
    pickled = pickle.dumps(release)
    tiny_release.write_tiny_release(root, name=THIRD_SCENARIO)
    assert len(open_release(root).scenario) == 3
    assert len(release.scenario) == 2
    assert len(release.track[:]) == len(release.track) > 0
    with pytest.raises(IndexStoreError, match="the index was made again; open the release again"):
        pickle.loads(pickled)


@pytest.mark.parametrize("frames", [3, 4, 6])
def test_an_accident_that_does_not_end_where_meta_says_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: int
) -> None:
    root = tiny_release.write_tiny_release(tmp_path, frames=frames)
    for _ in range(2):  # indexed, and opened again
        open_release(root)
        is_warned = (
            "so times to the impact are wrong; for details, run deepaccident validate"
            in caplog.text
        )
        assert is_warned == (frames != 4)
        caplog.clear()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def run_index(*arguments: object) -> str:
    result = CliRunner().invoke(
        deepaccident, ["index", *map(str, arguments)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return result.stdout


def make_index_in_the_cache(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(index_module, "is_writable_folder", lambda path: root not in path.parents)
        open_release(root)


@pytest.mark.parametrize(
    "arguments", ["index", "index a b", "check index", "index a --clear --workers 2"]
)
def test_wrong_usage_is_status_2(arguments: str) -> None:
    result = CliRunner().invoke(deepaccident, arguments.split())
    assert result.exit_code == 2
    assert "Usage: " in result.output


def test_clear_removes_every_index_and_says_what(
    root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release_files = folder_contents(root)
    make_index_in_the_cache(root, monkeypatch)
    (cache_index,) = cache.rglob("v1")
    own_index = root / INDEX_FOLDER
    shutil.copytree(cache_index, own_index)
    leftover_files = (
        ".tables-01.1.tmp/.track.arrow.1.tmp",
        ".manifest.json.1.tmp",
        "shards/type/a.arrow",
        ".unfinished",
        ".making",
    )
    derived_files = (
        "tables-01/interactions/kept/type/a",
        "tables-01/town_map-01.npz",
        "tables-01/thumbnails/01/a.jpg",
    )
    for name in (*leftover_files, *derived_files):
        (own_index / name).parent.mkdir(parents=True, exist_ok=True)
        (own_index / name).touch()

    lines = run_index(root, "--clear").splitlines()
    assert lines == [f"removed {own_index}", f"removed {cache_index}"]
    assert folder_contents(root) == release_files
    assert not own_index.parent.exists()
    assert list(cache.rglob("v1")) == []
    assert run_index(root, "--clear") == f"{root}: no index to remove\n"


@pytest.mark.parametrize(
    "name",
    [
        "notes.txt",
        "images/1.png",
        "shards/train/000.tar",
        "tables-01/notes.txt",
        "tables-01/linked",
    ],
)
def test_clear_refuses_what_is_no_index(root: Path, tmp_path: Path, name: str) -> None:
    folder = tmp_path / "given"
    path = folder / "v1" / name
    path.parent.mkdir(parents=True)
    if name.endswith("linked"):
        path.symlink_to(root)
    else:
        path.write_text("{}")
    before = folder_contents(folder)
    if "tables" not in name:
        assert clear_index(root, index_dir=folder) == []
    run_index(root, "--index-dir", folder)
    path.parent.mkdir(parents=True, exist_ok=True)  # indexing removes folders named as tables
    path.write_text("{}")
    assert_raises(
        (
            lambda: clear_index(root, index_dir=folder),
            IndexStoreError,
            ("v1: not removed", f"{name};"),
        )
    )
    assert folder_contents(folder).items() > before.items()


def test_clear_follows_no_symbolic_link(root: Path, tmp_path: Path) -> None:
    run_index(root)
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "one.arrow").touch()
    (root / INDEX_FOLDER / "tables-linked").symlink_to(precious)
    assert_raises(
        (
            lambda: clear_index(root),
            IndexStoreError,
            "files that belong to no index: tables-linked",
        )
    )
    assert (precious / "one.arrow").exists()
    assert (root / INDEX_FOLDER / MANIFEST_FILE).exists()


def test_a_newer_devkits_index_is_refused_and_kept_until_it_is_cleared(
    root: Path, tmp_path: Path
) -> None:
    run_index(root)
    path = root / INDEX_FOLDER / MANIFEST_FILE
    manifest = {**json.loads(path.read_text()), "schema_version": SCHEMA_VERSION + 1}
    path.write_text(json.dumps(manifest))
    before = folder_contents(root)
    message = (
        str(path),
        f"schema version {SCHEMA_VERSION + 1}",
        "deepaccident index DATAROOT --clear",
    )
    assert_raises((lambda: open_release(root), IndexStoreError, message))
    assert folder_contents(root) == before
    assert len(open_release(root, tmp_path / "own").scenario) == 2
    run_index(root, "--clear")
    assert len(open_release(root).scenario) == 2


def test_a_path_that_is_no_utf8_is_refused(tmp_path: Path) -> None:
    odd_root = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    odd_root.mkdir()
    assert_raises((lambda: open_release(odd_root), DatarootError, "is not UTF-8"))


def test_a_scenario_without_meta_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    release = open_release(tiny_release.write_tiny_release(tmp_path, meta=None))
    assert (
        f"meta/{tiny_release.SCENARIO_NAME}.txt: missing or not readable, so the weather and "
        "collision" in caplog.text
    )
    release.list_scenarios()
    assert "collision unknown" in capsys.readouterr().out
