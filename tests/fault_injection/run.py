"""Applying mutations, asking `validate`, and putting everything back: in several processes, each
with its own copy.
"""

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
from fault_injection.mutations import BEYOND, MUTATIONS, seeded
from fault_injection.mutations.calib import marker
from fault_injection.place import NoVictimError, Place

RELEASE = SynthConfig(
    scenarios=2, frames=7, image_size=(96, 54), seed=8, unplanned=0, designed=True
)
NUM_MUTATIONS = 200
SEEDS_BEYOND = 2
WORKERS = 2


@dataclass(frozen=True, slots=True, order=True)
class Job:
    """One application of a mutation."""

    name: str
    seed: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What `validate` said of a mutated release.

    Attributes:
        job: the mutation and its seed.
        token: the scenario that was mutated.
        changed: files that it changed, added or removed.
        errors: codes of the new findings that are errors, sorted.
        warnings: codes of the new warnings, sorted.
        code_ran: whether a pickle of the release ran its own code.
    """

    job: Job
    token: str
    changed: tuple[str, ...]
    errors: tuple[str, ...]
    warnings: tuple[str, ...]
    code_ran: bool

    @property
    def found(self) -> bool:
        """Whether anything was said."""
        return bool(self.errors or self.warnings)


def jobs(count: int = NUM_MUTATIONS) -> list[Job]:
    """Every mutation with seed 0, then every one with seed 1, … up to `count`, then those that need
    not be found.
    """
    names = [name for name in MUTATIONS if name not in BEYOND]
    counted = [Job(names[number % len(names)], number // len(names)) for number in range(count)]
    return [*counted, *(Job(name, seed) for seed in range(SEEDS_BEYOND) for name in BEYOND)]


def make_healthy(folder: Path) -> Path:
    """The release that is mutated: an accident and its normal twin."""
    return make_release(folder / "release", RELEASE, workers=WORKERS)


def places(root: Path) -> dict[str, Place]:
    """Token → scenario of a release."""
    return {scenario.token: Place(root, scenario) for scenario in find_release(root).scenarios}


def mutate(job: Job, of: dict[str, Place]) -> Place:
    """Apply a mutation to the first scenario with a victim for it, in an order that its seed
    chooses.
    """
    mutation, rng = MUTATIONS[job.name], seeded(job.name, job.seed)
    fitting = sorted(
        token
        for token in of
        if mutation.only is None or token.split("/")[0].endswith(mutation.only)
    )
    for token in rng.permutation(fitting):
        place = of[str(token)]
        assert set(place.sightings) == set(place.agents)  # looked at while all is well
        try:
            mutation.apply(place, rng)
        except NoVictimError:
            assert not place.changes()
        else:
            return place
    raise NoVictimError(
        f"{job.name}: nobody in {', '.join(fitting)} is what it needs; try another seed of RELEASE"
    )


def run(root: Path, wanted: Sequence[Job]) -> list[Outcome]:
    """Outcomes of the jobs, in their order. The dear ones (deep) are spread evenly over the
    processes.
    """
    dear_first = sorted(wanted, key=lambda job: (not MUTATIONS[job.name].deep, job))
    with tempfile.TemporaryDirectory(dir=root.parent) as folder:  # hard links need one file system
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(WORKERS, context, _start, (root, Path(folder))) as pool:
            outcomes = {outcome.job: outcome for outcome in pool.map(_outcome, dear_first)}
    return [outcomes[job] for job in wanted]


_OWN: dict[str, Place] = {}
"""The scenarios of this process's copy."""


def _start(root: Path, folder: Path) -> None:
    copy = folder / str(os.getpid())
    shutil.copytree(root, copy, copy_function=os.link)
    _OWN.update(places(copy))


def _outcome(job: Job) -> Outcome:
    from deepaccident_devkit.validation import validate_release

    place = mutate(job, _OWN)
    try:
        changed = tuple(place.changes())
        kind = MUTATIONS[job.name]
        scenarios = None if kind.group == "release" else [place.token]
        report = validate_release(place.root, deep=kind.deep, workers=1, scenarios=scenarios)
        code_ran = marker(place.root).exists()
    finally:
        place.restore()
        shutil.rmtree(marker(place.root), ignore_errors=True)
        shutil.rmtree(place.root / ".deepaccident", ignore_errors=True)
    told = {(finding.severity, finding.code) for finding in report.findings}
    return Outcome(
        job=job,
        token=place.token,
        changed=changed,
        errors=tuple(sorted(code for severity, code in told if severity == "error")),
        warnings=tuple(sorted(code for severity, code in told if severity == "warning")),
        code_ran=code_ran,
    )
