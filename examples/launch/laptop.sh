#!/bin/bash
# Trains with several processes on one machine, which must have an MPI library (Debian: libmpich-dev mpich, or libopenmpi-dev
# openmpi-bin) and a freerange built with it: cargo build --release --features mpi
#   examples/launch/laptop.sh 2 examples/launch/two-ranks.toml -o runs/two
# Run the same command again to go on, with as many processes as divide `data.virtual_ranks`.
set -euo pipefail
ranks=${1:?number of processes}
options=()
# Open MPI binds each process to one core unless told otherwise.
if mpirun --version | grep -q 'Open MPI\|OpenRTE'; then options+=(--bind-to none); fi
exec mpirun "${options[@]}" -n "$ranks" freerange train "${@:2}"
