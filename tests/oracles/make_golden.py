"""Write golden.json: what the oracles say of seeded synthetic data. `make golden` runs it."""

import json
import warnings
from pathlib import Path
from typing import Any

from oracles.track_sequences import clear_by_motmetrics, hota_by_trackeval, make_sequence

from benchmarks.common import nuscenes_devkit as devkit
from benchmarks.common.object_drives import make_drives
from foredrive.tasks.tracking.protocols import TRACKING_PROTOCOLS

GOLDEN = Path(__file__).with_name("golden.json")
SEEDS = (0, 1)
REGIONS = {"nuscenes": "circle", "vad": "rectangle"}


def golden(seed: int) -> dict[str, Any]:
    """The oracles' figures of one seed; scores of even seeds have ties."""
    drives, sequence = make_drives(seed, ties=seed % 2 == 0), make_sequence(seed)
    tracking = {}
    for name, protocol in TRACKING_PROTOCOLS.items():
        tracking[name] = devkit.tracking(drives, protocol.min_score)
        del tracking[name]["details"]
    return {
        "detection": {name: devkit.detection(drives, region) for name, region in REGIONS.items()},
        "tracking": tracking,
        "clear": clear_by_motmetrics(sequence),
        "hota": hota_by_trackeval(sequence),
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # the oracles' own
    GOLDEN.write_text(json.dumps({str(seed): golden(seed) for seed in SEEDS}, indent=1) + "\n")
