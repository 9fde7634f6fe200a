#!/usr/bin/env bash
# Archives for a release, named as cargo-binstall looks for them, and their SHA-256 checksums.
#
#     tools/release.sh [-o dist] [--target TRIPLE] [--features FEATURES --suffix NAME] [--wheel]
#
# One archive: freerange-cli-TARGET-vVERSION.tgz with a folder of that name that holds the program, the licenses and the README. Builds with further
# features get a suffix, by which binstall passes over them: `--features cuda --suffix cuda`. `--wheel` adds the Python wheel. The same program gives the same archive.
set -euo pipefail
cd "$(dirname "$0")/.."
out=dist target='' features='' suffix='' wheel=
refuse() {
  echo "$1" >&2
  exit 2
}
while [ $# -gt 0 ]; do
  case $1 in
    --wheel) wheel=yes ;;
    -o | --target | --features | --suffix)
      [ $# -gt 1 ] || refuse "$1: expected a value, found none"
      case $1 in
        -o) out=$2 ;;
        --target) target=$2 ;;
        --features) features=$2 ;;
        --suffix) suffix=$2 ;;
      esac
      shift
      ;;
    *) refuse "expected -o, --target, --features, --suffix or --wheel, found $1" ;;
  esac
  shift
done
if { [ -n "$features" ] && [ -z "$suffix" ]; } || { [ -z "$features" ] && [ -n "$suffix" ]; }; then
  refuse "--features and --suffix: expected both or neither"
fi
host=$(rustc -vV | sed -n 's/^host: //p')
version=$(cargo metadata --no-deps --format-version 1 | python3 -c '
import json, sys
print(next(p["version"] for p in json.load(sys.stdin)["packages"] if p["name"] == "freerange-cli"))')
cargo build --release --locked ${target:+--target "$target"} ${features:+--features "$features"}
program=${CARGO_TARGET_DIR:-target}/${target:+$target/}release/freerange
case ${target:-$host} in *windows*) program=$program.exe ;; esac
name=freerange-cli${suffix:+-$suffix}-${target:-$host}-v$version
staging=$(mktemp -d)
trap 'rm -rf "$staging"' EXIT
mkdir "$staging/$name"
cp "$program" README.md CHANGELOG.md LICENSE-APACHE LICENSE-MIT "$staging/$name/"
strip "$staging/$name/$(basename "$program")" 2>/dev/null || [ -n "$target" ]
mkdir -p "$out"
# No times, names or orders of this machine.
tar -C "$staging" --sort=name --mtime=@0 --owner=0 --group=0 --numeric-owner --mode=u+rwX,go+rX,go-w -cf - "$name" | gzip -9n >"$out/$name.tgz"
if [ -n "$wheel" ]; then
  python3 -m pip wheel -q --no-deps -w "$out" ./python ${features:+--config-settings="build-args=--features $features"}
fi
cd "$out"
# Of all that is there: archives of several machines may be brought together.
shopt -s nullglob
files=(*.tgz *.whl)
sha256sum -- "${files[@]}" >SHA256SUMS
cat SHA256SUMS
