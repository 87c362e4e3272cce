"""Pages in the browser: find a scenario, watch it, see what a model says of it (extra `explore`).

`explore` serves them, `export_pages` writes those of some scenarios as files; `make_app` gives the ASGI application
itself, without a guard. Everything is read-only: nothing that a browser sends changes a file of the release.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deepaccident_devkit.plugins.explore.explorer import Explorer
    from deepaccident_devkit.plugins.explore.pages import make_app
    from deepaccident_devkit.plugins.explore.static_pages import export_pages

__all__ = ["Explorer", "explore", "export_pages", "make_app"]

# Where names are that the help of the command does without; all but the first need the extra.
_LATER = {"Explorer": "explorer", "export_pages": "static_pages", "make_app": "pages"}


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

    Only who has the token in the printed address can read them; docs/explore.md says how they are reached through an
    SSH tunnel or a notebook's proxy, and what is checked.

    Args:
        explorer: of a release and of models.
        host: address to listen on; any but this machine's own, 127.0.0.1, lets other machines in.
        port: to listen on; None for the first free one from 8765 on.
        root_path: where a proxy shows the pages, such as `/user/me/proxy/8765`, or the whole URL.
        open_browser: whether to open the address in a browser, if there is one.
        say: called with each line that tells the address.

    Raises:
        MissingExtraError: the extra `explore` is not installed.
        ConfigError: the host, port or root path cannot be.

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
    """Import a name's module when it is asked for."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    from deepaccident_devkit.plugins.explore.serving import need_extra

    if name != "Explorer":
        need_extra()
    return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
