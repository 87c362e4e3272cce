"""`deepaccident train` and `predict` on the small release, and the commands of docs/training.md."""

import re
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from support.expected_errors import assert_raises

from deepaccident_devkit import DeepAccident
from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import ConfigError, DeepAccidentError, NotAvailableError
from deepaccident_devkit.evaluation import read_results

QUICK_OPTIONS = ("--validation", "none", "--device", "cpu")
PAGE = Path(__file__).parents[3] / "docs" / "training.md"


def run_command(*words: object) -> Result:
    arguments = [str(word) for word in words]
    return CliRunner().invoke(deepaccident, arguments, catch_exceptions=False)


def assert_command_refused(
    kind: type[DeepAccidentError], facts: tuple[str, ...], *words: object
) -> None:
    """Check that the error of a command is one line that names the facts."""
    assert_raises(
        (lambda: run_command(*words), kind, r"\A[^\n]*\Z"),
        (lambda: run_command(*words), kind, facts),
    )


@pytest.fixture(scope="module")
def trained_run(release_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model") / "a run"
    result = run_command("train", release_root, "--steps", 2, "--out", folder, *QUICK_OPTIONS)
    assert f"wrote {folder / 'final.safetensors'}" in result.output
    return folder


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
    trained_run: Path, release_root: Path, tmp_path: Path, agents: str, link: tuple[object, ...]
) -> None:
    """A scenario of 0.6 s gives each agent two samples, and the first of them has no past."""
    out, split = tmp_path / "results", tmp_path / "later.txt"
    meta_file = min(release_root.glob("type1*/meta/*"))
    split.write_text(f"{meta_file.parts[-3]} {meta_file.stem}\n", encoding="utf-8")

    samples = ("--split", split, "--samples", "evaluate", "--scope", "all")
    options = ("--agents", agents, *link, *samples, "--device", "cpu", "--out", out)
    result = run_command("predict", trained_run, release_root, *options)
    assert result.exit_code == 0

    has_bytes = agents != "single" and "--budget" not in link
    tasks: dict[str, tuple[str, ...]] = {
        "motion": ("motion", "--switch", "labels=clean"),
        "accident": ("accident.json", "--protocol", "boxes"),
        "detection": ("detection.json",),
        "forecasting": ("forecasting.json", "--samples", "evaluate"),
    }
    for task, (name, *protocol) in tasks.items():
        path = out / name
        predicted = read_results(path)
        notes = predicted.meta
        assert (predicted.task, notes["agents"]) == (task, agents)
        assert notes["model"]["preset"] == "tiny"
        assert (notes["bytes"]["partners"] > 0) == has_bytes
        assert f"wrote {path} ({task}, {len(predicted.tokens)} samples)" in result.output

        options = ("--results", path, "--split", split, "--scope", "all", "--json", *protocol)
        assert run_command("evaluate", task, release_root, *options).exit_code == 0

    assert read_results(out / "motion").form.grid.shape == (200, 200)


def test_existing_results_are_not_overwritten(
    trained_run: Path, release_root: Path, tmp_path: Path
) -> None:
    path = tmp_path / "accident.json"
    path.write_text("mine", encoding="utf-8")

    options = ("--split", "train", "--scope", "all", "--out", tmp_path, "--device", "cpu")
    assert_command_refused(
        DeepAccidentError,
        ("accident.json: already exists",),
        *("predict", trained_run, release_root, *options),
    )

    assert list(tmp_path.iterdir()) == [path]
    assert path.read_text(encoding="utf-8") == "mine"


def test_weights_of_another_model_say_which_keys_differ(
    trained_run: Path, release_root: Path, tmp_path: Path
) -> None:
    train = ("train", release_root, "--steps", 1, "--from", trained_run, *QUICK_OPTIONS)

    result = run_command(*train, "--fusion", "disconet", "--out", tmp_path / "run")
    assert "not in the file: v2x_fusion." in result.output

    facts = (
        "weights of the preset 'tiny' do not fit this model",
        " tensors missing (img_backbone.",
    )
    released = ("--preset", "released", "--out", tmp_path / "big")
    assert_command_refused(ConfigError, facts, *train, *released)


def test_a_release_without_images_is_refused(
    release_root_b: Path, trained_run: Path, tmp_path: Path
) -> None:
    facts = ("this release has no images", "deepaccident synth OUT --sensors cameras")
    options = ("--out", tmp_path / "out", "--split", "train", "--device", "cpu")
    for command in (
        ("train", release_root_b),
        ("predict", trained_run, release_root_b, "--samples", "all"),
    ):
        assert_command_refused(NotAvailableError, facts, *command, *options)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--device", "nowhere"), "device: 'nowhere' cannot be used"),
        (("--horizon", 0.7), "horizon: 0.7 s is not a multiple of 0.5 s"),
        (("--freeze", "nothing"), "no parameter's name begins with 'nothing'"),
        (("--from", "absent.pth"), "absent.pth: weights cannot be read"),
        (("--split", "nowhere"), "nowhere"),
        (("--validation", "test"), "(--validation none trains without it)"),
    ],
)
def test_wrong_options_are_refused_in_one_line(
    release_root: Path, tmp_path: Path, words: tuple[object, ...], message: str
) -> None:
    train = ("train", release_root, "--steps", 1, *QUICK_OPTIONS)
    assert_command_refused(
        DeepAccidentError,
        (message,),
        *train,
        *words,
        "--out",
        tmp_path / "run",
    )
    assert not list(tmp_path.glob("run/*"))


def test_the_pages_commands_can_be_parsed() -> None:
    """Running the commands would take half an hour, so that they are only parsed."""
    lines = re.findall(
        r"^    deepaccident (train|predict) (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE
    )
    assert {verb for verb, _ in lines} == {"train", "predict"}
    for verb, words in lines:
        command = deepaccident.get_command(None, verb)
        command.make_context(verb, words.split(), resilient_parsing=True)


def test_a_partial_release_trains_with_its_available_agents(
    da_partial: DeepAccident, tmp_path: Path
) -> None:
    """The release has no other_vehicle_behind, and the ego vehicle no front camera."""
    options = ("--steps", 1, "--out", tmp_path / "run", *QUICK_OPTIONS)
    train = ("train", da_partial.dataroot, *options)
    assert_command_refused(
        NotAvailableError, ("other_vehicle_behind is not in this release",), *train
    )
    assert run_command(*train, "--agents", "available").exit_code == 0
