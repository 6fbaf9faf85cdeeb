#!/usr/bin/env bash
# py123d 0.7.0: the lanes that a traffic light governs are read from <signalReference> alone. A <signal> that names
# its lanes itself, in <validity>, gives no stop zone, without a word.
#
# Seen: two of the 21 lights of CARLA's Town10HD, which comes with py123d, are missing: 955 and 956.
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

import py123d.parser.opendrive
from py123d.parser.opendrive.utils.collection import collect_element_helpers
from py123d.parser.opendrive.utils.stop_zone_helper import create_stop_zones_from_signals
from py123d.parser.opendrive.xodr_parser.opendrive import XODR

path = Path(py123d.parser.opendrive.__file__).parent / "carla_maps" / "Town10HD.xodr.gz"
lights = set()
for signal in ElementTree.fromstring(gzip.decompress(path.read_bytes())).iter():
    if signal.tag in ("signal", "signalReference"):
        lanes = [valid.get("fromLane") for valid in signal.findall("validity")]
        if any(lane != "0" for lane in lanes):
            lights.add(int(signal.get("id")))
helpers, signals = (collect_element_helpers(XODR.parse_from_file(path), 1.0, 0.1)[i] for i in (2, 6))
zones = set(create_stop_zones_from_signals(signals, helpers))
print("py123d", importlib.metadata.version("py123d"), len(lights), "name lanes, without a stop zone:", lights - zones)
assert lights - zones == {955, 956}
PY
