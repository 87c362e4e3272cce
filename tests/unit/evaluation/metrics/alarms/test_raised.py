"""Accidents that instance maps show."""

import numpy as np
import pytest
from accident_scenes import FRAMES, as_heads, as_maps, scene, standing

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.accident import AccidentReading
from deepaccident_devkit.evaluation.metrics.alarms.raised import foreseen_accident, named_alarms
from deepaccident_devkit.evaluation.metrics.alarms.truth import BoxTruth

NOBODY = BoxTruth(
    time=np.arange(0, 2.1, 0.1), actor_id=np.zeros(0, np.int64), footprint=np.zeros((21, 0, 5)), accident=None
)
CALM = {5: standing(20, 10), 9: standing(10, 10)}
EARLY = {5: standing(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 0, 3, 5, 7)]}
LATE = {5: standing(20, 10), 9: [(15.5 - gap, 10) for gap in (4, 3, 2, 0, 1)]}


@pytest.mark.parametrize(
    ("cars", "score", "frame"),
    [
        ([LATE], 1.0, 3),
        ([EARLY, CALM, LATE], 2 / 3, 3),
        ([CALM, EARLY, LATE, CALM], 0.5, 1),
        ([LATE, EARLY, CALM], 2 / 3, 3),
        ([CALM, CALM], None, 0),
    ],
)
@pytest.mark.parametrize("form", [as_maps, as_heads])
@pytest.mark.parametrize("config", [{}, {"protocol": "clean"}, {"orientation": "released"}])
def test_a_foreseen_accident_is_the_alarm_of_the_protocol_boxes(cars, score, frame, form, config) -> None:
    """The mean's, or else the first that there is; with the same place, moment and score."""
    labels = [scene(each, **config) for each in cars]
    output, settings = form(*labels), labels[0].config
    found = foreseen_accident(output, labels=settings.protocol)
    alarms = named_alarms(output, labels[0], NOBODY, AccidentReading())
    if score is None:
        assert found is None
        assert alarms == []
        return
    [(alarm, _)] = alarms
    np.testing.assert_array_equal(found.positions, alarm.positions)
    assert (found.time, found.score, found.ids) == (alarm.time, alarm.score, None)
    assert found.score == pytest.approx(score)
    assert found.time == pytest.approx(0.5 * frame)
    assert foreseen_accident(output, labels=settings.protocol, step=0.1).time == pytest.approx(0.1 * frame)


def test_a_foreseen_accident_follows_the_labels() -> None:
    output = as_maps(scene(LATE))
    apart = foreseen_accident(output, labels=None).positions - foreseen_accident(output).positions
    np.testing.assert_allclose(np.abs(apart), 0.25)
    with pytest.raises(ChoiceError, match="labels"):
        foreseen_accident(output, labels="none")
    assert len(output.instances[0]) == FRAMES
