"""The table of human names: what people read instead of identifiers."""

import re

import pytest
from support.repository_scripts import load_script

from deepaccident_devkit.evaluation.breakdowns import ATTRIBUTES
from deepaccident_devkit.evaluation.runs.setups import TASKS
from deepaccident_devkit.support.human_names import (
    human_name,
    metric_name,
    name_tables,
    rules_name,
    with_unit,
)
from deepaccident_devkit.support.text import with_minus
from deepaccident_devkit.taxonomy import AGENTS


@pytest.mark.parametrize(
    ("identifier", "name"),
    [
        ("vpq 100x100", "VPQ, 100 m × 100 m"),
        ("pq", "VPQ"),
        ("accuracy@10", "accuracy within 10 m"),
        ("accuracy@7", "accuracy within 7 m"),
        ("min_fde 3 s, K = 6", "minFDE at 3 s, K = 6"),
        ("TTA@R80 ustring ego_involved", "TTA@R80, UString, ego involved in the accident"),
        (
            "avoided bystander, lead 0.5 s",
            "accidents avoided, bystander, 0.5 s before the accident",
        ),
        ("avoided lead 3 s to contact", "accidents avoided, 3 s before the contact"),
        ("AP car", "AP, car"),
        ("my_own_number", "my own number"),
    ],
)
def test_metrics_have_their_range_group_or_distance_in_words(identifier, name):
    assert metric_name(identifier) == name


def test_every_metric_of_the_tasks_has_a_name_and_a_meaning():
    script = load_script("docs/make_glossary.py")
    for evaluator in TASKS.values():
        for row in evaluator.result_class.rows:
            metric = script.metric_identifier(row)
            name, meaning = name_tables()["metrics"][metric]
            assert name
            assert meaning
            assert "_" not in metric_name(row.name or metric)


def test_attributes_and_agents_have_names_without_underscores():
    for attribute in ATTRIBUTES:
        assert "_" not in human_name(attribute, "attributes")
    for agent in AGENTS:
        assert human_name(agent) == name_tables()["agents"][agent]


def test_unknown_identifiers_keep_their_letters():
    assert human_name("my_value") == "my value"
    assert human_name(None) == "unknown"
    assert human_name("one_of_the_agents_turning") == "one of the agents turns"
    assert human_name("random per frame, quiet") == "random per frame, ≤ 1 s/min"


def test_each_part_of_a_group_s_name_is_named():
    assert human_name("ego_involved, pedestrian") == "ego involved in the accident, pedestrian"
    assert human_name("ustring ego_involved") == "UString, ego involved in the accident"
    assert human_name("ustring infrastructure") == "UString, infrastructure"
    assert human_name("all samples") == "all samples"


def test_rules_name_the_task_and_the_protocol():
    assert rules_name("accident", "released") == "accident prediction, protocol: released code"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-0.163 s", "−0.163 s"),
        ("[-1.0, -.5]", "[−1.0, −.5]"),
        ("type1-2, a-1, 3-4, --by", "type1-2, a-1, 3-4, --by"),
    ],
)
def test_only_signs_of_numbers_become_minus_signs(text, expected):
    assert with_minus(text) == expected


def test_no_name_of_the_table_is_an_identifier():
    for kind, names in name_tables().items():
        for name in names.values():
            text = name[0] if kind == "metrics" else name
            assert not re.search(r"\w_\w", text)


def test_tables_of_plans_say_the_time_before_the_accident():
    assert human_name("bystander, lead 0.5 s to contact") == "bystander, 0.5 s before the contact"


def test_shares_have_no_unit():
    assert with_unit("APA", "share") == "APA"
    assert with_unit("L2 error", "m") == "L2 error (m)"
    assert with_unit("mASE", "1 - overlap") == "mASE (1 − overlap)"
