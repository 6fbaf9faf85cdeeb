#!/usr/bin/env bash
# CARLA 0.9.16, offline map: Waypoint.lane_change tells what the paint allows, not whether there is a lane. A
# single lane with broken lines may be left to both sides; a planner that trusts it drives off the road.
#
# Seen: on a road of one lane between broken lines lane_change is Both, and there is no lane to either side.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check carla==0.9.16
"$folder/venv/bin/python" - <<'PY'
import importlib.metadata

import carla

MARK = '<roadMark sOffset="0" type="broken" weight="standard" color="white" width="0.15" laneChange="both"/>'
ROAD = f"""<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="4"/>
<road name="" length="100" id="1" junction="-1"><link/><planView>
<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
<elevationProfile><elevation s="0" a="0" b="0" c="0" d="0"/></elevationProfile><lateralProfile/>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false">{MARK}</lane></center><right>
<lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>{MARK}</lane>
</right></laneSection></lanes></road></OpenDRIVE>"""
lane = carla.Map("road", ROAD).get_waypoint_xodr(1, -1, 50.0)
left, right = lane.get_left_lane(), lane.get_right_lane()
print("carla", importlib.metadata.version("carla"), lane.lane_change, "left:", left, "right:", right)
assert lane.lane_change == carla.LaneChange.Both
assert left is None and right is None
PY
