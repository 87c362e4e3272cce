"""Which model and sample an address names, and the addresses of samples."""

from __future__ import annotations

from collections.abc import Iterable

from starlette.requests import Request

from deepaccident_devkit.errors import NotAvailableError, TokenError
from deepaccident_devkit.explore.background import Job
from deepaccident_devkit.explore.explorer import Explorer
from deepaccident_devkit.explore.models import Model
from deepaccident_devkit.explore.pages.answers import explorer_of
from deepaccident_devkit.explore.pages.pictures import sample_of
from deepaccident_devkit.explore.sample_lists import is_sample
from deepaccident_devkit.pages import path_in_address

SAMPLE = "{type}/{name}/{agent}/{frame:int}"


def model_of(request: Request, name: str = "model") -> Model:
    """The model that a part of an address names; raises NotAvailableError."""
    given, models = request.path_params[name], explorer_of(request).models
    if given not in models:
        raise NotAvailableError(f"there is no model {given!r}; those that were given: {', '.join(models) or 'none'}")
    return models[given]


def sample_path(token: str) -> str:
    """A sample in an address: `type/scenario/agent/12`."""
    scenario, _, frame = token.rpartition("/")
    return path_in_address(f"{scenario}/{int(frame)}" if frame.isdecimal() and frame.isascii() else token)


def known_sample(request: Request, *models: Model) -> str:
    """The sample that an address names; raises TokenError if neither the release nor a model has it."""
    token = sample_of(request)
    if not is_sample(explorer_of(request).dataset, token) and not any(token in model.tokens for model in models):
        raise TokenError(f"neither the release nor {', '.join(each.name for each in models)} has the sample {token!r}")
    return token


def beside_in_time(tokens: Iterable[str], token: str) -> tuple[str | None, str | None]:
    """The samples before and after one, of those of the same agent."""
    recording = token.rpartition("/")[0] + "/"
    same = sorted(each for each in tokens if each.startswith(recording))
    before, after = [each for each in same if each < token], [each for each in same if each > token]
    return before[-1] if before else None, after[0] if after else None


def titles(jobs: Iterable[Job]) -> list[str]:
    """What is waited for, of the jobs that are not done."""
    return [job.title for job in jobs if not job.is_done]


def models_of_task(explorer: Explorer, task: str) -> list[Model]:
    """The evaluated models of a task."""
    return [each for each in explorer.models.values() if each.bundle is not None and each.setup.task == task]
