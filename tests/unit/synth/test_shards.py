"""Releases made on executors and in shards: the very bytes of one call, whatever was interrupted."""

import shutil
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest

from deepaccident_devkit.errors import ConfigError, UnfinishedError
from deepaccident_devkit.files import held_lock, temporary_path
from deepaccident_devkit.parallel import MERGE, Part
from deepaccident_devkit.synth import SynthConfig, generate, make_release
from deepaccident_devkit.synth.unfinished import Unfinished, unfinished_release

CONFIG = SynthConfig(scenarios=3, frames=2, sensors=False, seed=7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, digests) -> dict[str, bytes]:
    return digests(make_release(tmp_path_factory.mktemp("whole") / "out", CONFIG, workers=1))


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def unfinished(tmp_path) -> Unfinished:
    return Unfinished(tmp_path / ".out.unfinished")


@pytest.fixture
def recorded(monkeypatch) -> list[str]:
    """The parts that are recorded in this process, in order."""
    names: list[str] = []
    record = generate.record_scenario

    def record_and_tell(job):
        names.append(job.root.name)
        record(job)

    monkeypatch.setattr(generate, "record_scenario", record_and_tell)
    return names


def make(out: Path, part: Part | str = None, config: SynthConfig = CONFIG) -> Path:
    return make_release(out, config, workers=1, part=part)


@pytest.mark.slow
def test_an_executor_makes_the_same_bytes(out, whole, digests):
    with ThreadPoolExecutor(2) as executor:
        assert digests(make_release(out, CONFIG, executor=executor)) == whole
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["threads", "processes"])
def test_an_executor_makes_the_same_images(tmp_path, release_root, config, digests, kind):
    """Threads of one process are at several scenarios at once, and at several parts of one."""
    pools = {
        "threads": lambda: ThreadPoolExecutor(3),
        "processes": lambda: ProcessPoolExecutor(2, mp_context=get_context("spawn")),
    }
    with pools[kind]() as executor:
        made = make_release(tmp_path / "out", config, executor=executor)
    assert digests(made) == digests(release_root)


@pytest.mark.parametrize("count", [pytest.param(1, marks=pytest.mark.slow), 3, pytest.param(8, marks=pytest.mark.slow)])
def test_shards_make_the_same_bytes(out, whole, digests, recorded, count):
    for number in range(count, 0, -1):
        assert make(out, f"{number}/{count}") == out
        assert not out.exists()
    assert len(recorded) == 3
    assert digests(make(out, MERGE)) == whole
    assert len(recorded) == 3
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
def test_shards_with_images_make_the_same_bytes(tmp_path, release_root, config, digests):
    for part in ("2/2", "1/2", MERGE):
        make(tmp_path / "out", part, config)
    assert digests(tmp_path / "out") == digests(release_root)


@pytest.mark.slow
def test_nothing_is_merged_while_a_part_is_missing(out, unfinished, whole, digests, recorded):
    make(out, "1/3")
    make(out, "3/3")
    with pytest.raises(UnfinishedError, match=r"out: 1 of 3 are not done, such as type1_subtype1_normal_.*_1of1; run"):
        make(out, MERGE)
    assert not out.exists()
    assert len(unfinished.made()) == 2
    assert digests(make(out)) == whole
    assert len(recorded) == 3


def test_a_merge_of_nothing_leaves_nothing(out):
    with pytest.raises(UnfinishedError, match="3 of 3 are not done"):
        make(out, MERGE)
    assert list(out.parent.iterdir()) == []


def test_an_empty_folder_costs_no_shard(out, unfinished):
    out.mkdir()
    make(out, "1/3")
    with pytest.raises(UnfinishedError, match="2 of 3"):
        make(out, MERGE)
    assert len(unfinished.made()) == 1


def test_shards_of_another_configuration_are_not_merged(out, unfinished):
    make(out, "1/2")
    for part in ("2/2", MERGE, None):
        with pytest.raises(ConfigError, match=r"another configuration \(seed: 7 there, 8 asked for\)"):
            make(out, part, replace(CONFIG, seed=8))
    assert len(unfinished.made()) == 2


@pytest.mark.slow
def test_a_part_that_was_cut_off_is_recorded_again_and_no_other(out, unfinished, whole, digests, recorded):
    """As a killed worker leaves it: with files, some half-written, and without a note."""
    make(out, "1/2")
    cut, kept = sorted(unfinished.made())
    (unfinished.folder / "made" / cut).unlink()
    shutil.rmtree(next(unfinished.part(cut).rglob("calib")))
    for name in (cut, kept):
        temporary_path(next(unfinished.part(name).rglob("*_001.txt"))).touch()
    del recorded[:]
    make(out, "1/2")
    make(out, "1/2")
    assert recorded == [cut]
    make(out, "2/2")
    assert digests(make(out, MERGE)) == whole


@pytest.mark.slow
def test_a_part_is_left_alone_while_somebody_is_at_it(out, unfinished, whole, digests, recorded, caplog):
    """A worker that a scheduler takes for lost ends its part; who is sent for it then waits, and finds it made."""
    make(out, "1/1")
    name = min(unfinished.made())
    del recorded[:]
    with ThreadPoolExecutor(1) as executor:
        with unfinished.alone(name):
            (unfinished.folder / "made" / name).unlink()
            other = executor.submit(make, out, "1/1")
            while "another process records" not in caplog.text:
                assert not other.done()
            unfinished.note(name)
        other.result()
    assert recorded == []
    assert digests(make(out, MERGE)) == whole


def test_a_worker_whose_caller_was_stopped_marks_nothing_in_what_comes_later(out, unfinished, monkeypatch):
    """It may be at the first part: then the folder stays; and what was removed under it is not taken for made."""
    with unfinished_release(out, CONFIG, shared=True):
        pass
    monkeypatch.setattr(generate, "record_scenario", lambda _: 1 / 0)
    with unfinished.alone("a part"):
        with pytest.raises(ZeroDivisionError):
            make(out)
        assert unfinished.folder.exists()
        shutil.rmtree(unfinished.folder)
        with pytest.raises(ConfigError, match="was removed while parts of the release were recorded; make it again"):
            unfinished.note("a part")
    with pytest.raises(ConfigError, match="was removed"), unfinished.alone("a part"):
        pass
    assert not unfinished.folder.exists()


@pytest.mark.parametrize(("shared", "part"), [(False, None), (False, "1/2"), (True, None), (True, MERGE)])
def test_whoever_makes_the_whole_or_merges_is_alone(out, unfinished, shared, part):
    lock = held_lock(unfinished.folder / ".lock", "makes the release", shared=shared)
    with pytest.raises(ConfigError, match="another process is making it; wait for that one"):
        make(out, part)
    lock.release()
    assert not out.exists()


def test_several_processes_make_shards(out, unfinished):
    lock = held_lock(unfinished.folder / ".lock", "makes the release", shared=True)
    make(out, "1/3")
    lock.release()
    assert len(unfinished.made()) == 1
