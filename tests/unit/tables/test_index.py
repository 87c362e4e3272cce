"""Making, finding, refreshing and refusing indexes."""

import logging
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import BrokenReleaseError, IndexStoreError, NotAvailableError, SplitFileError
from deepaccident_devkit.overview import overview
from deepaccident_devkit.tables import index as index_module
from deepaccident_devkit.tables import indexing

OTHER = "Town05_type001_subtype0001_scenario00007"


def opened(root: Path, **arguments: object) -> DeepAccident:
    return DeepAccident(dataroot=root, verbose=False, **arguments)  # type: ignore[arg-type]


def label(root: Path, agent: str = "ego_vehicle", frame: int = 2, name: str = tiny.NAME) -> Path:
    return root / tiny.TYPE / agent / "label" / name / f"{name}_{frame:03d}.txt"


def calib(root: Path, agent: str = "ego_vehicle", frame: int = 2) -> Path:
    return root / tiny.TYPE / agent / "calib" / tiny.NAME / f"{tiny.NAME}_{frame:03d}.pkl"


def without_key(path: Path) -> None:
    content = tiny.calib(tiny.pose(), height=0)
    del content["intrinsic_Camera_Back"]
    path.write_bytes(tiny.old_pickle(content))


def with_wrong_shape(path: Path) -> None:
    content = tiny.calib(tiny.pose(), height=0)
    path.write_bytes(tiny.old_pickle({**content, "ego_to_world": np.eye(3)}))


def replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated label": (
        lambda root: label(root).write_text("0 0\ncar 1 2 3"),
        r"_002\.txt:2: expected 13 fields, found 4: 'car 1 2 3'; restore",
    ),
    "12 fields": (lambda root: replace(label(root), " 12 True", " True"), r"_002\.txt:3: expected 13 fields, found 12"),
    "NaN": (lambda root: replace(label(root), "30.0 -1.5", "nan -1.5"), r"_002\.txt:4: x is 'nan', expected a finite"),
    "calib without a key": (lambda root: without_key(calib(root)), r"_002\.pkl: lacks intrinsic_Camera_Back; restore"),
    "calib of a wrong shape": (
        lambda root: with_wrong_shape(calib(root)),
        r"_002\.pkl: ego_to_world: expected numbers of shape \(4, 4\), found \(3, 3\)",
    ),
    "calib that is code": (
        lambda root: calib(root).write_bytes(pickle.dumps(print)),
        r"_002\.pkl: not a readable calibration \(.*the pickle asks for builtins\.print, which is not allowed\)",
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
        lambda root: shutil.copy(label(root), label(root).with_name("copy of a label.txt")) and None,
        r"copy of a label\.txt: expected a name .*_<NNN>\.txt; rename it",
    ),
}


@pytest.fixture
def two_scenarios(tmp_path: Path) -> Path:
    tiny.write_tiny_release(tmp_path / "release")
    return tiny.write_tiny_release(tmp_path / "release", name=OTHER)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_scenario_is_named_and_never_hides_the_good_one(
    two_scenarios: Path, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    damage, message = FAULTS[fault]
    damage(two_scenarios)
    with pytest.raises(BrokenReleaseError, match=message) as raised:
        opened(two_scenarios)
    assert "1 of 2 scenarios are broken" in str(raised.value)
    assert "--on-error skip" in str(raised.value)
    with caplog.at_level(logging.WARNING):
        release = opened(two_scenarios, on_error="skip")
    assert [scenario["name"] for scenario in release.scenario] == [OTHER]
    assert [problem.scenario for problem in release.problems] == [tiny.TOKEN]
    assert f"left out {tiny.TOKEN}" in caplog.text
    with pytest.raises(BrokenReleaseError, match="1 of 2 scenarios"):
        opened(two_scenarios)  # an index made with skip does not hide it afterwards


def test_all_broken_scenarios_are_listed_at_once(two_scenarios: Path) -> None:
    label(two_scenarios).write_text("0 0\ncar")
    label(two_scenarios, name=OTHER).write_text("")
    replace(label(two_scenarios, frame=3), "van", "lorry")
    with pytest.raises(BrokenReleaseError, match="2 of 2 scenarios are broken") as raised:
        opened(two_scenarios)
    text = str(raised.value)
    assert f"{OTHER}_002.txt:1: expected '<speed_x> <speed_y>', found an empty file" in text
    assert f"{tiny.NAME}_003.txt:3: class is 'lorry', expected one of car" in text
    with pytest.raises(BrokenReleaseError, match="2 of 2"):
        opened(two_scenarios, on_error="skip")  # nothing is left to open


def test_a_label_mended_in_place_is_read_again(two_scenarios: Path) -> None:
    good = label(two_scenarios).read_text()
    label(two_scenarios).write_text("0 0\ncar 1 2")
    with pytest.raises(BrokenReleaseError, match="found 3"):
        opened(two_scenarios)
    label(two_scenarios).write_text(good)
    assert len(opened(two_scenarios).scenario) == 2


def test_the_same_scenario_in_two_split_files(own_release: Path) -> None:
    first = (own_release / "train.txt").read_text().splitlines()[0]
    with (own_release / "val.txt").open("a") as file:
        file.write(f"{first}  \r\n\n")
    with pytest.raises(BrokenReleaseError, match=r"stands in two splits: .*train\.txt and .*val\.txt; remove it"):
        opened(own_release)
    assert len(opened(own_release, on_error="skip").scenario) == 5


def test_the_same_scenario_in_two_folders(own_release: Path) -> None:
    shutil.copytree(own_release / "train", own_release / "val", dirs_exist_ok=True)
    with pytest.raises(BrokenReleaseError, match=r"stands in two folders: .*train and .*val; remove one"):
        opened(own_release)


def test_a_split_file_that_is_none(own_release: Path) -> None:
    (own_release / "val.txt").write_text("type1_subtype1_accident\n")
    with pytest.raises(SplitFileError, match=r"val\.txt:1: expected '<scenario_type> <scenario>'"):
        opened(own_release)


def test_splits_come_from_files_else_folders_else_are_unknown(own_release: Path) -> None:
    by_files = opened(own_release)
    train = by_files.split_scenarios("train")
    assert train == {"/".join(line.split()) for line in (own_release / "train.txt").read_text().splitlines()}
    assert by_files.split_scenarios("train_mini") <= train
    for file in own_release.glob("*.txt"):
        file.unlink()
    by_folders = opened(own_release)
    assert by_folders.split_scenarios("train") == train
    with pytest.raises(NotAvailableError, match=r"has no train_mini\.txt"):
        by_folders.split_scenarios("train_mini")
    flat = own_release.parent / "flat"
    for split in ("train", "val", "test"):
        shutil.copytree(own_release / split, flat, dirs_exist_ok=True)
    unknown = opened(flat)
    assert {scenario["split"] for scenario in unknown.scenario} == {None}
    own = f"or make a split file of your own: deepaccident split {flat} --out mine.txt, then --split mine.txt"
    with pytest.raises(NotAvailableError, match=f"the split of its scenarios is unknown: .*, {re.escape(own)}$"):
        unknown.split_scenarios("train")
    assert re.search(r"^unknown +6$", overview(unknown).to_text(), re.MULTILINE)


def test_split_files_win_over_folders(own_release: Path) -> None:
    train, val = ((own_release / f"{split}.txt").read_text() for split in ("train", "val"))
    (own_release / "train.txt").write_text(val)
    (own_release / "val.txt").write_text(train)
    release = opened(own_release)
    assert {scenario["folder"] for scenario in release.scenario if scenario["split"] == "val"} == {"train"}


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
    unlabelled = {"labels": set(agents), "labels of one agent": {"other_vehicle"}}.get(missing, set())
    for sample in samples:
        labelled = sample["agent"] not in unlabelled
        assert (sample["labelled"], sample["velocity"] is not None) == (labelled, labelled)
        assert (len(release.get_boxes(sample)) > 0, len(release.boxes(sample)) > 0) == (labelled, labelled)
        assert len(release.boxes(sample, "ego", visible="released")) == (1 if labelled else 0)
    scenario = release.scenario[0]
    if missing == "meta":
        assert (scenario["weather"], scenario["collision"], scenario["accident_type"]) == (None, None, None)
        own = release.get("annotation", f"{tiny.TOKEN}/ego_vehicle/001/0")
        assert (own["instance_token"], own["time_to_impact"]) == (None, None)
        assert own["next"] == f"{tiny.TOKEN}/ego_vehicle/002/0"
    if missing == "infrastructure":
        with pytest.raises(KeyError, match="the scenario's agents are ego_vehicle, ego_vehicle_behind"):
            release.get_sample(scenario, "infrastructure", 1)


def test_labels_without_calib_are_left_out_and_said_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = tiny.write_tiny_release(tmp_path)
    shutil.rmtree(root / tiny.TYPE / "other_vehicle" / "calib")
    with caplog.at_level(logging.WARNING):
        release = opened(root)
    assert "other_vehicle has labels but no calib files and is left out" in caplog.text
    assert len(release.agent) == 4


def test_opening_again_reads_no_label(two_scenarios: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened(two_scenarios)
    monkeypatch.setattr(index_module, "make_index", lambda *_, **__: pytest.fail("made again"))
    assert opened(two_scenarios).arrow("track").equals(first.arrow("track"))


def test_only_what_changed_is_read_again(two_scenarios: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened(two_scenarios)
    read = []
    original = indexing.read_scenario

    def counted(scenario: object, scan: object) -> object:
        read.append(scenario.token)  # type: ignore[attr-defined]
        return original(scenario, scan)  # type: ignore[arg-type]

    monkeypatch.setattr(indexing, "read_scenario", counted)
    third = "Town01_type001_subtype0001_scenario00001"
    tiny.write_tiny_release(two_scenarios, name=third)
    assert len(opened(two_scenarios).scenario) == 3
    assert read == [f"{tiny.TYPE}/{third}"]
    for agent in tiny.AGENTS:
        for kind in ("calib", "label"):
            shutil.rmtree(two_scenarios / tiny.TYPE / agent / kind / OTHER)
    assert [scenario["name"] for scenario in opened(two_scenarios).scenario] == [third, tiny.NAME]
    assert len(read) == 1
    assert sorted(path.stem for path in two_scenarios.glob(".deepaccident/v1/shards/*/*.arrow")) == [third, tiny.NAME]


@pytest.mark.slow
def test_one_and_two_workers_write_the_same_bytes(release_root_b: Path, tmp_path: Path) -> None:
    contents = []
    for workers in (1, 2):
        release = opened(release_root_b, index_dir=tmp_path / str(workers), workers=workers)
        files = sorted(path for path in release.tables_folder.iterdir())
        contents.append([(path.name, path.read_bytes()) for path in files])
    assert contents[0] == contents[1]
    assert len(contents[0]) == 12


def test_a_read_only_dataroot_gets_its_index_in_the_cache(
    two_scenarios: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = tmp_path / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    writable = index_module.is_writable_folder
    monkeypatch.setattr(
        index_module, "is_writable_folder", lambda path: two_scenarios not in path.parents and writable(path)
    )
    release = opened(two_scenarios)
    assert cache in release.tables_folder.parents
    assert not (two_scenarios / ".deepaccident").exists()
    monkeypatch.setattr(index_module, "make_index", lambda *_, **__: pytest.fail("made again"))
    assert len(opened(two_scenarios).scenario) == 2
    monkeypatch.undo()
    monkeypatch.setattr(index_module, "is_writable_folder", lambda _path: False)
    with pytest.raises(IndexStoreError, match="no place to write the index; give a writable folder with index_dir="):
        opened(tiny.write_tiny_release(tmp_path / "third"))


def test_a_stop_while_writing_leaves_the_old_index(two_scenarios: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened(two_scenarios)
    before = {path: path.read_bytes() for path in two_scenarios.glob(".deepaccident/v1/tables-*/*")}
    label(two_scenarios).write_text("1.0 2.0\n")

    def stopped(*_arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(indexing, "join_tables", stopped)
    (two_scenarios / tiny.TYPE / "ego_vehicle" / "label" / tiny.NAME / "now.tmp").touch()  # the folder's time moves
    with pytest.raises(IndexStoreError, match=r"the index cannot be written .*No space left"):
        opened(two_scenarios)
    after = {path: path.read_bytes() for path in two_scenarios.glob(".deepaccident/v1/tables-*/*")}
    assert after == before


@pytest.mark.slow
def test_a_script_without_a_main_guard_may_index_with_workers(two_scenarios: Path) -> None:
    script = two_scenarios.parent / "script.py"
    script.write_text(
        "from deepaccident_devkit import DeepAccident\n"
        f"da = DeepAccident(dataroot={str(two_scenarios)!r}, workers=2, verbose=False)\n"
        "print('opened', len(da.scenario))\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "opened 2\n", done.stderr
