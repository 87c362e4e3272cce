"""The moment and the agent that all pictures of a scenario show by default."""

import pytest
from support.replay_page import accident_scenario

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.render.moments import count_files, default_agent, default_frame
from deepaccident_devkit.taxonomy import AGENTS, CAMERAS, LIDAR


def test_the_default_moment_is_two_seconds_before_the_end(
    da: DeepAccident, da_motion: DeepAccident
) -> None:
    longer, shorter = da_motion.scenario[0], da.scenario[0]
    assert (longer["num_frames"], default_frame(da_motion, longer["token"])) == (35, 15)
    assert (shorter["num_frames"], default_frame(da, shorter["token"])) == (6, 1)


def test_motion_labels_of_the_default_moment_have_all_their_frames(da_motion: DeepAccident) -> None:
    scenario = accident_scenario(da_motion)
    frame = default_frame(da_motion, scenario)
    labels = da_motion.motion_labels(f"{scenario}/ego_vehicle/{frame:03d}")
    assert labels.label_valid.all()


@pytest.mark.parametrize(
    ("channels", "agent"),
    [
        (["Camera_Front"], AGENTS[1]),  # ego's was not downloaded
        ([*CAMERAS, LIDAR], AGENTS[1]),
        (["Camera_Back"], AGENTS[0]),
        ([], AGENTS[0]),
    ],
)
def test_the_default_agent_has_most_files(
    da_partial: DeepAccident, channels: list[str], agent: str
) -> None:
    scenario = accident_scenario(da_partial)
    assert default_agent(da_partial, scenario, range(1, 7), channels) == agent


def test_files_are_counted_by_agent_channel_and_frame(da_partial: DeepAccident) -> None:
    scenario = accident_scenario(da_partial)
    files = count_files(da_partial, scenario, CAMERAS)
    assert files.shape == (4, 6, 6)  # other_vehicle_behind was not downloaded
    assert files[0].sum(axis=1).tolist() == [0, 6, 6, 6, 6, 6]
    assert (files[1:] == 1).all()
