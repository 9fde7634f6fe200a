#!/usr/bin/env bash
# Seconds and peak memory of a reconstruction by the number of photos and by the number of Gaussians, and one plot of both.
#
#   tools/bench_scale.sh BINARY [PLACE [SVG]]
#
# BINARY is a release build of freerange. PLACE (/tmp/freerange-scale) gets 300 photos of 4000 x 3000 pixels as JPEG, made
# once, and all results; what is there is not made again. SVG is PLACE/scale.svg. Needs Python and nothing else.
# PHOTOS="4 16 64 300", GAUSSIANS="2048 8192 16384 32768 65536" and RASTER="2048 8192 32768 131072 262144" choose; OPTIONS are
# further ones of `freerange reconstruct`. Run it on an idle machine.
set -euo pipefail
[ $# -ge 1 ] || { sed -n '2,/^set/p' "$0" | sed '$d'; exit 2; }
exec python3 "$(dirname "$0")/bench_scale.py" "$(realpath "$1")" "${@:2}"
