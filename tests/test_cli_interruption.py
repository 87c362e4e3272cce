"""Verbs that are stopped: by Ctrl-C, by SIGTERM, or because a worker is killed."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from processes import catches, is_running, wait_for, workers_of, works
from verbs import called

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.support.files import temporary_of

LINE = "interrupted; no file is half-written, and the same command can be run again"
KILLED = "error: a worker process was killed ("
SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143}
LONGEST = 120.0
"""Seconds until a verb has ended, however much else the machine does: what hangs ends here."""
MOMENTS = 6
Process = subprocess.Popen[str]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


@contextmanager
def started(*words: object) -> Iterator[Process]:
    """A verb in a process group of its own, as a shell makes it, with its handlers in place."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, words)]
    how: dict[str, Any] = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "env": ENVIRONMENT,
    }
    # as in a terminal: a runner in the background ignores Ctrl-C, and so would its children
    how |= {
        "start_new_session": True,
        "preexec_fn": lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    }
    with subprocess.Popen(command, **how) as process:
        wait_for(lambda: process.poll() is not None or catches(process.pid, signal.SIGTERM))
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def lines_of(process: Process) -> list[str]:
    """What a verb says on stderr until it ends, without the states of progress bars."""
    _, said = process.communicate(timeout=LONGEST)
    return [
        line for line in said.replace("\r", "\n").splitlines() if line.strip() and "%|" not in line
    ]


def stopped(process: Process, number: signal.Signals) -> list[str]:
    """The lines of a verb to whose whole group a signal is sent; no process is left."""
    own = workers_of(process.pid)
    os.killpg(process.pid, number)
    lines = lines_of(process)
    wait_for(lambda: not any(map(is_running, own)))
    return lines


def leftovers(folder: Path) -> list[str]:
    return [
        path.name
        for path in folder.rglob(".*")
        if temporary_of(path.name) or path.name.endswith(".unfinished")
    ]


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The accidents that the baseline foresees in `da_motion`."""
    out = tmp_path_factory.mktemp("results")
    words = (
        "predict",
        "constant_velocity",
        da_motion.dataroot,
        "--task",
        "accident",
        *IN_TRAIN,
        "--out",
        out,
    )
    called(*words, "--workers", 1)
    return out / "accident.json"


IN_TRAIN = ("--split", "train", "--scope", "all")
WORDS: dict[str, Callable[[Path, Path, Path], tuple[object, ...]]] = {
    "index": lambda root, out, _: ("index", root, "--index-dir", out),
    "info": lambda root, out, _: ("info", root, "--index-dir", out),
    "stats": lambda root, out, _: (
        "info",
        root,
        "--statistics",
        "--index-dir",
        out,
        "--out",
        out / "statistics",
    ),
    "validate": lambda root, *_: ("validate", root, "--deep"),
    "labels": lambda root, out, _: (
        "labels",
        root,
        "--split",
        "train",
        "--samples",
        "all",
        "--out",
        out,
    ),
    "synth": lambda _, out, __: (
        "synth",
        out / "made",
        "--scenarios",
        2,
        "--frames",
        8,
        "--size",
        "64x36",
    ),
    "demo": lambda _, out, __: ("demo", out / "demo"),
    "predict": lambda root, out, _: ("predict", "constant_velocity", root, *IN_TRAIN, "--out", out),
    "evaluate": lambda root, out, results: (
        *(
            "evaluate",
            "accident",
            root,
            *IN_TRAIN,
            "--results",
            results,
            "--protocol",
            "boxes",
            "--out",
            out / "run",
        ),
    ),
    "export": lambda root, out, _: (
        "export",
        "opencood",
        root,
        "--without-clouds",
        "--out",
        out / "export",
    ),
    "video": lambda root, out, _: (
        "render",
        "video",
        root,
        "--what",
        "bev",
        "--out",
        out / "video.gif",
    ),
}
"""Verb with workers → its words, for a release, a folder to write into and a results file."""


@pytest.fixture(params=WORDS)
def words(
    request: pytest.FixtureRequest, da_motion: DeepAccident, results: Path, tmp_path: Path
) -> tuple[object, ...]:
    return (*WORDS[request.param](da_motion.dataroot, tmp_path, results), "--workers", 2)


@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
def test_a_signal_ends_a_verb_with_one_line(
    number: signal.Signals, status: int, tmp_path: Path
) -> None:
    with started("synth", tmp_path / "out", "--sensors", "none") as process:
        assert (stopped(process, number), process.returncode) == ([LINE], status)
    assert not leftovers(tmp_path)


@pytest.mark.slow
def test_a_signal_ends_the_workers_of_every_verb(words: tuple[object, ...], tmp_path: Path) -> None:
    with started(*words) as process:
        wait_for(lambda: any(map(works, workers_of(process.pid))))
        assert (stopped(process, signal.SIGTERM), process.returncode) == ([LINE], 143)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["index", "synth", "evaluate"])
def test_a_killed_worker_is_named(
    verb: str, da_motion: DeepAccident, results: Path, tmp_path: Path
) -> None:
    with started(*WORDS[verb](da_motion.dataroot, tmp_path, results), "--workers", 2) as process:
        wait_for(lambda: len(workers_of(process.pid)) == 2)
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        lines = lines_of(process)
    assert (process.returncode, [line.startswith(KILLED) for line in lines]) == (2, [True]), lines
    assert not [name for name in leftovers(tmp_path) if temporary_of(name)]


@pytest.mark.slow
def test_mcap(da: DeepAccident, tmp_path: Path) -> None:
    words = ("export", "mcap", da.dataroot, "--out", tmp_path / "story.mcap")
    with started(*words) as process:
        wait_for(lambda: leftovers(tmp_path))  # it is being written
        assert (stopped(process, signal.SIGINT), process.returncode) == ([LINE], 130)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_signal_at_any_moment(release_root_b: Path, tmp_path: Path) -> None:
    """From the first to the last: libraries are imported, workers start, files are written, Python
    ends.
    """
    source = shutil.copytree(
        release_root_b, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident")
    )
    words = ("index", source, "--workers", 2, "--index-dir")
    with started(*words, tmp_path / "whole") as process:
        begin = time.monotonic()
        assert lines_of(process) == []
        whole = time.monotonic() - begin
    for moment in range(MOMENTS):
        out = tmp_path / str(moment)
        with started(*words, out) as process:
            time.sleep(whole * moment / (MOMENTS - 1))
            ended = (stopped(process, signal.SIGTERM), process.returncode)
        assert ended in [([LINE], 143), ([], 0)], moment  # at the end there is nothing to stop
        with started(
            "check", *words, out
        ) as process:  # removes locks that were left at the very end, too
            assert lines_of(process) == []
        assert files(out) == files(tmp_path / "whole")


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


IN_A_LIBRARY = """
    import os, sys, time
    from deepaccident_devkit.cli.process import run_interruptibly

    def verb():
        try:
            print("begun", flush=True)
            time.sleep(600)
        except BaseException:
            {then}

    run_interruptibly(verb)
"""


def scripted(script: str) -> Process:
    """A process that runs a script."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    )


@pytest.mark.slow
@pytest.mark.parametrize("then", ["time.sleep(600)", "raise ImportError('numpy')", "pass"])
def test_a_library_that_takes_the_exception(then: str) -> None:
    with scripted(IN_A_LIBRARY.format(then=then)) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.terminate()
        said = process.communicate(timeout=LONGEST)[1]
    assert (said.splitlines(), process.returncode) == ([LINE], 143)


@pytest.mark.slow
def test_a_second_signal_ends_at_once() -> None:
    """Not only when the first one's time is over."""
    with scripted(
        IN_A_LIBRARY.format(then="print('tidying', flush=True); time.sleep(600)")
    ) as process:
        assert process.stdout is not None
        for _ in range(2):
            process.stdout.readline()
            process.terminate()
        process.wait(timeout=LONGEST)
    assert process.returncode == 143


ENDS = {
    """
    import signal
    from deepaccident_devkit.cli.process import run_interruptibly

    def verb():  # a signal such as that of a terminal whose size changes ends nothing
        signal.signal(signal.SIGUSR1, lambda *_: None)
        signal.raise_signal(signal.SIGUSR1)
        print("whole")

    run_interruptibly(verb)
    """: ("whole\n", [], 0),
    """
    import atexit, os
    from deepaccident_devkit.cli.process import run_interruptibly

    # the verb has done its work: this runs last of what is to run at the end
    atexit.register(lambda: (os.kill(os.getpid(), {number}), print("went on")))
    run_interruptibly(lambda: print("whole"))
    """: ("whole\nwent on\n", [], 0),
    """
    import os, time
    from deepaccident_devkit.cli.process import run_interruptibly

    class Last:  # Python ignores what a `__del__` raises, and would say so
        def __del__(self):
            os.kill(os.getpid(), {number})
            time.sleep(0.01)

    def verb():
        Last()
        try:
            time.sleep(600)
        finally:
            print("tidied up", flush=True)

    run_interruptibly(verb)
    """: ("tidied up\n", [LINE], None),
}
"""A script that gets a signal, by what it is sent amid → what it prints, what it says, its status.
"""


@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
@pytest.mark.parametrize(
    ("script", "ends"), ENDS.items(), ids=["another signal", "Python's end", "in between"]
)
def test_a_signal_amid(
    number: signal.Signals, status: int, script: str, ends: tuple[Any, ...]
) -> None:
    with scripted(script.format(number=int(number))) as process:
        printed, said = process.communicate(timeout=LONGEST)
    *told, usual = ends
    assert (printed, said.splitlines(), process.returncode) == (
        *told,
        status if usual is None else usual,
    )
