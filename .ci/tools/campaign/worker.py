"""A process that makes workers: `python worker.py` reads a case a line and answers with a line.

Workers are forks of it, so that a new one has everything imported. One lasts until a case ends it:
    by a crash, by more
than `seconds` of the processor's time, or by memory.
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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow.compute
import pyarrow.parquet
import scipy.optimize
import shapely
from fault_injection.mutations import seeded

from campaign.healthy import HAS_TORCH, copied
from campaign.kind import Action, Kind, Room
from campaign.mutations import MARKER, MUTATIONS
from deepaccident_devkit.errors import DeepAccidentError
from deepaccident_devkit.support.files import temporary_path

assert all(
    (pyarrow.compute, pyarrow.parquet, scipy.optimize, shapely)
)  # what the readers import when they need it
if HAS_TORCH:
    importlib.import_module("campaign.healthy_weights")

SECONDS = 20.0
"""Of the processor's time: a busy machine makes nothing fail."""
PATIENCE = 10
"""A case that waits has so many times as much time."""
MEGABYTES = 300
LONGEST_MESSAGE = 2000
_UNSEEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""What moves a terminal's cursor, or turns the direction of letters."""
_ROOM_MEGABYTES = 3000
"""More address space than a worker has at its start: the hard limit."""


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
    """What became of a case.

    Attributes:
        case: it.
        verdict: `read`, `refused`, or how it failed: `foreign` exception, `wrong`, `message` (an
            error of ours that does not name the file, is too long, or has control characters),
            `memory`, `hang`, `crash`, `code` (a pickle's), `outside` (something was changed there).
        detail: a sentence for those who look into it.
        megabytes: peak memory above the healthy run's.
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
    """Answer cases until there are no more; `kinds` is the module of the kinds of files."""
    known: Mapping[str, Kind] = importlib.import_module(kinds).KINDS
    worker: _Worker | None = None
    for line in sys.stdin:
        case, seconds = json.loads(line)
        worker = worker or _Worker(healthy, home, known)
        answer = worker.answer(line, seconds)
        if answer is None or json.loads(answer)["verdict"] == "memory":
            answer = answer or json.dumps({"case": case, **worker.ended()})
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
            for end in (self._to_fork, self._from_fork):
                os.close(end)
            _serve(Bench(healthy, home, kinds), os.fdopen(reading), writing)
        for end in (reading, writing):
            os.close(end)
        os.read(
            self._from_fork, 1
        )  # it is ready: copying the healthy files is none of a case's time

    def answer(self, line: str, seconds: float) -> str | None:
        """The outcome's JSON; None if there is none in time, or the process ended."""
        self._seconds = seconds
        os.write(self._to_fork, line.encode())
        until, worked = (
            time.monotonic() + PATIENCE * seconds,
            _processor_seconds(self._process) + seconds,
        )
        while b"\n" not in self._buffer:
            ready, _, _ = select.select([self._from_fork], [], [], 0.5)
            if (
                not ready
                and time.monotonic() < until
                and _processor_seconds(self._process) < worked
            ):
                continue
            more = os.read(self._from_fork, 1 << 16) if ready else b""
            if not more:
                self._is_gone = bool(ready)
                return None
            self._buffer += more
        answer, _, self._buffer = self._buffer.partition(b"\n")
        return answer.decode()

    def ended(self) -> dict[str, str]:
        """Why there was no answer."""
        if not self._is_gone:
            return {"verdict": "hang", "detail": f"no answer in {self._seconds:g} s of work"}
        _, status = os.waitpid(self._process, 0)  # however long its death takes
        self._process = 0
        return {"verdict": "crash", "detail": f"exit status {os.waitstatus_to_exitcode(status)}"}

    def stop(self) -> None:
        """End it."""
        if self._process:
            os.kill(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)
        os.close(self._to_fork)
        os.close(self._from_fork)


def _serve(bench: "Bench", cases: Iterable[str], writing: int) -> None:
    try:
        logging.disable()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        room = (_status("VmSize") << 10) + (_ROOM_MEGABYTES << 20)
        resource.setrlimit(resource.RLIMIT_AS, (room, room))
        bench.prepare()
        os.write(writing, b"\n")
        for line in cases:
            case, _ = json.loads(line)
            outcome = bench.outcome(Case(**case))
            os.write(writing, json.dumps(asdict(outcome)).encode() + b"\n")
    except BaseException:  # noqa: BLE001 - a fork must not return
        traceback.print_exc()
    finally:
        os._exit(1)


class Bench:
    """Runs cases in this process, on its own copy of the healthy files."""

    def __init__(self, healthy: Path, home: Path, kinds: Mapping[str, Kind]) -> None:
        self._healthy, self._home, self._kinds = healthy, home, kinds
        self._used: dict[str, float] = {}

    def prepare(self) -> None:
        """Copy the healthy files."""
        shutil.rmtree(self._home, ignore_errors=True)
        copied(self._healthy, self._home)

    def outcome(self, case: Case) -> Outcome:
        """What becomes of a case; its kind's healthy run comes first, once."""
        if case.kind not in self._used:
            self._used[case.kind] = self._outcome(Case(case.kind, None, 0), 0.0).megabytes
        return self._outcome(case, self._used[case.kind])

    def _outcome(self, case: Case, usual: float) -> Outcome:
        room = self.room(case)
        verdicts = [self._acted(action, room, usual) for action in self._kinds[case.kind].actions]
        if (room.victim.parent / MARKER).exists():
            return Outcome(case, "code", "a pickle ran its code")
        if changed := {name for name, _ in _tree(room.outside).items() ^ _OUTSIDE.items()}:
            return Outcome(
                case, "outside", f"{min(changed)} was changed outside ({verdicts[0][:2]})"
            )
        most = max(megabytes for *_, megabytes in verdicts)
        failed = [each for each in verdicts if each[0] not in ("read", "refused")]
        verdict, detail, _ = (
            failed or [each for each in verdicts if each[0] == "refused"] or verdicts
        )[0]
        return Outcome(case, verdict, detail, most)

    def room(self, case: Case) -> Room:
        """A fresh copy of the case's folder, in which one file is changed."""
        kind, rng = self._kinds[case.kind], seeded(f"{case.kind} {case.mutation}", case.seed)
        source, tree, scratch = (
            self._healthy / kind.folder,
            self._home / "case" / kind.folder,
            self._home / "scratch",
        )
        for folder in (self._home / "case", scratch):
            shutil.rmtree(folder, ignore_errors=True)
        if kind.writes:
            shutil.copytree(
                source, tree
            )  # what is written into a hard link is written into the healthy file
        else:
            copied(source, tree)
        scratch.mkdir()
        outside = _made_outside(self._home / "outside")
        files = kind.files(tree)
        victim = files[int(rng.integers(len(files)))]
        if case.mutation is not None:
            MUTATIONS[case.mutation].apply(victim, rng)
        return Room(self._home, tree, victim, scratch, outside, source / victim.relative_to(tree))

    def _acted(self, action: Action, room: Room, usual: float) -> tuple[str, str, float]:
        """Verdict, detail and megabytes of one action."""
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from now on
        before = _status("VmRSS")
        try:
            read = action.read(room)
        except Exception as error:  # noqa: BLE001 - which ones come out is the question
            verdict, detail = _of_error(error, room)
        else:
            verdict, detail = "read", ""
        megabytes = (_status("VmHWM") - before) / 1024 - usual
        if megabytes > MEGABYTES:
            return (
                "memory",
                f"{megabytes:.0f} MB more than the healthy run ({verdict}: {detail})"[
                    :LONGEST_MESSAGE
                ],
                megabytes,
            )
        if verdict == "read" and (fault := _judged(action.judge, room, read)):
            return "wrong", fault, megabytes
        return verdict, detail, megabytes


def _judged(judge: Callable[[Room, Any], str | None], room: Room, read: Any) -> str | None:
    try:
        return judge(room, read)
    except Exception as error:  # noqa: BLE001 - a plain reader may raise anything
        return f"was read, but a plain reader cannot: {error!r}"[:LONGEST_MESSAGE]


def _of_error(error: BaseException, room: Room) -> tuple[str, str]:
    detail = f"{type(error).__name__}: {error}"
    short = detail[:LONGEST_MESSAGE]
    causes: list[BaseException] = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    if any(isinstance(each, MemoryError) for each in causes):
        return "memory", f"ran into the limit: {short}"
    if not isinstance(error, DeepAccidentError):
        frames = [
            each
            for each in traceback.extract_tb(error.__traceback__)
            if "deepaccident_devkit" in each.filename
        ]
        where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        return "foreign", short + where
    if len(str(error)) > LONGEST_MESSAGE:
        return "message", f"{len(str(error))} characters: {short}"
    if unseen := _UNSEEN.search(str(error)):
        return "message", f"has the character {unseen[0]!r}: {short}"
    if room.victim.name not in detail and str(room.tree) not in detail:
        return "message", f"names no file: {short}"
    return "refused", short


def _made_outside(folder: Path) -> Path:
    """A new folder outside of what is read and written, with what a careless program would
    remove.
    """
    for aside in (folder, folder.with_name("aside")):
        if aside.is_dir() and not aside.is_symlink():
            shutil.rmtree(aside)
        else:
            aside.unlink(missing_ok=True)
    for name, content in _OUTSIDE.items():
        place = folder / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            place.mkdir(exist_ok=True)
        else:
            place.write_bytes(content)
    return folder


def _tree(folder: Path) -> dict[str, bytes | None]:
    """Path → content of all below a folder; None for folders."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


_DEAD = temporary_path(Path("kept.txt")).name.replace(f"-{os.getpid()}-", "-999999999-")
_OUTSIDE: Mapping[str, bytes | None] = {
    "kept.txt": b"kept",
    "folder": None,
    "folder/empty": None,
    "folder/inner.txt": b"inner",
    f"folder/{_DEAD}": b"of a dead process",
    _DEAD: b"of a dead process",
}


def _processor_seconds(process: int) -> float:
    """How long a process has worked; 0 if it is gone."""
    try:
        facts = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(facts[11]) + int(facts[12])) / os.sysconf("SC_CLK_TCK")


def _status(name: str) -> int:
    """A line of this process's status, kilobytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    raise LookupError(name)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
