#!/bin/bash
# Builds training shards of a folder (or list) of meshes as a Slurm job array:
#   sbatch slurm.sh MESHES OUTPUT --config paper
# Each task makes the shards whose number leaves its own remainder. A task that was killed or preempted is simply run
# again (`--requeue`): it goes on where it was. The last one to finish writes manifest.json.
#SBATCH --job-name=freerange-data
#SBATCH --array=0-63
#SBATCH --cpus-per-task=8
#SBATCH --mem=16G
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --output=freerange-%A-%a.log
set -euo pipefail
meshes=${1:?folder or list of meshes}
output=${2:?folder for the shards}
export RAYON_NUM_THREADS=$SLURM_CPUS_PER_TASK
exec freerange data build "$meshes" -o "$output" "${@:3}" \
  --shard "$((SLURM_ARRAY_TASK_ID - SLURM_ARRAY_TASK_MIN))/$SLURM_ARRAY_TASK_COUNT"
