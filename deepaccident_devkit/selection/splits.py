"""The scenarios of each split: the official procedure made reproducible, and split files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Final

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ConfigError, TokenError
from deepaccident_devkit.release import write_split_file
from deepaccident_devkit.support.files import replacing
from deepaccident_devkit.support.reports import Report
from deepaccident_devkit.support.text import (
    PathType,
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
# Smallest number of ego labels that a scenario needs to be included.
_MIN_EGO_LABELS = 6
# Largest share of all scenarios in val and in test; also their share of other twins and of single
# scenarios.
_SHARE = 0.15
# Share of designed twins in val, in test and in each mini split.
_DESIGNED_SHARE = 0.4
_MINI_SHARE = 0.2
_EGO_AGENTS = frozenset(VEHICLE_AGENTS[:2])
_OTHER_AGENTS = frozenset(VEHICLE_AGENTS[2:])

# Tokens that stay together: a normal scenario and its accident twin, or a single scenario.
_Unit = tuple[str, ...]
# Strata of designed twins, and strata of other twins and of single scenarios.
_Strata = tuple[list[list[_Unit]], list[list[_Unit]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Splits:
    """Scenario tokens by split, each list in ascending order.

    Attributes:
        train: Scenarios for training.
        val: Scenarios for validation.
        test: Scenarios for testing.
        train_mini: Subset of `train`.
        val_mini: Subset of `val`.
        left_out: Scenarios that are excluded, because `ego_vehicle` has five labels or fewer.
    """

    train: tuple[str, ...]
    val: tuple[str, ...]
    test: tuple[str, ...]
    train_mini: tuple[str, ...]
    val_mini: tuple[str, ...]
    left_out: tuple[str, ...] = ()

    def by_name(self) -> dict[str, tuple[str, ...]]:
        """Return split name → scenario tokens, as a new dict."""
        names = (*SPLITS, *MINI_SPLITS)
        return {name: getattr(self, name) for name in names}

    def save(self, folder: PathType, *, overwrite: bool = False) -> list[Path]:
        """Write `train.txt`, `val.txt`, `test.txt` and the mini splits' files, all or none.

        Args:
            folder: Folder of the files, which is created if it is missing. In a dataroot, the files
                decide the splits of the release.
            overwrite: Whether to replace existing files.

        Returns:
            Paths of the files.

        Raises:
            ConfigError: If a file exists and `overwrite` is not set, or `folder` is a file.
            TokenError: If a scenario's name contains blanks, which a split file cannot represent.
        """
        folder_path = path_of(folder)
        files = {folder_path / f"{name}.txt": tokens for name, tokens in self.by_name().items()}
        return _write_split_files(files, overwrite)


def official_split(
    dataset: Dataset, seed: int = OFFICIAL_SEED, *, released_skip: bool = False
) -> Splits:
    """Split a release as the official procedure does, but reproducibly.

    The official lists ship with the release. They cannot be reproduced, because the official
    procedure starts from the order in which a file system happened to list folders. This function
    sorts first, so the result depends only on the scenarios and `seed`.

    1. Only scenarios with more than five labels of `ego_vehicle` are included, so an unlabelled
    test split is not. Twins are a normal and an accident scenario with the same name and subtype;
    they stay together. Of T scenarios, val and test get at most round(0.15 T) each. 2. Twins are
    *designed* if, according to meta, the accident is between the ego or the car behind it and the
    other vehicle or the car behind that, and the normal scenario has no collision. 3. Twins form
    three strata by the accident's meta: three-way; four-way with the other vehicle from opposite;
    all others. Each stratum is shuffled; the first share goes to val, the next one to test, and the
    remainder to train: 0.4 and 0.4 of designed twins, then 0.15 and 0.15 of the other twins, then
    0.15 and 0.15 of the scenarios without a twin (with a stratum for each subtype, and for normal
    and accident scenarios), rounded, as far as val and test have room. 4. `train_mini` and
    `val_mini` are made from train and val in the same way, with the same seed: at most a fifth, by
    shares of 0.4 of designed twins and 0.2 of all others.

    Args:
        dataset: The release.
        seed: Seed of the shuffles; 17 is the official one.
        released_skip: Whether to reproduce a bug of the released loop: it removes each designed
            pair from the list that it iterates over. So it skips the next pair, which then counts
            as not designed.

    Returns:
        The splits.
    """
    counted_scenarios = []
    left_out = []
    for scenario in dataset.scenario[:]:
        if _count_ego_labels(dataset, scenario) >= _MIN_EGO_LABELS:
            counted_scenarios.append(scenario)
        else:
            left_out.append(scenario["token"])
    return split_records(
        counted_scenarios, seed, released_skip=released_skip, left_out=tuple(sorted(left_out))
    )


def split_records(
    scenarios: Iterable[ScenarioRecord],
    seed: int = OFFICIAL_SEED,
    *,
    released_skip: bool = False,
    left_out: tuple[str, ...] = (),
) -> Splits:
    """Apply steps 2 to 4 of `official_split` to scenario records, whose order does not matter."""
    scenario_by_token = {scenario["token"]: scenario for scenario in scenarios}
    max_tokens = round(_SHARE * len(scenario_by_token))
    strata = _make_strata(scenario_by_token.values(), released_skip=released_skip)
    shares = (_DESIGNED_SHARE, _SHARE)
    val, test, train = _deal_strata(strata, shares, max_tokens, parts=2, seed=seed)
    minis = []
    for split in (train, val):
        split_scenarios = [scenario_by_token[token] for token in split]
        strata = _make_strata(split_scenarios, released_skip=released_skip)
        shares = (_DESIGNED_SHARE, _MINI_SHARE)
        max_tokens = round(_MINI_SHARE * len(split))
        minis.append(_deal_strata(strata, shares, max_tokens, parts=1, seed=seed)[0])
    return Splits(
        train=train, val=val, test=test, train_mini=minis[0], val_mini=minis[1], left_out=left_out
    )


def save_selection(
    scenarios: Iterable[RowArgument], path: PathType, *, overwrite: bool = False
) -> Path:
    """Write scenarios, such as the ones that `find` returns, as a split file.

    `split_scenarios(path)` reads it.

    Args:
        scenarios: Tokens or records; their order is kept, and each is written once.
        path: Path of the file, with a name that ends in `.txt`.
        overwrite: Whether to replace an existing file.

    Returns:
        The path.

    Raises:
        ConfigError: If the name does not end in `.txt`, the file exists and `overwrite` is not set,
            or its folder is a file.
        TokenError: If an item is neither a scenario's token nor its record, or contains blanks,
            which a split file cannot represent.
    """
    path = path_of(path)
    if path.suffix != ".txt":
        raise ConfigError(f"{path}: a split file's name ends in .txt; choose another name")
    members = members_of("scenarios", scenarios, "tokens or records of scenarios")
    tokens = tuple(dict.fromkeys(map(_read_token, members)))
    return _write_split_files({path: tokens}, overwrite)[0]


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitReport(Report):
    """The distribution of scenarios among splits.

    Attributes:
        dataroot: Folder of the release.
        version: Version of the release, `v1` or `v1-mini`.
        scenarios: Split → number of scenarios.
        frames: Split → number of frames.
        attributes: Field → value (`none` if unknown) → split → number of scenarios.
        left_out: Tokens of scenarios that belong to no split.
    """

    dataroot: str
    version: str
    scenarios: Mapping[str, int]
    frames: Mapping[str, int]
    attributes: Mapping[str, Mapping[str, Mapping[str, int]]]
    left_out: Sequence[str]

    def to_text(self) -> str:
        """Return a block of counts and shares for each attribute, with one column per split."""
        names = list(self.scenarios)
        totals = {"scenarios": self.scenarios, "frames": self.frames}
        total_rows = [(word, *map(str, row.values())) for word, row in totals.items()]
        blocks = [
            f"DeepAccident {self.version} at {self.dataroot}",
            columns_text([("split", *names), *total_rows]),
        ]
        for field, counts in self.attributes.items():
            rows = [(field, *names)]
            for value, row in counts.items():
                shares = [share_text(row[name], self.scenarios[name]) for name in names]
                rows.append((value, *shares))
            blocks.append(columns_text(rows))
        if self.left_out:
            scenarios = counted(len(self.left_out), "scenario")
            blocks.append(f"excluded: {scenarios}, as ego_vehicle has five labels or fewer")
        return "\n\n".join(blocks)


def split_report(dataset: Dataset, splits: Splits | Mapping[str, Collection[str]]) -> SplitReport:
    """Count the values of attributes in each split.

    Args:
        dataset: The release.
        splits: The result of `official_split`, or split name → scenario tokens.

    Raises:
        TokenError: If the release has no scenario with one of the tokens.
    """
    by_name = splits.by_name() if isinstance(splits, Splits) else splits
    records = {}
    frames = {}
    for name, tokens in by_name.items():
        records[name] = [dataset.scenario.get(token) for token in tokens]
        frames[name] = sum(scenario["num_frames"] for scenario in records[name])
    fields = (*SCENARIO_ATTRIBUTES, "collision")
    return SplitReport(
        dataroot=str(dataset.dataroot),
        version=dataset.version,
        scenarios={name: len(scenarios) for name, scenarios in records.items()},
        frames=frames,
        attributes={field: _count_values(records, field) for field in fields},
        left_out=splits.left_out if isinstance(splits, Splits) else (),
    )


# The procedure.


def _count_ego_labels(dataset: Dataset, scenario: ScenarioRecord) -> int:
    """Return the number of frames that a scenario's ego labelled: all of them or 0.

    A scenario in which only some frames are labelled is not indexed.
    """
    try:
        labelled = dataset.sample.get(f"{scenario['token']}/{VEHICLE_AGENTS[0]}/001")["labelled"]
    except TokenError:  # a partial download without the ego
        return 0
    return scenario["num_frames"] if labelled else 0


def _make_strata(scenarios: Iterable[ScenarioRecord], *, released_skip: bool) -> _Strata:
    """Return two lists of strata: designed twins; all other twins and single scenarios.

    Both lists are in the official order.
    """
    in_order = sorted(scenarios, key=_sort_key)
    scenario_by_token = {scenario["token"]: scenario for scenario in in_order}
    twins, singles = _find_twins(scenario_by_token)
    designed = []
    others = []
    skip_next = False
    for normal, accident in twins:
        if not skip_next and _is_designed(scenario_by_token[normal], scenario_by_token[accident]):
            designed.append((normal, accident))
            skip_next = released_skip
        else:
            others.append((normal, accident))
            skip_next = False
    singles_by_type: dict[str, list[_Unit]] = {}
    for token in singles:
        singles_by_type.setdefault(scenario_by_token[token]["scenario_type"], []).append((token,))
    designed_strata = _group_by_junction(scenario_by_token, designed)
    other_strata = _group_by_junction(scenario_by_token, others)
    return designed_strata, [*other_strata, *singles_by_type.values()]


def _sort_key(scenario: ScenarioRecord) -> tuple[str, bool, str]:
    """Return a sort key: subtype, normal before accident, name."""
    return _remove_ending(scenario), scenario["designed_accident"], scenario["name"]


def _remove_ending(scenario: ScenarioRecord) -> str:
    """Return a scenario's type without `_normal` or `_accident`, such as `type1_subtype1`."""
    return scenario["scenario_type"].rpartition("_")[0]


def _find_twins(
    scenario_by_token: Mapping[str, ScenarioRecord],
) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the twins, normal scenario first, and the scenarios without a twin."""
    tokens_by_name: dict[tuple[str, str], list[str]] = {}
    for token, scenario in scenario_by_token.items():
        key = (_remove_ending(scenario), scenario["name"])
        tokens_by_name.setdefault(key, []).append(token)
    twins = []
    singles = []
    for tokens in tokens_by_name.values():
        if len(tokens) == 2:
            twins.append((tokens[0], tokens[1]))
        else:
            singles += tokens
    twins.sort(key=lambda pair: _sort_key(scenario_by_token[pair[0]]))
    singles.sort(key=lambda token: _sort_key(scenario_by_token[token]))
    return twins, singles


def _is_designed(normal: ScenarioRecord, accident: ScenarioRecord) -> bool:
    collision = accident["collision"]
    if collision is None or collision["agents"] is None or normal["collision"] is not None:
        return False
    # Without meta it is unknown whether the normal scenario ended in a collision.
    if normal["weather"] is None:
        return False
    agent, other = collision["agents"]
    if agent in _EGO_AGENTS:
        return other in _OTHER_AGENTS
    return agent in _OTHER_AGENTS and other in _EGO_AGENTS


def _group_by_junction(
    scenario_by_token: Mapping[str, ScenarioRecord], twins: Sequence[_Unit]
) -> list[list[_Unit]]:
    """Group twins by the accident's meta: three-way; four-way from opposite; all others."""
    three_way = []
    opposite = []
    others = []
    for twin in twins:
        _, accident_token = twin
        accident = scenario_by_token[accident_token]
        if (accident["road_type"] or "").startswith("three-way"):
            three_way.append(twin)
        elif (accident["spawn_side"] or "").startswith("opposite"):
            opposite.append(twin)
        else:
            others.append(twin)
    return [three_way, opposite, others]


def _deal_strata(
    strata: _Strata,
    shares: tuple[float, float],
    max_tokens: int,
    *,
    parts: int,
    seed: int,
) -> list[tuple[str, ...]]:
    """Distribute shares of every stratum to several lists, and the remainder to a last list.

    Args:
        strata: Strata of designed twins, and all other strata.
        shares: Share of each stratum that a list gets: of designed twins, and of the others.
        max_tokens: Largest number of tokens in each list except the last.
        parts: Number of lists, not counting the last.
        seed: Seed of the shuffles.

    Returns:
        Sorted tokens of each list.
    """
    rng = Random(seed)  # noqa: S311 - a split, not a secret; its shuffle is the same on all Pythons
    lists: list[list[str]] = [[] for _ in range(parts + 1)]
    for group, share in zip(strata, shares, strict=True):
        for stratum in group:
            units = list(stratum)
            rng.shuffle(units)
            for part in range(parts):
                capacity = (max_tokens - len(lists[part])) // len(units[0]) if units else 0
                count = min(round(share * len(stratum)), capacity)
                lists[part] += chain.from_iterable(units[:count])
                units = units[count:]
            lists[parts] += chain.from_iterable(units)
    return [tuple(sorted(tokens)) for tokens in lists]


# Files and counts.


def _write_split_files(files: Mapping[Path, Sequence[str]], overwrite: bool) -> list[Path]:  # noqa: FBT001
    """Write split files, and rename them into place only when all are complete."""
    for path, tokens in files.items():
        for token in tokens:
            _check_line(path, token)
        if path.exists() and not overwrite:
            raise ConfigError(
                f"{path}: already exists; choose another path, or pass overwrite=True (--overwrite)"
            )
        if path.is_dir():
            raise ConfigError(f"{path}: is a folder; choose another path")
        if path.parent.exists() and not path.parent.is_dir():
            raise ConfigError(f"{path.parent}: is a file; give a folder")
    with ExitStack() as stack:
        for path, tokens in files.items():
            write_split_file(stack.enter_context(replacing(path)), tokens)
    return list(files)


def _read_token(scenario: RowArgument) -> str:
    token = scenario.get("token") if isinstance(scenario, Mapping) else scenario
    if not isinstance(token, str) or token.count("/") != 1:
        raise TokenError(f"expected the token or the record of a scenario, found {scenario!r}")
    return token


def _check_line(path: Path, token: str) -> None:
    """Raise TokenError if a token cannot be read back from a line of two words."""
    if token.replace("/", " ").split() != token.split("/") or not token.isprintable():
        raise TokenError(
            f"{path}: scenario {token!r} cannot be in a split file, as its lines are "
            "'<scenario_type> <scenario>' of printable characters without blanks; exclude it, or "
            "rename its folders"
        )


def _count_values(
    records: Mapping[str, Sequence[ScenarioRecord]], field: str
) -> dict[str, dict[str, int]]:
    counts = {
        name: Counter(_format_value(scenario, field) for scenario in scenarios)
        for name, scenarios in records.items()
    }
    values = sorted(set[str]().union(*counts.values()), key=natural_order)
    return {value: {name: counter[value] for name, counter in counts.items()} for value in values}


def _format_value(scenario: ScenarioRecord, field: str) -> str:
    if field == "collision" and scenario["weather"] is not None:  # known if meta exists
        return "no" if scenario["collision"] is None else "yes"
    value = scenario[field]  # type: ignore[literal-required]
    if value is None:
        return "none"
    return str(value)
