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

import pytest
from support.command_calls import invoke_command
from support.linux_processes import catches, is_running, wait_for, worker_processes, works

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.support.files import temporary_of

INTERRUPTED_MESSAGE = "interrupted; no file is half-written, and the same command can be run again"
KILLED_MESSAGE = "error: a worker process was killed ("
STATUS_BY_SIGNAL = {signal.SIGINT: 130, signal.SIGTERM: 143}
TIMEOUT_S = 120.0
"""A verb that has not ended by then hangs, however busy the machine is."""
NUM_MOMENTS = 6
Process = subprocess.Popen[str]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


@contextmanager
def start_verb(*words: object) -> Iterator[Process]:
    """Start a verb in its own process group, as a shell does, and wait for its signal handlers."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, words)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
        start_new_session=True,
        # as in a terminal: a runner in the background ignores Ctrl-C, and so would its children
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    ) as process:
        wait_for(lambda: process.poll() is not None or catches(process.pid, signal.SIGTERM))
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def read_messages(process: Process) -> list[str]:
    """Return the lines of a verb's stderr until it ends, without progress bars."""
    _, errors = process.communicate(timeout=TIMEOUT_S)
    lines = errors.replace("\r", "\n").splitlines()
    return [line for line in lines if line.strip() and "%|" not in line]


def stop_verb(process: Process, number: signal.Signals) -> list[str]:
    """Send a signal to a verb's whole group, wait for its end, and return its messages."""
    workers = worker_processes(process.pid)
    os.killpg(process.pid, number)
    messages = read_messages(process)
    wait_for(lambda: not any(map(is_running, workers)))
    return messages


def temporary_files(folder: Path) -> list[str]:
    return [
        path.name
        for path in folder.rglob(".*")
        if temporary_of(path.name) or path.name.endswith(".unfinished")
    ]


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The accidents that the baseline predicts in `da_motion`."""
    out = tmp_path_factory.mktemp("results")
    command = ("predict", "constant_velocity", da_motion.dataroot, "--task", "accident")
    invoke_command(*command, *TRAIN_SPLIT, "--out", out, "--workers", 1)
    return out / "accident.json"


TRAIN_SPLIT = ("--split", "train", "--scope", "all")
VERBS: dict[str, Callable[[Path, Path, Path], tuple[object, ...]]] = {
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
    "predict": lambda root, out, _: (
        "predict",
        "constant_velocity",
        root,
        *TRAIN_SPLIT,
        "--out",
        out,
    ),
    "evaluate": lambda root, out, results: (
        "evaluate",
        "accident",
        root,
        *TRAIN_SPLIT,
        "--results",
        results,
        "--protocol",
        "boxes",
        "--out",
        out / "run",
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
"""Verb with workers → its words, for a release, an output folder and a results file."""


@pytest.fixture(params=VERBS)
def words(
    request: pytest.FixtureRequest, da_motion: DeepAccident, results: Path, tmp_path: Path
) -> tuple[object, ...]:
    return (*VERBS[request.param](da_motion.dataroot, tmp_path, results), "--workers", 2)


@pytest.mark.parametrize(("number", "status"), STATUS_BY_SIGNAL.items())
def test_a_signal_ends_a_verb_with_one_line(
    number: signal.Signals, status: int, tmp_path: Path
) -> None:
    with start_verb("synth", tmp_path / "out", "--sensors", "none") as process:
        assert stop_verb(process, number) == [INTERRUPTED_MESSAGE]
    assert process.returncode == status
    assert not temporary_files(tmp_path)


@pytest.mark.slow
def test_a_signal_ends_the_workers_of_every_verb(words: tuple[object, ...], tmp_path: Path) -> None:
    with start_verb(*words) as process:
        wait_for(lambda: any(map(works, worker_processes(process.pid))))
        assert stop_verb(process, signal.SIGTERM) == [INTERRUPTED_MESSAGE]
    assert process.returncode == 143


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["index", "synth", "evaluate"])
def test_a_killed_worker_is_named(
    verb: str, da_motion: DeepAccident, results: Path, tmp_path: Path
) -> None:
    with start_verb(*VERBS[verb](da_motion.dataroot, tmp_path, results), "--workers", 2) as process:
        wait_for(lambda: len(worker_processes(process.pid)) == 2)
        os.kill(worker_processes(process.pid)[0], signal.SIGKILL)
        messages = read_messages(process)
    assert process.returncode == 2
    assert [message.startswith(KILLED_MESSAGE) for message in messages] == [True], messages
    assert not [name for name in temporary_files(tmp_path) if temporary_of(name)]


@pytest.mark.slow
def test_an_interrupted_mcap_export_leaves_no_file(da: DeepAccident, tmp_path: Path) -> None:
    with start_verb("export", "mcap", da.dataroot, "--out", tmp_path / "story.mcap") as process:
        wait_for(lambda: temporary_files(tmp_path))  # the verb is writing
        assert stop_verb(process, signal.SIGINT) == [INTERRUPTED_MESSAGE]
    assert process.returncode == 130
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_signal_at_any_moment(release_root_b: Path, tmp_path: Path) -> None:
    """Between the start and the end, libraries are imported, workers start, files are written."""
    source = shutil.copytree(
        release_root_b, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident")
    )
    words = ("index", source, "--workers", 2, "--index-dir")
    with start_verb(*words, tmp_path / "undisturbed") as process:
        begin = time.monotonic()
        assert read_messages(process) == []
        duration = time.monotonic() - begin

    for moment in range(NUM_MOMENTS):
        out = tmp_path / str(moment)
        with start_verb(*words, out) as process:
            time.sleep(duration * moment / (NUM_MOMENTS - 1))
            ending = (stop_verb(process, signal.SIGTERM), process.returncode)
        # at the end there is nothing to stop
        assert ending in [([INTERRUPTED_MESSAGE], 143), ([], 0)], moment
        # the check also removes locks that were left at the very end
        with start_verb("check", *words, out) as process:
            assert read_messages(process) == []
        assert read_files(out) == read_files(tmp_path / "undisturbed")


def read_files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


SCRIPT_WITH_LIBRARY = """
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


def start_script(script: str) -> Process:
    """Start a process that runs a script."""
    command = [sys.executable, "-c", textwrap.dedent(script)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    )


@pytest.mark.slow
@pytest.mark.parametrize("then", ["time.sleep(600)", "raise ImportError('numpy')", "pass"])
def test_a_signal_ends_a_verb_although_a_library_catches_the_exception(then: str) -> None:
    with start_script(SCRIPT_WITH_LIBRARY.format(then=then)) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.terminate()
        _, errors = process.communicate(timeout=TIMEOUT_S)
    assert errors.splitlines() == [INTERRUPTED_MESSAGE]
    assert process.returncode == 143


@pytest.mark.slow
def test_a_second_signal_ends_at_once() -> None:
    """The second signal does not wait for the grace period of the first."""
    script = SCRIPT_WITH_LIBRARY.format(then="print('tidying', flush=True); time.sleep(600)")
    with start_script(script) as process:
        assert process.stdout is not None
        for _ in range(2):
            process.stdout.readline()
            process.terminate()
        process.wait(timeout=TIMEOUT_S)
    assert process.returncode == 143


ENDINGS = {
    """
    import signal
    from deepaccident_devkit.cli.process import run_interruptibly

    def verb():  # other signals, such as a change of the terminal's size, end nothing
        signal.signal(signal.SIGUSR1, lambda *_: None)
        signal.raise_signal(signal.SIGUSR1)
        print("whole")

    run_interruptibly(verb)
    """: ("whole\n", [], 0),
    """
    import atexit, os
    from deepaccident_devkit.cli.process import run_interruptibly

    # the verb has done its work: this runs when Python ends
    atexit.register(lambda: (os.kill(os.getpid(), {number}), print("went on")))
    run_interruptibly(lambda: print("whole"))
    """: ("whole\nwent on\n", [], 0),
    """
    import os, time
    from deepaccident_devkit.cli.process import run_interruptibly

    class Last:  # Python ignores errors in `__del__`, and would print them
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
    """: ("tidied up\n", [INTERRUPTED_MESSAGE], None),
}
"""Script that gets a signal → its output, its messages, and its status; None for the usual one."""


@pytest.mark.parametrize(("number", "status"), STATUS_BY_SIGNAL.items())
@pytest.mark.parametrize(
    ("script", "ending"), ENDINGS.items(), ids=["another signal", "Python's end", "in between"]
)
def test_a_signal_at_an_awkward_moment(
    number: signal.Signals, status: int, script: str, ending: tuple[str, list[str], int | None]
) -> None:
    expected_output, messages, own_status = ending
    with start_script(script.format(number=int(number))) as process:
        output, errors = process.communicate(timeout=TIMEOUT_S)
    assert output == expected_output
    assert errors.splitlines() == messages
    assert process.returncode == (status if own_status is None else own_status)
