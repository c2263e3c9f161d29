# SPDX-License-Identifier: MIT
"""Shared by all tests: a cache of their own, and the real data where there is some."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Simulated sweeps go to a folder of this test session, never to the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        if "DENSIFY_CACHE_DIR" not in os.environ:
            patch.setenv("DENSIFY_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield Path(os.environ["DENSIFY_CACHE_DIR"])


@pytest.fixture(scope="session")
def test_data() -> Path:
    """The folder of real recordings."""
    folder = os.environ.get("DENSIFY_TEST_DATA")
    if not folder:
        pytest.skip("DENSIFY_TEST_DATA is not set: no real recordings to test on")
    return Path(folder)
