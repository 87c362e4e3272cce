"""The choices of a protocol by their names."""

import json
from typing import Any

import numpy as np
import pytest

from deepaccident_devkit.errors import ChoiceError
from deepaccident_devkit.evaluation.accident import PaperAccidents
from deepaccident_devkit.evaluation.detection import DETECTION_PROTOCOLS
from deepaccident_devkit.evaluation.runs.setups import TASK_PROTOCOLS
from deepaccident_devkit.evaluation.task import switch_names, switched

ALL = [(task, protocol) for task, protocols in TASK_PROTOCOLS.items() for protocol in protocols]


class TestSwitches:
    def test_names_of_parts_too(self) -> None:
        names = switch_names(PaperAccidents())
        assert set(names) == {"reading.danger_distance", "sample_choice"}

    def test_each_name_of_every_protocol_can_be_given(self) -> None:
        for task, protocol in ALL:
            rules = TASK_PROTOCOLS[task][protocol]
            for name in switch_names(rules):
                value: Any = rules
                for part in name.split("."):
                    value = getattr(value, part)
                assert switched(rules, {name: json.loads(json.dumps(value)) if value != np.inf else value}) == rules

    def test_a_choice_within_a_part(self) -> None:
        changed = switched(PaperAccidents(), {"reading.danger_distance": 2, "sample_choice": "mean_first"})
        assert (changed.reading.danger_distance, changed.sample_choice) == (2, "mean_first")

    def test_null_only_where_a_choice_takes_it(self) -> None:
        assert (
            switched(DETECTION_PROTOCOLS["released"], {"area": None, "error_threshold": None}).error_threshold is None
        )
        with pytest.raises(ChoiceError, match=r"switch min_recall: expected a number, such as 0.1, found None"):
            switched(DETECTION_PROTOCOLS["paper"], {"min_recall": None})

    def test_lists_are_tuples_and_choices_that_go_together_alone_are_made_together(self) -> None:
        rules = DETECTION_PROTOCOLS["paper"]
        assert switched(rules, {"ranges": [[0, 30], [30, 50]], "error_threshold": None}).ranges == ((0, 30), (30, 50))

    @pytest.mark.parametrize(
        ("switches", "sentence"),
        [
            (
                {"reading.danger_distnce": 1},
                r"PaperAccidents has no switch 'reading.danger_distnce'; there are reading.danger",
            ),
            ({"reading": {}}, r"PaperAccidents has no switch 'reading'"),
            ({"reading.danger_distance": "2"}, r"switch danger_distance: expected a number, such as 1.0, found '2'"),
            ({"reading.danger_distance": True}, r"switch danger_distance: expected a number, such as 1.0, found True"),
            ({"sample_choice": 3}, r"switch sample_choice: expected a word, such as 'best', found 3"),
            ({"sample_choice": "all"}, r"sample_choice: expected one of best, mean_first, found 'all'"),
        ],
    )
    def test_refused(self, switches: dict[str, Any], sentence: str) -> None:
        with pytest.raises(ChoiceError, match=sentence):
            switched(PaperAccidents(), switches)

    def test_true_or_false(self) -> None:
        with pytest.raises(ChoiceError, match="switch own_box: expected true or false, such as False, found 1"):
            switched(DETECTION_PROTOCOLS["paper"], {"own_box": 1})

    def test_a_protocol_without_any(self) -> None:
        with pytest.raises(ChoiceError, match="FieldWarnings has no switch 'scores_of'; it has none"):
            switched(TASK_PROTOCOLS["warning"]["field"], {"scores_of": "pair"})
