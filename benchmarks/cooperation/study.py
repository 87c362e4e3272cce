"""Measure whether cooperation helps a small model: `python -m benchmarks.cooperation.study WORKDIR`, from a checkout.

It takes less than three hours of two cores. What is compared stands in protocol.py. Each stage is
skipped if its output is in WORKDIR, and one that broke off goes on: the same command ends what was begun. `--only` does
one stage, `--smoke` a tiny version of all in minutes (in a WORKDIR of its own), `--publish` copies the summary and the
counts beside this file, from which `python docs/make_tables.py model` makes the page, and the weights into the package.
"""

import argparse
import json
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import mean, median
from typing import Any, Final

import torch

from benchmarks.cooperation.numbers import differences, row_numbers
from benchmarks.cooperation.protocol import (
    ARMS,
    COMPARED,
    HEADLINE_NUMBER,
    PROTOCOL,
    SHIPPED,
    SMOKE,
    Protocol,
    ReleasePlan,
    rows_of,
)
from benchmarks.cooperation.rows import RowJob, count_results, evaluators_of, opened, write_counts, write_results
from deepaccident_devkit import __version__
from deepaccident_devkit.evaluation import Resampling
from deepaccident_devkit.model.checkpoint import FINAL, read_weights, write_weights
from deepaccident_devkit.model.checkpoint import SHIPPED as SHIPPED_WEIGHTS
from deepaccident_devkit.model.presets import ModelChoice, load_model
from deepaccident_devkit.model.results import PredictConfig
from deepaccident_devkit.model.training_loop import train
from deepaccident_devkit.model.training_run import TrainConfig, read_log
from deepaccident_devkit.model.training_step import SCORE, validated, validation_samples
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.release.layout import write_split_file
from deepaccident_devkit.support.files import write_bytes
from deepaccident_devkit.synth import SynthConfig, make_release

HERE: Final = Path(__file__).parent
SUMMARY: Final = "study.json"
COUNTS: Final = "counts.json.gz"
_SCORES: Final = "scores.json"
WEIGHTS: Final = SHIPPED_WEIGHTS["tiny"].name
_NOT_SHIPPED: Final = ("num_batches_tracked", "frustum")
_SYNTH: Final = ("scenarios", "frames", "image_size", "seed", "sensors", "view", "designs")


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """A run of the protocol in a folder."""

    folder: Path
    protocol: Protocol
    device: str = "cpu"
    processes: int = 2

    def release(self, name: str) -> Path:
        """Folder of one of the three releases."""
        return self.folder / "releases" / name

    def split(self, name: str) -> Path:
        """A split file."""
        return self.folder / "releases" / f"{name}.txt"

    def weights(self, arm: str, seed: int) -> Path:
        """Where training puts the weights of an arm."""
        return self.folder / "runs" / f"{arm}-{seed}" / FINAL

    def first(self, seed: int, rate: float) -> Path:
        """Likewise, of the first steps with a learning rate: where both arms begin."""
        return self.weights(f"first-{rate:g}", seed)

    def jobs(self) -> dict[str, RowJob]:
        """Row, and for models its seed → the job."""
        found = {}
        for row in rows_of(self.protocol):
            seeds: Sequence[int | None] = self.protocol.seeds if row.kind == "model" else (None,)
            for seed in seeds[:1] if row.first_seed_alone else seeds:
                key = row.name if seed is None else f"{row.name}#{seed}"
                found[key] = RowJob(
                    row=row,
                    release=self.release("test"),
                    split=self.split("test"),
                    out=self.folder / "rows" / key.replace(", ", "_").replace(" ", "_"),
                    weights=None if seed is None or row.arm is None else self.weights(row.arm, seed),
                    device=self.device,
                )
        return found

    def stored(self, name: str) -> Any:
        """What a stage has noted; None before it ends."""
        path = self.folder / "stages" / f"{name}.json"
        return json.loads(path.read_text()) if path.exists() else None


def releases(study: Study) -> dict[str, Any]:
    """Generate the three releases, with images alone, and their split files."""
    told = {}
    for name in ("training", "tuning", "test"):
        tokens = _made(study, name, getattr(study.protocol, name))
        found = fingerprint(scenario_hashes(opened(study.release(name)), set(tokens)))
        told[name] = {"scenarios": len(tokens), "fingerprint": found}
    return told


def _made(study: Study, name: str, plan: ReleasePlan) -> list[str]:
    """Make a release, if it is not there, and its split file; returns its scenarios."""
    if not study.release(name).exists():
        make_release(study.release(name), _synth(study, plan), workers=study.processes, progress=True)
    tokens = [record["token"] for record in opened(study.release(name)).scenario]
    write_split_file(study.split(name), tokens)
    return tokens


def _synth(study: Study, plan: ReleasePlan) -> SynthConfig:
    return SynthConfig(
        scenarios=plan.scenarios,
        frames=study.protocol.frames,
        image_size=study.protocol.image_size,
        seed=plan.seed,
        sensors="cameras",
        view="hidden",
        designs=plan.designs,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainJob:
    """One run of training; cheap to pickle."""

    release: Path
    out: Path
    config: TrainConfig
    weights: Path | None
    device: str
    choice: ModelChoice = field(default_factory=ModelChoice)


def trained(job: TrainJob) -> None:
    """Train; a run that is there goes on, and one that has ended is left as it is."""
    train(opened(job.release), job.out, job.choice, job.config, weights=job.weights, device=job.device)


def tuning(study: Study) -> dict[str, Any]:
    """Take the first steps of the first seed with each learning rate; the best score on the tuning release chooses."""
    protocol = study.protocol
    jobs = {rate: _first_job(study, protocol.seeds[0], rate) for rate in protocol.learning_rates}
    together(study, trained, jobs.values())
    given = {"release": "tuning", "agents": "single", "samples": protocol.tuning_samples}
    together(study, scored, [ScoreJob(study=study, weights=job.out / FINAL, **given) for job in jobs.values()])
    scores = {
        rate: {**json.loads((job.out / _SCORES).read_text()), "loss": _last_loss(read_log(job.out))}
        for rate, job in jobs.items()
    }
    best = max(found[SCORE] for found in scores.values())
    if best >= protocol.least_score:
        chosen = max(scores, key=lambda rate: scores[rate][SCORE])
    else:
        chosen = min(scores, key=lambda rate: scores[rate]["loss"])
    return {"rounds": [{f"{rate:g}": found for rate, found in scores.items()}], "learning_rate": chosen}


@dataclass(frozen=True, slots=True, kw_only=True)
class ScoreJob:
    """Weights that are scored on a release; cheap to pickle."""

    study: Study
    weights: Path
    release: str
    agents: str
    samples: int
    """How many of the release's, evenly chosen; 0 for all."""

    @property
    def out(self) -> Path:
        """The folder of the scores."""
        return self.weights.parent


def scored(job: ScoreJob) -> None:
    """Write the scores of weights beside them."""
    study = job.study
    dataset = opened(study.release(job.release))
    config = TrainConfig(validation=str(study.split(job.release)), validation_samples=job.samples)
    predict = PredictConfig(agents=job.agents, device=study.device)
    model = load_model(job.weights).to(study.device)
    scores = validated(model, dataset, validation_samples(dataset, config), predict)
    write_bytes(job.out / _SCORES, json.dumps(scores).encode())


def _last_loss(log: Sequence[Mapping[str, Any]]) -> float:
    """The mean of the last 50 steps."""
    return float(mean(row["loss"] for row in log[-50:]))


def _first_job(study: Study, seed: int, rate: float) -> TrainJob:
    return _job(study, study.first(seed, rate), "single", study.protocol.first_steps, seed, rate)


def _job(study: Study, weights: Path, agents: str, steps: int, seed: int, rate: float) -> TrainJob:
    """A run on the training release, from random weights."""
    return TrainJob(
        release=study.release("training"),
        out=weights.parent,
        config=TrainConfig(
            steps=steps,
            agents=agents,
            egos=study.protocol.egos,
            learning_rate=rate,
            split=str(study.split("training")),
            validation=None,
            seed=seed,
        ),
        weights=None,
        device=study.device,
    )


def training(study: Study) -> dict[str, Any]:
    """Each seed alone first, then both arms from its weights, equal except for the agents."""
    protocol, rate = study.protocol, study.stored("tuning")["learning_rate"]

    def then(done: TrainJob) -> list[TrainJob]:
        if done.weights is not None:
            return []
        seed, first = done.config.seed, done.out / FINAL
        return [
            replace(_job(study, study.weights(arm, seed), agents, protocol.arm_steps, seed, rate), weights=first)
            for arm, agents in ARMS.items()
        ]

    together(study, trained, [_first_job(study, seed, rate) for seed in protocol.seeds], then)
    runs = {
        f"{arm}-{seed}": path.parent
        for seed in protocol.seeds
        for arm, path in {"first": study.first(seed, rate), **{arm: study.weights(arm, seed) for arm in ARMS}}.items()
    }
    logs = {name: read_log(folder) for name, folder in runs.items()}
    return {
        name: {
            "steps": len(log),
            "loss": _last_loss(log),
            "seconds": sum(row["seconds"] for row in log),
        }
        for name, log in logs.items()
    }


def weights(study: Study) -> dict[str, Any]:
    """Round the weights of the arm `all` and the first seed, score them, and note the scores with them: they ship."""
    arm, seed = "all", study.protocol.seeds[0]
    _made(study, "shipped", SHIPPED)
    given = read_weights(study.weights(arm, seed)).tensors
    tensors = {name: each for name, each in given.items() if not name.endswith(_NOT_SHIPPED)}
    path = study.folder / "shipped" / WEIGHTS
    synth = _synth(study, SHIPPED)
    made = {
        "command": "python -m benchmarks.cooperation.study WORKDIR --publish",
        "protocol": asdict(study.protocol),
        "arm": arm,
        "seed": seed,
        "learning_rate": study.stored("tuning")["learning_rate"],
        "release": study.stored("releases")["training"]["fingerprint"],
        "devkit": __version__,
        "torch": torch.__version__,
    }
    notes = {**ModelChoice().as_dict(), "made": made}
    write_weights(path, tensors, notes, half=True)
    together(study, scored, [ScoreJob(study=study, weights=path, release="shipped", agents=arm, samples=0)])
    told = {
        "agents": arm,
        "synth": {name: getattr(synth, name) for name in _SYNTH},
        "scores": json.loads((path.parent / _SCORES).read_text()),
    }
    write_weights(path, tensors, {**notes, "scored": told}, half=True)
    return {**told, "bytes": path.stat().st_size}


def costs(study: Study) -> dict[str, Any]:
    """Seconds of a step with each fusion, and with a longer horizon; one process alone."""
    protocol, found = study.protocol, {}
    for name in protocol.costs:
        job = TrainJob(
            release=study.release("tuning"),
            out=study.folder / "runs" / f"cost-{name.replace(' ', '')}",
            config=TrainConfig(
                steps=protocol.cost_steps, egos=protocol.egos, split=str(study.split("tuning")), validation=None
            ),
            weights=None,
            device=study.device,
            choice=ModelChoice(horizon=float(name.removesuffix(" s")))
            if name.endswith(" s")
            else ModelChoice(fusion=name),
        )
        together(replace(study, processes=1), trained, [job])
        found[name] = median(row["seconds"] for row in read_log(job.out))
    return found


def predicting(study: Study, *, controls: bool) -> dict[str, Any]:
    """Write the results of the rows with, or without, spoilt inputs."""
    jobs = {name: job for name, job in study.jobs().items() if (job.row.control is not None) == controls}
    together(study, write_results, jobs.values())
    return {"rows": list(jobs)}


def evaluation(study: Study) -> dict[str, Any]:
    """Count all rows: bundles, and hidden actors."""
    jobs = study.jobs()
    together(study, count_results, jobs.values())
    return {"rows": list(jobs)}


def bundles(study: Study) -> dict[str, Any]:
    """Write the summary and all counts."""
    found = {name: evaluators_of(job.out) for name, job in study.jobs().items()}
    write_counts(study.folder / COUNTS, found)
    seconds = json.loads((study.folder / "seconds.json").read_text())
    notes = {name: study.stored(name) for name in ("releases", "tuning", "training", "costs", "weights")}
    summary = {
        "protocol": asdict(study.protocol),
        "smoke": study.protocol != PROTOCOL,
        **summarised(found, study.protocol),
        **notes,
        "seconds": seconds,
        "machine": machine(study),
    }
    write_bytes(study.folder / SUMMARY, (json.dumps(summary, indent=1) + "\n").encode())
    return {"counts_bytes": (study.folder / COUNTS).stat().st_size}


def summarised(found: Mapping[str, Any], protocol: Protocol) -> dict[str, Any]:
    """Every number of all rows and comparisons, from the evaluators of `ROW#SEED` or `ROW`."""
    resampling = Resampling(resamples=protocol.resamples)
    keys: dict[str, list[str]] = {}
    for key in found:
        keys.setdefault(key.partition("#")[0], []).append(key)
    rows = {
        row.name: {
            "says": row.says,
            "numbers": row_numbers([found[key] for key in keys[row.name]], resampling),
            "seeds": {_seed(key): row_numbers([found[key]], resampling) for key in keys[row.name] if _seed(key)},
            "designs": {
                name: row_numbers([found[key] for key in keys[row.name]], resampling, tokens)
                for name, tokens in by_design(found, protocol).items()
            },
        }
        for row in rows_of(protocol)
    }
    compared = [
        {
            "first": one,
            "second": other,
            "numbers": differences(*([found[key] for key in keys[name]] for name in (one, other)), resampling),
            "seeds": {
                _seed(first): differences([found[first]], [found[second]], resampling)
                for first, second in zip(keys[one], keys[other], strict=True)
            },
        }
        for one, other in COMPARED
    ]
    first = next(iter(found.values()))
    tokens = first["motion"].tokens
    hidden = first["hidden"].compute()
    return {
        "samples": len(tokens),
        "pairs": len({token.split("/")[1] for token in tokens}),
        "positives": first["accident"].compute().positives,
        "actors": {"hidden": hidden.hidden, "seen": hidden.seen},
        "headline_number": HEADLINE_NUMBER,
        "rows": rows,
        "differences": compared,
    }


def by_design(found: Mapping[str, Any], protocol: Protocol) -> dict[str, list[str]]:
    """The samples of designs that models have learned from, and of the one that was held out."""
    groups: dict[str, list[str]] = {"seen": [], "held out": []}
    for token in sorted(next(iter(found.values()))["motion"].tokens):
        pair = int(token.split("/")[1].rpartition("scenario")[2]) - 1
        design = protocol.test.designs[pair % len(protocol.test.designs)]
        groups["seen" if design in protocol.training.designs else "held out"].append(token)
    return groups


def _seed(key: str) -> str:
    """The model's seed in `ROW#SEED`."""
    return key.partition("#")[2]


def machine(study: Study) -> dict[str, Any]:
    """What it ran on."""
    gpu = torch.cuda.get_device_name(study.device) if study.device.startswith("cuda") else None
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "processes": study.processes,
        "gpu": gpu,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "devkit": __version__,
    }


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.machine()


def together(
    study: Study,
    work: Callable[[Any], None],
    jobs: Iterable[Any],
    then: Callable[[Any], Sequence[Any]] | None = None,
) -> None:
    """Do jobs in a few processes of one thread each; `then` says which ones follow one that is done."""
    with ProcessPoolExecutor(
        study.processes, mp_context=get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)
    ) as pool:
        running: dict[Future[None], Any] = {pool.submit(work, job): job for job in jobs}
        try:
            while running:
                done, _ = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    job = running.pop(future)
                    future.result()
                    print(f"  done: {job.out.name}", flush=True)
                    running |= {pool.submit(work, each): each for each in (then(job) if then else ())}
        except BaseException:
            pool.shutdown(cancel_futures=True)  # those that run end first: they keep what they have
            raise


STAGES: Final[Mapping[str, Callable[[Study], dict[str, Any]]]] = {
    "releases": releases,
    "tuning": tuning,
    "training": training,
    "predictions": lambda study: predicting(study, controls=False),
    "controls": lambda study: predicting(study, controls=True),
    "evaluation": evaluation,
    "costs": costs,
    "weights": weights,
    "bundles": bundles,
}


def run(study: Study, only: Sequence[str] = tuple(STAGES)) -> None:
    """Do the stages that are not done; the seconds of each are added up over interruptions, except by kill -9."""
    _claim(study)
    for name in only:
        if study.stored(name) is not None:
            continue
        print(f"{name} …", flush=True)
        began = time.monotonic()
        try:
            told = STAGES[name](study)
        finally:
            _add_seconds(study, name, time.monotonic() - began)
        write_bytes(study.folder / "stages" / f"{name}.json", json.dumps(told, indent=1).encode())
    times = json.loads((study.folder / "seconds.json").read_text())
    print(
        ", ".join(f"{name} {each:.0f} s" for name, each in times.items()), f"in all {sum(times.values()) / 3600:.2f} h"
    )


def _claim(study: Study) -> None:
    """Refuse a folder of another protocol."""
    path, told = study.folder / "protocol.json", json.dumps(asdict(study.protocol), indent=1)
    (study.folder / "stages").mkdir(parents=True, exist_ok=True)
    if path.exists() and path.read_text() != told:
        raise SystemExit(f"{path}: is of another protocol; choose another folder")
    write_bytes(path, told.encode())


def _add_seconds(study: Study, name: str, seconds: float) -> None:
    path = study.folder / "seconds.json"
    known = json.loads(path.read_text()) if path.exists() else {}
    write_bytes(path, json.dumps({**known, name: known.get(name, 0.0) + seconds}).encode())


def main() -> None:
    """Parse and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workdir", type=Path)
    parser.add_argument("--only", choices=STAGES, help="this stage alone")
    parser.add_argument("--smoke", action="store_true", help="all of it, tiny")
    parser.add_argument("--publish", action="store_true", help="copy all to where it is published")
    parser.add_argument("--device", default="cpu", help="of the models; a GPU is named in the summary")
    given = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes to come
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    study = Study(
        folder=given.workdir.resolve(),
        protocol=SMOKE if given.smoke else PROTOCOL,
        device=given.device,
        processes=2 if given.device == "cpu" else 1,
    )
    run(study, [given.only] if given.only else tuple(STAGES))
    if given.publish:
        if given.smoke:
            raise SystemExit("--publish, --smoke: the numbers of the smoke run say nothing; leave one of the two out")
        for name in (SUMMARY, COUNTS):
            shutil.copyfile(study.folder / name, HERE / name)
        shutil.copyfile(study.folder / "shipped" / WEIGHTS, SHIPPED_WEIGHTS["tiny"])


if __name__ == "__main__":
    main()
