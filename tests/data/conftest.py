"""Real data for the tests of the readers, on machines that have it."""

import os
from pathlib import Path

import pytest


@pytest.fixture
def real_data():
    """Find a folder of real data; without it the test is skipped, since files that the other tests generate cover the same readers."""

    def find(name: str) -> Path:
        base = Path(os.environ.get("CMIG_SHARED", Path(__file__).resolve().parents[2] / "../shared"))
        for path in (base / "data" / name, base / name):
            if path.is_dir():
                return path
        pytest.skip(f"needs {name}")

    return find
