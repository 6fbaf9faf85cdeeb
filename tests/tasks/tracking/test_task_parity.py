"""Detection and tracking against reference code on the same data (tests/oracles/golden.json)."""

import json
from pathlib import Path
from typing import Any

import pytest
from oracles.compare import check_clear, check_detection, check_hota, check_tracking
from oracles.make_golden import GOLDEN, REGIONS, SEEDS
from oracles.track_sequences import make_sequence

from benchmarks.common.object_drives import make_drives
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS


@pytest.fixture(params=SEEDS)
def seed(request: pytest.FixtureRequest) -> int:
    chosen: int = request.param
    return chosen


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    read: dict[str, Any] = json.loads(GOLDEN.read_text())
    return read


@pytest.mark.parametrize("name", list(REGIONS))
def test_detection_is_the_devkits(seed: int, name: str, golden: dict[str, Any], tmp_path: Path) -> None:
    check_detection(
        make_drives(seed, ties=seed % 2 == 0), name, golden[str(seed)]["detection"][name], tmp_path
    )


@pytest.mark.parametrize("name", list(TRACKING_PROTOCOLS))
def test_tracking_is_the_devkits(seed: int, name: str, golden: dict[str, Any], tmp_path: Path) -> None:
    check_tracking(make_drives(seed, ties=seed % 2 == 0), name, golden[str(seed)]["tracking"][name], tmp_path)


def test_clear_mot_is_that_of_motmetrics(seed: int, golden: dict[str, Any]) -> None:
    check_clear(make_sequence(seed), golden[str(seed)]["clear"])


def test_hota_is_that_of_trackeval(seed: int, golden: dict[str, Any]) -> None:
    check_hota(make_sequence(seed), golden[str(seed)]["hota"])
