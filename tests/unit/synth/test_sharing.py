"""Releases made on executors and by several processes: the very bytes of one call, whatever was interrupted."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.support.files import temporary_path
from deepaccident_devkit.synth import SynthConfig, generate, make_release
from deepaccident_devkit.synth.generate import Unfinished

CONFIG = SynthConfig(scenarios=3, frames=2, sensors=False, seed=7)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, digests) -> dict[str, bytes]:
    return digests(make_release(tmp_path_factory.mktemp("whole") / "out", CONFIG, workers=1))


@pytest.fixture
def out(tmp_path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def unfinished(tmp_path) -> Unfinished:
    return Unfinished(tmp_path / "out")


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


@pytest.fixture
def stop_at(monkeypatch):
    """Stop as Ctrl-C does, once so many parts are recorded."""
    record = generate.record_scenario

    def stop(out: Path, count: int, config: SynthConfig = CONFIG) -> None:
        left = iter(range(count))

        def record_or_stop(job):
            if next(left, None) is None:
                raise KeyboardInterrupt
            record(job)

        with monkeypatch.context() as patch:
            patch.setattr(generate, "record_scenario", record_or_stop)
            with pytest.raises(KeyboardInterrupt):
                make(out, config)

    return stop


def make(out: Path, config: SynthConfig = CONFIG) -> Path:
    return make_release(out, config, workers=1)


@pytest.mark.slow
def test_an_executor_makes_the_same_bytes(out, whole, digests):
    with ThreadPoolExecutor(2) as executor:
        assert digests(make_release(out, CONFIG, executor=executor)) == whole
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_several_calls_share_the_parts(out, whole, digests, recorded):
    def make_or_come_late(_: int) -> Path | None:
        try:
            return make(out)
        except ConfigError as error:
            assert "exists and is not an empty folder" in str(error)  # noqa: PT017 - it began when all was done
            return None

    with ThreadPoolExecutor(3) as threads:
        made = list(threads.map(make_or_come_late, range(3)))
    assert out in made
    assert sorted(recorded) == sorted(set(recorded))
    assert len(recorded) == 3
    assert digests(out) == whole
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.slow
def test_several_calls_share_a_scenario_with_images(tmp_path, release_root, config, digests):
    with ThreadPoolExecutor(2) as threads:
        list(threads.map(lambda _: make(tmp_path / "out", config), range(2)))
    assert digests(tmp_path / "out") == digests(release_root)


def test_what_broke_off_goes_on(out, unfinished, whole, digests, recorded, stop_at):
    """Of a part that was cut off some files are there, some half-written, and no note."""
    stop_at(out, 2)
    assert not out.exists()
    del recorded[:]
    cut, kept = sorted(path.name for path in (unfinished.folder / "kept").iterdir())
    (unfinished.folder / "kept" / cut).unlink()
    shutil.rmtree(next(unfinished.part(cut).rglob("calib")))
    for name in (cut, kept):
        temporary_path(next(unfinished.part(name).rglob("*_001.txt"))).touch()
    assert digests(make(out)) == whole
    assert len(recorded) == 2
    assert cut in recorded
    assert kept not in recorded


def test_a_call_that_makes_nothing_leaves_nothing(out, stop_at):
    stop_at(out, 0)
    assert list(out.parent.iterdir()) == []


def test_a_worker_whose_caller_was_stopped_marks_nothing_in_what_comes_later(unfinished):
    with pytest.raises(ConfigError, match="was removed while parts of the release were recorded; make it again"):
        unfinished.note("a part")
    assert not unfinished.folder.exists()
