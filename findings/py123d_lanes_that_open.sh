#!/usr/bin/env bash
# py123d 0.7.0: a driving lane that opens from no width beside another one has no predecessor in the file. py123d
# links it to the neighbour's, and moves its borders: it has its full width from the first metre and begins on top
# of the neighbour. Whoever takes widths or areas from these lanes counts them twice.
#
# Seen: lane -2 of road 26 of CARLA's Town07, which comes with py123d, opens within 12 m by the file. py123d gives
# it 3.5 m everywhere, and its first metre lies in lane -1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check py123d==0.7.0
"$folder/venv/bin/python" - <<'PY'
import gzip
import importlib.metadata
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import py123d.parser.opendrive
from py123d.parser.opendrive.utils.collection import collect_element_helpers
from py123d.parser.opendrive.xodr_parser.opendrive import XODR

path = Path(py123d.parser.opendrive.__file__).parent / "carla_maps" / "Town07.xodr.gz"
root = ElementTree.fromstring(gzip.decompress(path.read_bytes()))
(road,) = (road for road in root.iter("road") if road.get("id") == "26")
(lane,) = (lane for lane in road.iter("lane") if lane.get("id") == "-2")
written_m = float(lane.find("width").get("a"))
helpers = collect_element_helpers(XODR.parse_from_file(path), 1.0, 0.1)[2]
opening, beside = helpers["26_0_right_-2"], helpers["26_0_right_-1"]
ends = opening.inner_polyline_3d.array[0, :2], opening.outer_polyline_3d.array[0, :2]
width_m = np.linalg.norm(ends[0] - ends[1])
apart_m = np.linalg.norm(np.mean(ends, axis=0) - beside.center_polyline_3d.array[0, :2])
print("py123d", importlib.metadata.version("py123d"), f"width at the start: {width_m:.2f} m, in the file {written_m} m;")
print(f"its middle is {apart_m:.2f} m from that of the lane beside")
assert written_m == 0.0
assert abs(width_m - 3.5) < 0.01
assert apart_m < 0.1
PY
