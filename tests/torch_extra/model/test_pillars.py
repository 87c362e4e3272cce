"""The encoder of LiDAR points: the cells that points reach, and the points that count."""

from dataclasses import replace

import pytest
import torch
from support.expected_errors import assert_raises
from torch.testing import assert_close
from torch_extra.model.small_model import small_both_config, small_lidar_config

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.geometry import BevGrid
from deepaccident_devkit.plugins.model.inputs import model_inputs
from deepaccident_devkit.plugins.model.network import V2XFormer
from deepaccident_devkit.plugins.model.pillars import PillarConfig, PillarEncoder
from deepaccident_devkit.taxonomy import POLE_HEIGHT
from deepaccident_devkit.training.torch import V2XDataset, collate

GRID = BevGrid(x=(-10.0, 10.0, 1.0), y=(-5.0, 5.0, 1.0))


@pytest.fixture
def encoder() -> PillarEncoder:
    torch.manual_seed(3)
    return PillarEncoder(PillarConfig(channels=4, grid=GRID, width=6)).eval()


def find_reached_cells(
    encoder: PillarEncoder, points: list[list[float]], frames: list[int], num_frames: int = 1
) -> torch.Tensor:
    """Return where maps differ from maps without points, shape (frames, Y, X)."""
    with torch.inference_mode():
        maps = encoder(torch.tensor(points), torch.tensor(frames), num_frames)
        empty_maps = encoder(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), num_frames)
    assert maps.shape == (num_frames, 4, 10, 20)
    return (maps != empty_maps).any(1)


def test_a_point_reaches_the_cells_around_its_own(encoder: PillarEncoder) -> None:
    """Two convolutions reach two cells, and a third on the side where the point is in its cell."""
    is_reached = find_reached_cells(encoder, [[3.2, -1.3, 0.5, 0.4]], [0])
    rows, columns = is_reached[0].nonzero().unbind(1)
    assert (rows.min(), rows.max()) == (2, 5)
    assert (columns.min(), columns.max()) == (12, 14)


def test_points_are_of_their_own_frame(encoder: PillarEncoder) -> None:
    is_reached = find_reached_cells(
        encoder,
        [[3.2, -1.3, 0.5, 0.4], [-3.2, 1.3, 0.5, 0.4]],
        [2, 1],
        num_frames=3,
    )
    assert is_reached.flatten(1).any(1).tolist() == [False, True, True]
    assert not (is_reached[1] & is_reached[2]).any()


@pytest.mark.parametrize(
    "point", [(10.5, 0, 0), (-10.01, 0, 0), (0, 5.0, 0), (0, -5.5, 0), (0, 0, -0.6), (0, 0, 4.0)]
)
def test_points_outside_do_not_count(encoder: PillarEncoder, point: tuple[float, ...]) -> None:
    is_reached = find_reached_cells(encoder, [[*point, 0.5]], [0])
    assert not is_reached.any()


def test_heights_of_points_are_above_the_road(da: DeepAccident, moment: list[str]) -> None:
    """The frame of the agent on a pole begins at the pole's top."""
    item = V2XDataset(da, moment[:1], small_lidar_config().inputs("all"))[0]
    inputs = model_inputs(collate([item]))
    frames = inputs.frame_valid.shape[2]
    for agent, name in enumerate(item["agents"]):
        points = inputs.points[inputs.point_frames == agent * frames + frames - 1]
        frame_height = POLE_HEIGHT if name == "infrastructure" else 0.0
        assert_close(
            points,
            item["points"][agent][-1] + torch.tensor([0, 0, frame_height, 0]),
        )
        assert abs(float(points[:, 2].median())) < 1.0


def test_a_frame_that_did_not_arrive_has_the_points_of_the_present(
    da: DeepAccident, moment: list[str]
) -> None:
    first = moment[0].replace("/004", "/001")
    item = V2XDataset(da, [first], small_lidar_config().inputs("single"))[0]
    inputs = model_inputs(collate([item]))
    past, present = (inputs.points[inputs.point_frames == frame] for frame in (0, 1))
    assert len(present) > 100
    assert torch.equal(past, present)


def test_faults_are_named(da: DeepAccident, moment: list[str]) -> None:
    config = PillarConfig(channels=4, grid=GRID)
    item = V2XDataset(da, moment[:1], small_lidar_config().inputs("single"))[0]
    inputs = model_inputs(collate([item]))
    torch.manual_seed(0)
    model = V2XFormer(small_both_config())
    assert_raises(
        (lambda: model(inputs), ConfigError, ("inputs: have no images", "config.inputs")),
        (lambda: replace(config, split=0), ConfigError, "split: expected a number from 1"),
        (
            lambda: replace(config, height=(2.0, 1.0)),
            ConfigError,
            "height: expected the lower end, then the higher end",
        ),
    )
