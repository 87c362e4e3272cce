"""`run_study`: from a recipe to its results, cell by cell."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from deepaccident_devkit._version import __version__
from deepaccident_devkit.deepaccident import DeepAccident
from deepaccident_devkit.errors import NotAvailableError
from deepaccident_devkit.evaluation.breakdowns import cluster_of, sample_attributes, tokens_by_value
from deepaccident_devkit.evaluation.runs.setups import release_note, scenario_of
from deepaccident_devkit.release.fingerprints import fingerprint, scenario_hashes
from deepaccident_devkit.rooms import need_room
from deepaccident_devkit.selection import find
from deepaccident_devkit.study.cells import Bench, Cell, RowWork, Weights, make, weights_cell
from deepaccident_devkit.study.page import save_study
from deepaccident_devkit.study.recipe import DEFAULT_HORIZON, Recipe, Row, at, source_of
from deepaccident_devkit.study.summary import ALL, Counted, StudyReport, counted_row, summarised
from deepaccident_devkit.support.files import writable_folder
from deepaccident_devkit.support.json_text import as_record
from deepaccident_devkit.support.reading import file_checksum
from deepaccident_devkit.support.text import choice, natural_order
from deepaccident_devkit.synth import SynthConfig, make_release

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from deepaccident_devkit.parallel import Engine

_Seeds = Mapping[str, Weights]
"""The weights of each seed; those of a file under an empty text."""
_Release = tuple[Cell, DeepAccident]


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
        NotAvailableError: a release has no such samples.
        SomeFailedError: some cells failed; the others are done.
        DeepAccidentError: as of `make_release`, `model.train` and `evaluate_results`.
    """
    if recipe.weights:
        need_room("model", "a study with weights")
        from deepaccident_devkit.model import checked_device

        device = checked_device(device)
    bench = Bench(writable_folder(out).absolute(), device)
    cores = 1 if device.startswith("cuda") else os.cpu_count()
    engine: Any = {**how, "workers": how.get("workers") or cores}
    with bench.store.shared():
        releases = {name: _release(bench, name, recipe, **how) for name in _used_releases(recipe)}
        weights = _weights(recipe, bench, releases, **engine)
        rows = _rows(recipe, bench, releases[recipe.test.release], weights)
        cells = [*(cell for cell, _ in releases.values()), *_cells_of(weights)]
        for_rows = [cell for of_row in rows.values() for cell in of_row.values()]
        bench.make(for_rows, "rows", releases[recipe.test.release][1].places, **engine)
        counted = _counted(recipe, releases[recipe.test.release][1], rows)
        notes = [
            {"kind": each.kind, "name": each.name, "key": each.key, **_notes(each)} for each in [*cells, *for_rows]
        ]
    told = {"recipe": msgspec.to_builtins(recipe), "devkit": __version__, "cells": notes}
    report = StudyReport(summary=json.loads(json.dumps({**summarised(counted), **told})))
    save_study(report, counted, bench.out / recipe.name)
    return report


def _notes(cell: Cell) -> dict[str, Any]:
    """What was kept of a cell beside counts."""
    return {name: value for name, value in (cell.kept or {}).items() if name != "counts"}


def _used(recipe: Recipe) -> list[str]:
    """The weights that rows have, and those that they begin from, which stand above them."""
    used = {row.weights for row in recipe.rows}
    for name in reversed(list(recipe.weights)):
        if name in used:
            used.add(recipe.weights[name].get("from"))
    return [name for name in recipe.weights if name in used]


def _used_releases(recipe: Recipe) -> list[str]:
    used = {recipe.test.release, *(recipe.weights[name].get("release") for name in _used(recipe))}
    return [name for name in recipe.releases if name in used]


def _release(bench: Bench, name: str, recipe: Recipe, **how: Unpack[Engine]) -> _Release:
    """A release, made if it is not there, by all workers."""
    source = recipe.releases[name]
    config = source_of(source)
    dataset: Any = None
    if config is None:
        dataset = DeepAccident(source.get("version", "v1"), source["dataroot"], verbose=False)
        told = {**source, "release": release_note(dataset, _scenarios(dataset))}
        cell = bench.cell("release", name, partial(_described, dataset, how), **told)
    else:
        spec = None if config.spec is None else config.spec.read_text(encoding="utf-8")
        told = {**asdict(config), "spec": spec}
        cell = bench.cell("release", name, partial(_made, config, how), **told)
    make(cell)
    return cell, dataset if config is None else DeepAccident("v1", cell.folder, verbose=False)


def _made(config: SynthConfig, how: Any, folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        make_release(folder, config, **how)
    return _described(DeepAccident("v1", folder, verbose=False), how, folder)


def _described(dataset: DeepAccident, how: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """How many scenarios a release has, and its fingerprint."""
    folder.mkdir(parents=True, exist_ok=True)  # of a release that was there it has nothing
    tokens, engine = _scenarios(dataset), {name: each for name, each in how.items() if name != "progress"}
    return {"scenarios": len(tokens), "fingerprint": fingerprint(scenario_hashes(dataset, tokens, **engine))}


def _scenarios(dataset: DeepAccident, split: str = "all") -> list[str]:
    """The tokens of a split; of `all`, of all scenarios."""
    every = [record["token"] for record in dataset.scenario]
    chosen = every if split == "all" else dataset.split_scenarios(split)
    return [token for token in every if token in chosen]


def _weights(
    recipe: Recipe, bench: Bench, releases: Mapping[str, _Release], **how: Unpack[Engine]
) -> dict[str, _Seeds]:
    """All weights, trained if they are not there: those together that begin from nothing, then from these, and on."""
    found: dict[str, _Seeds] = {}
    depths: dict[str, int] = {}
    for name in _used(recipe):
        start = recipe.weights[name].get("from")
        depths[name] = 0 if start is None else depths[start] + 1
        with at(recipe.name, f"weights.{name}"):
            found[name] = _seeds(name, recipe, bench, releases, {} if start is None else found[start])
    places = tuple(place for _, dataset in releases.values() for place in dataset.places)
    for depth in sorted(set(depths.values())):
        together = _cells_of({name: found[name] for name in found if depths[name] == depth})
        bench.make(together, "trainings", places, **how)
    return found


def _cells_of(weights: Mapping[str, _Seeds]) -> list[Cell]:
    return [each.cell for of in weights.values() for each in of.values() if each.cell is not None]


def _seeds(
    name: str, recipe: Recipe, bench: Bench, releases: Mapping[str, _Release], starts: _Seeds
) -> dict[str, Weights]:
    """The weights of one name; raises ConfigError, ChoiceError or ValueError."""
    from deepaccident_devkit.model import ModelChoice, TrainConfig, read_weights

    plan = {key: each for key, each in recipe.weights[name].items() if key not in ("release", "from")}
    if "file" in plan:
        read = read_weights(plan["file"])
        return {"": Weights(read.path, file_checksum(read.path), ModelChoice.from_dict(read.meta, read.path))}
    models, trainings = ([each.name for each in fields(kind)] for kind in (ModelChoice, TrainConfig))
    for key in plan:
        choice("key", key, [each for each in (*models, *trainings) if each != "seed"])
    inherited = next(iter(starts.values())).choice.as_dict() if starts else {}
    model = as_record({**inherited, **{key: plan[key] for key in models if key in plan}}, ModelChoice)
    release, dataset = releases[recipe.weights[name]["release"]]
    given = {"validation": None, **{key: plan[key] for key in trainings if key in plan}}
    given["split"] = str(bench.split(_scenarios(dataset, plan.get("split", "all"))))
    made = {}
    for seed in recipe.seeds:
        config = as_record({**given, "seed": seed}, TrainConfig)
        start = starts.get(str(seed), starts.get(""))
        made[str(seed)] = weights_cell(bench, f"{name}, seed {seed}", release, dataset, model, config, start)
    return made


def _rows(recipe: Recipe, bench: Bench, release: _Release, weights: Mapping[str, _Seeds]) -> dict[str, dict[str, Cell]]:
    """Row → seed → its cell, all at the same samples."""
    (cell, dataset), test = release, recipe.test
    longest = test.horizon or max(_horizon(row, weights) for row in recipe.rows)
    scenarios = _matching(dataset, test.where, _scenarios(dataset, test.split), recipe, "test.where")
    selection = test.selection(bench.split(scenarios), longest)
    told = {"samples": {**selection.as_dict(), "split": Path(selection.split).name}, "test": [test.labels, test.cell]}
    found: dict[str, dict[str, Cell]] = {}
    for row in recipe.rows:
        horizon, seeds = _horizon(row, weights), weights.get(row.weights or "", {"": None})
        changes = {
            key: each for key, each in msgspec.to_builtins(row).items() if key not in ("name", "weights", "over")
        }
        for seed, of in seeds.items():
            folder, key = (None, None) if of is None else (of.folder, of.key)
            work = RowWork(
                dataset=dataset,
                row=row,
                test=test,
                selection=selection,
                horizon=horizon,
                weights=folder,
                device=bench.device,
            )
            decides = {**told, "row": {**changes, "horizon": horizon}, "weights": key, "release": cell.key}
            name = f"{row.name}, seed {seed}" if seed else row.name
            found.setdefault(row.name, {})[seed] = bench.cell("row", name, work, **decides)
    return found


def _horizon(row: Row, weights: Mapping[str, _Seeds]) -> float:
    if row.weights is None:
        return row.horizon or DEFAULT_HORIZON
    return next(iter(weights[row.weights].values())).choice.horizon or DEFAULT_HORIZON


def _matching(
    dataset: DeepAccident, where: Sequence[str], scenarios: Iterable[str], recipe: Recipe, place: str
) -> list[str]:
    """Those scenarios of whose pair one matches all filters; raises ConfigError if there is none."""
    with at(recipe.name, place):
        pairs = {cluster_of(record["token"]) for record in find(dataset, *where)}
        found = [token for token in scenarios if cluster_of(token) in pairs]
        if not found:
            raise NotAvailableError("no pair of scenarios of the test matches; change the filters")
    return found


def _counted(recipe: Recipe, dataset: DeepAccident, rows: Mapping[str, Mapping[str, Cell]]) -> Counted:
    """What was counted of all rows, and the groups of samples."""
    made = {name: {seed: cell.kept or {} for seed, cell in cells.items()} for name, cells in rows.items()}
    told: Any = {
        "title": recipe.title,
        "question": recipe.question,
        "labels": recipe.test.labels,
        "headline": msgspec.to_builtins(recipe.headline),
        "compare": [list(pair) for pair in recipe.pairs],
    }
    counted = {}
    for row in recipe.rows:
        kept = made[row.name]
        seeds = {seed: each["counts"] for seed, each in kept.items()}
        horizon = next(iter(kept.values()))["horizon"]
        counted[row.name] = counted_row({"horizon": horizon, "over": row.over, "seeds": seeds}, told["labels"])
    tokens = sorted(next(iter(next(iter(counted.values())).seeds.values()))["motion"].tokens)
    groups = {ALL: tokens}
    for name, where in recipe.groups.items():
        matching = set(_matching(dataset, where, map(scenario_of, tokens), recipe, f"groups.{name}"))
        groups[name] = [token for token in tokens if scenario_of(token) in matching]
    attributes = sample_attributes(dataset, tokens) if recipe.by else {}
    for by in recipe.by:
        values = tokens_by_value(attributes, by)
        groups |= {f"{by}={value or 'unknown'}": values[value] for value in sorted(values, key=natural_order)}
    return Counted(told=told, groups=groups, rows=counted)
