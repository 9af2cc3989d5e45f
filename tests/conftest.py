"""Fixtures shared by all tests."""

import os
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the real logs; tests that need it skip, and say so, where it is not there."""
    folder = Path(os.environ.get("CROSSCOMB_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real logs not found at {folder}: set CROSSCOMB_DATA")
    return folder
