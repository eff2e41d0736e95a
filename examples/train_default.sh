#!/usr/bin/env bash
# From nothing to the default weights, in chunks of under ten minutes; run again, it goes on where it was.
# Usage: train_default.sh OUT [--cpu]
#   with a GPU  $STEPS (20000) steps of $BATCH (64) crops and grids
#   --cpu       $STEPS steps of 8, preset default as it is; the shipped weights had fewer (docs/training-default.md)
set -euo pipefail
out=$1
mkdir -p "$out"
budget=(--set "training.steps=${STEPS:-20000}")
if [ "${2:-}" = "--cpu" ]; then
  export ACCELERATE_USE_CPU=true
  budget+=(--save-every 100)
else
  budget+=("training.batch_size=${BATCH:-64}" --precision bf16)
fi
while true; do
  # SIGTERM saves and exits 0, for which timeout would say 124; a run that has reached its last step ends at once
  timeout --preserve-status 580 lidarsynth train default --data virtual --out "$out" "${budget[@]}" | tee "$out/last.log"
  grep -q "stopped after step" "$out/last.log" || break
done
python "$(dirname "$0")/../benchmarks/learn_judge.py" "$out" "$out-judged"   # chooses among drawn layouts
python "$(dirname "$0")/../benchmarks/learn_drawn.py" "$out-judged" "$out-done"   # names what is drawn, before it is cast
lidarsynth info "$out-done"
