"""Parity with the devkit, motmetrics and trackeval as they are installed: `make test-oracles`.

The seeds and sizes are others than those of golden.json, which every run of the tests compares with.
"""

from pathlib import Path

import pytest
from oracles.compare import check_clear, check_detection, check_hota, check_tracking
from oracles.make_golden import REGIONS
from oracles.synthetic import Size, make_drives
from oracles.track_sequences import clear_by_motmetrics, hota_by_trackeval, make_sequence

from foredrive.metrics.tracking.protocols import TRACKING_PROTOCOLS

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore")]
DENSE = Size(scenes=2, frames=10, objects=60, false=30, reach_m=25.0)
"""Objects so close that many compete for the same track."""


@pytest.mark.parametrize("seed", [10, 11])
@pytest.mark.parametrize("name", list(REGIONS))
def test_detection(seed: int, name: str, tmp_path: Path) -> None:
    pytest.importorskip("nuscenes.eval.detection.evaluate", exc_type=ImportError)
    from oracles import devkit

    drives = make_drives(seed, DENSE, ties=seed % 2 == 0)
    check_detection(drives, name, devkit.detection(drives, REGIONS[name]), tmp_path)


@pytest.mark.parametrize("seed", [12, 13])
@pytest.mark.parametrize("name", list(TRACKING_PROTOCOLS))
def test_tracking(seed: int, name: str, tmp_path: Path) -> None:
    pytest.importorskip("motmetrics", exc_type=ImportError)
    pytest.importorskip("nuscenes.eval.tracking.evaluate", exc_type=ImportError)
    from oracles import devkit

    drives = make_drives(seed, DENSE, ties=seed % 2 == 0)
    expected = devkit.tracking(drives, TRACKING_PROTOCOLS[name].min_score)
    check_tracking(drives, name, expected, tmp_path)


@pytest.mark.parametrize("seed", range(20, 30))
def test_clear_mot(seed: int) -> None:
    pytest.importorskip("motmetrics", exc_type=ImportError)
    sequence = make_sequence(seed)
    check_clear(sequence, clear_by_motmetrics(sequence))


@pytest.mark.parametrize("seed", range(20, 30))
def test_hota(seed: int) -> None:
    pytest.importorskip("trackeval", exc_type=ImportError)
    sequence = make_sequence(seed)
    check_hota(sequence, hota_by_trackeval(sequence))
