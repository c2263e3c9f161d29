# SPDX-License-Identifier: MIT
"""A real Chromium for tests of pages, without a network and with software for a GPU."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
OPTIONS = (
    *("--no-sandbox", "--ignore-gpu-blocklist", "--use-angle=swiftshader"),
    *("--enable-unsafe-swiftshader", "--disable-dev-shm-usage"),
)


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of playwright; the test is skipped where there is none."""
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip(f"none of {', '.join(NAMES)} is installed (Debian: apt-get install chromium)")
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(OPTIONS))
        yield browser
        browser.close()


class Opened:
    """A page from disk. told: what it said on the console. asked: what it requested."""

    def __init__(self, browser: Any, path: Path, width: int = 1200) -> None:
        self.told: list[str] = []
        self.asked: list[str] = []
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.page.on("console", lambda message: self.told.append(message.text))
        self.page.on("pageerror", lambda error: self.told.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.told.append("dialog"), dialog.dismiss()))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("html[data-ready=yes]", state="attached", timeout=60_000)

    def value(self, code: str) -> Any:
        """Of an expression in the page."""
        return self.page.evaluate(code)

    def set(self, name: str, value: object) -> None:
        """A control, as a person would move it, and the next two frames."""
        self.value(
            f"""(() => {{ const c = document.getElementById({name!r}); c.value = {str(value)!r};
            for (const kind of ["input", "change"]) c.dispatchEvent(new Event(kind)); }})()"""
        )
        self.settle()

    def settle(self) -> None:
        frames = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.value(frames)

    def picture(self, selector: str) -> bytes:
        """PNG of what is seen of an element."""
        return self.page.locator(selector).screenshot()

    def text(self, selector: str) -> str:
        return self.page.locator(selector).inner_text()

    def problems(self) -> list[str]:
        return self.page.locator("#problems p").all_inner_texts()

    def foreign(self) -> list[str]:
        """Requests for anything but itself and what it has in itself."""
        return [u for u in self.asked[1:] if not u.startswith(("data:", "blob:"))]
