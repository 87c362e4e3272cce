"""What two checkouts of the devkit compute and write, compared by named digests: `digests.py BEFORE AFTER`.

Both read the same releases, made by BEFORE with a fixed seed, one after the other in the same folder, so that paths in
files are equal. A worker in each checkout writes a JSON file of names and digests: tables, labels, predictions, counts
and summaries of all protocols, exports, a generated release. A name that a checkout cannot compute has the error as its
digest. Then the names that changed, came and went are printed. Exit status 1 if there is one that no --expect names.

    python .ci/tools/digests.py ../main . --expect 'evaluate/warning/boxes/*' --expect 'export/*.manifest.json'

It takes some four minutes of a processor.
"""

import argparse
import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

RELEASES = {
    "labelled": ["--scenarios", "6", "--frames", "35", "--sensors", "none", "--seed", "977"],
    "sensors": ["--scenarios", "2", "--frames", "11", "--size", "32x18", "--seed", "978"],
}
"""Name → how `synth` makes it: one with pasts and futures, and a small one with all sensors."""
GENERATED = ["--scenarios", "2", "--frames", "2", "--size", "48x27", "--seed", "979", "--layout", "B", "--designed"]
"""How each checkout makes a release of its own, all of whose files are compared."""
EXPORTS = {
    "cache": ("sensors", ["cache", "--size", "16x9", "--where", "length=1..1000"]),
    "labels": ("labelled", ["labels", "--samples", "all", "--split"]),
    "labels of beverse": ("labelled", ["labels", "--samples", "evaluate", "--names", "beverse", "--split"]),
    "mcap": ("sensors", ["export", "mcap", "--motion-labels", "deepaccident"]),
    "mmdet3d": ("sensors", ["export", "mmdet3d"]),
    "mmdet3d released": ("sensors", ["export", "mmdet3d", "--style", "released"]),
    "nuscenes": ("sensors", ["export", "nuscenes"]),
    "opencood": ("sensors", ["export", "opencood"]),
    "parquet": ("labelled", ["export", "parquet"]),
    "questions": ("labelled", ["export", "questions", "--observe", "1", "--ahead", "1", "--stride", "0.5"]),
    "town-maps": ("sensors", ["export", "town-maps"]),
    "webdataset": ("sensors", ["export", "webdataset"]),
}
"""Name → the release that is exported, and the command; what ends in --split gets a split file of all scenarios."""
FILES_LEFT_OUT = {
    "*.deepaccident*": "marks of how far an export is, for the devkit alone",
    "*.manifest.json": "names the version of the devkit and of what it kept",
}
"""Pattern of files that are not compared → why."""
KEYS_LEFT_OUT = {
    "devkit_version": "a version",
    "environment": "versions of libraries",
    "settings": "all choices of the protocol: one that nobody can choose is none",
    "switches": "as settings",
    "explanation": "asked for by no evaluation here",
    "sanity": "asked for by no evaluation here",
    "results": "where the predictions are, and notes with a version; they have digests of their own",
}
"""Key of an evaluation's summary that is not compared → why."""
SPLIT = "everything.txt"
"""Name of a split file of all scenarios of the labelled release."""
SHOWN = 20
"""Names of a section that are printed one by one."""
Digests = dict[str, str]


def digest(value: object) -> str:
    """A hash of values: arrays by type, shape and bytes, records by the fields that say something."""
    made = hashlib.sha256()
    for part in _parts(value):
        made.update(part)
    return made.hexdigest()[:16]


def _parts(value: Any) -> Iterator[bytes]:
    """What a value is made of, as bytes."""
    if dataclasses.is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        for name in sorted(value, key=repr):
            if value[name] is not None:  # a field that is not set may as well not be there
                yield f"{name!r}:".encode()
                yield from _parts(value[name])
    elif isinstance(value, bytes):
        yield value
    elif hasattr(value, "tobytes"):
        yield f"{value.dtype}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, Iterable) and not isinstance(value, str):
        yield b"["
        for each in value:
            yield from _parts(each)
        yield b"]"
    else:
        yield f"{value!r},".encode()


def leaves(value: Any, name: str = "", depth: int = 3) -> Iterator[tuple[str, str]]:
    """Name and text of each value of a JSON document; the digest of what is long, or deeper in it."""
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        value = dict(enumerate(value))
    if isinstance(value, Mapping) and depth:
        for key, each in value.items():
            yield from leaves(each, f"{name}/{key}", depth - 1)
    else:
        text = json.dumps(value)
        yield name.removeprefix("/"), text if len(text) <= 40 else digest(value)


class Found:
    """The digests of a checkout, as they are found."""

    def __init__(self) -> None:
        self.digests: Digests = {}

    def add(self, name: str, find: Callable[..., object], *arguments: object) -> None:
        """Take the digest of what a function gives, or those by name that it gives, or the error that it raises."""
        try:
            found = find(*arguments)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever a name that went brings about
            self.digests[name] = f"{type(error).__name__}: {str(error)[:160]}"
        else:
            if isinstance(found, Mapping):
                self.digests |= {f"{name}/{part}": each for part, each in found.items()}
            else:
                self.digests[name] = digest(found)


def command(*arguments: str) -> None:
    """Run a command of the devkit in this process, silently; older checkouts spell some options otherwise."""
    import click

    from deepaccident_devkit.cli import deepaccident

    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        try:
            deepaccident.main(list(arguments), standalone_mode=False)
        except click.UsageError:
            deepaccident.main(_as_before(arguments), standalone_mode=False)


def _as_before(arguments: Sequence[str]) -> list[str]:
    """A command as it was written before November 2026; every spelling that went gets a line here."""
    words = [word for word in arguments if word != "--designed"]
    if words != list(arguments):
        return words  # of a day on which the other spellings were there
    size = {"synth": "--image-size", "cache": "--resize"}.get(words[0], "--size")
    return "\0".join(words).replace("--sensors\0none", "--no-sensors").replace("--size", size).split("\0")


def digests_of_files(folder: Path) -> Digests:
    """Relative path → hash of the content of each file; of a link, where it leads to."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if not path.is_dir() and not any(fnmatchcase(name, pattern) for pattern in FILES_LEFT_OUT):
            found[name] = digest(str(path.readlink()) if path.is_symlink() else path.read_bytes())
    return found


def digests_of_tables(dataset: Any, table: str) -> Digests:
    """Each column as Arrow holds it, and each further field as records have it."""
    arrow, records = dataset.arrow(table), list(getattr(dataset, table))
    fields = [field for field in (records[0] if records else ()) if field not in arrow.column_names]
    return {
        **{name: digest([str(arrow.schema.field(name).type), arrow[name].to_pylist()]) for name in arrow.column_names},
        **{name: digest([record[name] for record in records]) for name in fields},
    }


def add_tables(found: Found, name: str, dataset: Any) -> None:
    """The index's tables, and what is derived from them: boxes, and pairs of road users."""
    for table in dataset.table_names:
        found.add(f"tables/{name}/{table}", digests_of_tables, dataset, table)
    for frame in ("world", "ego", "lidar"):
        found.add(f"tables/{name}/box/{frame}", digests_of_boxes, dataset, frame)
    for record in dataset.scenario:
        found.add(f"tables/{name}/interaction/{record['token']}", digests_of_pairs, dataset, record["token"])


def digests_of_boxes(dataset: Any, frame: str) -> Digests:
    """Each field of the boxes of some samples."""
    boxes = [dataset.boxes(token, frame) for token in some_samples(dataset, 40)]
    return {each.name: digest([getattr(one, each.name) for one in boxes]) for each in dataclasses.fields(boxes[0])}


def digests_of_pairs(dataset: Any, scenario: str) -> Digests:
    """Each column of the two tables of a scenario's interactions."""
    from deepaccident_devkit.interactions import interactions

    made = interactions(dataset, scenario)
    tables = {"interaction": made.to_arrow(), "interaction_pair": made.pairs.to_arrow()}
    return {
        f"{name}/{column}": digest(of[column].to_pylist()) for name, of in tables.items() for column in of.column_names
    }


def add_labels(found: Found, dataset: Any, sensors: Any) -> None:
    """Motion labels by each preset and protocol, and targets of segmentation."""
    from deepaccident_devkit.motion import LABEL_PROTOCOLS, PRESETS, MotionLabelConfig, bev_segmentation

    configs = {name: MotionLabelConfig.preset(name) for name in PRESETS}
    configs |= {f"protocol {name}": MotionLabelConfig(protocol=name) for name in LABEL_PROTOCOLS}
    configs |= {"agents single": MotionLabelConfig(agents="single"), "vehicles": MotionLabelConfig(only_vehicle=True)}
    for name, config in configs.items():
        found.add(f"labels/{name}", digests_of_labels, dataset, config)
    for token in some_samples(sensors, 6):
        found.add(f"labels/segmentation/{token}", bev_segmentation, sensors, token)


def digests_of_labels(dataset: Any, config: Any) -> Digests:
    """All arrays of the labels of some samples."""
    from deepaccident_devkit.motion import motion_labels

    made = [motion_labels(dataset, token, config) for token in some_samples(dataset, 12)]
    fields = ("segmentation", "instance", "centerness", "offset", "flow", "future_egomotion", "valid", "id_map")
    return {field: digest([getattr(each, field) for each in made]) for field in fields}


def some_samples(dataset: Any, count: int) -> list[str]:
    """Tokens of about this many samples, of all scenarios and agents in turn."""
    tokens = [record["token"] for record in dataset.sample]
    return tokens[7 :: len(tokens) // count]


def baselines() -> Mapping[str, Any]:
    """Those whose predictions are evaluated."""
    from deepaccident_devkit.baselines import Baseline
    from deepaccident_devkit.v2x import Link

    noisy = Link(latency=0.2, pose_noise=0.4, packet_loss=0.1, seed=977)
    return {
        "constant velocity": Baseline(),
        "turn rate of all, noisy": Baseline(agents="all", model="constant_turn_rate", link=noisy, horizon=3.0),
    }


def add_evaluations(found: Found, dataset: Any, split: Path, folder: Path) -> None:
    """Predictions of baselines; counts, numbers and breakdowns of each protocol of each task that takes them."""
    from deepaccident_devkit.baselines import predict_results
    from deepaccident_devkit.evaluation import read_results
    from deepaccident_devkit.evaluation.runs import SampleSelection
    from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS, TASK_RESULTS

    tokens = SampleSelection(split=str(split), samples="all", scope="all").tokens(dataset)
    for name, baseline in baselines().items():
        for kind in ("motion", "accident", "detection"):
            path = folder / name / (kind if kind == "motion" else f"{kind}.json")
            path.parent.mkdir(parents=True, exist_ok=True)
            results = read_results(predict_results(dataset, kind, tokens, path, baseline))
            found.add(f"predicted/{name}/{kind}", map, results.prediction, tokens)
            for task, protocol in [(task, each) for task, of in TASK_PROTOCOLS.items() for each in of]:
                maps_alone = (task, protocol) == ("accident", "released")
                if kind in (("motion",) if maps_alone else TASK_RESULTS[task]):
                    told = f"evaluate/{task}/{protocol}/{name}, {kind}"
                    found.add(told, digests_of_evaluation, dataset, results, task, protocol, split)


def digests_of_evaluation(dataset: Any, results: Any, task: Any, protocol: str, split: Path) -> Digests:
    """The numbers of an evaluation by name, and digests of its breakdowns and of the samples' counts."""
    from deepaccident_devkit.evaluation import Resampling
    from deepaccident_devkit.evaluation.runs import default_selection, evaluate_results, with_prevented
    from deepaccident_devkit.evaluation.runs.setups import EvaluationSetup

    setup, resampling = EvaluationSetup(task=task, protocol=protocol), Resampling(resamples=30)
    run = evaluate_results(dataset, results, setup, default_selection(setup, split), allow_partial=True)
    run = run.broken_down(None, resampling)
    if (task, protocol) == ("warning", "clean"):
        run = with_prevented(run, dataset, resampling)
    summary = {name: each for name, each in run.summary().items() if name not in KEYS_LEFT_OUT}
    breakdowns = summary.pop("breakdowns")
    return {
        **dict(leaves(summary)),
        **{f"breakdowns/{by}": digest(each) for by, each in breakdowns.items()},
        "counts of samples": digest(dict(run.evaluator.counts)),
    }


def digests_of_export(name: str, here: Path) -> Digests:
    """The files that an export writes."""
    release, words = EXPORTS[name]
    out = here / "exported" / name / ("scene.mcap" if name == "mcap" else "out")
    out.parent.mkdir(parents=True)
    split = [str(here / SPLIT)] if words[-1] == "--split" else []
    command(*words, *split, str(here / "releases" / release), "--out", str(out))
    return digests_of_files(out.parent)


def digests_of_generated(here: Path) -> Digests:
    """The files of a release that this checkout makes."""
    command("synth", str(here / "generated"), *GENERATED)
    return digests_of_files(here / "generated")


def work(out: Path) -> None:
    """Find all digests of the checkout on the path, from the releases in this folder, and write them."""
    import deepaccident_devkit
    from deepaccident_devkit import DeepAccident

    print(f"  {deepaccident_devkit.__file__}", flush=True)
    here, found = Path.cwd(), Found()
    dataset, sensors = (DeepAccident("v1", here / "releases" / name, verbose=False) for name in RELEASES)
    (here / SPLIT).write_text("".join(record["token"].replace("/", " ") + "\n" for record in dataset.scenario))

    def exports() -> None:
        for name in EXPORTS:
            found.add(f"export/{name}", digests_of_export, name, here)

    sections: dict[str, Callable[[], None]] = {
        "synth": lambda: found.add("synth", digests_of_generated, here),
        "tables of labels": lambda: add_tables(found, "labelled", dataset),
        "tables with sensors": lambda: add_tables(found, "sensors", sensors),
        "labels": lambda: add_labels(found, dataset, sensors),
        "evaluations": lambda: add_evaluations(found, dataset, here / SPLIT, here / "predicted"),
        "exports": exports,
    }
    for name, section in sections.items():
        before = len(found.digests)
        found.add(f"all {name}", section)
        print(f"  {name}: {len(found.digests) - before:,} digests", flush=True)
    out.write_text(json.dumps(found.digests, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def run_in(checkout: Path, python: str, *arguments: str, folder: Path) -> None:
    """Run Python with a checkout's package in a folder; raises CalledProcessError."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "MPLBACKEND": "Agg", "PYTHONHASHSEED": "0"}
    subprocess.run([python, *arguments], cwd=folder, env=environment, check=True, stderr=None)


def digests_in(checkout: Path, python: str, releases: Path, folder: Path) -> Digests:
    """What a worker in a checkout finds; the folder is made anew."""
    shutil.rmtree(folder, ignore_errors=True)
    without_index = shutil.ignore_patterns(".deepaccident")
    shutil.copytree(releases, folder / "releases", ignore=without_index, copy_function=shutil.copyfile)
    out = folder / "digests.json"
    run_in(checkout, python, __file__, "--worker", str(out), folder=folder)
    found: Digests = json.loads(out.read_text())
    return found


def make_releases(checkout: Path, python: str, folder: Path) -> None:
    """Make the releases by a checkout."""
    for name, words in RELEASES.items():
        call = f"import sys; sys.path.append({str(Path(__file__).parent)!r}); from digests import command"
        run_in(
            checkout,
            python,
            "-c",
            f"{call}; command(*sys.argv[1:])",
            "synth",
            str(folder / name),
            *words,
            folder=folder,
        )


def differences(before: Digests, after: Digests) -> dict[str, str]:
    """Name → how it differs."""
    return {
        **{name: f"went (was {each})" for name, each in before.items() if name not in after},
        **{name: f"came ({each})" for name, each in after.items() if name not in before},
        **{
            name: f"changed: {each} → {after[name]}"
            for name, each in before.items()
            if name in after and after[name] != each
        },
    }


def report(found: Mapping[str, str], title: str) -> None:
    """Print names and how they differ; of a section with many, some and the number of the others."""
    print(f"{title}: {len(found):,}")
    printed: Counter[str] = Counter()
    for name, how in sorted(found.items()):
        section = "/".join(name.split("/")[:3])
        printed[section] += 1
        if printed[section] <= SHOWN:
            print(f"  {name}: {how}")
    for section, number in printed.items():
        if number > SHOWN:
            print(f"  {section}/…: {number - SHOWN:,} more")


def parsed() -> argparse.Namespace:
    """The arguments."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("checkouts", nargs="*", type=Path, metavar="CHECKOUT", help="two folders: BEFORE and AFTER")
    parser.add_argument("--release", type=Path, help="folder of releases that a run with --keep made")
    parser.add_argument("--expect", action="append", default=[], metavar="PATTERN", help="names that may differ")
    parser.add_argument("--python", default=sys.executable, help="interpreter of both workers")
    parser.add_argument("--keep", type=Path, help="folder for releases and digests, in place of a temporary one")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker is None and len(given.checkouts) != 2:
        parser.error("give two checkouts")
    return given


def main() -> int:
    """Compare; returns the exit status."""
    given = parsed()
    if given.worker is not None:
        work(given.worker)
        return 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given.keep or Path(temporary)).resolve()
        (folder / "releases").mkdir(parents=True, exist_ok=True)
        before, after = (checkout.resolve() for checkout in given.checkouts)
        releases = given.release.resolve() if given.release else folder / "releases"
        if given.release is None:
            make_releases(before, given.python, releases)
        found = []
        for name, checkout in (("before", before), ("after", after)):
            print(f"{name}: {checkout}", flush=True)
            found.append(digests_in(checkout, given.python, releases, folder / "run"))
            (folder / f"{name}.json").write_text(json.dumps(found[-1], indent=1, sort_keys=True, ensure_ascii=False))
        different = differences(*found)
    expected = {n: how for n, how in different.items() if any(fnmatchcase(n, pattern) for pattern in given.expect)}
    unexpected = {name: how for name, how in different.items() if name not in expected}
    print(f"{sum(name in found[1] for name in found[0]) - sum('changed' in how for how in different.values()):,} equal")
    report(expected, "as expected")
    report(unexpected, "unexpected")
    return int(bool(unexpected))


if __name__ == "__main__":
    sys.exit(main())
