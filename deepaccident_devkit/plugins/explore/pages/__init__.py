"""The pages, and `make_app`: an explorer as one ASGI application, without access control.

Access control is `access.Gate`.
"""

from __future__ import annotations

import logging
from typing import Final

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
_NOT_FOUND_ERRORS: Final = (TokenError, ChoiceError, FieldError, NotAvailableError)


def make_app(explorer: Explorer) -> Starlette:
    """Return the pages of an explorer as an application.

    Every address in them is relative, so that they work behind any proxy and below any path.
    """
    app = Starlette(
        routes=[
            *static_routes(),
            *release.routes(),
            *scenario.routes(),
            *models.routes(),
        ],
        exception_handlers={
            HTTPException: _answer_http_error,
            DeepAccidentError: _answer_devkit_error,
        },
    )
    app.router.redirect_slashes = False  # its redirects are absolute
    app.state.explorer = explorer
    return app


async def _answer_http_error(request: Request, error: Exception) -> Response:
    status = 500
    if isinstance(error, HTTPException):
        status = error.status_code
    words = "This cannot be done here."
    if status == 404:
        words = "There is no such page."
    return page(request, "error.html", status=status, title="Not found", words=words)


async def _answer_devkit_error(request: Request, error: Exception) -> Response:
    """Answer with the devkit's own message about what it cannot read or find."""
    status, title = 500, "Cannot be shown"
    if isinstance(error, _NOT_FOUND_ERRORS):
        status, title = 404, "Not here"
    logger.debug("%s", request.url.path, exc_info=error)
    return page(request, "error.html", status=status, title=title, words=str(error))
