"""Recipes: what a file can contain, and how faults in it are reported."""

from pathlib import Path
from typing import Any

import pytest
from support.expected_errors import assert_raises
from support.study_recipes import write_recipe

from deepaccident_devkit.errors import ConfigError
from deepaccident_devkit.plugins.study import read_recipe
from deepaccident_devkit.plugins.study.recipe import MAX_ROWS, SHIPPED_RECIPES, StudyRow

PLAIN_RECIPE: dict[str, Any] = {
    "title": "A study",
    "question": "Does it help?",
    "releases": {"test": {"seed": 3, "scenarios": 4}},
    "test": {"release": "test"},
    "rows": [{"name": "one", "baseline": "standing"}, {"name": "two", "trivial": "nothing"}],
}
MODEL_RECIPE = {
    "weights": {"trunk": {"release": "test"}},
    "rows": [{"name": "one", "weights": "trunk"}],
}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"titel": "A study"}, "unknown field `titel`"),
        ({"title": 3}, r"expected `str`, got `int` - at `\$.title`"),
        ({"rows": None}, r"expected `array`, got `null` - at `\$.rows`"),
        (
            {"rows": [{"name": "one"}]},
            "expected one of weights, baseline and trivial, or .*, found none",
        ),
        (
            {
                "rows": [{"name": "one", "weights": "w", "baseline": "standing"}],
                "weights": {"w": {"file": "tiny"}},
            },
            "or weights and the baseline constant_velocity, found weights and baseline",
        ),
        (
            {"rows": [{"name": "one", "baseline": "flying"}]},
            r"invalid enum value 'flying' - at `\$.rows\[0\].baseline`",
        ),
        (
            {"rows": [{"name": "one", "weights": "trunk"}]},
            "rows: one: weights: expected one of .*found 'trunk'",
        ),
        (
            {"rows": [{"name": "one", "trivial": "nothing"}] * 2},
            "rows: one: name: appears twice; put the keys",
        ),
        (
            {"rows": [{"name": "one", "baseline": "standing", "control": "blank"}]},
            "control: changes what a model sees",
        ),
        (
            {"rows": [{"name": "one", "baseline": "standing", "agents": "+front"}]},
            "agents: expected one of .*'.front'",
        ),
        (
            {"rows": [{"name": "one", "baseline": "standing", "latency": 0.15}]},
            "rows: one: latency: .*0.15",
        ),
        (
            {"rows": [{"name": "one", "baseline": "standing", "horizon": 0.7}]},
            "rows: one: .*0.7.*0.5",
        ),
        (
            {"rows": [{"name": "a{latency}", "trivial": "nothing", "latencies": [1]}]},
            "unknown field `latencies`",
        ),
        (
            {**MODEL_RECIPE, "rows": [{"name": "one", "weights": "trunk", "horizon": 3.0}]},
            "horizon: is set by the weights",
        ),
        (
            {**MODEL_RECIPE, "weights": {"trunk": {"release": "tset"}}},
            "weights.trunk: release: .*did you mean 'test'",
        ),
        (
            {**MODEL_RECIPE, "weights": {"trunk": {"release": "test", "from": "trunk"}}},
            r"from \(weights listed above\): expected",
        ),
        (
            {**MODEL_RECIPE, "weights": {"trunk": {"file": "tiny", "steps": 3}}},
            "file: these weights already exist; remove the other",
        ),
        (
            {"releases": {"test": {"sede": 3}}},
            "releases.test: key: expected one of .*did you mean 'seed'",
        ),
        (
            {"releases": {"test": {"frames": 0}}},
            "releases.test: .*frames: 0 is not possible; choose a number from 1",
        ),
        ({"test": {"release": "training"}}, "test: release: expected .*'training'"),
        (
            {"test": {"release": "test", "where": ["town"]}},
            r"test.where, groups: expected field=value",
        ),
        ({"test": {"release": "test", "labels": "cleam"}}, "test: .*did you mean 'clean'"),
        (
            {"test": {"release": "TEST"}},
            "test: release: found 'TEST'; use the same capital letters",
        ),
        (
            {"headline": {"row": "one", "less": "two", "number": "APA"}},
            "headline: number: found 'APA'",
        ),
        ({"rows": []}, "rows: expected 1 to 1,000, found 0"),
        (
            {"rows": [{"name": "one", "trivial": "nothing", "agents": []}]},
            "rows: expected 1 to 1,000, found 0",
        ),
        (
            {"rows": [{"name": "one", "baseline": "standing", "horizon": 1e9}]},
            "rows: one: horizon: 1000000000.0 s",
        ),
        (
            {"test": {"release": "test", "horizon": 1e12}},
            "test: horizon: 1000000000000.0 s .* up to 100",
        ),
        (
            {"releases": {"test": {"spec": 3}}},
            r"expected `str`, got `int` - at `\$.releases\[...\].spec`",
        ),
        (
            {"releases": {"test": {"seed": 3, "nuscenes": "yes"}}},
            "nuscenes: expected True or False",
        ),
        (
            {"releases": {"test": {"dataroot": [1]}}},
            r"expected `str`, got `array` - at `\$.releases\[...\].dataroot`",
        ),
        *(
            (
                {**MODEL_RECIPE, "weights": {"trunk": {"release": "test", key: value}}},
                f"weights.trunk: .*{key}",
            )
            for key, value in {
                "mix": "abc",
                "also": 3,
                "also_split": [1],
                "split": None,
                "from": ["a"],
            }.items()
        ),
        (
            {**MODEL_RECIPE, "weights": {"trunk": {"release": "test", "mix": 1.5}}},
            "mix: expected a share .*found 1.5",
        ),
        ({"seeds": [-1]}, r"expected `int` >= 0 - at `\$.seeds\[0\]`"),
        ({"seeds": list(range(101))}, r"length <= 100 - at `\$.seeds`"),
        ({"by": ["town_hall"]}, "by: by: expected one of .*'town_hall'"),
        (
            {"compare": [["one", "three"]]},
            "compare, headline: row: expected one of one, two, found 'three'",
        ),
        (
            {"headline": {"row": "one", "less": "two", "number": "apaa"}},
            "headline: number: .*did you mean 'apa'",
        ),
        (
            {"headline": {"row": "one", "less": "two", "where": "hidden"}},
            "headline: where: .*'hidden'",
        ),
    ],
)
def test_a_fault_is_named_with_its_file_its_key_and_a_remedy(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = write_recipe(tmp_path, {**PLAIN_RECIPE, **changes})
    with pytest.raises(ConfigError, match=message) as raised:
        read_recipe(str(path))
    assert str(raised.value).startswith(f"{path}: ")


@pytest.mark.parametrize("rows", [5, [5], {"a": 1}, None])
def test_rows_of_the_smoke_part_must_be_rows(rows: Any, tmp_path: Path) -> None:
    path = write_recipe(tmp_path, {**PLAIN_RECIPE, "smoke": {"rows": rows}})
    with pytest.raises(
        ConfigError, match=r"mine.yaml: the recipe: expected .* got .* - at `\$.rows"
    ):
        read_recipe(str(path), smoke=True)


def test_lists_in_many_keys_are_counted_before_they_are_multiplied_out(tmp_path: Path) -> None:
    def read_rows(rows: list[dict[str, Any]]) -> tuple[StudyRow, ...]:
        return read_recipe(str(write_recipe(tmp_path, {**PLAIN_RECIPE, "rows": rows}))).rows

    hundred_numbers = [float(number) for number in range(100)]
    row = {
        "name": "a",
        "baseline": "standing",
        "horizon": hundred_numbers,
        "latency": hundred_numbers,
        "pose_noise": hundred_numbers,
        "packet_loss": hundred_numbers,
        "agents": ["all"] * 100,
        "budget": list(range(1, 101)),
    }
    with pytest.raises(
        ConfigError,
        match=r"rows: expected 1 to 1,000, found 1,000,000,000,000; each value of a list",
    ):
        read_rows([row])
    many_rows = [
        {"name": f"{{agents}} {number}", "trivial": "nothing", "agents": ["all", "single"]}
        for number in range(500)
    ]
    assert len(read_rows(many_rows)) == MAX_ROWS
    with pytest.raises(ConfigError, match="found 1,001"):
        read_rows([*many_rows, {"name": "one", "trivial": "nothing"}])


@pytest.mark.parametrize(
    "changes",
    [
        {"rows": [{"name": f"n{number}", "trivial": "nothing"} for number in range(28_000)]},
        {"weights": {f"w{number}": {"release": "test"} for number in range(40_000)}},
    ],
)
def test_a_recipe_of_too_many_characters_is_not_parsed(
    changes: dict[str, Any], tmp_path: Path
) -> None:
    path = str(write_recipe(tmp_path, {**PLAIN_RECIPE, **changes}))
    with pytest.raises(
        ConfigError, match=r"has [\d,]+ characters, more than 100,000; split the study|more than"
    ) as raised:
        read_recipe(path)
    assert path in str(raised.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, r"no\.yaml: cannot be read"),
        ("a: &b {}\nc: *b\n", r"no\.yaml:2: c: aliases"),
        ("\n", r"no\.yaml: .*missing .*`rows`"),
        ("- a\n", r"no\.yaml: .*got `array`"),
    ],
)
def test_files_that_are_no_recipes_are_refused(
    content: str | None, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "no.yaml"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ConfigError, match=message):
        read_recipe(str(path))


def test_an_unknown_recipe_and_a_missing_smoke_part_are_refused(tmp_path: Path) -> None:
    path = str(write_recipe(tmp_path, PLAIN_RECIPE))
    assert_raises(
        (lambda: read_recipe("link"), ConfigError, ("'link'", "did you mean 'links'")),
        (lambda: read_recipe(path, smoke=True), ConfigError, ("smoke", "--smoke")),
    )


def test_each_element_of_a_list_makes_a_row(tmp_path: Path) -> None:
    rows = [
        {
            "name": "{agents}, {latency} s",
            "baseline": "standing",
            "agents": ["single", "all"],
            "latency": [0.0, 0.5],
        },
        {"name": "{agents.__class__} {weights}", "trivial": "nothing", "agents": ["all"]},
    ]
    study_rows = read_recipe(str(write_recipe(tmp_path, {**PLAIN_RECIPE, "rows": rows}))).rows
    expected = [
        StudyRow(
            name=f"{agents}, {latency} s",
            baseline="standing",
            agents=agents,
            latency=latency,
            over=("latency", latency, f"{agents}, … s"),
        )
        for agents in ("single", "all")
        for latency in (0.0, 0.5)
    ]
    expected.append(StudyRow(name="{agents.__class__} {weights}", trivial="nothing"))
    assert list(study_rows) == expected
    assert study_rows[0].link is None
    assert study_rows[1].link.latency_frames == 5
    row = StudyRow(name="a", agents="ego_vehicle,other_vehicle")
    assert row.cooperating == ["ego_vehicle", "other_vehicle"]


def test_the_smoke_part_replaces_what_it_names(tmp_path: Path) -> None:
    smoke_part = {
        "releases": {"test": {"scenarios": 2}},
        "rows": PLAIN_RECIPE["rows"][:1],
        "title": "Small",
    }
    path = str(write_recipe(tmp_path, {**PLAIN_RECIPE, "smoke": smoke_part}))
    whole, smoke = read_recipe(path), read_recipe(path, smoke=True)
    assert (whole.name, smoke.name) == ("mine", "mine-smoke")
    assert (whole.title, smoke.title) == ("A study", "Small")
    assert (len(whole.rows), len(smoke.rows)) == (2, 1)
    assert whole.releases["test"] == {"seed": 3, "scenarios": 4}
    assert smoke.releases["test"] == {"seed": 3, "scenarios": 2}
    assert whole.test == smoke.test


def test_the_shipped_recipes_share_releases_and_the_trunk() -> None:
    names = sorted(path.stem for path in SHIPPED_RECIPES.glob("*.yaml"))
    assert all(read_recipe(name, smoke=True).rows for name in names)
    first, *other_recipes = (
        recipe for recipe in map(read_recipe, names) if "trunk" in recipe.weights
    )
    assert other_recipes
    for recipe in other_recipes:
        assert recipe.releases["training"] == first.releases["training"]
        assert recipe.weights["trunk"] == first.weights["trunk"]
        assert set(recipe.seeds) <= set(first.seeds)


def test_a_scenario_file_lies_beside_the_recipe(tmp_path: Path) -> None:
    releases = {"test": {"seed": 3, "spec": "scenes/mine.yaml"}}
    path = write_recipe(tmp_path, {**PLAIN_RECIPE, "releases": releases})
    expected = str(tmp_path / "scenes" / "mine.yaml")
    assert read_recipe(str(path)).releases["test"]["spec"] == expected
