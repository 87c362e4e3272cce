"""Lists of samples for training and for evaluation."""

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
# Recorded frames from one keyframe to the next, counted back from a scenario's last frame.
_KEYFRAME_STEP: Final = 5
_FRAME_STEPS: Final = {
    "train": 10,
    "evaluate": _KEYFRAME_STEP,
    "all": _KEYFRAME_STEP,
    "keyframes": _KEYFRAME_STEP,
    "every": 1,
}
_RELEASED_HORIZON_S: Final = 2.0


def samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    purpose: Purpose,
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON_S,
    scope: Scope = "accident",
    sensors: Iterable[str] = (),
) -> list[str]:
    """Return the labelled samples of a split, of all agents, for training or evaluation.

    Frames are counted back from a scenario's last one, which in an accident scenario is the
    collision:

    - `train`: one a second, of normal and accident scenarios;
    - `evaluate`: two a second within the last `horizon` seconds except the last frame, of scenarios
      designed to end in an accident (`_accident` in their folder); `scope="all"` adds normal ones;
    - `all`, or `keyframes`: two a second over every complete scenario, but not all of its samples;
    - `every`: all samples, ten a second.

    The released V2X class stops after 50 samples of a list in an unknown order; this function does
    not.

    Args:
        dataset: The release.
        split: `train`, `val`, …, `all` or a split file, as in `Dataset.split_scenarios`.
        purpose: `train`, `evaluate`, `all`, `keyframes` or `every`.
        protocol: `released` has only a horizon of 2 s and accident scenarios; `paper` has others.
        horizon: Seconds before the end, a multiple of 0.5; only for `evaluate`.
        scope: `accident` or `all`; only for `evaluate`.
        sensors: Channels, such as `Camera_Front`: only samples with files of all these channels are
            returned, for instance of a partial download.

    Returns:
        Tokens by scenario, agent and time.

    Raises:
        ChoiceError: The split, purpose, protocol or scope is unknown.
        ConfigError: The horizon is no multiple of 0.5 s, or the released protocol has another.
        NotAvailableError: The split is unknown, this release has no scenario of it, none of its
            samples has labels (the test split has none), or none has the files of the sensors.
    """
    channels = choices("sensors", sensors, CHANNELS, empty=True)
    purpose_name: str = choice("purpose", purpose, _FRAME_STEPS)
    protocol = choice("protocol", protocol, get_args(SampleProtocol))
    scope = choice("scope", scope, get_args(Scope))
    seconds = checked_number("horizon", horizon, "a number of seconds", ConfigError)
    steps = seconds / (_KEYFRAME_STEP * FRAME_PERIOD)
    if not (1 <= steps < float("inf") and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(f"horizon: {horizon} s is no multiple of 0.5 s; choose 0.5, 1, 1.5, …")
    if protocol == "released" and (seconds != _RELEASED_HORIZON_S or scope != "accident"):
        raise ConfigError(
            "the released protocol looks 2 s ahead in accident scenarios; choose protocol='paper'"
        )

    scenario_tokens = dataset.split_scenarios(split)
    if not scenario_tokens:
        raise NotAvailableError(
            f"{split}: no scenario of this split is in {dataset.dataroot}; unpack that part of the "
            f"release, or choose another split: it has {_splits_text(dataset)}"
        )
    split_rows = [dataset.getind("scenario", token) for token in scenario_tokens]
    is_in_split = np.isin(np.arange(len(dataset.scenario)), split_rows)
    columns = dataset.columns("sample")
    scenarios = dataset.columns("scenario")
    row = columns["scenario_row"]
    candidates = is_in_split[row] & columns["labelled"][:]
    if not candidates.any():
        raise NotAvailableError(
            f"{split}: none of its samples here has labels (the test split has none)"
        )
    frame = columns["frame_row"] - scenarios["first_frame_row"][row] + 1
    frames_to_end = scenarios["num_frames"][row] - frame
    selected = candidates & (frames_to_end % _FRAME_STEPS[purpose_name] == 0)
    if purpose_name == "evaluate":
        selected &= (frames_to_end > 0) & (frames_to_end <= round(seconds / FRAME_PERIOD))
        if scope == "accident":
            selected &= scenarios["designed_accident"][:][row]
    tokens = [dataset.sample[index]["token"] for index in np.flatnonzero(selected).tolist()]
    if channels:
        return _with_files(dataset, tokens, channels)
    return tokens


def _with_files(dataset: Dataset, tokens: Sequence[str], channels: Sequence[str]) -> list[str]:
    """Return the samples with files of all channels; raises NotAvailableError if none has them."""
    with_files: list[str] = []
    for scenario, scenario_samples in groupby(tokens, lambda token: token.rsplit("/", 2)[0]):
        frames = dataset.sensor_frames(scenario)
        for token in scenario_samples:
            agent, number = token.split("/")[-2:]
            if all(int(number) in frames[agent, channel] for channel in channels):
                with_files.append(token)
    if tokens and not with_files:
        raise NotAvailableError(
            f"sensors: none of the {len(tokens)} samples has its files of {', '.join(channels)} in "
            f"{dataset.dataroot}; unpack their archives, or choose other sensors"
        )
    return with_files


def no_samples_text(dataset: Dataset, split: str | os.PathLike[str], scope: Scope) -> str:
    """Return advice if a split has labelled samples, but a list has none of them."""
    scenarios = [dataset.get("scenario", token) for token in sorted(dataset.split_scenarios(split))]
    if scope == "accident" and not any(scenario["designed_accident"] for scenario in scenarios):
        return (
            f"the scope accident, which is the default, leaves out all {len(scenarios)} of its "
            "scenarios, since none was designed to end in an accident; use scope='all' "
            "(--scope all)"
        )
    return "choose others"


def _splits_text(dataset: Dataset) -> str:
    """Return a text such as `train: 2 scenarios, split unknown: 1 scenario`."""
    counts = Counter(scenario["split"] or "split unknown" for scenario in dataset.scenario)
    return ", ".join(
        f"{name}: {count} scenario{'s' * (count != 1)}" for name, count in counts.items()
    )


def training_samples(
    dataset: Dataset, split: str | os.PathLike[str], *, sensors: Iterable[str] = ()
) -> list[str]:
    """Return the samples for training, one a second: `samples` for the purpose `train`."""
    return samples(dataset, split, "train", sensors=sensors)


def evaluation_samples(
    dataset: Dataset,
    split: str | os.PathLike[str],
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON_S,
    scope: Scope = "accident",
) -> list[str]:
    """Return the samples for evaluation: `samples` for the purpose `evaluate`."""
    return samples(dataset, split, "evaluate", protocol, horizon=horizon, scope=scope)
