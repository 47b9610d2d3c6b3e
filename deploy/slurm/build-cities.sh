#!/usr/bin/env bash
# Builds many cities on a Slurm cluster: an array job, one city a task; the tiles of a city share the GPUs of its node.
#
#   sbatch --array=0-49%8 --export=ALL,PRESIGHT_WORKSPACE=/shared/presight deploy/slurm/build-cities.sh cities.txt
#
# cities.txt names a city a line; --array has as many tasks as it has lines, %8 is how many run at once. The workspace
# lies on a file system that all nodes see, with the catalog in PostgreSQL (docs/deploy.md).
#SBATCH --job-name=presight
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=16
#SBATCH --gpus-per-node=4
#SBATCH --mem=128G
#SBATCH --time=12:00:00
#SBATCH --signal=B:TERM@180
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=presight-%A-%a.log
set -euo pipefail

cities=${1:?usage: sbatch --array=0-N build-cities.sh CITIES}
: "${PRESIGHT_WORKSPACE:?name the workspace: --export=ALL,PRESIGHT_WORKSPACE=/shared/presight}"
export PRESIGHT_WORKSPACE
export PREFECT_HOME="${SLURM_TMPDIR:-${TMPDIR:-/tmp}}/presight-${SLURM_JOB_ID}" # a server of its own for each task
export DO_NOT_TRACK=1

city=$(sed -n "$((SLURM_ARRAY_TASK_ID + 1))p" "$cities")
if [[ -z $city ]]; then
  echo "$cities has no line $((SLURM_ARRAY_TASK_ID + 1))" >&2
  exit 2
fi

# Three minutes before the time is over, Slurm says so: the build ends, and the task is queued again. It goes on from
# the last checkpoint, whichever node it gets.
stopped=no
trap 'stopped=yes; kill -TERM "$build" 2>/dev/null || true' TERM

presight build "$city" --wait --json &
build=$!
status=0
wait "$build" || status=$?
if [[ $stopped == yes ]]; then
  wait "$build" 2>/dev/null || true
  scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
  exit 0
fi
presight status "$city"
exit "$status" # 6: a tile failed, the others are published; docs/cities.md
