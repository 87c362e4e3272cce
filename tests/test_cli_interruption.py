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
from click.testing import CliRunner
from processes import catches, is_running, wait_for, workers_of, works

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.support.files import temporary_of

LINE = "interrupted; no file is half-written, and the same command can be run again"
KILLED = "error: a worker process was killed ("
SIGNALS = {signal.SIGINT: 130, signal.SIGTERM: 143}
PROMISED, ALLOWED = 2.0, 10.0
"""Seconds until a verb has ended; and on a machine that does other things too."""
Process = subprocess.Popen[str]


def ctrl_c_counts() -> None:
    """As in a terminal: a runner in the background ignores it, and so would its children."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def started(*words: object) -> Iterator[Process]:
    """A verb in a process group of its own, as a shell makes it, with its handlers in place."""
    command = [sys.executable, "-m", "deepaccident_devkit.cli", *map(str, words)]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        start_new_session=True,
        preexec_fn=ctrl_c_counts,  # noqa: PLW1509 - no thread of this process holds a lock for it
    ) as process:
        wait_for(lambda: process.poll() is not None or catches(process.pid, signal.SIGTERM))
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


def lines_of(process: Process) -> list[str]:
    """What a verb says on stderr until it ends, without the states of progress bars."""
    _, said = process.communicate(timeout=120)
    return [line for line in said.replace("\r", "\n").splitlines() if line.strip() and "%|" not in line]


def stopped(process: Process, number: signal.Signals) -> list[str]:
    """The lines of a verb to whose whole group a signal is sent; within the promised time, and no process is left."""
    own = workers_of(process.pid)
    begin = time.monotonic()
    os.killpg(process.pid, number)
    lines = lines_of(process)
    seconds = time.monotonic() - begin
    if seconds > PROMISED:
        print(f"{number.name}: ended after {seconds:.1f} s")
    assert seconds < ALLOWED
    wait_for(lambda: not any(map(is_running, own)), seconds=5)
    return lines


def leftovers(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob(".*") if temporary_of(path.name) or path.name.endswith(".unfinished")]


@pytest.fixture(scope="module")
def results(da_motion: DeepAccident, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The accidents that the baseline foresees in `da_motion`."""
    out = tmp_path_factory.mktemp("results")
    words = ["predict", "constant_velocity", da_motion.dataroot, "--task", "accident", *IN_TRAIN, "--out", out]
    done = CliRunner().invoke(deepaccident, [*map(str, words), "--workers", "1"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return out / "accident.json"


IN_TRAIN = ("--split", "train", "--scope", "all")
WORDS: dict[str, Callable[[Path, Path, Path], tuple[object, ...]]] = {
    "index": lambda root, out, _: ("index", root, "--index-dir", out),
    "info": lambda root, out, _: ("info", root, "--index-dir", out),
    "stats": lambda root, out, _: ("info", root, "--statistics", "--index-dir", out, "--out", out / "statistics"),
    "validate": lambda root, *_: ("validate", root, "--deep"),
    "labels": lambda root, out, _: ("labels", root, "--split", "train", "--samples", "all", "--out", out),
    "synth": lambda _, out, __: ("synth", out / "made", "--scenarios", 2, "--frames", 8, "--size", "64x36"),
    "demo": lambda _, out, __: ("demo", out / "demo"),
    "predict": lambda root, out, _: ("predict", "constant_velocity", root, *IN_TRAIN, "--out", out),
    "evaluate": lambda root, out, results: (
        *("evaluate", "accident", root, *IN_TRAIN, "--results", results, "--protocol", "boxes", "--out", out / "run"),
    ),
    "export": lambda root, out, _: ("export", "opencood", root, "--without-clouds", "--out", out / "export"),
    "video": lambda root, out, _: ("render", "video", root, "--what", "bev", "--out", out / "video.gif"),
}
"""Verb with workers → its words, for a release, a folder to write into and a results file."""


@pytest.fixture(params=WORDS)
def words(request: pytest.FixtureRequest, da_motion: DeepAccident, results: Path, tmp_path: Path) -> tuple[object, ...]:
    return (*WORDS[request.param](da_motion.dataroot, tmp_path, results), "--workers", 2)


@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
def test_a_signal_ends_a_verb_with_one_line(number: signal.Signals, status: int, tmp_path: Path) -> None:
    with started("synth", tmp_path / "out", "--sensors", "none") as process:
        assert (stopped(process, number), process.returncode) == ([LINE], status)
    assert not leftovers(tmp_path)


@pytest.mark.slow
def test_a_signal_ends_the_workers_of_every_verb(words: tuple[object, ...], tmp_path: Path) -> None:
    with started(*words) as process:
        wait_for(lambda: len(workers_of(process.pid)) == 2)
        assert (stopped(process, signal.SIGINT), process.returncode) == ([LINE], 130)
    with started(*words) as process:
        wait_for(lambda: any(map(works, workers_of(process.pid))))
        assert (stopped(process, signal.SIGTERM), process.returncode) == ([LINE], 143)


@pytest.mark.slow
def test_a_killed_worker_is_named_alike_by_every_verb(words: tuple[object, ...], tmp_path: Path) -> None:
    with started(*words) as process:
        wait_for(lambda: len(workers_of(process.pid)) == 2)
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
        lines = lines_of(process)
    assert process.returncode == 2, lines
    assert len(lines) == 1
    assert lines[0].startswith(KILLED)
    assert not [name for name in leftovers(tmp_path) if temporary_of(name)]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
def test_mcap(number: signal.Signals, status: int, da: DeepAccident, tmp_path: Path) -> None:
    words = ("export", "mcap", da.dataroot, "--out", tmp_path / "story.mcap")
    with started(*words) as process:
        wait_for(lambda: leftovers(tmp_path))  # it is being written
        assert (stopped(process, number), process.returncode) == ([LINE], status)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
def test_ten_moments(number: signal.Signals, status: int, release_root_b: Path, tmp_path: Path) -> None:
    """From the first to the last: libraries are imported, workers start, files are written, Python ends."""
    source = shutil.copytree(release_root_b, tmp_path / "release", ignore=shutil.ignore_patterns(".deepaccident"))
    words = ("index", source, "--workers", 2, "--index-dir")
    with started(*words, tmp_path / "whole") as process:
        begin = time.monotonic()
        assert lines_of(process) == []
        whole = time.monotonic() - begin
    ended = []
    for moment in range(10):
        out = tmp_path / str(moment)
        with started(*words, out) as process:
            time.sleep(whole * moment / 9)
            lines = stopped(process, number)
            ended.append(process.returncode)
        assert (lines, process.returncode) in [([LINE], status), ([], 0)], moment  # at the end there is nothing to stop
        with started(*words, out, "--check") as process:  # removes locks that were left at the very end, too
            assert lines_of(process) == []
        assert files(out) == files(tmp_path / "whole")
    assert ended.count(status) > 3, ended  # by the load of the machine


def files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


IN_A_LIBRARY = """
    import os, sys, time
    from deepaccident_devkit.cli.process import run_interruptibly

    def verb():
        try:
            time.sleep(60)
        except BaseException:
            {then}

    run_interruptibly(verb)
"""


@pytest.mark.slow
@pytest.mark.parametrize("then", ["time.sleep(60)", "raise ImportError('numpy')", "pass"])
def test_a_library_that_takes_the_exception(then: str) -> None:
    script = textwrap.dedent(IN_A_LIBRARY).format(then=then)
    with subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True) as process:
        wait_for(lambda: catches(process.pid, signal.SIGTERM))
        time.sleep(0.2)
        begin = time.monotonic()
        process.terminate()
        assert process.communicate(timeout=ALLOWED)[1].splitlines() == [LINE]
        assert process.returncode == 143
        assert time.monotonic() - begin < ALLOWED


@pytest.mark.slow
def test_a_second_signal_ends_at_once() -> None:
    script = textwrap.dedent(IN_A_LIBRARY).format(then="print('tidying', flush=True); time.sleep(60)")
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        wait_for(lambda: catches(process.pid, signal.SIGTERM))
        time.sleep(0.2)
        process.terminate()
        process.stdout.readline()
        begin = time.monotonic()
        time.sleep(0.3)
        process.terminate()
        process.wait(timeout=ALLOWED)
        assert time.monotonic() - begin < 1.2
        assert process.returncode == 143


def test_other_signals_end_nothing() -> None:
    """Such as that of a terminal whose size changes."""
    script = """
        import signal, time
        from deepaccident_devkit.cli.process import run_interruptibly

        def verb():
            signal.signal(signal.SIGUSR1, lambda *_: None)
            signal.raise_signal(signal.SIGUSR1)
            time.sleep(1.8)
            print("whole")

        run_interruptibly(verb)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("whole\n", "")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_amid_the_end_of_python_changes_nothing(number: signal.Signals) -> None:
    """The verb has done its work: this runs last of what is to run at the end."""
    script = f"""
        import atexit, os
        from deepaccident_devkit.cli.process import run_interruptibly

        atexit.register(lambda: (os.kill(os.getpid(), {int(number)}), print("went on")))
        run_interruptibly(lambda: print("whole"))
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("whole\nwent on\n", "")


@pytest.mark.parametrize(("number", "status"), SIGNALS.items())
def test_a_signal_amid_what_python_calls_in_between(number: signal.Signals, status: int) -> None:
    """Python ignores what a `__del__` raises, and would say so."""
    script = f"""
        import os, time
        from deepaccident_devkit.cli.process import run_interruptibly

        class Last:
            def __del__(self):
                os.kill(os.getpid(), {int(number)})
                time.sleep(0.01)

        def verb():
            Last()
            try:
                time.sleep(60)
            finally:
                print("tidied up", flush=True)

        run_interruptibly(verb)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr.splitlines(), done.returncode) == ("tidied up\n", [LINE], status)
