"""Plug-ins of other packages are found, and broken ones are left out with a reason."""

import importlib.metadata
from collections.abc import Callable, Iterator
from typing import Any

import click
import pytest
from click.testing import CliRunner

from deepaccident_devkit.cli import deepaccident
from deepaccident_devkit.errors import MissingPluginError
from deepaccident_devkit.support import plugins
from deepaccident_devkit.support.plugins import (
    PROTOCOL_VERSION,
    LazyVerb,
    Plugin,
    offers,
    own_plugins,
)


def make_plugin(name: str, *verbs: str, version: int = PROTOCOL_VERSION) -> Plugin:
    """Make a plug-in with verbs that greet."""
    lazy_verbs = {verb: LazyVerb("Greet.", lambda: greet) for verb in verbs or ("greet",)}
    return Plugin(name=name, protocol_version=version, verbs=lazy_verbs)


@click.command()
def greet() -> None:
    click.echo("good morning")


class EntryPoint:
    """An entry point of an installed package."""

    def __init__(self, name: str, load: Callable[[], Any]) -> None:
        self.name = name
        self.load = load


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Pretend that packages with these plug-ins are installed."""

    def install_plugins(**loads: Any) -> None:
        entry_points = [EntryPoint(name, load) for name, load in loads.items()]
        monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: entry_points)
        plugins.all_plugins.cache_clear()

    yield install_plugins
    plugins.all_plugins.cache_clear()


def make_greeting_plugin() -> Plugin:
    return make_plugin("greeting")


def run_command(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(deepaccident, words)
    return result.exit_code, result.output


def test_a_verb_of_another_package_is_listed_and_runs(install: Callable[..., None]) -> None:
    install(greeting=make_greeting_plugin)
    assert "  greet          Greet.\n" in run_command("--help")[1]
    assert run_command("greet") == (0, "good morning\n")


def raise_module_not_found() -> Plugin:
    raise ModuleNotFoundError("No module named 'nowhere'")


@pytest.mark.parametrize(
    ("plugin", "reason"),
    [
        (raise_module_not_found, "ModuleNotFoundError: No module named 'nowhere'"),
        (object, "expected an object of the class Plugin, found object"),
        (
            lambda: Plugin(name="sick", protocol_version=PROTOCOL_VERSION, verbs={"wave": greet}),  # type: ignore[dict-item]
            "TypeError: verbs: expected objects of the class LazyVerb, found <Command greet>",
        ),
        (lambda: make_plugin("sick", "synth"), "it offers 'synth', which synth also offers"),
        (lambda: make_plugin("sick", "info"), "it offers 'info', which is part of the devkit"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_named_and_stops_nothing(
    install: Callable[..., None], plugin: Callable[[], Plugin], reason: str
) -> None:
    install(greeting=make_greeting_plugin, sick=plugin)
    status, output = run_command("wave")

    assert status == 2
    assert f"Plug-in sick was ignored: {reason}." in " ".join(output.split())
    assert run_command("greet") == (0, "good morning\n")
    assert run_command("synth", "--help")[0] == 0
    assert run_command("info", "--help")[0] == 0


def test_two_plugins_with_one_verb_are_both_named(install: Callable[..., None]) -> None:
    install(
        first=lambda: make_plugin("first"), second=lambda: make_plugin("second", "greet", "wink")
    )
    status, output = run_command("greet")

    assert status == 2
    assert "first and second both offer 'greet'; uninstall one of them" in " ".join(output.split())
    assert run_command("wink") == (0, "good morning\n")


def test_a_plugin_for_another_version_of_the_protocol_is_refused(
    install: Callable[..., None],
) -> None:
    install(later=lambda: make_plugin("later", version=PROTOCOL_VERSION + 1))
    message = (
        f"it is for version {PROTOCOL_VERSION + 1} of the plug-in protocol, but this "
        f"devkit has {PROTOCOL_VERSION}"
    )
    assert offers(lambda plugin: plugin.verbs).refused == {"later": message}


def test_a_verb_that_cannot_be_imported_is_named(install: Callable[..., None]) -> None:
    verbs = {"wave": LazyVerb("Wave.", raise_module_not_found)}  # type: ignore[arg-type]
    install(waving=lambda: Plugin(name="waving", protocol_version=PROTOCOL_VERSION, verbs=verbs))
    assert "Wave." in run_command("--help")[1]
    message = r"^wave: its plug-in failed with ModuleNotFoundError: .*nowhere"
    with pytest.raises(MissingPluginError, match=message):
        CliRunner().invoke(deepaccident, ["wave"], catch_exceptions=False)


def test_plugins_can_be_switched_off(
    install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    install(greeting=make_greeting_plugin)
    monkeypatch.setenv("DEEPACCIDENT_PLUGINS", "off")
    assert plugins.all_plugins() == own_plugins()
    assert run_command("greet")[0] == 2
