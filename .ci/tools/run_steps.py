"""Run steps of the checks, two at a time, and report every failure at the end.

A step is a script `.ci/steps/NAME.sh`. It runs in its own copy of the working tree, and goes on
when one of its checks fails. Without names all steps run, except the ones that take so long that
they are run by hand.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

TOP = Path(__file__).resolve().parents[2]
SCRIPTS = TOP / ".ci" / "steps"
STEPS = ("quick", "slow", "torch", "newest", "oldest", "clients", "browser", "package", "site")
"""Steps in the order in which they start: the quickest answer first, then the longest."""
MAX_RUNNING_STEPS = 2
_POLL_S = 0.5
_REPORTED_LINES = 400


@dataclass(frozen=True)
class Check:
    """A command of a step that has ended."""

    name: str
    passed: bool
    seconds: int
    log: Path


@dataclass
class Run:
    """A step that runs or has run."""

    name: str
    folder: Path
    process: subprocess.Popen[bytes]
    began: float
    seconds: float = 0.0
    checks: list[Check] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether the script and all of its checks passed; a script without any check did not."""
        return (
            self.process.returncode == 0
            and bool(self.checks)
            and all(check.passed for check in self.checks)
        )

    def new_checks(self) -> list[Check]:
        """Return the checks that ended since the last call."""
        path = self.folder / "checks.tsv"
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        rows = [line.split("\t") for line in lines[len(self.checks) :]]
        ended = [
            Check(name, result == "passed", int(seconds), Path(log))
            for name, result, seconds, log in rows
        ]
        self.checks += ended
        return ended


def main() -> int:
    """Run the steps of the command line; return 0 if all passed."""
    options = _options()
    if options.list:
        for name in (*STEPS, *sorted({path.stem for path in SCRIPTS.glob("*.sh")} - {*STEPS})):
            by_hand = "" if name in STEPS else " (by hand)"
            print(f"{name:<14}{_description(SCRIPTS / f'{name}.sh')}{by_hand}")
        return 0
    names = options.steps or STEPS
    unknown = [name for name in names if not (SCRIPTS / f"{name}.sh").is_file()]
    if unknown:
        print(f"no such step: {', '.join(unknown)}; .ci/run --list names them", file=sys.stderr)
        return 2
    began = time.monotonic()
    work = Path(tempfile.mkdtemp(prefix="deepaccident-ci-"))
    try:
        runs = _run_all(names, work, options.environments or work / "environments")
        _report(runs, time.monotonic() - began)
        return 0 if all(run.passed for run in runs) else 1
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog=".ci/run", description=(__doc__ or "").partition("\n\n")[2]
    )
    parser.add_argument(
        "steps", nargs="*", metavar="STEP", help="names of steps; default: all but those by hand"
    )
    parser.add_argument("--list", action="store_true", help="list the steps, and run none")
    parser.add_argument(
        "--environments",
        type=lambda text: Path(text).resolve(),
        metavar="DIR",
        help="keep the virtual environments here for the next run; default: make new ones",
    )
    return parser.parse_args()


def _description(script: Path) -> str:
    """Return the first comment of a step's script."""
    return script.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ")


def _run_all(names: Sequence[str], work: Path, environments: Path) -> list[Run]:
    """Run steps in this order, some at the same time; they share the machine's cores."""
    environments.mkdir(parents=True, exist_ok=True)
    source = work / "source"
    _copy_tree(source)
    num_parallel = min(MAX_RUNNING_STEPS, len(names))
    variables = {
        **{name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        "CI_TOP": str(TOP),
        "CI_ENVIRONMENTS": str(environments),
        "CI_STEPS": " ".join(names),
        "CI_SOURCE_HASH": _hash_of(source),
        "CI_WORKERS": str(max(1, len(os.sched_getaffinity(0)) // num_parallel)),
        "PYTHON": sys.executable,
    }
    waiting, running, ended = list(names), [], []
    try:
        while waiting or running:
            while waiting and len(running) < num_parallel:
                running.append(_start(waiting.pop(0), work, variables))
            time.sleep(_POLL_S)
            for run in list(running):
                is_over = run.process.poll() is not None
                for check in run.new_checks():
                    print(
                        f"{run.name}: {check.name} {_result(check.passed)} ({check.seconds} s)",
                        flush=True,
                    )
                if is_over:
                    run.seconds = time.monotonic() - run.began
                    print(f"== {run.name} {_result(run.passed)} ({run.seconds:.0f} s)", flush=True)
                    running.remove(run)
                    ended.append(run)
                    shutil.rmtree(run.folder / "source", ignore_errors=True)
    finally:
        for run in running:
            os.killpg(run.process.pid, signal.SIGKILL)
    return ended


def _copy_tree(target: Path) -> None:
    """Copy the files that git tracks or would track."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    output = subprocess.run(command, cwd=TOP, check=True, capture_output=True).stdout.decode()
    for name in {*output.split("\0")} - {""}:
        if (TOP / name).is_file():
            copy = target / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(TOP / name, copy, follow_symlinks=False)


def _hash_of(folder: Path) -> str:
    """Return a hash of the names and contents of all files in a folder."""
    sha = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        sha.update(f"{path.relative_to(folder)}\0".encode() + path.read_bytes())
    return sha.hexdigest()


def _start(name: str, work: Path, variables: dict[str, str]) -> Run:
    folder = work / name
    shutil.copytree(work / "source", folder / "source", symlinks=True)
    with (folder / "script.log").open("wb") as log:
        process = subprocess.Popen(
            ["bash", str(SCRIPTS / f"{name}.sh")],
            cwd=folder / "source",
            env={**variables, "CI_LOGS": str(folder)},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    print(f"== {name} begins", flush=True)
    return Run(name, folder, process, time.monotonic())


def _report(runs: Sequence[Run], seconds: float) -> None:
    """Print a table of the steps, the output of each failure, and the summary of all tests."""
    print("\nstep            result  seconds")
    for run in runs:
        print(f"{run.name:<15} {_result(run.passed):<7} {run.seconds:7.0f}")
    print(f"{'all':<15} {_result(all(run.passed for run in runs)):<7} {seconds:7.0f}")
    failures = [(run.name, name, text) for run in runs for name, text in _failures(run)]
    print("".join(f"failed: {step}: {name}\n" for step, name, _ in failures))
    for step, name, text in failures:
        print(f"==== {step}: {name}\n{text}\n")
    print("==== test summary")
    for run in runs:
        for line in _test_summary(run):
            print(line)
    sys.stdout.flush()


def _failures(run: Run) -> Iterator[tuple[str, str]]:
    """Yield the name and output of each failed check, or of a script that failed without one."""
    for check in run.checks:
        if not check.passed:
            yield check.name, _excerpt(check.log)
    if not run.passed and all(check.passed for check in run.checks):
        reason = "the script made no check"
        if run.checks:
            reason = f"the script ended with {run.process.returncode}"
        yield reason, _excerpt(run.folder / "script.log")


def _excerpt(log: Path) -> str:
    """Return the end of an output; of pytest's, from its errors and failures on."""
    text = log.read_text(encoding="utf-8", errors="replace")
    heading = re.search(r"^=+ (ERRORS|FAILURES) =+$", text, re.MULTILINE)
    if heading:
        text = text[heading.start() :]
    return "\n".join(text.splitlines()[-_REPORTED_LINES:])


def _test_summary(run: Run) -> Iterator[str]:
    """Yield the failed tests of each check, and how many of its tests passed and failed."""
    for check in run.checks:
        lines = check.log.read_text(encoding="utf-8", errors="replace").splitlines()
        total = None
        for line in lines:
            if re.match(r"(FAILED|ERROR) \S+", line):
                yield line
            elif re.search(r"\d (passed|failed|error)\b.* in [\d.]+s", line):
                total = line.strip("= ")
        if total:
            yield f"{run.name}, {check.name}: {total}"


def _result(passed: bool) -> str:
    return "passed" if passed else "FAILED"


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    sys.exit(main())
