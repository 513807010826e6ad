#!/bin/bash
# A batch on Slurm without Ray: an array of tasks, each of which tracks one video of a list.
#
#   sbatch --array=1-$(wc -l < videos.txt)%200 slurm-array.sh videos.txt /data/runs
#
# A line of the list is a video and its box: "clips/a.mp4 301,11,296,227". --resume lets a task that was stopped and
# queued again go on from its last frame.
#SBATCH --job-name=tracking3d
#SBATCH --cpus-per-task=1
#SBATCH --mem=3G
#SBATCH --time=08:00:00
#SBATCH --signal=TERM@60
#SBATCH --requeue
#SBATCH --output=tracking3d-%A_%a.log
set -euo pipefail

list=${1:?give the list of videos}
out=${2:?give the folder for the runs}
source "${VENV:-$HOME/venv}/bin/activate"
export OMP_NUM_THREADS=1

line=$(sed -n "${SLURM_ARRAY_TASK_ID}p" "$list")
box=${line##* }
video=${line% *}
name=$(basename "$video")
exec tracking3d run "$video" --box "$box" --out "$out/${name%.*}" --resume --quiet
