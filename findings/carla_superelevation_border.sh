#!/usr/bin/env bash
# CARLA 0.9.16, offline map: two elements of OpenDRIVE that change where a lane is are read as if they were not
# there. <superelevation> tilts a road about its reference line; heights and roll stay. <border> is the other way to
# give a lane's width; the lane has none and lies on the reference line (the log says that no <width> was found).
#
# Seen: a lane 3.5 m wide on a road with a superelevation of .1 rad has height 0 and roll 0; with <border> in
# place of <width> its width is 0.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check carla==0.9.16
"$folder/venv/bin/python" - <<'PY'
import importlib.metadata

import carla


def lane(shape, tilt):
    """Return the middle of a straight road's only lane."""
    road = f"""<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>
    <road name="" length="100" id="1" junction="-1"><link/><planView>
    <geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
    <elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile>
    <lateralProfile><superelevation s="0" a="{tilt}" b="0" c="0" d="0"/></lateralProfile>
    <lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center><right>
    <lane id="-1" type="driving" level="false"><{shape} sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
    </right></laneSection></lanes></road></OpenDRIVE>"""
    return carla.Map("road", road).get_waypoint_xodr(1, -1, 50.0)


level, tilted, bordered = lane("width", 0.0), lane("width", 0.1), lane("border", 0.0)
for name, seen in (("level", level), ("tilted", tilted), ("with border", bordered)):
    place, turn = seen.transform.location, seen.transform.rotation
    print("carla", importlib.metadata.version("carla"), name, (place.x, place.y, place.z), turn.roll, seen.lane_width)
assert (level.lane_width, level.transform.location.y) == (3.5, 1.75)
assert tilted.transform == level.transform
assert bordered.lane_width == 0.0 and abs(bordered.transform.location.y) == 0.0
PY
