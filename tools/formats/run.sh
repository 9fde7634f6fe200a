#!/usr/bin/env bash
# check.mjs with all it needs: Node 20 or later, Chromium, other people's readers from npm and PyPI. Says what it leaves out where these cannot be had.
#
#     tools/formats/run.sh target/release/freerange
set -euo pipefail
binary=$(realpath "$1")
cd "$(dirname "$0")"
# On a developer's machine what cannot be had is left out. CI=true makes it a failure.
leave() {
  echo "LEFT OUT: formats in other programs' readers: $*"
  [ "${CI:-}" != true ] || exit 1
  exit 0
}
node -e 'process.exit(Number(process.versions.node.split(".")[0]) >= 20 ? 0 : 1)' 2>/dev/null || leave "no Node of version 20 or later"
if [ -z "${CHROMIUM:-}" ]; then
  CHROMIUM=$(command -v chromium || command -v chromium-browser || command -v google-chrome || true)
  if [ -z "$CHROMIUM" ]; then
    { apt-get update -q && apt-get install -q -y --no-install-recommends chromium; } || leave "no Chromium"
    CHROMIUM=chromium
  fi
fi
export CHROMIUM
if [ ! -d node_modules ]; then
  npm ci --no-audit --no-fund --ignore-scripts || leave "no packages from npm"
fi
# Of the Python readers the check itself says that they are left out.
if [ -z "${PYTHON:-}" ] && [ ! -d venv ]; then
  { python3 -m venv venv && venv/bin/pip install -q 'gsply[sogs,spz]==0.4.6' gaussforge==0.6.0 plyfile==1.1.5 usd-core==26.11; } || rm -rf venv
fi
if [ -d venv ] && ! venv/bin/python -c 'import pycolmap, nerfstudio' 2>/dev/null; then
  # nerfstudio's reader of COLMAP models needs NumPy alone; what else it asks for is gigabytes.
  { venv/bin/pip install -q pycolmap==4.2.1 && venv/bin/pip install -q --no-deps nerfstudio==1.1.5; } || true
fi
options=()
node -e 'process.exit(typeof WebSocket === "undefined" ? 1 : 0)' || options+=(--experimental-websocket)
node "${options[@]}" check.mjs "$binary"
