#!/usr/bin/env bash
# CARLA 0.9.16, offline map: a <spiral> whose curvature is the same at both ends, as editors write an arc or a line
# between two arcs of one radius, has no place: waypoints are NaN. With a difference of 1e-12 1/m, which is left
# of equal numbers after rounding, they are finite and tens of metres off.
#
# Seen: 50 m along an arc of radius 50 m, which is at (43.5, -22.0): NaN, and (1.5, 0.9).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check carla==0.9.16
"$folder/venv/bin/python" - <<'PY'
import importlib.metadata
import math

import carla


def place(shape):
    """Return where a lane is halfway along a road of 100 m."""
    road = f"""<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>
    <road name="" length="100" id="1" junction="-1"><link/><planView>
    <geometry s="0" x="0" y="0" hdg="0" length="100">{shape}</geometry></planView>
    <elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile><lateralProfile/>
    <lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center><right>
    <lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
    </right></laneSection></lanes></road></OpenDRIVE>"""
    seen = carla.Map("road", road).get_waypoint_xodr(1, -1, 50.0).transform.location
    return seen.x, seen.y


arc, same, nearly, apart = (
    place(shape)
    for shape in (
        '<arc curvature="0.02"/>',
        '<spiral curvStart="0.02" curvEnd="0.02"/>',
        '<spiral curvStart="0.02" curvEnd="0.020000000001"/>',
        '<spiral curvStart="0.02" curvEnd="0.020000001"/>',
    )
)
print("carla", importlib.metadata.version("carla"), "arc", arc, "equal", same, "nearly", nearly, "1e-9 apart", apart)
assert all(math.isnan(value) for value in same)
assert math.dist(nearly, arc) > 10.0
assert math.dist(apart, arc) < 0.01
PY
