"""Apply mutations, run `validate` and undo the changes, in several processes with a copy each."""

import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from deepaccident_devkit.plugins.synth import SynthConfig, make_release
from deepaccident_devkit.release import find_release
from fault_injection.editor import NoVictimError, UndoableEditor
from fault_injection.mutations import BEYOND, MUTATIONS, seeded
from fault_injection.mutations.calib import marker

RELEASE_CONFIG = SynthConfig(
    scenarios=2, frames=7, image_size=(96, 54), seed=8, unplanned=0, designed=True
)
NUM_MUTATIONS = 200
NUM_SEEDS_BEYOND = 2
NUM_WORKERS = 2


@dataclass(frozen=True, slots=True, order=True)
class Job:
    """One application of a mutation."""

    name: str
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What `validate` found in a mutated release.

    Attributes:
        job: Mutation and seed.
        token: Token of the mutated scenario.
        changed: Files that the mutation changed, added or removed.
        errors: Codes of the errors, sorted.
        warnings: Codes of the warnings, sorted.
        code_ran: Whether a pickle of the release ran its own code.
    """

    job: Job
    token: str
    changed: tuple[str, ...]
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    code_ran: bool

    @property
    def found(self) -> bool:
        """Whether there was any error or warning."""
        return bool(self.errors or self.warnings)


def list_jobs(count: int = NUM_MUTATIONS) -> list[Job]:
    """Return every mutation with seed 0, then every one with seed 1, … up to `count` jobs.

    Mutations that need not be found follow, and are not counted.
    """
    names = [name for name in MUTATIONS if name not in BEYOND]
    all_jobs = []
    for number in range(count):
        seed, index = divmod(number, len(names))
        all_jobs.append(Job(names[index], seed))
    for seed in range(NUM_SEEDS_BEYOND):
        all_jobs.extend(Job(name, seed) for name in BEYOND)
    return all_jobs


def make_healthy(folder: Path) -> Path:
    """Make the release that is mutated: an accident and its normal twin."""
    return make_release(folder / "release", RELEASE_CONFIG, workers=NUM_WORKERS)


def open_editors(root: Path) -> dict[str, UndoableEditor]:
    """Return an editor for each scenario of a release, by the scenario's token."""
    scenarios = find_release(root).scenarios
    return {scenario.token: UndoableEditor(root, scenario) for scenario in scenarios}


def mutate(job: Job, editors: dict[str, UndoableEditor]) -> UndoableEditor:
    """Apply a mutation to the first scenario with a victim, in an order chosen by the seed.

    Returns the editor of that scenario.
    """
    mutation = MUTATIONS[job.name]
    rng = seeded(job.name, job.seed)
    tokens = sorted(
        token
        for token in editors
        if mutation.only is None or token.split("/")[0].endswith(mutation.only)
    )
    for token in rng.permutation(tokens):
        editor = editors[str(token)]
        assert set(editor.sightings) == set(editor.agents)  # read before the first change
        try:
            mutation.apply(editor, rng)
        except NoVictimError:
            assert not editor.changes()
        else:
            return editor
    raise NoVictimError(
        f"{job.name}: nobody in {', '.join(tokens)} is what it needs; "
        "try another seed of RELEASE_CONFIG"
    )


def run(root: Path, jobs_to_run: Sequence[Job]) -> list[Outcome]:
    """Return the outcomes of the jobs, in their order.

    Slow jobs (deep ones) start first, so that they are spread evenly over the processes.
    """
    slow_jobs_first = sorted(jobs_to_run, key=lambda job: (not MUTATIONS[job.name].deep, job))
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:  # hard links need one file system
        context = multiprocessing.get_context("spawn")
        initargs = (root, Path(folder))
        with ProcessPoolExecutor(NUM_WORKERS, context, _start_worker, initargs) as pool:
            outcomes = {outcome.job: outcome for outcome in pool.map(_run_job, slow_jobs_first)}
    return [outcomes[job] for job in jobs_to_run]


_EDITORS: dict[str, UndoableEditor] = {}
"""Editors of this process's copy of the release, by token."""


def _start_worker(root: Path, folder: Path) -> None:
    copy = folder / str(os.getpid())
    shutil.copytree(root, copy, copy_function=os.link)
    _EDITORS.update(open_editors(copy))


def _run_job(job: Job) -> Outcome:
    from deepaccident_devkit.validation import validate_release

    editor = mutate(job, _EDITORS)
    try:
        changed = tuple(editor.changes())
        mutation = MUTATIONS[job.name]
        scenarios = None if mutation.group == "release" else [editor.token]
        report = validate_release(editor.root, deep=mutation.deep, workers=1, scenarios=scenarios)
        code_ran = marker(editor.root).exists()
    finally:
        editor.restore()
        shutil.rmtree(marker(editor.root), ignore_errors=True)
        shutil.rmtree(editor.root / ".deepaccident", ignore_errors=True)

    codes: dict[str, set[str]] = {"error": set(), "warning": set(), "note": set()}
    for finding in report.findings:
        codes[finding.severity].add(finding.code)
    return Outcome(
        job=job,
        token=editor.token,
        changed=changed,
        errors=tuple(sorted(codes["error"])),
        warnings=tuple(sorted(codes["warning"])),
        code_ran=code_ran,
    )
