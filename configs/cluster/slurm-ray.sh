#!/bin/bash
# A batch on several nodes of Slurm: a Ray cluster within the allocation, and one command that uses it.
#
#   sbatch slurm-ray.sh /data/jobs.csv /data/runs
#
# Put in partition and account of your own. tracking3d with its extra `ray` is in $VENV, which every node sees.
#SBATCH --job-name=tracking3d
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1
#SBATCH --cpus-per-task=32
#SBATCH --mem=64G
#SBATCH --time=24:00:00
#SBATCH --signal=B:TERM@120
#SBATCH --requeue
#SBATCH --output=tracking3d-%j.log
set -euo pipefail

jobs=${1:?give the table or folder of videos}
out=${2:?give the folder for the runs}
source "${VENV:-$HOME/venv}/bin/activate"
export OMP_NUM_THREADS=1 # every video has one processor

mapfile -t nodes < <(scontrol show hostnames "$SLURM_JOB_NODELIST")
head=${nodes[0]}
address=$(srun --nodes=1 --ntasks=1 --nodelist="$head" hostname --ip-address | awk '{print $1}')
port=$((20000 + SLURM_JOB_ID % 20000)) # two jobs may share a node
trap 'kill $(jobs -p) 2>/dev/null || true; wait' EXIT

srun --nodes=1 --ntasks=1 --nodelist="$head" \
  ray start --head --node-ip-address="$address" --port="$port" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
for attempt in {1..30}; do
  ray status --address "$address:$port" >/dev/null 2>&1 && break
  [ "$attempt" -lt 30 ] || { echo "Ray did not start on $head." >&2; exit 1; }
  sleep 2
done
for node in "${nodes[@]:1}"; do
  srun --nodes=1 --ntasks=1 --nodelist="$node" \
    ray start --address="$address:$port" --num-cpus="$SLURM_CPUS_PER_TASK" --block &
done

# Before the time is over Slurm sends SIGTERM: what is done stays, and the job, queued again, goes on from there.
tracking3d batch "$jobs" --out "$out" --address "$address:$port" &
batch=$!
trap 'kill -TERM "$batch"' TERM
code=0
wait "$batch" || code=$?
if kill -0 "$batch" 2>/dev/null; then # a signal ended the waiting, not the batch
  code=0
  wait "$batch" || code=$?
fi
if [ "$code" -eq 130 ]; then
  scontrol requeue "$SLURM_JOB_ID"
fi
exit "$code"
