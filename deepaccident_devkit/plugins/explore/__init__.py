"""Pages in the browser: find a scenario, watch it, see a model's predictions (extra `explore`).

`explore` serves the pages, `export_pages` writes the pages of some scenarios as files, and
`make_app` returns the ASGI application itself, without access control. Everything is read-only:
nothing that a browser sends can change a file of the release.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.explorer import Explorer
    from deepaccident_devkit.plugins.explore.pages import make_app
    from deepaccident_devkit.plugins.explore.static_pages import export_pages

__all__ = ["Explorer", "explore", "export_pages", "make_app"]

# Modules of the names that the command's help does not need, by name; all except the first one need
# the extra.
_LAZY_MODULES = {"Explorer": "explorer", "export_pages": "static_pages", "make_app": "pages"}


def explore(
    explorer: Explorer,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    root_path: str = "",
    open_browser: bool = True,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the pages of an explorer until Ctrl-C.

    Only a browser that has the token of the printed address can read them. docs/explore.md explains
    how to reach them through an SSH tunnel or a notebook's proxy, and what is checked.

    Args:
        explorer: Explorer of a release and of models.
        host: Address to listen on. With any address other than 127.0.0.1, which is this machine
            itself, other machines can connect.
        port: Port to listen on; None for the first free one from 8765 on.
        root_path: Path at which a proxy shows the pages, such as `/user/me/proxy/8765`, or the
            complete URL.
        open_browser: Whether to open the address in a browser, if there is one.
        say: Function that is called with each line about the address, for example to print it.

    Raises:
        MissingExtraError: If the extra `explore` is not installed.
        ConfigError: If the host, port or root path is impossible.

    Examples:
        >>> explore(Explorer(da, bundles=["bundle"]))  # doctest: +SKIP
    """
    from deepaccident_devkit.plugins.explore.serving import need_extra, serve

    need_extra()
    from deepaccident_devkit.plugins.explore.pages import make_app

    app = make_app(explorer)
    explorer.begin()
    try:
        page = explorer.first_page
        serve(
            app,
            host=host,
            port=port,
            root_path=root_path,
            page=page,
            open_browser=open_browser,
            say=say,
        )
    finally:
        explorer.jobs.end()


def __getattr__(name: str) -> Any:
    """Import the module of a name when the name is first used."""
    if name not in _LAZY_MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    from deepaccident_devkit.plugins.explore.serving import need_extra

    if name != "Explorer":
        need_extra()
    return getattr(import_module(f"{__name__}.{_LAZY_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
