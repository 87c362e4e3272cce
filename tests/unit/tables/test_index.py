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
import tiny
from click.testing import CliRunner
from refusals import assert_refused
from tiny_index import INDEX, OTHER, THIRD, contents, edit, label, opened

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


def calib(root: Path, agent: str = "ego_vehicle", frame: int = 2) -> Path:
    return root / tiny.TYPE / agent / "calib" / tiny.NAME / f"{tiny.NAME}_{frame:03d}.pkl"


def write_calib(path: Path, **changes: object) -> None:
    """A calib file with other entries; those that are None are left out."""
    content = tiny.calib(tiny.pose(), height=0) | changes
    path.write_bytes(
        tiny.old_pickle({key: each for key, each in content.items() if each is not None})
    )


def replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated label": (
        lambda root: label(root).write_text("0 0\ncar 1 2 3"),
        r"_002\.txt:2: expected 13 fields, found 4: 'car 1 2 3'; restore",
    ),
    "12 fields": (
        lambda root: replace(label(root), " 12 True", " True"),
        r"_002\.txt:3: expected 13 fields, found 12",
    ),
    "NaN": (
        lambda root: replace(label(root), "30.0 -1.5", "nan -1.5"),
        r"_002\.txt:4: x is 'nan', expected a finite",
    ),
    "calib without a key": (
        lambda root: write_calib(calib(root), intrinsic_Camera_Back=None),
        r"_002\.pkl: lacks intrinsic_Camera_Back; restore",
    ),
    "calib of a wrong shape": (
        lambda root: write_calib(calib(root), ego_to_world=np.eye(3)),
        r"_002\.pkl: ego_to_world: expected numbers of shape \(4, 4\), found \(3, 3\)",
    ),
    "calib that is code": (
        lambda root: calib(root).write_bytes(pickle.dumps(print)),
        (
            r"_002\.pkl: not a readable calibration \(.*the pickle asks for "
            r"builtins\.print, which is not allowed\)"
        ),
    ),
    "meta with a word missing": (
        lambda root: replace(root / tiny.TYPE / "meta" / f"{tiny.NAME}.txt", "same ", ""),
        r"scenario00024\.txt:1: expected 9 words .* found 8",
    ),
    "a frame of an agent missing": (
        lambda root: [path(root, "infrastructure", 3).unlink() for path in (label, calib)] and None,
        r"infrastructure/calib/.*: lacks frames 3 of 1 to 4; unpack its archive again",
    ),
    "last label missing": (
        lambda root: label(root, frame=4).unlink(),
        r"ego_vehicle/label/.*: lacks frames 4 of 1 to 4",
    ),
    "a file with an odd name": (
        lambda root: (
            shutil.copy(label(root), label(root).with_name("copy of a label.txt")) and None
        ),
        r"copy of a label\.txt: expected a name .*_<NNN>\.txt; rename it",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_scenario_is_named_and_never_hides_the_good_one(
    root: Path, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    damage, message = FAULTS[fault]
    damage(root)
    assert_refused(
        (lambda: opened(root), BrokenReleaseError, message),
        (
            lambda: opened(root),
            BrokenReleaseError,
            ("1 of 2 scenarios are broken", "--on-error skip"),
        ),
    )
    with caplog.at_level(logging.WARNING):
        release = opened(root, on_error="skip")
    assert [scenario["name"] for scenario in release.scenario] == [OTHER]
    assert [problem.scenario for problem in release.problems] == [tiny.TOKEN]
    assert f"left out {tiny.TOKEN}" in caplog.text
    # an index made with skip does not hide it afterwards
    assert_refused((lambda: opened(root), BrokenReleaseError, "1 of 2 scenarios"))


def test_all_broken_scenarios_are_listed_at_once(root: Path) -> None:
    label(root).write_text("0 0\ncar")
    label(root, name=OTHER).write_text("")
    replace(label(root, frame=3), "van", "lorry")
    named = (
        f"{OTHER}_002.txt:1: ",
        "found an empty file",
        f"{tiny.NAME}_003.txt:3: class is 'lorry'",
    )
    assert_refused(
        (lambda: opened(root), BrokenReleaseError, ("2 of 2 scenarios are broken", *named)),
        (
            lambda: opened(root, on_error="skip"),
            BrokenReleaseError,
            "2 of 2",
        ),  # nothing is left to open
    )


def test_the_same_scenario_in_two_split_files_or_folders(own_release: Path) -> None:
    first = (own_release / "train.txt").read_text().splitlines()[0]
    with (own_release / "val.txt").open("a") as file:
        file.write(f"{first}  \r\n\n")
    assert_refused(
        (
            lambda: opened(own_release),
            BrokenReleaseError,
            ("in two splits", "train.txt and ", "val.txt; rem"),
        )
    )
    assert len(opened(own_release, on_error="skip").scenario) == 5
    shutil.copytree(own_release / "train", own_release / "val", dirs_exist_ok=True)
    assert_refused(
        (
            lambda: opened(own_release),
            BrokenReleaseError,
            ("in two folders", "train and ", "val; remove one"),
        )
    )


def test_splits_come_from_files_else_folders_else_are_unknown(own_release: Path) -> None:
    by_files = opened(own_release)
    train = by_files.split_scenarios("train")
    assert train == {
        "/".join(line.split()) for line in (own_release / "train.txt").read_text().splitlines()
    }
    assert by_files.split_scenarios("train_mini") <= train
    for file in own_release.glob("*.txt"):
        file.unlink()
    by_folders = opened(own_release)
    assert by_folders.split_scenarios("train") == train
    assert_refused(
        (
            lambda: by_folders.split_scenarios("train_mini"),
            NotAvailableError,
            r"has no train_mini\.txt",
        )
    )
    flat = own_release.parent / "flat"
    for split in ("train", "val", "test"):
        shutil.copytree(own_release / split, flat, dirs_exist_ok=True)
    unknown = opened(flat)
    assert {scenario["split"] for scenario in unknown.scenario} == {None}
    remedy = f"deepaccident split {flat} --out mine.txt"
    assert_refused(
        (lambda: unknown.split_scenarios("train"), NotAvailableError, (remedy,)),
        (lambda: unknown.split_scenarios("unknown"), ChoiceError, (remedy, "train, val")),
    )


def test_split_files_win_over_folders(own_release: Path) -> None:
    train, val = ((own_release / f"{split}.txt").read_text() for split in ("train", "val"))
    (own_release / "train.txt").write_text(val)
    (own_release / "val.txt").write_text(train)
    release = opened(own_release)
    assert {scenario["folder"] for scenario in release.scenario if scenario["split"] == "val"} == {
        "train"
    }


@pytest.mark.parametrize("missing", ["labels", "infrastructure", "meta", "labels of one agent"])
def test_partial_releases_are_indexed_as_what_they_are(tmp_path: Path, missing: str) -> None:
    agents = tiny.AGENTS[:4] if missing == "infrastructure" else tiny.AGENTS
    meta = None if missing == "meta" else tiny.META
    root = tiny.write_tiny_release(tmp_path, agents=agents, labelled=missing != "labels", meta=meta)
    if missing == "labels of one agent":
        shutil.rmtree(root / tiny.TYPE / "other_vehicle" / "label")
    release = opened(root)
    samples = release.samples_of(f"{tiny.TOKEN}/001")
    assert [sample["agent"] for sample in samples] == list(agents)
    unlabelled = {"labels": set(agents), "labels of one agent": {"other_vehicle"}}.get(
        missing, set()
    )
    for sample in samples:
        labelled = sample["agent"] not in unlabelled
        assert (sample["labelled"], sample["velocity"] is not None) == (labelled, labelled)
        assert (len(release.get_boxes(sample)) > 0, len(release.boxes(sample)) > 0) == (
            labelled,
            labelled,
        )
        assert len(release.boxes(sample, "ego", visible="released")) == (1 if labelled else 0)
    scenario = release.scenario[0]
    if missing == "meta":
        assert (scenario["weather"], scenario["collision"], scenario["accident_type"]) == (
            None,
            None,
            None,
        )
        own = release.get("annotation", f"{tiny.TOKEN}/ego_vehicle/001/0")
        found = [own[name] for name in ("instance_token", "time_to_impact", "next")]
        assert found == [None, None, f"{tiny.TOKEN}/ego_vehicle/002/0"]
    if missing == "infrastructure":
        assert_refused(
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
    whole = opened(root, tmp_path / "other")
    for name in {"pyarrow.memory_map", impossible}:
        monkeypatch.setattr(name, Mock(side_effect=OSError(errno.ENODEV, "No such device")))
    without = opened(root)
    assert contents(without.tables_folder).keys() == contents(whole.tables_folder).keys()
    assert all(
        list(getattr(without, name)) == list(getattr(whole, name))
        for name in ("sample", "annotation")
    )


def test_a_refresh_reads_just_what_was_edited_added_or_removed(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    original = indexing.read_scenario
    monkeypatch.setattr(
        indexing,
        "read_scenario",
        lambda scenario, scan: (read.append(scenario.name), original(scenario, scan))[1],
    )

    def refreshed(*verbs: str) -> tuple[int, list[str]]:
        read.clear()
        assert CliRunner().invoke(deepaccident, [*(verbs or ("index",)), str(root)]).exit_code == 0
        names = sorted(read)
        shutil.rmtree(root.parent / "fresh", ignore_errors=True)
        count = len(opened(root, root.parent / "fresh").annotation)
        assert contents(root / INDEX.parent) == contents(root.parent / "fresh")
        return count, names

    before, names = refreshed()
    assert names == [tiny.NAME, OTHER]
    assert refreshed("check", "index") == (before, [])
    edit(root, OTHER)
    assert refreshed("check", "index") == (before - 1, [OTHER])
    tiny.write_tiny_release(root, scenario_type="type1_subtype2_accident", name=THIRD)
    assert refreshed()[1] == [THIRD]
    shutil.rmtree(root / "type1_subtype2_accident")
    assert refreshed() == (before - 1, [])


@pytest.mark.slow
def test_workers_and_executors_write_the_same_bytes(release_root_b: Path, tmp_path: Path) -> None:
    release = opened(release_root_b, tmp_path / "one", workers=1)
    assert len(list(release.tables_folder.iterdir())) == 12
    opened(release_root_b, tmp_path / "two", workers=2)
    with ThreadPoolExecutor(3) as threads:
        opened(release_root_b, tmp_path / "threads", executor=threads)
    assert (
        contents(tmp_path / "one") == contents(tmp_path / "two") == contents(tmp_path / "threads")
    )


def test_a_read_only_dataroot_gets_its_index_in_the_cache(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache, writable = tmp_path / "cache", index_module.is_writable_folder
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    monkeypatch.setattr(
        index_module, "is_writable_folder", lambda path: root not in path.parents and writable(path)
    )
    assert cache in opened(root).tables_folder.parents
    assert not (root / ".deepaccident").exists()
    with monkeypatch.context() as patch:
        patch.setattr(indexing, "read_scenario", lambda *_: pytest.fail("made again"))
        assert len(opened(root).scenario) == 2
    monkeypatch.setattr(index_module, "is_writable_folder", lambda _path: False)
    whole = tiny.write_tiny_release(tmp_path / "third")
    assert_refused(
        (lambda: opened(whole), IndexStoreError, ("no place to write the index", "index_dir="))
    )


def test_a_relative_dataroot_survives_chdir_and_a_home_folder_is_found(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(root.parent)
    release = opened(root.name, "index")
    pickled = pickle.dumps(release)
    monkeypatch.chdir("/")
    assert release.get_sample_data_path(
        f"{tiny.TOKEN}/ego_vehicle/001/lidar01"
    ).parent.parent.is_relative_to(root)
    assert len(pickle.loads(pickled).track) == len(release.track) > 0
    monkeypatch.setenv("HOME", str(root.parent))
    assert len(opened(f"~/{root.name}").scenario) == 2


@pytest.mark.parametrize(
    ("place", "named", "good"),
    [
        (
            f"{tiny.TYPE}/ego_vehicle/label/{tiny.NAME}",
            ("1 of 3", "cannot be listed"),
            [THIRD, OTHER],
        ),
        (f"{tiny.TYPE}/other_vehicle", ("2 of 3", "other_vehicle", "Not a directory"), [THIRD]),
    ],
)
def test_a_file_in_a_folders_place_breaks_whose_folder_it_is(
    root: Path,
    caplog: pytest.LogCaptureFixture,
    place: str,
    named: tuple[str, ...],
    good: list[str],
) -> None:
    """A scenario's labels, and an agent of all scenarios of a type."""
    tiny.write_tiny_release(root, scenario_type="type1_subtype2_accident", name=THIRD)
    shutil.rmtree(root / place)
    (root / place).write_text("")
    assert_refused((lambda: opened(root), BrokenReleaseError, ("scenarios are broken", *named)))
    assert {scenario["name"] for scenario in opened(root, on_error="skip").scenario} == set(good)
    assert f"left out {tiny.TOKEN}" in caplog.text


def test_a_scenario_whose_name_is_no_utf8_is_broken_and_hides_no_other(root: Path) -> None:
    """Its folders, and its line in a split file; the system gives such names, and Arrow has
    none.
    """
    odd = os.fsdecode(b"Town03_type001_subtype0001_\xff\xfe")
    tiny.write_tiny_release(root, name=odd)
    (root / "train.txt").write_bytes(
        os.fsencode(f"{tiny.TOKEN}\n{tiny.TYPE}/{odd}\n".replace("/", " "))
    )
    named = (
        "1 of 3 scenarios are broken",
        r"Town03_type001_subtype0001_\udcff\udcfe",
        "not UTF-8; rename its folders",
    )
    assert_refused((lambda: opened(root), BrokenReleaseError, named))
    release = opened(root, on_error="skip")
    assert [scenario["name"] for scenario in release.scenario] == [tiny.NAME, OTHER]
    assert release.split_scenarios("train") == {tiny.TOKEN}
    (finding,) = [
        each for each in validate_release(root, workers=1).findings if each.code == "odd-name"
    ]
    assert (finding.severity, finding.scenario) == ("error", f"{tiny.TYPE}/{odd}")


def test_an_open_release_outlives_a_new_index(root: Path) -> None:
    release = opened(root)
    pickled = pickle.dumps(release)
    tiny.write_tiny_release(root, name=THIRD)
    assert (len(opened(root).scenario), len(release.scenario)) == (3, 2)
    assert len(release.track[:]) == len(release.track) > 0
    with pytest.raises(IndexStoreError, match="the index was made again; open the release again"):
        pickle.loads(pickled)


@pytest.mark.parametrize("frames", [3, 4, 6])
def test_an_accident_that_does_not_end_where_meta_says_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, frames: int
) -> None:
    root = tiny.write_tiny_release(tmp_path, frames=frames)
    for _ in range(2):  # indexed, and opened again
        opened(root)
        assert ("times to the impact are wrong; see: deepaccident validate" in caplog.text) == (
            frames != 4
        )
        caplog.clear()


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def run(*arguments: object) -> str:
    result = CliRunner().invoke(
        deepaccident, ["index", *map(str, arguments)], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    return result.stdout


def index_in_the_cache(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(index_module, "is_writable_folder", lambda path: root not in path.parents)
        opened(root)


@pytest.mark.parametrize(
    "arguments", ["index", "index a b", "check index", "index a --clear --workers 2"]
)
def test_wrong_usage_is_status_2(arguments: str) -> None:
    result = CliRunner().invoke(deepaccident, arguments.split())
    assert (result.exit_code, "Usage: " in result.output) == (2, True)


def test_clear_removes_every_index_and_says_what(
    root: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    release = contents(root)
    index_in_the_cache(root, monkeypatch)
    own = root / INDEX
    shutil.copytree(next(cache.rglob("v1")), own)
    left = (
        ".tables-01.1.tmp/.track.arrow.1.tmp",
        ".manifest.json.1.tmp",
        "shards/type/a.arrow",
        ".unfinished",
        ".making",
    )
    kept = (
        "tables-01/interactions/kept/type/a",
        "tables-01/town_map-01.npz",
        "tables-01/thumbnails/01/a.jpg",
    )
    for name in (*left, *kept):
        (own / name).parent.mkdir(parents=True, exist_ok=True)
        (own / name).touch()
    (found,) = cache.rglob("v1")
    assert run(root, "--clear").splitlines() == [f"removed {own}", f"removed {found}"]
    assert (contents(root), own.parent.exists(), list(cache.rglob("v1"))) == (release, False, [])
    assert run(root, "--clear") == f"{root}: no index to remove\n"


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
    folder, path = tmp_path / "given", tmp_path / "given" / "v1" / name
    path.parent.mkdir(parents=True)
    path.symlink_to(root) if name.endswith("linked") else path.write_text("{}")
    before = contents(folder)
    if "tables" not in name:
        assert clear_index(root, index_dir=folder) == []
    run(root, "--index-dir", folder)
    path.parent.mkdir(parents=True, exist_ok=True)  # what looks like tables was removed
    path.write_text("{}")
    assert_refused(
        (
            lambda: clear_index(root, index_dir=folder),
            IndexStoreError,
            ("v1: not removed", f"{name};"),
        )
    )
    assert contents(folder).items() > before.items()


def test_clear_follows_no_symbolic_link(root: Path, tmp_path: Path) -> None:
    run(root)
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "one.arrow").touch()
    (root / INDEX / "tables-linked").symlink_to(precious)
    assert_refused(
        (lambda: clear_index(root), IndexStoreError, "no part of an index: tables-linked")
    )
    assert (precious / "one.arrow").exists()
    assert (root / INDEX / MANIFEST_FILE).exists()


def test_a_newer_devkits_index_is_refused_and_kept_until_it_is_cleared(
    root: Path, tmp_path: Path
) -> None:
    run(root)
    path = root / INDEX / MANIFEST_FILE
    path.write_text(
        json.dumps({**json.loads(path.read_text()), "schema_version": SCHEMA_VERSION + 1})
    )
    before = contents(root)
    named = (
        str(path),
        f"schema version {SCHEMA_VERSION + 1}",
        "deepaccident index DATAROOT --clear",
    )
    assert_refused((lambda: opened(root), IndexStoreError, named))
    assert (contents(root), len(opened(root, tmp_path / "own").scenario)) == (before, 2)
    run(root, "--clear")
    assert len(opened(root).scenario) == 2


def test_a_path_that_is_no_utf8_is_refused(tmp_path: Path) -> None:
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    odd.mkdir()
    assert_refused((lambda: opened(odd), DatarootError, "is not UTF-8"))


def test_a_scenario_without_meta_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: object
) -> None:
    release = opened(tiny.write_tiny_release(tmp_path, meta=None))
    assert f"meta/{tiny.NAME}.txt: missing or not readable: weather and collision" in caplog.text
    release.list_scenarios()
    assert "collision unknown" in capsys.readouterr().out  # type: ignore[attr-defined]
