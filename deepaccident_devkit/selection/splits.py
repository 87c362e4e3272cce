"""Which scenario is in which split: the official procedure, made reproducible, and selections as split files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, TokenError
from deepaccident_devkit.release import write_split_file
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import (
    columns_text,
    counted,
    members_of,
    natural_order,
    path_of,
    share_text,
)
from deepaccident_devkit.taxonomy import MINI_SPLITS, SCENARIO_ATTRIBUTES, SPLITS, VEHICLE_AGENTS

if TYPE_CHECKING:
    from deepaccident_devkit.tables.records import ScenarioRecord

OFFICIAL_SEED: Final = 17
_FEWEST_LABELS: Final = 6
# The largest share of all scenarios in val and in test; also their share of twins not designed and of single ones.
_SHARE: Final = 0.15
_DESIGNED_SHARE: Final = 0.4
_MINI_SHARE: Final = 0.2
_EGOS, _OTHERS = frozenset(VEHICLE_AGENTS[:2]), frozenset(VEHICLE_AGENTS[2:])

# Tokens that go together: a normal scenario and its accident, or one scenario.
_Unit = tuple[str, ...]
# The strata of designed twins; those of other twins and of single scenarios.
_Strata = tuple[list[list[_Unit]], list[list[_Unit]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Splits:
    """Scenario tokens by split, each list in ascending order.

    Attributes:
        train: for training.
        val: for validation.
        test: for testing.
        train_mini: a subset of `train`.
        val_mini: a subset of `val`.
        left_out: scenarios that do not count: `ego_vehicle` has five labels or fewer.
    """

    train: tuple[str, ...]
    val: tuple[str, ...]
    test: tuple[str, ...]
    train_mini: tuple[str, ...]
    val_mini: tuple[str, ...]
    left_out: tuple[str, ...] = ()

    def by_name(self) -> dict[str, tuple[str, ...]]:
        """Split name → scenario tokens, as new dict."""
        return {name: getattr(self, name) for name in (*SPLITS, *MINI_SPLITS)}

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write `train.txt`, `val.txt`, `test.txt`, `train_mini.txt`, `val_mini.txt` into a folder, all or none.

        Args:
            folder: where; it is made if missing. In a dataroot the files decide the release's splits.
            overwrite: replace existing files.

        Returns:
            The files' paths.

        Raises:
            ConfigError: one of the files is there and `overwrite` is not set, or `folder` is a file.
            TokenError: a scenario's name has blanks, which a split file cannot hold.
        """
        return _write_all(
            {path_of(folder) / f"{name}.txt": tokens for name, tokens in self.by_name().items()},
            overwrite,
        )


def official_split(
    dataset: Dataset, seed: int = OFFICIAL_SEED, *, released_skip: bool = False
) -> Splits:
    """Split a release as the official procedure does, but reproducibly.

    The official lists ship with the release and cannot be made again: their procedure starts from the order in which
    a file system happened to list folders. This one sorts first, so that it depends on the scenarios and `seed` alone.

    1. Only scenarios whose `ego_vehicle` has more than five labels count (so none of an unlabelled test split). Twins
       are a normal and an accident scenario of one name and subtype; they stay together. With T scenarios, val and test
       hold at most round(0.15 T) each.
    2. Twins are *designed* if by meta, in the accident, ego or the car behind it collides with other or the car behind
       it, and names no collision in the normal scenario.
    3. Twins fall into three strata by the accident's meta: three-way; four-way with the other vehicle from opposite;
       the rest. Each stratum is shuffled; the first share goes to val, the next to test, the rest to train: 0.4 and
       0.4 of designed twins, then 0.15 and 0.15 of the other twins, then 0.15 and 0.15 of the scenarios without a twin
       (a stratum each subtype, normal and accident apart), rounded, as far as val and test have room.
    4. `train_mini` and `val_mini` are made of train and val in the same way, with the same seed: at most a fifth, by
       shares of 0.4 of designed twins and 0.2 of all else.

    Args:
        dataset: the release.
        seed: of the shuffles; 17 is the official one.
        released_skip: do as the released loop does, which removes each designed pair from the list over which it loops.
            So it skips the pair after it, which then counts as not designed.
    """
    scenarios = dataset.scenario[:]
    counted = [
        scenario for scenario in scenarios if _ego_labels(dataset, scenario) >= _FEWEST_LABELS
    ]
    tokens = {scenario["token"] for scenario in counted}
    left_out = tuple(
        sorted(scenario["token"] for scenario in scenarios if scenario["token"] not in tokens)
    )
    return split_records(counted, seed, released_skip=released_skip, left_out=left_out)


def split_records(
    scenarios: Iterable[ScenarioRecord],
    seed: int = OFFICIAL_SEED,
    *,
    released_skip: bool = False,
    left_out: tuple[str, ...] = (),
) -> Splits:
    """The steps 2 to 4 of `official_split` on records of scenarios, in any order."""
    of_token = {scenario["token"]: scenario for scenario in scenarios}
    most = round(_SHARE * len(of_token))
    strata = _strata(of_token.values(), released_skip=released_skip)
    val, test, train = _dealt(strata, (_DESIGNED_SHARE, _SHARE), most, parts=2, seed=seed)
    minis = []
    for split in (train, val):
        strata = _strata([of_token[token] for token in split], released_skip=released_skip)
        shares = (_DESIGNED_SHARE, _MINI_SHARE)
        minis.append(_dealt(strata, shares, round(_MINI_SHARE * len(split)), parts=1, seed=seed)[0])
    return Splits(
        train=train, val=val, test=test, train_mini=minis[0], val_mini=minis[1], left_out=left_out
    )


def save_selection(
    scenarios: Iterable[RowArgument], path: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Write scenarios, such as `find` gives, as a split file that `split_scenarios(path)` reads.

    Args:
        scenarios: tokens or records; their order is kept, each is written once.
        path: the file, whose name has to end in `.txt`.
        overwrite: replace an existing file.

    Returns:
        The path.

    Raises:
        ConfigError: the name does not end in `.txt`; the file is there and `overwrite` is not set; its folder is a
            file.
        TokenError: something is neither a scenario's token nor a record of one, or has blanks, which a split file
            cannot hold.
    """
    path = path_of(path)
    if path.suffix != ".txt":
        raise ConfigError(f"{path}: a split file's name ends in .txt; choose another name")
    chosen = members_of("scenarios", scenarios, "tokens or records of scenarios")
    tokens = tuple(dict.fromkeys(_scenario_token(scenario) for scenario in chosen))
    return _write_all({path: tokens}, overwrite)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitReport(Report):
    """How the scenarios of some splits are distributed.

    Attributes:
        dataroot: the release's folder.
        version: `v1` or `v1-mini`.
        scenarios: split → scenarios.
        frames: split → frames.
        attributes: field → value → split → scenarios; `none` for unknown values.
        left_out: scenarios that count for no split, by token.
    """

    dataroot: str
    version: str
    scenarios: Mapping[str, int]
    frames: Mapping[str, int]
    attributes: Mapping[str, Mapping[str, Mapping[str, int]]]
    left_out: Sequence[str]

    def to_text(self) -> str:
        """A block of counts and shares for each attribute, a column for each split."""
        names = list(self.scenarios)
        totals = {"scenarios": self.scenarios, "frames": self.frames}
        blocks = [
            f"DeepAccident {self.version} at {self.dataroot}",
            columns_text(
                [("split", *names)]
                + [(word, *map(str, row.values())) for word, row in totals.items()]
            ),
        ]
        for field, counts in self.attributes.items():
            rows = [
                (value, *(share_text(row[name], self.scenarios[name]) for name in names))
                for value, row in counts.items()
            ]
            blocks.append(columns_text([(field, *names), *rows]))
        if self.left_out:
            scenarios = counted(len(self.left_out), "scenario")
            blocks.append(f"left out, as ego_vehicle has five labels or fewer: {scenarios}")
        return "\n\n".join(blocks)


def split_report(dataset: Dataset, splits: Splits | Mapping[str, Collection[str]]) -> SplitReport:
    """Count how attributes are distributed over splits.

    Args:
        dataset: the release.
        splits: of `official_split`, or scenario tokens by any names.

    Raises:
        TokenError: a token is no scenario of the release.
    """
    by_name = splits.by_name() if isinstance(splits, Splits) else splits
    records = {
        name: [dataset.scenario.get(token) for token in tokens] for name, tokens in by_name.items()
    }
    return SplitReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        scenarios={name: len(scenarios) for name, scenarios in records.items()},
        frames={
            name: sum(scenario["num_frames"] for scenario in scenarios)
            for name, scenarios in records.items()
        },
        attributes={
            field: _distribution(records, field) for field in (*SCENARIO_ATTRIBUTES, "collision")
        },
        left_out=splits.left_out if isinstance(splits, Splits) else (),
    )


# the procedure


def _ego_labels(dataset: Dataset, scenario: ScenarioRecord) -> int:
    """Labels of a scenario's ego: of every frame or of none, else the scenario would not have been indexed."""
    try:
        labelled = dataset.sample.get(f"{scenario['token']}/{VEHICLE_AGENTS[0]}/001")["labelled"]
    except TokenError:  # a partial download without ego
        return 0
    return scenario["num_frames"] if labelled else 0


def _strata(scenarios: Iterable[ScenarioRecord], *, released_skip: bool) -> _Strata:
    """The strata of designed twins, and those of the other twins and of single scenarios, in the official order."""
    of_token = {scenario["token"]: scenario for scenario in sorted(scenarios, key=_order)}
    twins, singles = _twins(of_token)
    designed, others, passed_over = [], [], False
    for normal, accident in twins:
        if not passed_over and _is_designed(of_token[normal], of_token[accident]):
            designed.append((normal, accident))
            passed_over = released_skip
        else:
            others.append((normal, accident))
            passed_over = False
    single_types: dict[str, list[_Unit]] = {}
    for token in singles:
        single_types.setdefault(of_token[token]["scenario_type"], []).append((token,))
    return _by_junction(of_token, designed), [
        *_by_junction(of_token, others),
        *single_types.values(),
    ]


def _order(scenario: ScenarioRecord) -> tuple[str, bool, str]:
    """Subtype by subtype, normal scenarios first, then by name."""
    return _family(scenario), scenario["designed_accident"], scenario["name"]


def _family(scenario: ScenarioRecord) -> str:
    """The scenario type without its ending: `type1_subtype1`."""
    return scenario["scenario_type"].rpartition("_")[0]


def _twins(of_token: Mapping[str, ScenarioRecord]) -> tuple[list[tuple[str, str]], list[str]]:
    """Normal and accident scenarios of one name and subtype, and those that have no twin."""
    by_name: dict[tuple[str, str], list[str]] = {}
    for token, scenario in of_token.items():
        by_name.setdefault((_family(scenario), scenario["name"]), []).append(token)
    twins = [(tokens[0], tokens[1]) for tokens in by_name.values() if len(tokens) == 2]
    of_twins = {token for pair in twins for token in pair}
    return sorted(twins, key=lambda pair: _order(of_token[pair[0]])), [
        token for token in of_token if token not in of_twins
    ]


def _is_designed(normal: ScenarioRecord, accident: ScenarioRecord) -> bool:
    collision = accident["collision"]
    if collision is None or collision["agents"] is None or normal["collision"] is not None:
        return False
    if normal["weather"] is None:  # without meta nobody knows whether it had a collision
        return False
    first, second = collision["agents"]
    return (first in _EGOS and second in _OTHERS) or (first in _OTHERS and second in _EGOS)


def _by_junction(
    of_token: Mapping[str, ScenarioRecord], twins: Sequence[_Unit]
) -> list[list[_Unit]]:
    """Twins by the accident's meta: three-way; four-way from opposite; the rest."""
    strata: list[list[_Unit]] = [[], [], []]
    for twin in twins:
        accident = of_token[twin[1]]
        if (accident["road_type"] or "").startswith("three-way"):
            strata[0].append(twin)
        else:
            strata[1 if (accident["spawn_side"] or "").startswith("opposite") else 2].append(twin)
    return strata


def _dealt(
    strata: tuple[list[list[_Unit]], list[list[_Unit]]],
    shares: tuple[float, float],
    most: int,
    *,
    parts: int,
    seed: int,
) -> list[tuple[str, ...]]:
    """Deal every stratum out: a share to each of `parts` lists of at most `most` tokens, the rest to one list more."""
    rng = Random(seed)  # noqa: S311 - a split, not a secret; its shuffle is the same on all Pythons
    dealt: list[list[str]] = [[] for _ in range(parts + 1)]
    for group, share in zip(strata, shares, strict=True):
        for stratum in group:
            units = list(stratum)
            rng.shuffle(units)
            for part in dealt[:parts]:
                room = (most - len(part)) // len(units[0]) if units else 0
                count = min(round(share * len(stratum)), room)
                part += [token for unit in units[:count] for token in unit]
                units = units[count:]
            dealt[parts] += [token for unit in units for token in unit]
    return [tuple(sorted(tokens)) for tokens in dealt]


# files and counts


def _write_all(files: Mapping[Path, Sequence[str]], overwrite: bool) -> list[Path]:  # noqa: FBT001
    """Write split files; they are renamed into place once all of them are whole."""
    for path, tokens in files.items():
        for token in tokens:
            _check_line(path, token)
        if path.exists() and not overwrite:
            raise ConfigError(
                f"{path}: is there already; choose another place, or ask to overwrite it"
            )
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; choose another place")
        if path.parent.exists() and not path.parent.is_dir():
            raise ConfigError(f"{path.parent}: is a file; give a folder")
    with ExitStack() as stack:
        for path, tokens in files.items():
            write_split_file(stack.enter_context(replacing(path)), tokens)
    return list(files)


def _scenario_token(scenario: RowArgument) -> str:
    token = scenario.get("token") if isinstance(scenario, Mapping) else scenario
    if not isinstance(token, str) or token.count("/") != 1:
        raise TokenError(f"expected a scenario's token or its record, found {scenario!r}")
    return token


def _check_line(path: Path, token: str) -> None:
    """Refuse a token whose line would not be read as two words."""
    if token.replace("/", " ").split() != token.split("/") or not token.isprintable():
        raise TokenError(
            f"{path}: scenario {token!r} cannot stand in a split file, whose lines are '<scenario_type> <scenario>' of "
            "printable characters without blanks; leave it out, or rename its folders"
        )


def _distribution(
    records: Mapping[str, Sequence[ScenarioRecord]], field: str
) -> dict[str, dict[str, int]]:
    counts = {
        name: Counter(_shown(scenario, field) for scenario in scenarios)
        for name, scenarios in records.items()
    }
    values = sorted({value for counter in counts.values() for value in counter}, key=natural_order)
    return {value: {name: counter[value] for name, counter in counts.items()} for value in values}


def _shown(scenario: ScenarioRecord, field: str) -> str:
    if field == "collision" and scenario["weather"] is not None:  # there is meta, so it is known
        return "no" if scenario["collision"] is None else "yes"
    value = scenario[field]  # type: ignore[literal-required]
    return "none" if value is None else str(value)
