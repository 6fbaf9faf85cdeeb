"""Parity with the devkit, motmetrics and trackeval as they are installed: `make test-oracles`.

The seeds and sizes are others than those of golden.json, which every run of the tests compares with.
"""

from pathlib import Path

import numpy as np
import pytest
from oracles.compare import check_clear, check_detection, check_hota, check_tracking
from oracles.make_golden import REGIONS
from oracles.track_sequences import clear_by_motmetrics, hota_by_trackeval, make_sequence

from benchmarks.common.object_drives import Size, make_drives
from foredrive.tasks.tracking.kitti_tracks import score_kitti_tracks
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS

pytestmark = [pytest.mark.oracle, pytest.mark.filterwarnings("ignore")]
DENSE = Size(scenes=2, frames=10, objects=60, false=30, reach_m=25.0)
"""Objects so close that many compete for the same track."""


@pytest.mark.parametrize("seed", [10, 11])
@pytest.mark.parametrize("name", list(REGIONS))
def test_detection(seed: int, name: str, tmp_path: Path) -> None:
    from benchmarks.common import nuscenes_devkit as devkit

    drives = make_drives(seed, DENSE, ties=seed % 2 == 0)
    check_detection(drives, name, devkit.detection(drives, REGIONS[name]), tmp_path)


@pytest.mark.parametrize("seed", [12, 13])
@pytest.mark.parametrize("name", list(TRACKING_PROTOCOLS))
def test_tracking(seed: int, name: str, tmp_path: Path) -> None:
    from benchmarks.common import nuscenes_devkit as devkit

    drives = make_drives(seed, DENSE, ties=seed % 2 == 0)
    expected = devkit.tracking(drives, TRACKING_PROTOCOLS[name].min_score)
    check_tracking(drives, name, expected, tmp_path)


@pytest.mark.parametrize("seed", range(20, 30))
def test_clear_mot(seed: int) -> None:
    sequence = make_sequence(seed)
    check_clear(sequence, clear_by_motmetrics(sequence))


@pytest.mark.parametrize("seed", range(20, 30))
def test_hota(seed: int) -> None:
    sequence = make_sequence(seed)
    check_hota(sequence, hota_by_trackeval(sequence))


def kitti_lines(seed: int, *, scored: bool) -> list[str]:
    """Cars, vans and pedestrians of all kinds of visibility, and regions of no interest, in 20 frames."""
    rng = np.random.default_rng(100 + seed)
    noise = np.random.default_rng(seed)
    lines = []
    for frame in range(20):
        for track, kind in enumerate(["Car"] * 6 + ["Van"] * 2 + ["Pedestrian"] * 4 + ["Person"] * 2):
            x, y, w, h = rng.uniform(0, 400), rng.uniform(0, 80), rng.uniform(30, 90), rng.uniform(20, 70)
            x, y = (track * 60 + x / 40, 100 + y / 10)
            hidden, cut = rng.integers(0, 4), rng.choice([0, 0, 0, 1])
            if scored:
                x, y, w, h = x + noise.normal(0, 4), y + noise.normal(0, 4), w, h * noise.uniform(0.9, 1.1)
                kind = {"Van": "Car", "Person": "Pedestrian"}.get(kind, kind)
                if noise.random() < 0.2:
                    continue
            end = " 0.9" if scored else ""
            identity = track + 20 * (frame // 9) if scored else track
            box = f"{x:.2f} {y:.2f} {x + w:.2f} {y + h:.2f}"
            lines.append(f"{frame} {identity} {kind} {cut} {hidden} 0 {box} 1 1 1 0 0 0 0{end}")
        if not scored:
            lines.append(f"{frame} -1 DontCare -1 -1 -10 700 0 900 400 -1 -1 -1 -1000 -1000 -1000 -10")
    return lines


@pytest.mark.parametrize("seed", [0, 1])
def test_tracks_of_kitti(seed: int, tmp_path: Path) -> None:
    """Rules and HOTA of trackeval's own KITTI benchmark, read from files."""
    import trackeval

    truth, found = tmp_path / "gt" / "label_02", tmp_path / "trackers" / "ours" / "data"
    for folder, scored in ((truth, False), (found, True)):
        folder.mkdir(parents=True)
        for name in ("0000", "0001"):
            lines = kitti_lines(2 * seed + int(name), scored=scored)
            (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "gt" / "evaluate_tracking.seqmap.training").write_text("0000 empty 0 20\n0001 empty 0 20\n")
    folders = {"GT_FOLDER": str(tmp_path / "gt"), "TRACKERS_FOLDER": str(tmp_path / "trackers")}
    data = trackeval.datasets.Kitti2DBox({**folders, "PRINT_CONFIG": False})
    metric, figures = trackeval.metrics.HOTA(), score_kitti_tracks(found, truth)
    for name in ("car", "pedestrian"):
        each = {}
        for sequence in ("0000", "0001"):
            raw = data.get_raw_seq_data("ours", sequence)
            each[sequence] = metric.eval_sequence(data.get_preprocessed_seq_data(raw, name))
        expected, prefix = metric.combine_sequences(each), f"tracking.kitti.{name}"
        assert figures[f"{prefix}.gt"] == (expected["HOTA_TP"] + expected["HOTA_FN"])[0]
        for theirs, key in {"HOTA": "hota", "DetA": "det_a", "AssA": "ass_a", "LocA": "loc_a"}.items():
            assert figures[f"{prefix}.{key}"] == pytest.approx(np.mean(expected[theirs]), abs=1e-9)
