#!/usr/bin/env bash
# The page of `freerange serve`: types and lint of its JavaScript, then check.mjs, which drives the real program in
# headless Chromium, and firefox.mjs, which does the same in short in Firefox. Says what it leaves out where Node 20,
# a browser or packages from npm cannot be had. PICTURES=FOLDER also writes pictures of every state.
#
#     tools/serve/run.sh target/release/freerange
set -euo pipefail
binary=$(realpath "$1")
cd "$(dirname "$0")"
# On a developer's machine what cannot be had is left out. CI=true makes it a failure.
leave() {
  echo "LEFT OUT: the page in a browser: $*"
  [ "${CI:-}" != true ] || exit 1
  exit 0
}
# The first of these programs that is there, else the one that Debian's package of this name has.
found() {
  local package=$1 name
  shift
  for name in "$@"; do
    command -v "$name" && return
  done
  { apt-get update -q && apt-get install -q -y --no-install-recommends "$package"; } >&2 && command -v "$package"
}
node -e 'process.exit(Number(process.versions.node.split(".")[0]) >= 20 ? 0 : 1)' 2>/dev/null || leave "no Node of version 20 or later"
CHROMIUM=${CHROMIUM:-$(found chromium chromium chromium-browser google-chrome)} || leave "no Chromium"
FIREFOX=${FIREFOX:-$(found firefox-esr firefox-esr firefox)} || leave "no Firefox"
export CHROMIUM FIREFOX
# Other people's readers of .glb are those of the formats' check.
for folder in . ../formats; do
  [ -d "$folder/node_modules" ] || (cd "$folder" && npm ci --no-audit --no-fund --ignore-scripts) || leave "no packages from npm"
done
npx tsc -p tsconfig.json
npx tsc -p tsconfig.viewer.json
# ESLint does not look above its own folder.
trap 'rm -rf linted' EXIT
mkdir -p linted
cp ../../crates/product/freerange-serve/src/page/*.js ../../crates/base/freerange-gaussians/src/formats/viewer/viewer.js linted/
npx eslint linted check.mjs firefox.mjs
options=()
node -e 'process.exit(typeof WebSocket === "undefined" ? 1 : 0)' || options+=(--experimental-websocket)
node "${options[@]}" check.mjs "$binary"
node "${options[@]}" firefox.mjs "$binary"
