"""`run_study`: from a recipe to its results, cell by cell."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.evaluation.breakdowns import cluster_of, sample_attributes, tokens_by_value
from deepaccident_devkit.evaluation.runs import SampleSelection
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.export.bulk import export_release
from deepaccident_devkit.export.nuscenes import NuScenes
from deepaccident_devkit.plugins.study.cells import Bench, Counting, StudyCell, make, taken, trained
from deepaccident_devkit.plugins.study.numbers import HIDDEN
from deepaccident_devkit.plugins.study.overlap import ReleaseScenarios, known_scenarios
from deepaccident_devkit.plugins.study.page import save_study
from deepaccident_devkit.plugins.study.recipe import (
    DEFAULT_HORIZON,
    NUSCENES,
    Recipe,
    TrainingPlan,
    recipe_place,
    synth_config_of,
)
from deepaccident_devkit.plugins.study.summary import (
    ALL,
    Counted,
    StudyReport,
    counted_of,
    summarised,
)
from deepaccident_devkit.plugins.synth import make_release
from deepaccident_devkit.plugins.synth.generate import file_text
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.selection import find
from deepaccident_devkit.support.cores import usable_cores
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.plugins import need_plugin
from deepaccident_devkit.support.reading import file_checksum
from deepaccident_devkit.support.text import choice, natural_order
from deepaccident_devkit.support.version import __version__
from deepaccident_devkit.taxonomy import AGENTS

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.plugins.model import ModelChoice
    from deepaccident_devkit.support.parallel import Engine

# Settings of releases that keys of earlier studies do not have, and what they are without a word.
_LATER: Final = {"rig": "released", "decimals": None}
# The model, and the weights of each seed; those of a file under an empty text.
_Weights = tuple["ModelChoice", dict[str, StudyCell]]
_Release = tuple[StudyCell, DeepAccident]


def run_study(
    recipe: Recipe, out: str | os.PathLike[str], *, device: str = "auto", **how: Unpack[Engine]
) -> StudyReport:
    """Make what is not there of a study, and write its results into `out/NAME`, NAME that of the recipe.

    After a kill the same call goes on. Studies with the same `out` share releases, weights and rows.

    Args:
        recipe: of `read_recipe`.
        out: a folder, of one study or several.
        device: of models: `auto`, `cpu`, `cuda`, …
        **how: `workers` (None for as many as there are cores, of a GPU one), `executor` and `progress`, as
            `parallel.Engine` says.

    Returns:
        What came out. The folder has it as `study.json`, `tables/*.csv`, `figures/*.png`, `index.html`, and the counts
        of all samples as `counts.json.gz` (`read_counts`).

    Raises:
        ConfigError: the recipe asks for weights or samples that cannot be, or something cannot be written.
        SomeFailedError: some cells failed; the others are done.
        DeepAccidentError: as of `make_release`, `model.train` and `evaluate_results`.
    """
    if recipe.weights:
        need_plugin("model", "a study with weights")
        from deepaccident_devkit.plugins.model import checked_device

        device = checked_device(device)
    bench = Bench(writable_folder(out).absolute(), device if recipe.weights else "cpu")
    engine: Any = {
        **how,
        "workers": how.get("workers") or (1 if device.startswith("cuda") else usable_cores()),
    }
    with bench.store.shared():
        releases = {name: _release(bench, name, recipe, **how) for name in recipe.releases}
        test, dataset = recipe.test, releases[recipe.test.release][1]
        tested = _matching(
            dataset, test.where, _scenarios(dataset, test.split), recipe, "test.where"
        )
        if not test.includes_training:
            _refuse_known_tests(recipe, releases, (dataset, tested))
        weights = _weights(recipe, bench, releases, **engine)
        rows = _rows(recipe, bench, releases[test.release], weights, tested)
        bench.make(
            (cell for of in rows.values() for cell in of.values()),
            "rows",
            dataset.places,
            **engine,
        )
        counted = _counted(recipe, dataset, rows)
        cells = [cell for cell, _ in releases.values()]
        for made in (*(seeds for _, seeds in weights.values()), *rows.values()):
            cells += made.values()
        notes = [
            {"kind": each.kind, "name": each.name, "key": each.key}
            | {name: value for name, value in (each.kept or {}).items() if name != "counts"}
            for each in cells
        ]
    summary = {
        **summarised(counted),
        "recipe": msgspec.to_builtins(recipe),
        "devkit": __version__,
        "cells": notes,
    }
    report = StudyReport(summary=json.loads(json.dumps(summary)))
    save_study(report, counted, bench.out / recipe.name)
    return report


def _release(bench: Bench, name: str, recipe: Recipe, **how: Unpack[Engine]) -> _Release:
    """A release, made if it is not there, by all workers."""
    source, config = recipe.releases[name], synth_config_of(recipe.releases[name])
    if config is None:
        dataset = _opened(source)
        told = {**source, "release": release_note(dataset, _scenarios(dataset))}
    else:
        settings = {
            name: each for name, each in asdict(config).items() if _LATER.get(name, ...) != each
        }
        told = {**settings, "spec": config.spec and file_text(config.spec)}
        if source.get(NUSCENES):
            told[NUSCENES] = True
    cell = bench.cell("release", name, partial(_made, source, how), **told)
    make(cell)
    return cell, _opened(source, cell.folder)


def _opened(source: Mapping[str, Any], folder: Path | None = None) -> DeepAccident:
    if folder is not None and source.get(NUSCENES):
        need_plugin("nuscenes", "a study on nuScenes")
        from deepaccident_devkit.plugins.nuscenes.check import check_source
        from deepaccident_devkit.plugins.nuscenes.source import open_nuscenes

        road = open_nuscenes(folder / NUSCENES)
        check_source(road)
        return road
    return DeepAccident(source.get("version", "v1"), source.get("dataroot", folder), verbose=False)


def _made(source: Mapping[str, Any], how: Any, folder: Path) -> dict[str, Any]:
    """Make a release, if it is not there: how many scenarios it has, and its fingerprint."""
    config = synth_config_of(source)
    release = folder.with_name(f"{folder.name}-release") if source.get(NUSCENES) else folder
    if config is not None and not release.is_dir():
        make_release(release, config, **how)
    if release != folder and not (folder / NUSCENES).is_dir():
        form = NuScenes(agents=AGENTS[:1], lidar_axes="nuscenes", sweeps=False)
        export_release(DeepAccident("v1", release, verbose=False), folder / NUSCENES, form, **how)
    folder.mkdir(parents=True, exist_ok=True)  # of one that was there it has nothing
    dataset, engine = (
        _opened(source, folder),
        {name: each for name, each in how.items() if name != "progress"},
    )
    hashes = scenario_hashes(dataset, _scenarios(dataset), **engine)
    return {"scenarios": len(hashes), "fingerprint": fingerprint(hashes)}


def _scenarios(dataset: DeepAccident, split: str = "all") -> list[str]:
    """The tokens of a split's scenarios, in the order of the release."""
    chosen = dataset.split_scenarios(split)
    return [record["token"] for record in dataset.scenario if record["token"] in chosen]


def _refuse_known_tests(
    recipe: Recipe, releases: Mapping[str, _Release], tested: ReleaseScenarios
) -> None:
    """Raise ConfigError if a training shows scenarios of the test, or their twins."""
    for name in recipe.weights:
        plan = recipe.plan(name)
        splits = (
            (plan.release, plan.split),
            (plan.release, plan.validation),
            (plan.also, plan.also_split),
        )
        for release, split in splits:
            if release and split:
                with recipe_place(recipe.name, f"weights.{name}"):
                    learned = releases[release][1], _scenarios(releases[release][1], split)
                    if known := known_scenarios(learned, tested):
                        raise ConfigError(
                            f"{release}, {split}: shows {len(known)} scenarios of the test, or their twins, such as "
                            f"{known[0]}; change split, also_split or validation here, or the test's split, or say "
                            "includes_training: true in test"
                        )


def _weights(
    recipe: Recipe, bench: Bench, releases: Mapping[str, _Release], **how: Unpack[Engine]
) -> dict[str, _Weights]:
    """All weights, made if they are not there: those together that begin from nothing, then from these, and on."""
    found: dict[str, _Weights] = {}
    depths: dict[str | None, int] = {None: -1}
    for name, plan in recipe.weights.items():
        depths[name] = depths[plan.get("from")] + 1
        with recipe_place(recipe.name, f"weights.{name}"):
            found[name] = _seeds(name, recipe, bench, releases, found)
    places = tuple(place for _, dataset in releases.values() for place in dataset.places)
    for depth in range(max(depths.values()) + 1):
        together = [
            cell
            for name, (_, cells) in found.items()
            if depths[name] == depth
            for cell in cells.values()
        ]
        bench.make(together, "weights", places, **how)
    return found


def _seeds(
    name: str,
    recipe: Recipe,
    bench: Bench,
    releases: Mapping[str, _Release],
    others: Mapping[str, _Weights],
) -> _Weights:
    """The weights of one name; raises ConfigError, ChoiceError or ValueError."""
    from deepaccident_devkit.plugins.model import (
        ModelChoice,
        SecondSource,
        TrainConfig,
        read_weights,
    )

    plan, given = recipe.plan(name), recipe.weights[name]
    if plan.file is not None:
        read = read_weights(plan.file)
        cell = bench.cell("weights", name, partial(taken, read.path), file=file_checksum(read.path))
        return ModelChoice.from_dict(read.meta, read.path), {"": cell}
    release, dataset = releases[plan.release]
    models, trainings = (
        [each.name for each in fields(kind)] for kind in (ModelChoice, TrainConfig)
    )
    told: dict[str, Any] = {}
    second = None
    if plan.also is not None:
        other, there = releases[plan.also]
        also_split = bench.split(_scenarios(there, plan.also_split))
        second = SecondSource(dataset=there, split=str(also_split), mix=plan.mix)
        told["also"] = {"release": other.key, "mix": plan.mix}
        if plan.also_split != "all":  # which it was in keys of earlier studies
            told["also"]["split"] = also_split.name
    for key in given:
        choice(
            "key",
            key,
            [
                each
                for each in (*TrainingPlan.__struct_encode_fields__, *models, *trainings)
                if each != "seed"
            ],
        )
    inherited, starts = others[plan.start] if plan.start else (ModelChoice(), {})
    model = as_record(
        {**inherited.as_dict(), **{key: given[key] for key in models if key in given}}, ModelChoice
    )
    split, cells = bench.split(_scenarios(dataset, plan.split)), {}
    for seed in recipe.seeds:
        training = {key: given[key] for key in trainings if key in given}
        config = as_record(
            {"validation": None, **training, "split": str(split), "seed": seed}, TrainConfig
        )
        first = starts.get(str(seed), starts.get(""))
        cells[str(seed)] = bench.cell(
            "weights",
            f"{name}, seed {seed}",
            partial(
                trained,
                dataset,
                model,
                config,
                None if first is None else first.folder,
                second,
                bench.device,
            ),
            release=release.key,
            model=model.as_dict(),
            training={**config.as_dict(), "split": split.name},
            start=None if first is None else first.key,
            **told,
        )
    return model, cells


def _rows(
    recipe: Recipe,
    bench: Bench,
    release: _Release,
    weights: Mapping[str, _Weights],
    scenarios: Sequence[str],
) -> dict[str, dict[str, StudyCell]]:
    """Row → seed → its cell, all at the same samples of some scenarios."""
    (cell, dataset), test, found = release, recipe.test, {}
    horizons = {
        row.name: (weights[row.weights][0] if row.weights else row).horizon or DEFAULT_HORIZON
        for row in recipe.rows
    }
    selection = SampleSelection(
        split=str(bench.split(scenarios)),
        samples=test.samples,
        scope=test.scope,
        agents=test.agents,
        horizon=test.horizon or max(horizons.values()),
    )
    with recipe_place(recipe.name, "test"):
        if not scenarios:
            raise ConfigError("where: no pair of scenarios matches; change the filters")
        selection.tokens(dataset)
    for row in recipe.rows:
        seeds: Mapping[str, StudyCell | None] = (
            weights[row.weights][1] if row.weights else {"": None}
        )
        labels, told = test.label_config(horizons[row.name]), msgspec.to_builtins(row)
        decides = {
            key: each
            for key, each in told.items()
            if key not in ("name", "weights", "over", "horizon")
        }
        found[row.name] = {
            seed: bench.cell(
                "row",
                f"{row.name}, seed {seed}" if seed else row.name,
                Counting(
                    dataset=dataset,
                    row=row,
                    selection=selection,
                    labels=labels,
                    weights=None if of is None else of.folder,
                    device=bench.device,
                ),
                **decides,
                labels=[test.labels, horizons[row.name]],
                samples={**selection.as_dict(), "split": Path(selection.split).name},
                release=cell.key,
                trained=None if of is None else of.key,
            )
            for seed, of in seeds.items()
        }
    return found


def _matching(
    dataset: DeepAccident,
    where: Sequence[str],
    scenarios: Iterable[str],
    recipe: Recipe,
    place: str,
) -> list[str]:
    """Those scenarios of whose pair one matches all filters; raises ConfigError."""
    with recipe_place(recipe.name, place):
        pairs = {cluster_of(record["token"]) for record in find(dataset, *where)}
    return [token for token in scenarios if cluster_of(token) in pairs]


def _counted(
    recipe: Recipe, dataset: DeepAccident, rows: Mapping[str, Mapping[str, StudyCell]]
) -> Counted:
    """What was counted of all rows, and the groups of samples."""
    told = {
        "title": recipe.title,
        "question": recipe.question,
        "labels": recipe.test.labels,
        "headline": msgspec.to_builtins(recipe.headline),
        "compare": [list(pair) for pair in recipe.pairs],
        "over": {row.name: row.over and list(row.over) for row in recipe.rows},
    }
    counts = {
        name: {seed: (cell.kept or {})["counts"] for seed, cell in of.items()}
        for name, of in rows.items()
    }
    tokens = sorted(next(iter(next(iter(counts.values())).values()))[HIDDEN])
    groups = {ALL: tokens}
    for name, where in recipe.groups.items():
        matching = set(
            _matching(dataset, where, map(scenario_of, tokens), recipe, f"groups.{name}")
        )
        groups[name] = [token for token in tokens if scenario_of(token) in matching]
    attributes = sample_attributes(dataset, tokens) if recipe.by else {}
    for by in recipe.by:
        values = tokens_by_value(attributes, by)
        groups |= {
            f"{by}={value or 'unknown'}": values[value]
            for value in sorted(values, key=natural_order)
        }
    return counted_of(counts, groups, told)
