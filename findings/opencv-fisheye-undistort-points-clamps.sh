#!/bin/sh
# cv2.fisheye.undistortPoints moves the outer rim of a stereographic fisheye inward, without a word: it cuts the distorted angle off at
# 90 degrees, though the true angle is below that. Expected: the points that its projectPoints was given. Found with OpenCV 5.0.0.
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" -q install opencv-python-headless==5.0.0.93 numpy==2.3.5
"$work/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

# r = 2 f tan(a / 2) as OpenCV's polynomial in the angle a, right to 0.1 % of the radius at 85 degrees.
focal, center = 300.0, 640.0
k = np.array([1 / 12, 1 / 120, 17 / 20160, 31 / 362880])
lens = np.array([[focal, 0, center], [0, focal, center], [0, 0, 1.0]])
zero = np.zeros(3)
angles = np.radians([30, 60, 75, 80, 85])
rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)[:, None]
pixels = cv2.fisheye.projectPoints(rays, zero, zero, lens, k)[0]
points = cv2.fisheye.undistortPoints(pixels, lens, k)
found = np.degrees(np.arctan(points[:, 0, 0]))
off = (cv2.fisheye.distortPoints(points, lens, k) - pixels)[:, 0, 0]
print("OpenCV", cv2.__version__, "fisheye of f = 300 pixels: a ray is projected, its pixel undistorted and distorted again")
for angle, pixel, back, away in zip(np.degrees(angles), pixels[:, 0, 0], found, off):
    print(f"{angle:.0f} degrees -> x = {pixel:.1f} -> {back:.2f} degrees -> off by {away:.1f} pixels")
print("Invert the polynomial yourself for lenses that show 90 degrees farther out than 1.57 focal lengths.")
inside, rim = np.abs(off[:3]).max(), off[3:]
raise SystemExit(0 if inside < 0.01 and rim[0] < -20 and rim[1] < -50 else "the behavior has changed")
PYTHON
