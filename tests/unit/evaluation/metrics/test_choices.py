"""The choices of a protocol by their names."""

import json
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.metrics.accident import PaperAccidents
from deepaccident_devkit.evaluation.metrics.choices import switch_names, switched
from deepaccident_devkit.evaluation.metrics.detection import DETECTION_PROTOCOLS
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS

ALL = [(task, protocol) for task, protocols in TASK_PROTOCOLS.items() for protocol in protocols]


class TestSwitches:
    def test_names_of_parts_too(self) -> None:
        names = switch_names(PaperAccidents())
        assert {"predicted_by", "reading.danger_distance", "scoring.far_is_missed"} <= set(names)
        assert "reading" not in names

    def test_each_name_of_every_protocol_can_be_given(self) -> None:
        for task, protocol in ALL:
            rules = TASK_PROTOCOLS[task][protocol]
            for name in switch_names(rules):
                value: Any = rules
                for part in name.split("."):
                    value = getattr(value, part)
                assert switched(rules, {name: json.loads(json.dumps(value)) if value != np.inf else value}) == rules

    def test_a_choice_within_a_part(self) -> None:
        changed = switched(PaperAccidents(), {"scoring.far_is_missed": False, "match_distance": 2})
        assert (changed.scoring.far_is_missed, changed.match_distance) == (False, 2)
        assert changed.reading == PaperAccidents().reading

    def test_null_only_where_a_choice_takes_it(self) -> None:
        assert (
            switched(DETECTION_PROTOCOLS["released"], {"area": None, "error_threshold": None}).error_threshold is None
        )
        with pytest.raises(ChoiceError, match=r"switch match_distance: expected a number, such as 4.0, found None"):
            switched(TASK_PROTOCOLS["accident"]["paper"], {"match_distance": None})

    def test_lists_are_tuples_and_choices_that_go_together_alone_are_made_together(self) -> None:
        rules = DETECTION_PROTOCOLS["paper"]
        assert switched(rules, {"ranges": [[0, 30], [30, 50]], "error_threshold": None}).ranges == ((0, 30), (30, 50))

    @pytest.mark.parametrize(
        ("switches", "sentence"),
        [
            (
                {"scoring.far_is_mised": 1},
                r"PaperAccidents has no switch 'scoring.far_is_mised'; there are scoring.far_i",
            ),
            ({"reading": {}}, r"PaperAccidents has no switch 'reading'"),
            ({"scoring.far_is_missed": 1}, r"switch far_is_missed: expected true or false, such as True, found 1"),
            ({"match_distance": "2"}, r"switch match_distance: expected a number, such as 4.0, found '2'"),
            ({"match_distance": True}, r"switch match_distance: expected a number, such as 4.0, found True"),
            ({"predicted_by": 3}, r"switch predicted_by: expected a word, such as 'any', found 3"),
            ({"predicted_by": "all"}, r"predicted_by: expected one of any, mean, found 'all'"),
        ],
    )
    def test_refused(self, switches: dict[str, Any], sentence: str) -> None:
        with pytest.raises(ChoiceError, match=sentence):
            switched(PaperAccidents(), switches)

    def test_a_protocol_without_any(self) -> None:
        with pytest.raises(ChoiceError, match="FieldWarnings has no switch 'scores_of'; it has none"):
            switched(TASK_PROTOCOLS["warning"]["field"], {"scores_of": "pair"})
