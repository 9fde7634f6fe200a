#!/usr/bin/env bash
# Training on several ranks with real MPI libraries: MPICH and Open MPI from Debian's packages, one after the other. With 1, 2 and 4
# ranks the losses are the same; ranks come and go; one is killed, and the job ends and goes on. Says what it leaves out where no
# library can be had, and fails there under CI=true.
#
#     tools/ranks/run.sh [FEATURES] [KILLS]
#
# FEATURES: those the other programs are built with, so that nothing but our own crates is built again;
# CARGO_OPTIONS likewise. KILLS: 1, or more to be sure.
set -euo pipefail
cd "$(dirname "$0")/../.."
features=${1:+$1,}freerange-cli/mpi
kills=${2:-1}
have() { pkg-config --exists "$1" 2>/dev/null && command -v "$2" >/dev/null; }
if ! { have mpich mpirun.mpich && have ompi mpirun.openmpi; }; then
  { apt-get update -q && apt-get install -q -y --no-install-recommends libmpich-dev mpich libopenmpi-dev openmpi-bin pkg-config; } ||
    { echo "LEFT OUT: ranks: no MPICH and no Open MPI"; [ "${CI:-}" = true ] && exit 1; exit 0; }
fi
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
for library in mpich ompi; do
  # The whole workspace, as the tests are: a selection of packages would compile dependencies with other features.
  # shellcheck disable=SC2086
  MPI_PKG_CONFIG=$library cargo build --workspace --release ${CARGO_OPTIONS:-} --features "$features"
  case $library in
    mpich) launch=(mpirun.mpich) ;;
    # Slots, root, cores: this is one machine with as many processes as we like.
    ompi) launch=(mpirun.openmpi --oversubscribe --allow-run-as-root --bind-to none) ;;
  esac
  echo "== ranks with $library"
  cp "${CARGO_TARGET_DIR:-target}/release/freerange" "$place/freerange-$library"
  python3 tools/ranks/check.py "$place/freerange-$library" "$place/$library" "$kills" "${launch[@]}"
done
