"""Points from LiDARs: where they come to lie, which of them count, and that all of it is
trained.
"""

from dataclasses import replace

import pytest
import torch
from refusals import assert_refused
from torch.testing import assert_close
from torch_extra.model.small_model import small_both, small_lidar

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


def reached(
    encoder: PillarEncoder, points: list[list[float]], frame: list[int], frames: int = 1
) -> torch.Tensor:
    """(frames, Y, X) bool: where a map differs from that of no points."""
    with torch.inference_mode():
        maps = encoder(torch.tensor(points), torch.tensor(frame), frames)
        empty = encoder(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), frames)
    assert maps.shape == (frames, 4, 10, 20)
    return (maps != empty).any(1)


def test_a_point_reaches_the_cells_around_its_own(encoder: PillarEncoder) -> None:
    """Two convolutions of 3 x 3: two cells, or one more on the side where its half of the cell
    is.
    """
    rows, columns = reached(encoder, [[3.2, -1.3, 0.5, 0.4]], [0])[0].nonzero().unbind(1)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (2, 5, 12, 14)


def test_points_are_of_their_own_frame(encoder: PillarEncoder) -> None:
    found = reached(encoder, [[3.2, -1.3, 0.5, 0.4], [-3.2, 1.3, 0.5, 0.4]], [2, 1], frames=3)
    assert found.flatten(1).any(1).tolist() == [False, True, True]
    assert not (found[1] & found[2]).any()


@pytest.mark.parametrize(
    "point", [(10.5, 0, 0), (-10.01, 0, 0), (0, 5.0, 0), (0, -5.5, 0), (0, 0, -0.6), (0, 0, 4.0)]
)
def test_what_lies_outside_does_not_count(encoder: PillarEncoder, point: tuple[float, ...]) -> None:
    assert not reached(encoder, [[*point, 0.5]], [0]).any()


def test_points_stand_on_the_road(da: DeepAccident, moment: list[str]) -> None:
    """Heights are above it, also of the agent on a pole, whose frame begins at the top."""
    item = V2XDataset(da, moment[:1], small_lidar().inputs("all"))[0]
    inputs = model_inputs(collate([item]))
    frames = inputs.frame_valid.shape[2]
    for agent, name in enumerate(item["agents"]):
        own = inputs.points[inputs.point_frames == agent * frames + frames - 1]
        raised = POLE_HEIGHT if name == "infrastructure" else 0.0
        assert_close(own, item["points"][agent][-1] + torch.tensor([0, 0, raised, 0]))
        assert abs(float(own[:, 2].median())) < 1.0


def test_a_frame_that_did_not_arrive_has_the_points_of_the_present(
    da: DeepAccident, moment: list[str]
) -> None:
    """As it has the images of the present."""
    first = moment[0].rsplit("/", 1)[0] + "/001"
    inputs = model_inputs(collate([V2XDataset(da, [first], small_lidar().inputs("single"))[0]]))
    past, present = (inputs.points[inputs.point_frames == frame] for frame in (0, 1))
    assert len(present) > 100
    assert torch.equal(past, present)


def test_faults_are_named(da: DeepAccident, moment: list[str]) -> None:
    made = PillarConfig(channels=4, grid=GRID)
    seen = model_inputs(collate([V2XDataset(da, moment[:1], small_lidar().inputs("single"))[0]]))
    torch.manual_seed(0)
    model = V2XFormer(small_both())
    assert_refused(
        (lambda: model(seen), ConfigError, ("inputs: have no images", "config.inputs")),
        (lambda: replace(made, split=0), ConfigError, "split: expected a number from 1"),
        (
            lambda: replace(made, height=(2.0, 1.0)),
            ConfigError,
            "height: expected a lower and a higher end",
        ),
    )
