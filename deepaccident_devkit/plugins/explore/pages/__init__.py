"""The pages, and `make_app`, which combines them into one ASGI application for an explorer.

The application has no access control; `access.Gate` adds it.
"""

import logging

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
from deepaccident_devkit.plugins.explore.pages.responses import render_page, static_routes

logger = logging.getLogger(__name__)
_NOT_FOUND_ERRORS = (TokenError, ChoiceError, FieldError, NotAvailableError)


def make_app(explorer: Explorer) -> Starlette:
    """Make an application that serves the pages of an explorer.

    All addresses in the pages are relative, so that they work behind any proxy and below any path.
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
    app.router.redirect_slashes = False  # Its redirects are absolute.
    app.state.explorer = explorer
    return app


async def _answer_http_error(request: Request, error: Exception) -> Response:
    status = 500
    if isinstance(error, HTTPException):
        status = error.status_code
    words = "This cannot be done here."
    if status == 404:
        words = "There is no such page."
    return render_page(request, "error.html", status=status, title="Not found", words=words)


async def _answer_devkit_error(request: Request, error: Exception) -> Response:
    """Answer with the devkit's own message about what it cannot read or find."""
    status = 500
    title = "Cannot be shown"
    if isinstance(error, _NOT_FOUND_ERRORS):
        status = 404
        title = "Not here"
    logger.debug("%s", request.url.path, exc_info=error)
    return render_page(request, "error.html", status=status, title=title, words=str(error))
