"""Plug-ins of other packages: what they offer is found, and what is broken is left out with a
reason.
"""

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


def plugin_with(name: str, *verbs: str, version: int = PROTOCOL_VERSION) -> Plugin:
    """Return a plug-in whose verbs greet."""
    offered = {verb: LazyVerb("Greet.", lambda: greet) for verb in verbs or ("greet",)}
    return Plugin(name=name, protocol_version=version, verbs=offered)


@click.command()
def greet() -> None:
    click.echo("good morning")


class Point:
    """An entry point."""

    def __init__(self, name: str, load: Callable[[], Any]) -> None:
        self.name = name
        self.load = load


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Pretend that packages with these plug-ins are installed."""

    def installed(**loads: Any) -> None:
        points = [Point(name, load) for name, load in loads.items()]
        monkeypatch.setattr(importlib.metadata, "entry_points", lambda **_: points)
        plugins.all_plugins.cache_clear()

    yield installed
    plugins.all_plugins.cache_clear()


def greeting() -> Plugin:
    return plugin_with("greeting")


def called(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(deepaccident, words)
    return result.exit_code, result.output


def test_a_verb_of_another_package_is_listed_and_runs(install: Callable[..., None]) -> None:
    install(greeting=greeting)
    assert "  greet          Greet.\n" in called("--help")[1]
    assert called("greet") == (0, "good morning\n")


def missing() -> Plugin:
    raise ModuleNotFoundError("No module named 'nowhere'")


@pytest.mark.parametrize(
    ("plugin", "reason"),
    [
        (missing, "ModuleNotFoundError: No module named 'nowhere'"),
        (object, "expected an object of the class Plugin, found object"),
        (
            lambda: Plugin(name="sick", protocol_version=PROTOCOL_VERSION, verbs={"wave": greet}),  # type: ignore[dict-item]
            "TypeError: verbs: expected objects of the class LazyVerb, found <Command greet>",
        ),
        (lambda: plugin_with("sick", "synth"), "it offers 'synth', which synth offers, too"),
        (lambda: plugin_with("sick", "info"), "it offers 'info', which the devkit itself has"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_named_and_stops_nothing(
    install: Callable[..., None], plugin: Callable[[], Plugin], reason: str
) -> None:
    install(greeting=greeting, sick=plugin)
    status, output = called("wave")
    assert status == 2
    assert f"The plug-in sick is left out: {reason}." in " ".join(output.split())
    assert called("greet") == (0, "good morning\n")
    assert called("synth", "--help")[0] == 0
    assert called("info", "--help")[0] == 0


def test_two_plugins_with_one_verb_are_both_named(install: Callable[..., None]) -> None:
    install(
        first=lambda: plugin_with("first"), second=lambda: plugin_with("second", "greet", "wink")
    )
    status, output = called("greet")
    said = " ".join(output.split())
    assert (status, "first and second both offer 'greet'; uninstall one of them" in said) == (
        2,
        True,
    )
    assert called("wink") == (0, "good morning\n")


def test_a_plugin_for_another_version_of_the_protocol(install: Callable[..., None]) -> None:
    install(later=lambda: plugin_with("later", version=PROTOCOL_VERSION + 1))
    told = (
        f"it is for version {PROTOCOL_VERSION + 1} of the plug-in protocol, this "
        f"devkit has {PROTOCOL_VERSION}"
    )
    assert offers(lambda plugin: plugin.verbs).refused == {"later": told}


def test_a_verb_that_cannot_be_imported_is_named(install: Callable[..., None]) -> None:
    verbs = {"wave": LazyVerb("Wave.", missing)}  # type: ignore[arg-type]
    install(waving=lambda: Plugin(name="waving", protocol_version=PROTOCOL_VERSION, verbs=verbs))
    assert "Wave." in called("--help")[1]
    with pytest.raises(
        MissingPluginError, match=r"^wave: its plug-in fails with ModuleNotFoundError: .*nowhere"
    ):
        CliRunner().invoke(deepaccident, ["wave"], catch_exceptions=False)


def test_they_can_be_switched_off(
    install: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    install(greeting=greeting)
    monkeypatch.setenv("DEEPACCIDENT_PLUGINS", "off")
    assert plugins.all_plugins() == own_plugins()
    assert called("greet")[0] == 2
