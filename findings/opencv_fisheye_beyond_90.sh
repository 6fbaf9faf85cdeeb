#!/usr/bin/env bash
# OpenCV 5.0.0: cv2.fisheye has the angles of the Kannala-Brandt model, but divides by z first. A point more than
# 90° from the axis is drawn on the opposite side of the image, without a flag. undistortPoints takes no angle
# after distortion above 90°, so a lens that stretches loses its rim even before 90°.
#
# Seen: a point 95° to the right lands 454 px left of the principal point (505 px right of it by the model); the
# pixel of 89° comes back as 88.3°.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check opencv-python-headless==5.0.0.93 numpy
"$folder/venv/bin/python" - <<'PY'
import cv2
import numpy as np

FOCAL, CENTRE, K1, K2 = 300.0, (640.0, 480.0), 0.02, -0.005
camera = np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1]])
lens = np.array([K1, K2, 0.0, 0.0])


def model(angle):
    """Return u of a point to the right, by r = f θ (1 + k1 θ² + k2 θ⁴)."""
    return CENTRE[0] + FOCAL * angle * (1 + K1 * angle**2 + K2 * angle**4)


for degrees, agrees in ((60, True), (89, True), (95, False), (110, False)):
    angle = np.radians(degrees)
    point = np.array([[[np.sin(angle), 0.0, np.cos(angle)]]])
    u = cv2.fisheye.projectPoints(point, np.zeros(3), np.zeros(3), camera, lens)[0].ravel()[0]
    print(cv2.__version__, f"{degrees}°: {u - CENTRE[0]:+.0f} px, by the model {model(angle) - CENTRE[0]:+.0f} px")
    assert (abs(u - model(angle)) < 0.1) == agrees
    assert agrees or u < CENTRE[0]
pixel = np.array([[[model(np.radians(89)), CENTRE[1]]]])
back = np.degrees(np.arctan(cv2.fisheye.undistortPoints(pixel, camera, lens).ravel()[0]))
print(f"89° comes back as {back:.1f}°")
assert 88.2 < back < 88.4
PY
