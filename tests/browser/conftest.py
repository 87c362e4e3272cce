"""Tests that open pages in Debian's headless chromium: not collected where chromium, its driver or
selenium is not installed, unless DEEPACCIDENT_REQUIRE_BROWSER is set.
"""

import importlib.util
import os
import shutil
from collections.abc import Iterator

import pytest
from support.chromium import Browser

MISSING = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
if importlib.util.find_spec("selenium") is None:
    MISSING.append("selenium")
if MISSING:
    if os.environ.get("DEEPACCIDENT_REQUIRE_BROWSER"):
        raise pytest.UsageError(
            f"DEEPACCIDENT_REQUIRE_BROWSER is set, but there is no {', '.join(MISSING)}"
        )
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """Headless Chromium with a fresh profile and no network."""
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    profile = tmp_path_factory.mktemp("chromium")
    for argument in (
        "headless=new",
        "no-sandbox",
        "disable-gpu",
        "disable-dev-shm-usage",
        "enable-unsafe-swiftshader",
        f"user-data-dir={profile}",
    ):
        options.add_argument(f"--{argument}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = Chrome(options=options, service=Service(shutil.which("chromedriver")))
    driver.set_script_timeout(120)
    yield Browser(driver)
    driver.quit()


@pytest.fixture(params=["light", "dark"])
def scheme(request: pytest.FixtureRequest, browser: Browser) -> Iterator[str]:
    """The colour scheme of the reader's system: light or dark."""
    features = [{"name": "prefers-color-scheme", "value": request.param}]
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    yield request.param
    browser.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})
