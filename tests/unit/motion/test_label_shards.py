"""Labels written on executors and in shards: the very bytes of one call, and nothing listed before all are there."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from click.testing import CliRunner

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import LabelFilesError, NotAvailableError, SomeFailedError, UnfinishedError
from deepaccident_devkit.files import temporary_path
from deepaccident_devkit.motion import LabelFiles, LabelsWritten, MotionLabels, label_files, write_label_files
from deepaccident_devkit.motion.label_folder import writing_to
from deepaccident_devkit.parallel import MERGE, Part, Shard


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
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


def write(release: DeepAccident, folder: Path, part: Part | str, *frames: int) -> LabelsWritten:
    return write_label_files(release, folder, tokens_of(release, *(frames or (2, 4))), workers=1, part=part)


def test_an_executor_writes_the_same_bytes(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    with ThreadPoolExecutor(3) as executor:
        done = write_label_files(da_b, out, tokens_of(da_b, 2, 4), executor=executor)
    assert done == LabelsWritten(samples=24, written=12, kept=0)
    assert contents(out) == whole


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)])
def test_shards_make_the_same_bytes(da_b: DeepAccident, out: Path, whole: dict[str, bytes], count: int) -> None:
    done = [write(da_b, out, f"{number}/{count}") for number in range(count, 0, -1)]
    assert (sum(each.samples for each in done), sum(each.written for each in done)) == (24, 12)
    with pytest.raises(LabelFilesError, match="its labels are not complete"):
        LabelFiles(out)
    assert write(da_b, out, MERGE) == LabelsWritten(samples=24, written=0, kept=12)
    assert contents(out) == whole


def test_a_shard_has_all_agents_of_its_scenarios(da_b: DeepAccident, out: Path) -> None:
    write(da_b, out, Shard(2, 3))
    scenarios = [record["token"] for record in da_b.scenario][1::3]
    assert {path.parent.relative_to(out).as_posix() for path in out.rglob("*.npz")} == set(scenarios)
    assert len(list(out.rglob("*.npz"))) == 2 * len(scenarios)


def test_batches_of_other_codes_can_be_merged(da_b: DeepAccident, tmp_path: Path) -> None:
    tokens = tokens_of(da_b, 2)[::3]
    for folder, parts in (("one", (None,)), ("shards", ("1/2", "2/2", MERGE))):
        for part in parts:
            write_label_files(da_b, tmp_path / folder, tokens, names="fiery", part=part, workers=1)
    assert contents(tmp_path / "one") == contents(tmp_path / "shards")


def test_nothing_is_listed_while_a_shard_is_missing(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    write(da_b, out, "1/3")
    write(da_b, out, "3/3")
    with monkeypatch.context() as patch:
        patch.setattr(label_files, "motion_labels", lambda *_: pytest.fail("labels are made"))
        with pytest.raises(UnfinishedError, match=r"labels: 4 of 12 are not done, such as .*ego_vehicle\.npz; run"):
            write(da_b, out, MERGE)
    with pytest.raises(LabelFilesError, match="its labels are not complete"):
        LabelFiles(out)
    assert write(da_b, out, None) == LabelsWritten(samples=24, written=4, kept=8)
    assert contents(out) == whole


def test_files_of_other_samples_or_cut_off_are_not_merged(
    da_b: DeepAccident, out: Path, whole: dict[str, bytes]
) -> None:
    write(da_b, out, "1/2", 2)
    write(da_b, out, "2/2")
    with pytest.raises(UnfinishedError, match="6 of 12 are not done"):
        write(da_b, out, MERGE)
    assert write(da_b, out, "1/2").written == 6
    path = next(out.rglob("*.npz"))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(UnfinishedError, match="1 of 12 are not done"):
        write(da_b, out, MERGE)
    assert (write(da_b, out, "1/2").written, write(da_b, out, "2/2").written) in ((1, 0), (0, 1))
    write(da_b, out, MERGE)
    assert contents(out) == whole


def test_samples_can_be_added_in_shards(da_b: DeepAccident, out: Path, whole: dict[str, bytes]) -> None:
    for frame in (4, 2):
        for part in ("2/2", "1/2", MERGE):
            write(da_b, out, part, frame)
    assert len(LabelFiles(out)) == 24
    assert contents(out) == whole


def test_several_shards_write_at_once_and_leave_what_others_have_begun(da_b: DeepAccident, out: Path) -> None:
    write(da_b, out, "1/2")
    with writing_to(out, shared=True):
        begun = temporary_path(next(out.rglob("*.npz")))
        begun.touch()
        assert write(da_b, out, "1/2").written == 0
        assert write(da_b, out, "2/2").written == 6
        assert begun.exists()
    write(da_b, out, MERGE)
    assert not begun.exists()


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
        with pytest.raises(SomeFailedError, match=rf"1 of 12 failed:\n  {broken[:-4]}: nothing to see\n"):
            write(da_b, out, None)
    assert len(list(out.rglob("*.npz"))) == 11
    assert write(da_b, out, None) == LabelsWritten(samples=24, written=1, kept=11)
    assert contents(out) == whole


def test_the_verb_writes_shards_and_merges_them(da_b: DeepAccident, tmp_path: Path) -> None:
    command = ["labels", str(da_b.dataroot), "--split", "val", "--workers", "1", "--out"]
    for folder, parts in (("one", ((),)), ("parts", (("--shard", "1/2"), ("--shard", "2/2"), ("--merge",)))):
        for part in parts:
            result = CliRunner().invoke(deepaccident, [*command, str(tmp_path / folder), *part])
            assert result.exit_code == 0, result.output
            assert ("; next: the same with --merge" in result.stdout) == ("--shard" in part)
    assert contents(tmp_path / "one") == contents(tmp_path / "parts")
