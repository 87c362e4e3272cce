"""Labels written on executors and by several processes: the very bytes of one call."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import LabelFilesError, NotAvailableError, SomeFailedError
from deepaccident_devkit.motion import (
    LabelFiles,
    LabelsWritten,
    MotionLabelConfig,
    MotionLabels,
    label_files,
    write_label_files,
)
from deepaccident_devkit.motion.label_folder import Manifest, label_store
from deepaccident_devkit.support.files import temporary_path


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def tokens_of(release: DeepAccident, *frames: int) -> list[str]:
    ends = tuple(f"/{agent}/{frame:03d}" for agent in ("ego_vehicle", "infrastructure") for frame in frames)
    return [record["token"] for record in release.sample if record["token"].endswith(ends)]


@pytest.fixture(scope="module")
def whole(da_b: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What one call writes for the frames 2 and 4 of six scenarios."""
    folder = tmp_path_factory.mktemp("labels")
    write_label_files(da_b, folder, tokens_of(da_b, 2, 4), workers=1)
    return contents(folder)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "labels"


def write(release: DeepAccident, folder: Path, *frames: int) -> LabelsWritten:
    return write_label_files(release, folder, tokens_of(release, *(frames or (2, 4))), workers=1)


def test_an_executor_writes_the_same_bytes(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    with ThreadPoolExecutor(3) as executor:
        done = write_label_files(da_b, out, tokens_of(da_b, 2, 4), executor=executor)
    assert (done, contents(out)) == (LabelsWritten(samples=24, written=12, kept=0), whole)


def test_several_calls_share_the_scenarios(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    with ThreadPoolExecutor(3) as threads:
        done = list(threads.map(lambda _: write(da_b, out), range(3)))
    assert sum(each.written for each in done) == 12
    assert ({(each.samples, each.written + each.kept) for each in done}, contents(out)) == ({(24, 12)}, whole)


def test_calls_for_other_samples_take_turns(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda frame: write(da_b, out, frame), (4, 2)))
    assert (len(LabelFiles(out)), contents(out)) == (24, whole)


def test_nothing_is_listed_before_all_is_there(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    """And what a killed process has begun is removed, unless others are at work."""
    store = label_store(out, "")
    with store.shared():
        Manifest(MotionLabelConfig(), {}).write(out)
        assert_refused(
            (lambda: LabelFiles(out), LabelFilesError, "its labels are not complete"),
        )
    begun = temporary_path(out / "manifest.json")
    begun.touch()
    assert write(da_b, out).written == 12
    assert not begun.exists()
    assert contents(out) == whole


def test_files_that_were_cut_off_are_written_again(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    write(da_b, out)
    path = next(out.rglob("*.npz"))
    path.write_bytes(path.read_bytes()[:-1])
    assert (write(da_b, out), contents(out)) == (LabelsWritten(samples=24, written=1, kept=11), whole)


def test_what_fails_is_listed_and_the_rest_is_done(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    made, broken = label_files.motion_labels, tokens_of(da_b, 4)[3]

    def fail_once(dataset: DeepAccident, token: str, *more: object) -> MotionLabels:
        if token == broken:
            raise NotAvailableError("nothing to see")
        return made(dataset, token, *more)

    with monkeypatch.context() as patch:
        patch.setattr(label_files, "motion_labels", fail_once)
        assert_refused(
            (lambda: write(da_b, out), SomeFailedError, rf"1 of 12 failed:\n  {broken[:-4]}: nothing to see\n"),
        )
    assert (len(list(out.rglob("*.npz"))), write(da_b, out)) == (11, LabelsWritten(samples=24, written=1, kept=11))
    assert contents(out) == whole
