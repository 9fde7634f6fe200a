#!/bin/bash
# Trains one model on several nodes, one process per GPU: sbatch slurm.sh CONFIG RUN [OPTIONS]
# CONFIG needs data.virtual_ranks that the number of processes divides. A job that loses a process, a node or its time is put into the
# queue again and goes on from the last state, as one whose input is refused is not. For other sizes, options of sbatch win:
#   sbatch --nodes=1 --ntasks-per-node=2 --gpus-per-node=0 --cpus-per-task=1 slurm.sh CONFIG RUN --device cpu
#SBATCH --job-name=freerange-train
#SBATCH --nodes=8
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=12
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=freerange-%j.log
set -uo pipefail
config=${1:?configuration}
run=${2:?folder of the run}
# How Slurm introduces the processes to each other depends on the MPI library: pmix for Open MPI, pmi2 for MPICH and Intel's.
mpi=${FREERANGE_MPI:-pmix}
srun --mpi="$mpi" --kill-on-bad-exit=1 freerange train "$config" -o "$run" "${@:3}"
code=$?
# 2: the input was refused, and would be again.
if [ "$code" -ne 0 ] && [ "$code" -ne 2 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt 50 ]; then
  echo "ended with $code: the job is put into the queue again"
  scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
