"""Folders of motion labels: what is read back, what an interruption or damage leaves behind, and
which folders are refused.
"""

import json
import operator
import os
import pickle
import random
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from support import tiny_release
from support.expected_errors import assert_raises
from support.tiny_release_index import folder_contents, label_path, open_release

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import (
    ChoiceError,
    ConfigError,
    LabelFilesError,
    NotAvailableError,
    SomeFailedError,
    TokenError,
)
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.motion import (
    LABEL_PROTOCOLS,
    PRESETS,
    Augmentation,
    FrameBoxes,
    LabelFiles,
    LabelsWritten,
    MotionLabelConfig,
    MotionLabels,
    label_files,
    motion_labels,
    motion_labels_from_boxes,
    write_label_files,
)
from deepaccident_devkit.motion.batch_names import BatchNames
from deepaccident_devkit.motion.label_folder import (
    LABEL_FORMAT_VERSION,
    MANIFEST,
    LabelManifest,
    StoredLabels,
    label_store,
)
from deepaccident_devkit.support.files import replacing, temporary_path
from deepaccident_devkit.taxonomy import AGENTS

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[3] / "schema" / "motion_labels.md"
MAPS = ("segmentation", "instance", "centerness", "offset", "flow", "future_egomotion", "valid")
OBLONG = BevGrid((-20.0, 60.0, 0.5), (-30.0, 10.0, 0.25))
CONFIGS = {
    **PRESETS,
    "clean": MotionLabelConfig(protocol="clean"),
    "clean, everybody, untracked too": MotionLabelConfig(protocol="clean", filter_invisible=False),
    "everybody": MotionLabelConfig(filter_invisible=False),
    "released orientation": MotionLabelConfig(orientation="released"),
    "clean, as fiery": MotionLabelConfig(protocol="clean", orientation="fiery", draw_ego=False),
    "fiery, as released": MotionLabelConfig.preset(
        "fiery", orientation="released", ignore_index=201
    ),
    "oblong": MotionLabelConfig(grid=OBLONG, receptive_field=1, future_frames=2, step=2),
    "oblong, as fiery": MotionLabelConfig(grid=OBLONG, orientation="fiery", protocol="clean"),
    "large": MotionLabelConfig(
        grid=BevGrid((-100.0, 100.0, 0.5), (-100.0, 100.0, 0.5)), future_frames=1
    ),
    "augmented": MotionLabelConfig(augmentation=Augmentation(rotation=0.3, scale=1.04, flip=True)),
    "quirks of one's own": MotionLabelConfig(
        protocol=replace(LABEL_PROTOCOLS["clean"], untracked_share_an_id=True)
    ),
    "one agent's sight": MotionLabelConfig(agents=("ego_vehicle",)),
}


def assert_same_labels(labels: MotionLabels, expected: MotionLabels) -> None:
    """Check that labels are equal to the bit, including types and the sign of zeros."""
    for name in MAPS:
        assert_same_bytes(getattr(labels, name), getattr(expected, name), name)
    assert dict(labels.id_map) == dict(expected.id_map)
    assert labels.config.digest == expected.config.digest
    assert labels.at_present == expected.at_present


def assert_same_bytes(array: np.ndarray, expected: np.ndarray, name: str) -> None:
    assert array.dtype == expected.dtype, name
    assert array.shape == expected.shape, name
    differing = int((array != expected).sum())
    assert array.tobytes() == expected.tobytes(), f"{name}: {differing} cells differ"


def read_files(folder: Path) -> dict[str, bytes]:
    """Read all files except the lock."""
    return {
        path: content
        for path, content in folder_contents(folder).items()
        if Path(path).name != ".lock"
    }


def make_lines_with_people(agent: str, frame: int) -> list[str]:
    """Return tiny's boxes and two untracked people who are seen."""
    y = 4 + frame / 5
    return [
        *tiny_release.label_lines(agent, frame),
        f"pedestrian 8.0 {y} -0.9 0.6 0.6 1.86 0 0.0 0.0 -1 9 True",
        f"pedestrian 11.0 {y} -0.9 0.6 0.6 1.86 0 0.0 0.0 -1 9 True",
    ]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tiny_release.write_tiny_release(
        tmp_path / "release", frames=12, lines_of=make_lines_with_people
    )


@pytest.fixture
def small(root: Path) -> DeepAccident:
    return open_release(root)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "labels"


def list_tokens(release: DeepAccident, *frames: int, agents: tuple[str, ...] = AGENTS) -> list[str]:
    """List the samples of some frames and agents by scenario, agent and time."""
    endings = tuple(f"/{agent}/{frame:03d}" for agent in agents for frame in frames)
    tokens = [record["token"] for record in release.sample]
    return [token for token in tokens if token.endswith(endings)]


def write_labels(
    release: DeepAccident,
    folder: Path,
    tokens: list[str],
    config: MotionLabelConfig | None = None,
    **options: Any,
):
    return write_label_files(release, folder, tokens, config, **{"workers": 1, **options})


def change_manifest(folder: Path, **changes: object) -> None:
    path = folder / MANIFEST
    manifest = json.loads(path.read_text())
    path.write_text(json.dumps({**manifest, **changes}))


def change_label(
    release: Path, agent: str, name: str = tiny_release.SCENARIO_NAME, frame: int = 6
) -> None:
    """Take a label's last row away."""
    label = label_path(release, agent, frame, name)
    lines = label.read_text().splitlines()
    label.write_text("\n".join(lines[:-1]) + "\n")
    os.utime(label.parent)


def raise_lidar(
    release: Path, agent: str, name: str = tiny_release.SCENARIO_NAME, frame: int = 6
) -> None:
    """Put an agent's LiDAR at a height of 1.5 m in a frame."""
    folder = release / tiny_release.SCENARIO_TYPE / agent / "calib" / name
    calib = tiny_release.make_calib(tiny_release.ego_to_world(agent, frame), height=1.5)
    (folder / f"{name}_{frame:03d}.pkl").write_bytes(tiny_release.old_pickle(calib))
    os.utime(folder)


@pytest.mark.parametrize("name", CONFIGS)
def test_labels_of_every_configuration_come_back(
    da_motion: DeepAccident, tmp_path: Path, name: str
) -> None:
    config = CONFIGS[name]
    tokens = list_tokens(da_motion, 1, 27, agents=("ego_vehicle", "infrastructure"))
    write_labels(da_motion, tmp_path, tokens, config)

    files = LabelFiles(tmp_path)
    random.Random(0).shuffle(tokens)  # noqa: S311 - any order
    for token in tokens:
        assert_same_labels(files[token], motion_labels(da_motion, token, config))


@pytest.mark.parametrize(
    "name", ["clean, everybody, untracked too", "everybody", "quirks of one's own"]
)
def test_untracked_actors(small: DeepAccident, out: Path, name: str) -> None:
    """Each row is an instance without an actor, or all are actor −1."""
    config = replace(CONFIGS[name], filter_invisible=False)
    tokens = list_tokens(small, 1, 9, 12)
    write_labels(small, out, tokens, config)

    files = LabelFiles(out, config)
    for token in tokens:
        labels = files[token]
        assert_same_labels(labels, motion_labels(small, token, config))
        assert (-1 in labels.id_map) == config.rules.untracked_share_an_id


@pytest.mark.parametrize("count", [255, 256, 300])
def test_more_instances_than_a_byte_counts(tmp_path: Path, count: int) -> None:
    x, y = np.meshgrid(np.arange(20) * 4.5 - 45, np.arange(15) * 4.5 - 30)
    center = np.column_stack([x.ravel(), y.ravel(), np.zeros(300)])[:count]
    frame = FrameBoxes(
        center=center,
        size=np.tile([3.0, 3.0, 1.5], (count, 1)),
        yaw=np.zeros(count),
        actor_id=1000 + np.arange(count),
        category=np.zeros(count),
        visible=np.ones(count),
        ego_from_lidar=np.eye(4),
    )
    config = MotionLabelConfig(draw_ego=False)
    labels = motion_labels_from_boxes([frame] * 5, np.zeros((7, 6)), config)
    assert labels.instance.max() == count

    path = tmp_path / "one.npz"
    with zipfile.ZipFile(path, "w") as archive:
        StoredLabels.of(labels).write(archive, "007")
    with zipfile.ZipFile(path) as archive:
        stored = StoredLabels.read(archive, "007")

    assert stored.instance.dtype == (np.uint8 if count < 256 else np.uint16)
    assert_same_labels(stored.labels(config), labels)


def test_bytes_do_not_depend_on_time_workers_or_order(
    da_motion: DeepAccident, tmp_path: Path
) -> None:
    tokens = list_tokens(da_motion, 5, 30)
    records = [da_motion.get("sample", token) for token in tokens]

    write_labels(da_motion, tmp_path / "one", tokens)
    write_labels(da_motion, tmp_path / "two", tokens[::-1], workers=2)
    with ThreadPoolExecutor(2) as executor:
        write_label_files(da_motion, tmp_path / "three", [*records, *records], executor=executor)

    expected = read_files(tmp_path / "one")
    assert read_files(tmp_path / "two") == expected
    assert read_files(tmp_path / "three") == expected


@pytest.mark.parametrize("name", ["deepaccident", "oblong, as fiery"])
def test_the_lines_of_the_page_rebuild_the_maps(
    da_motion: DeepAccident, tmp_path: Path, name: str
) -> None:
    """The page's lines need only numpy and are exact, for a sample in the middle of a recording and
    for one with a future beyond its end.
    """
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("```python\n")
    lines, fence, _ = rest.partition("```")
    assert fence
    tokens = list_tokens(da_motion, 15, 27, agents=("other_vehicle",))
    write_labels(da_motion, tmp_path, tokens, CONFIGS[name])

    files = LabelFiles(tmp_path)
    for token in tokens:
        rebuilt = {"folder": str(tmp_path), "token": token}
        exec(compile(lines, PAGE, "exec"), rebuilt)  # noqa: S102 - our own page
        labels = files[token]
        for field in ("segmentation", "instance", "centerness", "offset", "flow"):
            assert_same_bytes(rebuilt[field], getattr(labels, field), field)


@pytest.mark.parametrize("name", get_args(BatchNames))
def test_the_loop_of_the_page_reads_batches(
    small: DeepAccident, out: Path, name: BatchNames
) -> None:
    _, _, rest = PAGE.read_text(encoding="utf-8").partition("A training loop")
    _, _, rest = rest.partition("```python\n")
    lines, _, _ = rest.partition("```")
    tokens = list_tokens(small, 3, 12)
    write_label_files(small, out, tokens, names=name, workers=1)

    namespace = {"folder": str(out)}
    exec(compile(lines, PAGE, "exec"), namespace)  # noqa: S102 - our own page

    stems = [path.relative_to(out).with_suffix("").as_posix() for path in namespace["paths"]]
    assert sorted(stems) == sorted(tokens)
    batch = namespace["batch"]
    expected = motion_labels(small, tokens[0]).as_batch(name)
    assert batch.keys() == expected.keys()
    for key, array in expected.items():
        assert batch[key].dtype == array.dtype
        assert batch[key].shape[1:] == array.shape


@pytest.mark.parametrize("name", get_args(BatchNames))
@pytest.mark.parametrize("config", ["deepaccident", "fiery", "clean", "oblong"])
def test_batches_of_every_code_and_sample(
    small: DeepAccident, out: Path, name: BatchNames, config: str
) -> None:
    tokens = list_tokens(small, 1, 12, agents=("ego_vehicle", "infrastructure"))

    report = write_label_files(small, out, tokens, CONFIGS[config], names=name, workers=1)

    assert report == LabelsWritten(samples=4, written=4, kept=0)
    for token in tokens:
        expected = motion_labels(small, token, CONFIGS[config]).as_batch(name)
        with np.load(out / f"{token}.npz", allow_pickle=False) as file:
            assert file.files == list(expected)
            for key, array in expected.items():
                assert_same_bytes(file[key], array, key)


def test_stopped_after_any_file_it_goes_on_there(
    small: DeepAccident, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = list_tokens(small, 3, 7, agents=("ego_vehicle", "infrastructure"))
    write_label_files(small, tmp_path / "fresh", tokens, names="fiery", workers=1)
    expected = read_files(tmp_path / "fresh")
    for stop in range(4):
        folder = tmp_path / f"{stop}"
        files_before_stop = iter(range(stop))

        @contextmanager
        def stop_replacing(
            path: Path, files_before_stop: Iterator[int] = files_before_stop
        ) -> Iterator[Path]:
            with replacing(path) as temporary:
                yield temporary
                if next(files_before_stop, None) is None:
                    raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(label_files, "replacing", stop_replacing)
            with pytest.raises(KeyboardInterrupt):
                write_label_files(small, folder, tokens, names="fiery", workers=1)

        report = write_label_files(small, folder, tokens, names="fiery", workers=1)
        assert report == LabelsWritten(samples=4, written=4 - stop, kept=stop)
        assert read_files(folder) == expected


def test_samples_can_be_added_and_damaged_files_are_made_again(
    small: DeepAccident, out: Path
) -> None:
    first = list_tokens(small, 2, agents=("ego_vehicle",))
    second = list_tokens(small, 7, agents=("ego_vehicle",))
    report = write_labels(small, out, first, names="beverse")
    assert report == LabelsWritten(samples=1, written=1, kept=0)
    report = write_labels(small, out, second, names="beverse")
    assert report.written == 1
    assert report.kept == 1

    before = read_files(out)
    path = out / f"{first[0]}.npz"
    path.write_bytes(path.read_bytes()[:-40])
    temporary_path(path).touch()  # of a killed process
    assert write_labels(small, out, second, names="beverse").written == 1
    assert read_files(out) == before


def test_folders_of_other_names_are_refused_and_left(small: DeepAccident, tmp_path: Path) -> None:
    tokens = list_tokens(small, 3)
    for names, other_names in ((None, "fiery"), ("fiery", "beverse"), ("beverse", None)):
        folder = tmp_path / str(names)
        write_labels(small, folder, tokens, names=names)
        before = read_files(folder)
        assert_raises(
            (
                partial(write_label_files, small, folder, tokens, names=other_names, workers=1),
                ConfigError,
                f"settings .names: {names!r}, asked for {other_names!r}.; choose another",
            ),
        )
        assert read_files(folder) == before
    assert_raises(
        (
            lambda: LabelFiles(tmp_path / "fiery"),
            LabelFilesError,
            r"contains batches of fiery, which np\.load opens .* without --names on",
        ),
        (
            lambda: write_label_files(small, tmp_path / "lss", tokens, names="lss"),
            ChoiceError,
            "expected one of fiery, beverse, deepaccident, or None, found 'lss'",
        ),
    )


def test_whole_files_are_kept_and_fewer_samples_remove_nothing(
    small: DeepAccident, out: Path
) -> None:
    all_agents = list_tokens(small, 2, 7)
    ego = list_tokens(small, 7, 12, agents=("ego_vehicle",))
    report = write_labels(small, out, all_agents)
    assert report == LabelsWritten(samples=10, written=5, kept=0)
    report = write_labels(small, out, ego)
    assert report == LabelsWritten(samples=2, written=1, kept=0)

    before = read_files(out)
    report = write_labels(small, out, all_agents[:1])
    assert report == LabelsWritten(samples=1, written=0, kept=1)
    report = write_labels(small, out, all_agents)
    assert report == LabelsWritten(samples=10, written=0, kept=5)
    assert read_files(out) == before

    files = LabelFiles(out)
    assert set(files) == {*all_agents, *ego}
    for token in files:
        assert_same_labels(files[token], motion_labels(small, token))


@pytest.mark.parametrize("names", [None, "fiery"])
def test_files_are_made_again_if_the_release_changed(
    root: Path, out: Path, names: BatchNames | None
) -> None:
    """A label row of an agent that is not asked for changes, then a LiDAR's pose, then nothing."""
    tokens = list_tokens(open_release(root), 1, agents=("ego_vehicle", "infrastructure"))
    write_labels(open_release(root), out, tokens, names=names)

    change_label(root, "other_vehicle")
    report = write_labels(open_release(root), out, tokens, names=names)
    assert report == LabelsWritten(samples=2, written=2, kept=0)

    raise_lidar(root, "ego_vehicle")
    assert write_labels(open_release(root), out, tokens, names=names).written == 2
    assert write_labels(open_release(root), out, tokens, names=names).written == 0


def test_a_file_depends_only_on_the_rows_of_its_own_scenario(tmp_path: Path, out: Path) -> None:
    """One scenario has a single frame, the other two frames and no boxes in the first; each change
    makes only its own file again.
    """
    frames_by_name = {
        tiny_release.SCENARIO_NAME: 1,
        tiny_release.SCENARIO_NAME.replace("24", "25"): 2,
    }
    for name, last_frame in frames_by_name.items():

        def make_last_lines(agent: str, frame: int, last_frame: int = last_frame) -> list[str]:
            return tiny_release.label_lines(agent, frame) if frame == last_frame else ["0 0"]

        tiny_release.write_tiny_release(
            tmp_path,
            frames=last_frame,
            name=name,
            agents=("infrastructure",),
            lines_of=make_last_lines,
        )
    tokens = [f"{tiny_release.SCENARIO_TYPE}/{name}/infrastructure/001" for name in frames_by_name]
    write_labels(open_release(tmp_path), out, tokens)

    for name, last_frame in frames_by_name.items():
        for change in (change_label, raise_lidar):
            before = read_files(out)
            change(tmp_path, "infrastructure", name, last_frame)
            report = write_labels(open_release(tmp_path), out, tokens)
            assert report == LabelsWritten(samples=2, written=1, kept=1)
            after = read_files(out)
            changed_paths = [path for path, content in after.items() if content != before[path]]
            assert changed_paths == [f"{tiny_release.SCENARIO_TYPE}/{name}/infrastructure.npz"]


def test_another_configuration_leaves_the_folder_as_it_is(small: DeepAccident, out: Path) -> None:
    tokens = list_tokens(small, 3)
    write_labels(small, out, tokens)
    before = read_files(out)
    unshifted = replace(LABEL_PROTOCOLS["released"], half_cell_shift=False)
    for difference, config in {
        "draw_ego: True, asked for False": MotionLabelConfig(draw_ego=False),
        "half_cell_shift: True, asked for False": MotionLabelConfig(protocol=unshifted),
        "agents: None, asked for 'single'": MotionLabelConfig(agents="single"),
        "orientation: 'devkit', asked for 'released'": MotionLabelConfig(orientation="released"),
    }.items():
        assert_raises(
            (
                partial(write_labels, small, out, tokens, config),
                ConfigError,
                f"other settings .*{difference}.*choose another folder",
            ),
            (partial(LabelFiles, out, config), ConfigError, difference),
        )
    assert read_files(out) == before


def test_folders_that_are_something_else(small: DeepAccident, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("mine")
    (tmp_path / "odd" / MANIFEST).mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    tokens = list_tokens(small, 3)

    no_room = "cannot be written .*; free space there, or choose another folder"
    for folder, message in {
        "": "found an empty path; give '.' for the current one",
        tmp_path / "file": "file: is a file; give a folder",
        tmp_path
        / "photos": "photos: is not empty and contains no motion labels; choose a new folder",
        tmp_path / "odd": r"manifest.json: not a regular file \(a folder\)",
        tmp_path / "file" / "below": f"below: {no_room}",
        "/proc/nowhere": f"nowhere: {no_room}",
    }.items():
        assert_raises(
            (partial(write_label_files, small, folder, tokens), LabelFilesError, message),
        )
    assert read_files(tmp_path / "photos") == {"cat.jpg": b"mine"}

    for name in ("nowhere", "empty", "photos", "file"):
        assert_raises(
            (
                partial(LabelFiles, tmp_path / name),
                LabelFilesError,
                r"contains no motion labels .*make them with `deepaccident labels`",
            ),
        )
    assert write_labels(small, tmp_path / "empty", tokens).written == 5


def test_what_cannot_be_drawn_is_refused_before_anything_is_written(
    root: Path, tmp_path: Path, out: Path
) -> None:
    small = open_release(root)
    unlabelled = open_release(tiny_release.write_tiny_release(tmp_path / "test", labelled=False))
    two_agents = open_release(
        tiny_release.write_tiny_release(tmp_path / "two", agents=("ego_vehicle", "infrastructure"))
    )
    tokens = list_tokens(small, 3)
    assert_raises(
        (
            lambda: write_labels(
                two_agents, out, list_tokens(two_agents, 3), MotionLabelConfig(agents="+other")
            ),
            NotAvailableError,
            "other_vehicle is not in this release",
        ),
        (
            lambda: write_labels(unlabelled, out, list_tokens(unlabelled, 3)),
            NotAvailableError,
            "ego_vehicle/003 has no label",
        ),
        (
            lambda: write_labels(small, out, [*tokens, "nothing"]),
            TokenError,
            "no token 'nothing'",
        ),
        (
            lambda: write_labels(small, out, []),
            ChoiceError,
            "expected at least one sample, found none",
        ),
        (
            lambda: write_label_files(small, out, tokens[0]),
            ChoiceError,
            "put it into a list",
        ),
        (
            lambda: write_label_files(small, out, small.sample[3]),
            ChoiceError,
            "put it into a list",
        ),
    )
    assert not out.exists()


def assert_refused_and_kept(dataset: DeepAccident, folder: Path, message: str) -> None:
    """Assert that a folder of labels can neither be read nor written, and is left as it is."""
    before = read_files(folder)
    assert_raises(
        (lambda: LabelFiles(folder), LabelFilesError, message),
        (
            lambda: write_labels(dataset, folder, list_tokens(dataset, 3)),
            LabelFilesError,
            message,
        ),
    )
    assert read_files(folder) == before


class TestReading:
    @pytest.fixture
    def files(self, da_motion: DeepAccident, tmp_path: Path) -> LabelFiles:
        write_labels(da_motion, tmp_path / "labels", list_tokens(da_motion, 4, 19))
        return LabelFiles(tmp_path / "labels")

    def test_it_is_a_mapping_by_token(self, files: LabelFiles, da_motion: DeepAccident) -> None:
        tokens = list_tokens(da_motion, 4, 19)
        assert list(files) == tokens
        assert all(token in files for token in tokens)

        recording = tokens[0].removesuffix("/004")
        numbers = ("4", "0004", "005", "٠٠٤", "-04", "+04", " 04", "", "004/")
        for absent in (
            *(f"{recording}/{number}" for number in numbers),
            recording,
            f"/{tokens[0]}",
            "",
            4,
            None,
            da_motion.get("sample", tokens[0]),
        ):
            assert absent not in files
            with pytest.raises(
                TokenError, match=r"has no labels of .*; `deepaccident labels` can add them"
            ):
                files[absent]

    def test_threads_and_spawned_processes_read_the_same(self, files: LabelFiles) -> None:
        tokens = random.Random(1).choices(list(files), k=60)  # noqa: S311
        expected = {token: files[token] for token in files}

        with ThreadPoolExecutor(8) as threads:
            for token, labels in zip(tokens, threads.map(files.__getitem__, tokens), strict=True):
                assert_same_labels(labels, expected[token])

        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
            labels = processes.submit(operator.getitem, files, tokens[0]).result()
        assert_same_labels(labels, expected[tokens[0]])

        copied_files = pickle.loads(pickle.dumps(files))
        assert_same_labels(copied_files[tokens[1]], expected[tokens[1]])


class TestDamage:
    @pytest.fixture
    def folder(self, small: DeepAccident, out: Path) -> Path:
        write_labels(small, out, list_tokens(small, 3, 7, agents=("ego_vehicle",)))
        return out

    @pytest.fixture
    def path(self, folder: Path) -> Path:
        return folder / f"{tiny_release.SCENARIO_TOKEN}" / "ego_vehicle.npz"

    def test_any_byte_of_a_file(self, small: DeepAccident, folder: Path, path: Path) -> None:
        """Whatever byte is changed, a reader gets the labels or the devkit's error."""
        token = list_tokens(small, 3)[0]
        expected = LabelFiles(folder)[token]
        whole = path.read_bytes()
        generator = random.Random(2)  # noqa: S311
        messages = []
        for _ in range(150):
            anywhere = generator.randrange(len(whole))
            near_the_end = -generator.randrange(1, 700)
            content = bytearray(whole)
            content[generator.choice([anywhere, near_the_end])] ^= generator.randrange(1, 256)
            path.write_bytes(content)
            try:
                assert_same_labels(LabelFiles(folder)[token], expected)
            except LabelFilesError as error:
                messages.append(str(error))
        assert len(messages) > 20
        assert messages[-1].startswith(f"{path}: ")
        assert messages[-1].endswith("; remove it and run `deepaccident labels` again")

    @pytest.mark.parametrize("keep", [0, 1, 500, -1, None])
    def test_a_file_cut_short_or_gone_is_made_again(
        self, small: DeepAccident, folder: Path, path: Path, keep: int | None
    ) -> None:
        before = read_files(folder)
        tokens = list(LabelFiles(folder))
        if keep is None:
            path.unlink()
        else:
            path.write_bytes(path.read_bytes()[:keep])

        files = LabelFiles(folder)
        for token in tokens:
            with pytest.raises(LabelFilesError, match=r"ego_vehicle\.npz.*; remove it and run"):
                files[token]

        report = write_labels(small, folder, tokens[:1])
        assert report == LabelsWritten(samples=1, written=1, kept=0)
        assert read_files(folder) == before
        assert_same_labels(files[tokens[1]], motion_labels(small, tokens[1]))

    def test_a_file_of_another_folder(
        self, small: DeepAccident, folder: Path, path: Path, tmp_path: Path
    ) -> None:
        token = list_tokens(small, 3)[0]
        write_labels(small, tmp_path / "clean", [token], MotionLabelConfig(protocol="clean"))
        shutil.copy(tmp_path / "clean" / path.relative_to(folder), path)
        assert_raises(
            (
                lambda: LabelFiles(folder)[token],
                LabelFilesError,
                "contains labels with other settings; remove it",
            ),
        )
        assert write_labels(small, folder, [token]).written == 1
        assert_same_labels(LabelFiles(folder)[token], motion_labels(small, token))

    @pytest.mark.parametrize(
        "member", ["instance", "center", "flow", "actor", "future_egomotion", "valid"]
    )
    def test_arrays_that_cannot_be_the_samples(
        self, small: DeepAccident, path: Path, folder: Path, member: str
    ) -> None:
        changed_name = f"003/{member}.npy"
        with zipfile.ZipFile(path) as archive:
            contents = {name: archive.read(name) for name in archive.namelist()}
            with archive.open(changed_name) as file:
                array = np.lib.format.read_array(file)
        del contents[changed_name]
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in contents.items():
                archive.writestr(name, content)
            with archive.open(changed_name, "w") as file:
                np.lib.format.write_array(file, array[:-1])

        assert_raises(
            (
                lambda: LabelFiles(folder)[list_tokens(small, 3)[0]],
                LabelFilesError,
                r"ego_vehicle\.npz: .*expected .*found",
            ),
        )

    @pytest.mark.parametrize(
        "text",
        [
            "",
            "{",
            "[]",
            "null",
            "3",
            "\0",
            "[" * 100_000,
            "\xff",
            '{"format": "DeepAccident motion labels"}',
        ],
    )
    def test_a_manifest_that_is_none(self, small: DeepAccident, folder: Path, text: str) -> None:
        (folder / MANIFEST).write_text(text, encoding="latin-1")
        message = r"manifest\.json: cannot be read .*; make the labels again in an"
        assert_refused_and_kept(small, folder, message)

    @pytest.mark.parametrize(
        "change",
        [
            {"format": "something"},
            {"version": "1"},
            {"version": None},
            {"config": {}},
            {"config": None},
            {"config_digest": "0" * 16},
            {"names": "lss"},
            {"names": []},
            {"samples": []},
            {"samples": {"a/b/ego_vehicle": 3}},
            {"samples": {"a/b/ego_vehicle": [0]}},
            {"samples": {"a/b/ego_vehicle": [True]}},
            {"samples": {"a/b/ego_vehicle": ["3"]}},
            {"samples": {"a/b/nobody": [3]}},
            {"samples": {"../../ego_vehicle": [3]}},
            {"samples": {"/etc/ego_vehicle": [3]}},
        ],
    )
    def test_a_manifest_with_a_wrong_value(self, folder: Path, change: dict[str, object]) -> None:
        change_manifest(folder, **change)
        assert_raises(
            (lambda: LabelFiles(folder), LabelFilesError, r"manifest\.json: cannot be read")
        )

    def test_a_manifest_that_is_a_pipe_or_a_giant(self, folder: Path) -> None:
        path = folder / MANIFEST
        content = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        assert_raises(
            (lambda: LabelFiles(folder), LabelFilesError, r"not a regular file \(a named pipe\)"),
        )
        path.unlink()
        with path.open("wb") as file:
            file.truncate(3 << 30)
        assert_raises(
            (lambda: LabelFiles(folder), LabelFilesError, "has 3,221,225,472 bytes"),
        )
        path.write_bytes(content)
        config = MotionLabelConfig(grid=BevGrid((-1000.0, 1000.0, 0.1), (-1000.0, 1000.0, 0.1)))
        change_manifest(folder, config=config.as_dict(), config_digest=config.digest)
        assert_raises(
            (lambda: LabelFiles(folder), LabelFilesError, "a sample takes 32,000,000,000 bytes"),
        )

    @pytest.mark.parametrize(
        ("version", "kind"), [(LABEL_FORMAT_VERSION + 1, "newer"), (0, "older")]
    )
    def test_another_devkits_labels_are_refused_and_kept(
        self, small: DeepAccident, folder: Path, version: int, kind: str
    ) -> None:
        change_manifest(folder, version=version, new=1)
        message = (
            rf"{kind} devkit's labels \(format version {version}, this devkit's is "
            rf"{LABEL_FORMAT_VERSION}\); .* or make"
        )
        assert_refused_and_kept(small, folder, message)


FULL = """
import resource, sys
from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import LabelFilesError
from deepaccident_devkit.motion import write_label_files

release = DeepAccident(dataroot=sys.argv[1], verbose=False, workers=1)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[3]),) * 2)
try:
    write_label_files(release, sys.argv[2], [record["token"] for record in release.sample], workers=1)
except LabelFilesError as error:
    print(error)
"""  # noqa: E501


def run_script(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=300, check=False, env=environment
    )


def test_a_full_disk(root: Path, out: Path) -> None:
    small = open_release(root)
    for limit_bytes, files_written in ((100, 0), (12_000, 1)):
        process = run_script(FULL, root, out, limit_bytes)
        assert "labels: cannot be written ([Errno 27]" in process.stdout, process.stderr
        assert (
            "free space there, or choose another folder, and run the command again"
            in process.stdout
        )
        files = read_files(out)
        assert len(files) == files_written, files.keys()

    write_labels(small, out, list_tokens(small, 3))
    assert len(LabelFiles(out)) == 5


def list_two_agents(release: DeepAccident, *frames: int) -> list[str]:
    """List the samples of two agents, of the frames 2 and 4 unless others are given."""
    return list_tokens(release, *(frames or (2, 4)), agents=("ego_vehicle", "infrastructure"))


@pytest.fixture(scope="module")
def whole(da_b: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Write the frames 2 and 4 of six scenarios in one call."""
    folder = tmp_path_factory.mktemp("labels")
    write_labels(da_b, folder, list_two_agents(da_b))
    return read_files(folder)


def test_several_calls_share_the_scenarios(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes]
) -> None:
    tokens = list_two_agents(da_b)

    with ThreadPoolExecutor(3) as threads:
        calls = [threads.submit(write_labels, da_b, out, tokens) for _ in range(3)]
        reports = [call.result() for call in calls]

    assert sum(report.written for report in reports) == 12
    for report in reports:
        assert report.samples == 24
        assert report.written + report.kept == 12
    assert read_files(out) == whole


def test_nothing_is_listed_before_the_labels_are_complete(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes]
) -> None:
    """What a killed process has begun is removed too, unless other processes are at work."""
    store = label_store(out, "")
    with store.shared():
        LabelManifest(MotionLabelConfig(), {}).write(out)
        assert_raises(
            (lambda: LabelFiles(out), LabelFilesError, "its labels are not complete"),
        )

    unfinished = temporary_path(out / "manifest.json")
    unfinished.touch()
    assert write_labels(da_b, out, list_two_agents(da_b)).written == 12
    assert not unfinished.exists()
    assert read_files(out) == whole


def test_what_fails_is_listed_and_the_rest_is_done(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = list_two_agents(da_b)
    broken = list_two_agents(da_b, 4)[3]
    draw_labels = label_files.motion_labels_of

    def fail_once(
        dataset: DeepAccident, tokens: list[str], *arguments: object
    ) -> Iterator[MotionLabels]:
        if broken in tokens:
            raise NotAvailableError("nothing to see")
        return draw_labels(dataset, tokens, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(label_files, "motion_labels_of", fail_once)
        assert_raises(
            (
                lambda: write_labels(da_b, out, tokens),
                SomeFailedError,
                rf"1 of 12 failed:\n  {broken[:-4]}: nothing to see\n",
            ),
        )
    assert len(list(out.rglob("*.npz"))) == 11

    report = write_labels(da_b, out, tokens)
    assert report == LabelsWritten(samples=24, written=1, kept=11)
    assert read_files(out) == whole
