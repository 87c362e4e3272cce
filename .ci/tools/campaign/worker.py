"""A process that makes workers: `python worker.py` reads a case from each line and answers it.

Workers are forks of it, so that a new one has everything imported. A worker lasts until a case ends
it by a crash, by more than `seconds` of CPU time, or by memory.
"""

import importlib
import json
import logging
import os
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute
import pyarrow.parquet
import scipy.optimize
import shapely
from fault_injection.mutations import seeded

from campaign.healthy import HAS_TORCH, link_tree
from campaign.kind import Action, Judge, Kind, Workspace
from campaign.mutations import MARKER, MUTATIONS
from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.support.files import temporary_path

# what the readers import when they need it
assert all((pyarrow.compute, pyarrow.parquet, scipy.optimize, shapely))
if HAS_TORCH:
    importlib.import_module("campaign.healthy_weights")

CASE_CPU_S = 20.0
"""CPU time that a case may take; wall time would let cases fail on a busy machine."""
WALL_S_PER_CPU_S = 10
"""A case that takes longer than this hangs, even if it only waits."""
MAX_MEGABYTES = 300
"""Memory that a case may take in addition to its kind's healthy run."""
MAX_MESSAGE_CHARACTERS = 2000
_CONTROL_CHARACTERS = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"
)
"""Characters that move a terminal's cursor or turn the direction of letters."""
_SPARE_MEGABYTES = 3000
"""Hard limit of a worker's address space, in addition to what it has at its start."""
_DEAD_NAME = temporary_path(Path("kept.txt")).name.replace(f"-{os.getpid()}-", "-999999999-")
"""Temporary name of a process that has ended."""
_OUTSIDE_FILES: Mapping[str, bytes | None] = {
    "kept.txt": b"kept",
    "folder": None,
    "folder/empty": None,
    "folder/inner.txt": b"inner",
    f"folder/{_DEAD_NAME}": b"of a dead process",
    _DEAD_NAME: b"of a dead process",
}
"""Contents of the files outside, by their paths; None for folders."""


@dataclass(frozen=True, slots=True)
class Case:
    """One file that is changed in one way; without a mutation it stays healthy."""

    kind: str
    mutation: str | None
    seed: int

    def __str__(self) -> str:
        return f"{self.kind} / {self.mutation} / seed {self.seed}"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a case.

    Attributes:
        case: The case.
        verdict: `read`, `refused`, or how the case failed: `foreign` (an exception that is not
            ours), `wrong`, `message` (an error of ours that does not name the file, is too long,
            or has control characters), `memory`, `hang`, `crash`, `code` (a pickle ran its code)
            or `outside` (something was changed there).
        detail: Sentence about the verdict.
        megabytes: Peak memory above that of the healthy run.
    """

    case: Case
    verdict: str
    detail: str = ""
    megabytes: float = 0.0

    def __str__(self) -> str:
        return f"{self.case}: {self.verdict}: {self.detail}"

    @property
    def failed(self) -> bool:
        return self.verdict not in ("read", "refused")


def main(healthy: Path, home: Path, kinds: str) -> None:
    """Answer all cases of the standard input.

    Args:
        healthy: Folder of healthy files.
        home: Folder for the worker's copy of them.
        kinds: Name of the module of the kinds of files.
    """
    kinds_by_name: Mapping[str, Kind] = importlib.import_module(kinds).KINDS
    worker: _Worker | None = None
    for line in sys.stdin:
        case, seconds = json.loads(line)
        worker = worker or _Worker(healthy, home, kinds_by_name)
        answer = worker.answer(line, seconds)
        if answer is None:
            answer = json.dumps({"case": case, **worker.explain_silence()})
            is_done = True
        else:
            is_done = json.loads(answer)["verdict"] == "memory"
        if is_done:
            worker.stop()
            worker = None
        print(answer, flush=True)
    if worker:
        worker.stop()


class _Worker:
    """A fork that works on one case after another."""

    def __init__(self, healthy: Path, home: Path, kinds: Mapping[str, Kind]) -> None:
        reading, self._to_fork = os.pipe()
        self._from_fork, writing = os.pipe()
        self._process = os.fork()
        self._seconds = 0.0
        self._is_gone = False
        self._buffer = b""
        if self._process == 0:
            os.close(self._to_fork)
            os.close(self._from_fork)
            _serve(CaseRunner(healthy, home, kinds), os.fdopen(reading), writing)
        os.close(reading)
        os.close(writing)
        # wait until it is ready: no case pays for the copy of the healthy files
        os.read(self._from_fork, 1)

    def answer(self, line: str, seconds: float) -> str | None:
        """Return an outcome as JSON; None if it is not there in time or the process ended."""
        self._seconds = seconds
        os.write(self._to_fork, line.encode())
        wall_end = time.monotonic() + WALL_S_PER_CPU_S * seconds
        cpu_end = _read_cpu_seconds(self._process) + seconds
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([self._from_fork], [], [], 0.5)
            if ready:
                content = os.read(self._from_fork, 1 << 16)
                if not content:
                    self._is_gone = True
                    return None
                self._buffer += content
            elif time.monotonic() >= wall_end or _read_cpu_seconds(self._process) >= cpu_end:
                return None
        answer, _, self._buffer = self._buffer.partition(b"\n")
        return answer.decode()

    def explain_silence(self) -> dict[str, str]:
        """Return the verdict and the detail of a case without an answer."""
        if not self._is_gone:
            return {"verdict": "hang", "detail": f"no answer in {self._seconds:g} s of work"}
        _, status = os.waitpid(self._process, 0)  # however long its death takes
        self._process = 0
        return {"verdict": "crash", "detail": f"exit status {os.waitstatus_to_exitcode(status)}"}

    def stop(self) -> None:
        """End the fork, and close the pipes to it."""
        if self._process:
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)
        os.close(self._to_fork)
        os.close(self._from_fork)


def _serve(runner: "CaseRunner", cases: Iterable[str], writing: int) -> None:
    """Run cases in a fork, and write their outcomes into a pipe; never return."""
    try:
        logging.disable()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        limit = (_read_status_kb("VmSize") << 10) + (_SPARE_MEGABYTES << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        runner.prepare()
        os.write(writing, b"\n")
        for line in cases:
            case, _ = json.loads(line)
            outcome = runner.run(Case(**case))
            os.write(writing, json.dumps(asdict(outcome)).encode() + b"\n")
    except BaseException:  # noqa: BLE001 - a fork must not return
        traceback.print_exc()
    finally:
        os._exit(1)


class CaseRunner:
    """Runs cases in this process, on its own copy of the healthy files."""

    def __init__(self, healthy: Path, home: Path, kinds: Mapping[str, Kind]) -> None:
        self._healthy, self._home, self._kinds = healthy, home, kinds
        self._healthy_megabytes: dict[str, float] = {}

    def prepare(self) -> None:
        """Copy the healthy files."""
        shutil.rmtree(self._home, ignore_errors=True)
        link_tree(self._healthy, self._home)

    def run(self, case: Case) -> Outcome:
        """Return the outcome of a case; the healthy run of its kind comes first, once."""
        if case.kind not in self._healthy_megabytes:
            healthy_outcome = self._run(Case(case.kind, None, 0), 0.0)
            self._healthy_megabytes[case.kind] = healthy_outcome.megabytes
        return self._run(case, self._healthy_megabytes[case.kind])

    def _run(self, case: Case, healthy_megabytes: float) -> Outcome:
        """Run all actions of a case; return the worst outcome."""
        workspace = self.make_workspace(case)
        outcomes = []
        for action in self._kinds[case.kind].actions:
            outcomes.append(_run_action(case, action, workspace, healthy_megabytes))
        if (workspace.changed_file.parent / MARKER).exists():
            return Outcome(case, "code", "a pickle ran its code")
        differences = _read_tree(workspace.outside).items() ^ _OUTSIDE_FILES.items()
        if differences:
            path = min(path for path, _ in differences)
            first = (outcomes[0].verdict, outcomes[0].detail)
            return Outcome(case, "outside", f"{path} was changed outside ({first})")
        failed = [outcome for outcome in outcomes if outcome.failed]
        refused = [outcome for outcome in outcomes if outcome.verdict == "refused"]
        worst = (failed or refused or outcomes)[0]
        megabytes = max(outcome.megabytes for outcome in outcomes)
        return Outcome(case, worst.verdict, worst.detail, megabytes)

    def make_workspace(self, case: Case) -> Workspace:
        """Make a fresh copy of the case's folder, and change one file in it."""
        kind = self._kinds[case.kind]
        rng = seeded(f"{case.kind} {case.mutation}", case.seed)
        source = self._healthy / kind.folder
        target = self._home / "case" / kind.folder
        scratch = self._home / "scratch"
        for folder in (self._home / "case", scratch):
            shutil.rmtree(folder, ignore_errors=True)
        if kind.writes:  # writing into a hard link would change the healthy file
            shutil.copytree(source, target)
        else:
            link_tree(source, target)
        scratch.mkdir()
        outside = _make_outside_folder(self._home / "outside")
        files = kind.files(target)
        changed_file = files[rng.integers(len(files))]
        if case.mutation is not None:
            MUTATIONS[case.mutation].apply(changed_file, rng)
        healthy_file = source / changed_file.relative_to(target)
        return Workspace(self._home, target, changed_file, scratch, outside, healthy_file)


def _run_action(
    case: Case, action: Action, workspace: Workspace, healthy_megabytes: float
) -> Outcome:
    """Return the outcome of one action, with its peak memory above that of the healthy run."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from now on
    start = _read_status_kb("VmRSS")
    output = None
    try:
        output = action.read(workspace)
    except Exception as error:  # noqa: BLE001 - the kind of exception is the question
        verdict, detail = _judge_error(error, workspace)
    else:
        verdict, detail = "read", ""
    megabytes = (_read_status_kb("VmHWM") - start) / 1024 - healthy_megabytes
    if megabytes > MAX_MEGABYTES:
        text = f"{megabytes:.0f} MB more than the healthy run ({verdict}: {detail})"
        return Outcome(case, "memory", text[:MAX_MESSAGE_CHARACTERS], megabytes)
    if verdict == "read":
        fault = _judge_output(action.judge, workspace, output)
        if fault:
            verdict, detail = "wrong", fault
    return Outcome(case, verdict, detail, megabytes)


def _judge_output(judge: Judge, workspace: Workspace, output: Any) -> str | None:
    """Return what is wrong with the output of an action; None if nothing is."""
    try:
        return judge(workspace, output)
    except Exception as error:  # noqa: BLE001 - a plain reader may raise anything
        return f"was read, but a plain reader cannot: {error!r}"[:MAX_MESSAGE_CHARACTERS]


def _judge_error(error: BaseException, workspace: Workspace) -> tuple[str, str]:
    """Return the verdict and the detail of an action that raised an error."""
    detail = f"{type(error).__name__}: {error}"
    short = detail[:MAX_MESSAGE_CHARACTERS]
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, MemoryError):
            return "memory", f"ran into the limit: {short}"
        cause = cause.__cause__ or cause.__context__
    if not isinstance(error, DeepAccidentError):
        frames = traceback.extract_tb(error.__traceback__)
        package_frames = [frame for frame in frames if "deepaccident_devkit" in frame.filename]
        if package_frames:
            last = package_frames[-1]
            short += f" ({Path(last.filename).name}:{last.lineno})"
        return "foreign", short
    message = str(error)
    if len(message) > MAX_MESSAGE_CHARACTERS:
        return "message", f"{len(message)} characters: {short}"
    if match := _CONTROL_CHARACTERS.search(message):
        return "message", f"has the character {match[0]!r}: {short}"
    if workspace.changed_file.name not in detail and str(workspace.folder) not in detail:
        return "message", f"names no file: {short}"
    return "refused", short


def _make_outside_folder(folder: Path) -> Path:
    """Make a new folder apart from the case, with files that a careless program would remove."""
    for old_folder in (folder, folder.with_name("aside")):
        if old_folder.is_dir() and not old_folder.is_symlink():
            shutil.rmtree(old_folder)
        else:
            old_folder.unlink(missing_ok=True)
    for name, content in _OUTSIDE_FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            path.mkdir(exist_ok=True)
        else:
            path.write_bytes(content)
    return folder


def _read_tree(folder: Path) -> dict[str, bytes | None]:
    """Return the contents of all files below a folder, by their paths; None for folders."""
    contents = {}
    for path in folder.rglob("*"):
        content = path.read_bytes() if path.is_file() else None
        contents[path.relative_to(folder).as_posix()] = content
    return contents


def _read_cpu_seconds(process: int) -> float:
    """Return the CPU time that a process has taken; 0 if it is gone."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    user_ticks, system_ticks = int(fields[11]), int(fields[12])
    return (user_ticks + system_ticks) / os.sysconf("SC_CLK_TCK")


def _read_status_kb(name: str) -> int:
    """Return a line of this process's status, in kilobytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    raise LookupError(name)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
