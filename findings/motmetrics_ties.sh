#!/usr/bin/env bash
# motmetrics 1.4.0: where two tracks are equally far from two objects, which one is matched depends on the order
# in which the tracks are listed, and a match is kept for later frames. The same tracks get another score.
#
# Seen: two objects and two tracks over six frames, the first three of which cannot be told apart: MOTA 1.0 and
# no switch in one order, .83 and two switches in the other.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check motmetrics==1.4.0
"$folder/venv/bin/python" - <<'PY'
import motmetrics
import numpy as np

PARTNER = {1: 10, 2: 20}


def scores(tracks):
    found = motmetrics.MOTAccumulator(auto_id=True)
    for frame in range(6):
        distance = [
            [0.5 if frame < 3 else 0.1 if track == PARTNER[name] else np.nan for track in tracks] for name in PARTNER
        ]
        found.update(list(PARTNER), tracks, np.array(distance))
    table = motmetrics.metrics.create().compute(found, metrics=["mota", "num_switches"])
    return float(table["mota"].iloc[0]), int(table["num_switches"].iloc[0])


one, other = scores([10, 20]), scores([20, 10])
print(motmetrics.__version__, "MOTA and switches:", one, "in one order,", other, "in the other")
assert one == (1.0, 0)
assert other[1] == 2 and abs(other[0] - 10 / 12) < 1e-9
PY
