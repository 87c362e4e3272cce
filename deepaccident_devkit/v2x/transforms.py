"""Transforms between agents, their sensors and moments."""

from deepaccident_devkit.dataset import Dataset, RowArgument
from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.geometry import SE3


def transform(
    dataset: Dataset,
    target_sample: RowArgument,
    source_sample: RowArgument,
    target: str = "ego",
    source: str = "ego",
) -> SE3:
    """The transform `target_from_source` between frames of any two agents and moments of one scenario.

    Args:
        dataset: the release.
        target_sample: token or record of the sample to which the target frame belongs.
        source_sample: token or record of the sample to which the source frame belongs.
        target: `world`, `ego`, `lidar` or a channel (cameras: the optical frame).
        source: the same choice as for `target`.

    Raises:
        TokenError: no such sample.
        ChoiceError: no such frame, or the samples are of two scenarios, whose worlds have nothing in common.
    """
    scenarios = [dataset.get("sample", sample)["scenario_token"] for sample in (target_sample, source_sample)]
    if scenarios[0] != scenarios[1]:
        raise ChoiceError(
            f"transform: expected two samples of one scenario, found {scenarios[0]} and {scenarios[1]}; "
            "scenarios take place in different worlds"
        )
    world_from_target = dataset.world_from(target_sample, target)
    return world_from_target.inverse() @ dataset.world_from(source_sample, source)
