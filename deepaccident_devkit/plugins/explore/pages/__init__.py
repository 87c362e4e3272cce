"""The pages, and `make_app`: all of an explorer as one ASGI application, without a guard (`access.Gate`)."""

from __future__ import annotations

import logging
from typing import Any, Final

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from deepaccident_devkit.errors import (
    ChoiceError,
    DeepAccidentError,
    FieldError,
    NotAvailableError,
    TokenError,
)
from deepaccident_devkit.plugins.explore.explorer import Explorer
from deepaccident_devkit.plugins.explore.pages import models, release, scenario
from deepaccident_devkit.plugins.explore.pages.responses import page, static_routes

logger = logging.getLogger(__name__)
_NOT_THERE: Final = (TokenError, ChoiceError, FieldError, NotAvailableError)


def make_app(explorer: Explorer) -> Starlette:
    """The pages of an explorer.

    Every address in them is relative, so that they work behind any proxy and below any path.
    """
    app = Starlette(
        routes=[
            *static_routes(),
            *release.routes(),
            *scenario.routes(),
            *models.routes(),
        ],
        exception_handlers={HTTPException: _refused, DeepAccidentError: _failed},
    )
    app.router.redirect_slashes = False  # its redirects are absolute
    app.state.explorer = explorer
    return app


async def _refused(request: Request, error: Exception) -> Response:
    status = error.status_code if isinstance(error, HTTPException) else 500
    words = "There is no such page." if status == 404 else "This cannot be done here."
    return page(request, "error.html", status=status, title="Not found", words=words)


async def _failed(request: Request, error: Exception) -> Response:
    """What the devkit cannot read or find, in its own words."""
    found = not isinstance(error, _NOT_THERE)
    logger.debug("%s", request.url.path, exc_info=error)
    said: dict[str, Any] = {
        "title": "Cannot be shown" if found else "Not here",
        "words": str(error),
    }
    return page(request, "error.html", status=500 if found else 404, **said)
