#!/bin/bash
# Reconstructs many scenes as a job array, without MPI: sbatch --array=0-15 slurm-array.sh LIST OUTPUT [OPTIONS]
# LIST names a scene on each line. Tasks that are killed are run again and go on. Each writes scenes-I-of-N.json.
#SBATCH --job-name=freerange-scenes
#SBATCH --array=0-15
#SBATCH --cpus-per-task=8
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=freerange-%A-%a.log
set -euo pipefail
list=${1:?list of scenes}
output=${2:?folder for the results}
export RAYON_NUM_THREADS=$SLURM_CPUS_PER_TASK
exec freerange reconstruct --list "$list" -o "$output" "${@:3}" \
  --shard "$((SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN))/$SLURM_ARRAY_TASK_COUNT"
