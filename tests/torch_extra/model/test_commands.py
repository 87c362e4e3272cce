"""`deepaccident train` and `predict`, and the commands of docs/training.md, on the session's small
release.
"""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from refusals import assert_refused

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, DeepAccidentError, NotAvailableError
from deepaccident_devkit.evaluation import read_results

QUICK = ("--validation", "none", "--device", "cpu")
PAGE = Path(__file__).parents[3] / "docs" / "training.md"


def run(*words: object) -> Result:
    return CliRunner().invoke(deepaccident, [str(word) for word in words], catch_exceptions=False)


def refused(kind: type[DeepAccidentError], named: tuple[str, ...], *words: object) -> None:
    """The error of a command is one line, which names these."""
    assert_refused((lambda: run(*words), kind, r"\A[^\n]*\Z"), (lambda: run(*words), kind, named))


@pytest.fixture(scope="module")
def trained(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of two steps."""
    out = tmp_path_factory.mktemp("model") / "a run"
    result = run("train", release_root, "--steps", 2, "--out", out, *QUICK)
    assert f"weights: {out / 'final.safetensors'}" in result.output
    return out


@pytest.mark.parametrize(
    ("agents", "link"),
    [
        ("all", ()),
        ("single", ()),
        ("+other", ("--pose-noise", 0.3, "--packet-loss", 0.5)),
        ("all", ("--budget", 1)),
    ],
)
def test_one_set_of_weights_predicts_for_any_agents(
    trained: Path, release_root: Path, tmp_path: Path, agents: str, link: tuple[object, ...]
) -> None:
    """The release's scenarios are as short as 0.6 s, so that each agent has two samples, the first
    without a past.
    """
    out, split = tmp_path / "results", tmp_path / "later.txt"
    meta = next(iter(sorted(release_root.glob("type1*/meta/*"))))
    split.write_text(f"{meta.parts[-3]} {meta.stem}\n", encoding="utf-8")
    chosen = ("--split", split, "--samples", "evaluate", "--scope", "all", "--device", "cpu")
    result = run("predict", trained, release_root, "--agents", agents, *link, *chosen, "--out", out)
    assert result.exit_code == 0
    tasks: dict[str, tuple[str, ...]] = {
        "motion": ("motion", "--switch", "labels=clean"),
        "accident": ("accident.json", "--protocol", "boxes"),
        "detection": ("detection.json",),
        "forecasting": ("forecasting.json", "--samples", "evaluate"),
    }
    for task, (name, *protocol) in tasks.items():
        found, judged = (
            read_results(out / name),
            ("--split", split, "--scope", "all", "--json", *protocol),
        )
        assert (found.task, found.meta["agents"], found.meta["model"]["preset"]) == (
            task,
            agents,
            "tiny",
        )
        assert (found.meta["bytes"]["partners"] > 0) == (
            agents != "single" and "--budget" not in link
        )
        assert f"{task}: {len(found.tokens)} samples in {out / name}" in result.output
        assert run("evaluate", task, release_root, "--results", out / name, *judged).exit_code == 0
    assert read_results(out / "motion").form.grid.shape == (200, 200)


def test_what_is_there_already_is_not_overwritten(
    trained: Path, release_root: Path, tmp_path: Path
) -> None:
    (tmp_path / "accident.json").write_text("mine", encoding="utf-8")
    words = (
        "predict",
        trained,
        release_root,
        "--split",
        "train",
        "--scope",
        "all",
        "--out",
        tmp_path,
    )
    refused(DeepAccidentError, ("accident.json: is there already",), *words, "--device", "cpu")
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == {
        "accident.json": "mine"
    }


def test_weights_of_another_model_say_which_keys_differ(
    trained: Path, release_root: Path, tmp_path: Path
) -> None:
    words = (
        "train",
        release_root,
        "--fusion",
        "disconet",
        "--steps",
        1,
        "--out",
        tmp_path / "run",
        *QUICK,
    )
    assert "as they were: v2x_fusion." in run(*words, "--from", trained).output
    other = (
        "train",
        release_root,
        "--preset",
        "released",
        "--steps",
        1,
        "--out",
        tmp_path / "big",
        *QUICK,
    )
    named = (
        "weights of the preset 'tiny' do not fit this model",
        " of the model are missing (img_backbone.",
    )
    refused(ConfigError, named, *other, "--from", trained)


def test_a_release_without_images(release_root_b: Path, trained: Path, tmp_path: Path) -> None:
    named = ("this release has no images", "deepaccident synth OUT --sensors cameras")
    train, predict = (
        ("train", release_root_b),
        ("predict", trained, release_root_b, "--samples", "all"),
    )
    for words in (train, predict):
        refused(
            NotAvailableError,
            named,
            *words,
            "--out",
            tmp_path / "out",
            "--split",
            "train",
            "--device",
            "cpu",
        )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--device", "nowhere"), "device: 'nowhere' cannot be used"),
        (("--horizon", 0.7), "horizon: 0.7 s is no number of steps of 0.5 s"),
        (("--freeze", "nothing"), "no parameter's name begins with 'nothing'"),
        (("--from", "absent.pth"), "absent.pth: weights cannot be read"),
        (("--split", "nowhere"), "nowhere"),
        (("--validation", "test"), "(--validation; none trains without it)"),
    ],
)
def test_wrong_options_are_one_line(
    release_root: Path, tmp_path: Path, words: tuple[object, ...], said: str
) -> None:
    given = ("train", release_root, "--steps", 1, *QUICK, *words, "--out", tmp_path / "run")
    refused(DeepAccidentError, (said,), *given)
    assert not list(tmp_path.glob("run/*"))


def test_the_pages_commands_exist() -> None:
    """They would take half an hour; here they are only parsed."""
    lines = re.findall(
        r"^    deepaccident (train|predict) (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {verb for verb, _ in lines} == {"train", "predict"}
    for verb, words in lines:
        command = deepaccident.get_command(None, verb)
        command.make_context(verb, words.split(), resilient_parsing=True)


def test_a_partial_release_trains_with_the_agents_that_are_there(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    """It has no other_vehicle_behind, and the ego no front camera."""
    words = ("train", da_partial.dataroot, "--steps", 1, "--out", tmp_path / "run", *QUICK)
    refused(NotAvailableError, ("other_vehicle_behind is not in this release",), *words)
    assert run(*words, "--agents", "available").exit_code == 0
