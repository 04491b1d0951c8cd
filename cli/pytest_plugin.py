"""The option `--regolden` and the fixture `golden` of pytest; see `rsundistort.testing`.

Every pytest of an environment loads this at its start, so it must cost nothing: it lives beside the commands, whose
package imports nothing, since `rsundistort.testing` cannot be had without `rsundistort` and its numba (1.5 s).
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from rsundistort.testing import Golden


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("rsundistort").addoption(
        "--regolden", action="store_true", help="write the golden files of the fixture `golden` instead of comparing"
    )


def pytest_report_header(config: pytest.Config) -> str | None:
    return "golden files: written, not compared (--regolden)" if config.getoption("--regolden") else None


@pytest.fixture
def golden(request: pytest.FixtureRequest, tmp_path: Path) -> Golden:
    """Compares with, or under `--regolden` writes, files in the folder `golden` beside the test's file."""
    from rsundistort.testing import Golden

    return Golden(request.path.parent / "golden", tmp_path / "golden", request.config.getoption("--regolden"))
