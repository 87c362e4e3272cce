"""Lists of samples for training and for evaluation."""

from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Literal, get_args

import numpy as np

from deepaccident_devkit.dataset import Dataset
from deepaccident_devkit.errors import ConfigError, NotAvailableError
from deepaccident_devkit.support.arrays import checked_number
from deepaccident_devkit.support.text import PathType, choice, choices, counted
from deepaccident_devkit.taxonomy import CHANNELS, FRAME_PERIOD

Purpose = Literal["train", "evaluate", "all", "keyframes", "every"]
SampleProtocol = Literal["released", "paper"]
Scope = Literal["accident", "all"]
# Number of frames from one keyframe to the next, counted back from the last frame of a scenario.
_KEYFRAME_STEP = 5
# Purpose → number of frames between samples.
_FRAME_STEPS = {
    "train": 10,
    "evaluate": _KEYFRAME_STEP,
    "all": _KEYFRAME_STEP,
    "keyframes": _KEYFRAME_STEP,
    "every": 1,
}
_RELEASED_HORIZON_S = 2.0


def samples(
    dataset: Dataset,
    split: PathType,
    purpose: Purpose,
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON_S,
    scope: Scope = "accident",
    sensors: Iterable[str] = (),
) -> list[str]:
    """Return a split's labelled samples, from all agents, for training or evaluation.

    Frames are counted back from a scenario's last frame, which is the collision in an accident
    scenario:

    - `train`: one frame per second, from normal and accident scenarios;
    - `evaluate`: two frames per second within the last `horizon` seconds, without the last frame,
      from scenarios designed to end in an accident (`_accident` in their folder); `scope="all"`
      adds normal scenarios;
    - `all` or `keyframes`: two frames per second, over the whole of each scenario;
    - `every`: all samples, ten per second.

    The released V2X class stops after 50 samples of a list in an unknown order; this function does
    not.

    Args:
        dataset: The release.
        split: Name of the split, `train`, `val`, …, `all`, or a split file, as in
            `Dataset.split_scenarios`.
        purpose: Purpose of the samples: `train`, `evaluate`, `all`, `keyframes` or `every`.
        protocol: Name of the protocol: `released` only allows a horizon of 2 s and accident
            scenarios, `paper` also allows others.
        horizon: Number of seconds before the end, a multiple of 0.5; only for `evaluate`.
        scope: Kind of scenarios, `accident` or `all`; only for `evaluate`.
        sensors: Channels, such as `Camera_Front`, for which each returned sample must have a file;
            useful for a partial download.

    Returns:
        Tokens, sorted by scenario, agent and time.

    Raises:
        ChoiceError: If the split, purpose, protocol or scope is unknown.
        ConfigError: If the horizon is not a multiple of 0.5 s, or the released protocol is combined
            with another horizon or scope.
        NotAvailableError: If the scenarios' splits are unknown, this release has no scenario of the
            split, none of its samples is labelled (as in the test split), or none has files of all
            `sensors`.
    """
    channels = choices("sensors", sensors, CHANNELS, empty=True)
    purpose_name: str = choice("purpose", purpose, _FRAME_STEPS)
    protocol = choice("protocol", protocol, get_args(SampleProtocol))
    scope = choice("scope", scope, get_args(Scope))
    seconds = checked_number("horizon", horizon, "a number of seconds", ConfigError)
    steps = seconds / (_KEYFRAME_STEP * FRAME_PERIOD)
    if not (1 <= steps < float("inf") and abs(steps - round(steps)) < 1e-6):
        raise ConfigError(f"horizon: {horizon} s is not a multiple of 0.5 s; choose 0.5, 1, 1.5, …")
    if protocol == "released" and (seconds != _RELEASED_HORIZON_S or scope != "accident"):
        raise ConfigError(
            "the released protocol looks only 2 s ahead in accident scenarios; use protocol='paper'"
        )

    scenario_tokens = dataset.split_scenarios(split)
    if not scenario_tokens:
        raise NotAvailableError(
            f"{split}: no scenario of this split is in {dataset.dataroot}; unpack that part of "
            f"the release, or choose another split (the release has {_describe_splits(dataset)})"
        )
    split_rows = [dataset.getind("scenario", token) for token in scenario_tokens]
    is_in_split = np.isin(np.arange(len(dataset.scenario)), split_rows)
    columns = dataset.columns("sample")
    scenarios = dataset.columns("scenario")
    row = columns["scenario_row"]
    candidates = is_in_split[row] & columns["labelled"][:]
    if not candidates.any():
        raise NotAvailableError(
            f"{split}: no sample of this split has labels (the test split has none)"
        )
    frame_numbers = columns["frame_row"] - scenarios["first_frame_row"][row] + 1
    frames_to_end = scenarios["num_frames"][row] - frame_numbers
    is_selected = candidates & (frames_to_end % _FRAME_STEPS[purpose_name] == 0)
    if purpose_name == "evaluate":
        is_selected &= (frames_to_end > 0) & (frames_to_end <= round(seconds / FRAME_PERIOD))
        if scope == "accident":
            is_selected &= scenarios["designed_accident"][:][row]
    tokens = [dataset.sample[index]["token"] for index in np.flatnonzero(is_selected).tolist()]
    if channels:
        return _select_with_files(dataset, tokens, channels)
    return tokens


def _select_with_files(
    dataset: Dataset, tokens: Sequence[str], channels: Sequence[str]
) -> list[str]:
    """Return the samples with files of all channels; raise NotAvailableError if none has them."""
    with_files = []
    for scenario, scenario_samples in groupby(tokens, lambda token: token.rsplit("/", 2)[0]):
        frames = dataset.sensor_frames(scenario)
        for token in scenario_samples:
            agent, number = token.split("/")[-2:]
            if all(int(number) in frames[agent, channel] for channel in channels):
                with_files.append(token)
    if tokens and not with_files:
        raise NotAvailableError(
            f"sensors: none of the {counted(len(tokens), 'sample')} has files of "
            f"{', '.join(channels)} in {dataset.dataroot}; unpack their archives, or choose other "
            "sensors"
        )
    return with_files


def no_samples_text(dataset: Dataset, split: PathType, scope: Scope) -> str:
    """Return advice for a split that has labelled samples, but none was selected."""
    tokens = sorted(dataset.split_scenarios(split))
    is_designed = [dataset.get("scenario", token)["designed_accident"] for token in tokens]
    if scope == "accident" and not any(is_designed):
        return (
            "the default scope (accident) excludes every scenario of this split, as none was "
            "designed to end in an accident; use scope='all' (--scope all)"
        )
    return "choose other samples"


def _describe_splits(dataset: Dataset) -> str:
    """Return a text such as `train: 2 scenarios, split unknown: 1 scenario`."""
    counts = Counter(scenario["split"] or "split unknown" for scenario in dataset.scenario)
    texts = [f"{name}: {counted(count, 'scenario')}" for name, count in counts.items()]
    return ", ".join(texts)


def training_samples(
    dataset: Dataset, split: PathType, *, sensors: Iterable[str] = ()
) -> list[str]:
    """Return the samples for training: `samples` with the purpose `train`."""
    return samples(dataset, split, "train", sensors=sensors)


def evaluation_samples(
    dataset: Dataset,
    split: PathType,
    protocol: SampleProtocol = "released",
    *,
    horizon: float = _RELEASED_HORIZON_S,
    scope: Scope = "accident",
) -> list[str]:
    """Return the samples for evaluation: `samples` with the purpose `evaluate`."""
    return samples(dataset, split, "evaluate", protocol, horizon=horizon, scope=scope)
