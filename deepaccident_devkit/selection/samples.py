"""Lists of samples: those that models are trained on, and those that they are evaluated at."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Final, Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.support.arrays import checked_number
from deepaccident_devkit.support.text import choice, choices
from deepaccident_devkit.taxonomy import CHANNELS, FRAME_PERIOD

Purpose = Literal["train", "evaluate", "all", "keyframes", "every"]
SampleProtocol = Literal["released", "paper"]
Scope = Literal["accident", "all"]
# Recorded frames from one key frame to the next, counted back from a scenario's last frame.
_KEY_STEP: Final = 5
_STEPS: Final = {
    "train": 10,
    "evaluate": _KEY_STEP,
    "all": _KEY_STEP,
    "keyframes": _KEY_STEP,
    "every": 1,
}
_RELEASED_HORIZON: Final = 2.0


def samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    purpose: Purpose,
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON,
    scope: Scope = "accident",
    sensors: Iterable[str] = (),
) -> list[str]:
    """The labelled samples of a split that a model is trained on or evaluated at, of all agents.

    Frames are counted back from a scenario's last one, which in an accident scenario is the collision:

    - `train`: one a second, of normal and accident scenarios;
    - `evaluate`: two a second within the last `horizon` seconds except the last frame, of scenarios designed to end
      in an accident (`_accident` in their folder); `scope="all"` adds the normal ones;
    - `all`, or `keyframes`: two a second, the whole of every scenario, but not all of its samples;
    - `every`: all samples, ten a second.

    The released V2X class stops after 50 samples of a list in an unknown order; this function does not.

    Args:
        dataset: the release.
        split: `train`, `val`, …, `all` or a split file, as `Dataset.split_scenarios` takes it.
        purpose: `train`, `evaluate`, `all`, `keyframes` or `every`.
        protocol: `released` has only a horizon of 2 s and accident scenarios; `paper` allows others.
        horizon: seconds before the end, a multiple of 0.5; only for `evaluate`.
        scope: `accident` or `all`; only for `evaluate`.
        sensors: channels, such as `Camera_Front`: only samples whose own files of all of these are here, such as of a
            partial download.

    Returns:
        Tokens by scenario, agent and time.

    Raises:
        ChoiceError: no such split, purpose, protocol or scope.
        ConfigError: a horizon that is no multiple of 0.5 s, or one that the released protocol does not have.
        NotAvailableError: the split is unknown, this release has no scenario of it, none of its samples has labels
            (the test split has none), or none has the files of the sensors.
    """
    channels = choices("sensors", sensors, CHANNELS, empty=True)
    listed: str = choice("purpose", purpose, _STEPS)
    protocol = choice("protocol", protocol, get_args(SampleProtocol))
    scope = choice("scope", scope, get_args(Scope))
    seconds = checked_number("horizon", horizon, "a number of seconds", ConfigError)
    steps = seconds / (_KEY_STEP * FRAME_PERIOD)
    if not (1 <= steps < float("inf") and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(f"horizon: {horizon} s is no multiple of 0.5 s; choose 0.5, 1, 1.5, …")
    if protocol == "released" and (seconds != _RELEASED_HORIZON or scope != "accident"):
        raise ConfigError(
            "the released protocol looks 2 s ahead in accident scenarios; choose protocol='paper'"
        )

    scenario_tokens = dataset.split_scenarios(split)
    if not scenario_tokens:
        raise NotAvailableError(
            f"{split}: no scenario of this split is in {dataset.dataroot}; unpack that part of the release, or choose "
            f"another split: it has {_splits_text(dataset)}"
        )
    wanted = np.isin(
        np.arange(len(dataset.scenario)),
        [dataset.getind("scenario", one) for one in scenario_tokens],
    )
    columns, scenarios = dataset.columns("sample"), dataset.columns("scenario")
    row = columns["scenario_row"]
    in_split = wanted[row] & columns["labelled"][:]
    if not in_split.any():
        raise NotAvailableError(
            f"{split}: none of its samples here has labels (the test split has none)"
        )
    to_end = scenarios["num_frames"][row] - (
        columns["frame_row"] - scenarios["first_frame_row"][row] + 1
    )
    chosen = to_end % _STEPS[listed] == 0
    if listed == "evaluate":
        chosen &= (to_end > 0) & (to_end <= round(seconds / FRAME_PERIOD))
        if scope == "accident":
            chosen &= scenarios["designed_accident"][:][row]
    tokens = [
        dataset.sample[index]["token"] for index in np.flatnonzero(in_split & chosen).tolist()
    ]
    return _with_files(dataset, tokens, channels) if channels else tokens


def _with_files(dataset: Dataset, tokens: Sequence[str], channels: Sequence[str]) -> list[str]:
    """Keep the samples that have the files of these sensors; raises NotAvailableError if none has."""
    kept: list[str] = []
    for scenario, of_scenario in groupby(tokens, lambda token: token.rsplit("/", 2)[0]):
        frames = dataset.sensor_frames(scenario)
        for token in of_scenario:
            agent, number = token.split("/")[-2:]
            if all(int(number) in frames[agent, channel] for channel in channels):
                kept.append(token)
    if tokens and not kept:
        raise NotAvailableError(
            f"sensors: none of the {len(tokens)} samples has its files of {', '.join(channels)} in {dataset.dataroot}; "
            "unpack their archives, or choose other sensors"
        )
    return kept


def no_samples_text(dataset: Dataset, split: str | os.PathLike[str], scope: Scope) -> str:
    """What to do where a split of a release has labelled samples, but a list has none of them."""
    scenarios = [dataset.get("scenario", token) for token in sorted(dataset.split_scenarios(split))]
    if scope == "accident" and not any(scenario["designed_accident"] for scenario in scenarios):
        return (
            f"the scope accident, which is the default, leaves out all {len(scenarios)} of its scenarios, since none "
            "was designed to end in an accident; use scope='all' (--scope all)"
        )
    return "choose others"


def _splits_text(dataset: Dataset) -> str:
    """`train: 2 scenarios, split unknown: 1 scenario`."""
    counts = Counter(scenario["split"] or "split unknown" for scenario in dataset.scenario)
    return ", ".join(
        f"{name}: {count} scenario{'s' * (count != 1)}" for name, count in counts.items()
    )


def training_samples(
    dataset: Dataset, split: str | os.PathLike[str], *, sensors: Iterable[str] = ()
) -> list[str]:
    """The samples that a model is trained on, one a second: `samples` for the purpose `train`; see there."""
    return samples(dataset, split, "train", sensors=sensors)


def evaluation_samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON,
    scope: Scope = "accident",
) -> list[str]:
    """The samples that a model is evaluated at: `samples` for the purpose `evaluate`; see there."""
    return samples(dataset, split, "evaluate", protocol, horizon=horizon, scope=scope)
