#!/usr/bin/env bash
# From nothing to the default weights, in chunks of under ten minutes; run again, it goes on where it was.
# Usage: train_default.sh OUT [--cpu]
#   with a GPU  as many steps of $BATCH (64) as it does in $MINUTES (22), by a short measurement, on $IMAGES streets
#   --cpu       preset default as it is, about the budget of the shipped weights
set -euo pipefail
here=$(dirname "$0")
out=$1
cache=$out/streets
mkdir -p "$out"
if [ "${2:-}" = "--cpu" ]; then
  export ACCELERATE_USE_CPU=true
  IMAGES=${IMAGES:-3072}
fi
lidarsynth data synthetic "$cache" -n "${IMAGES:-32768}" --seed 4
lidarsynth data synthetic "$out/validation" -n 64 --seed 777
if [ "${2:-}" = "--cpu" ]; then
  budget=(--save-every 250)
else
  batch=${BATCH:-64}
  if [ ! -s "$out/steps" ]; then
    python "$here/../benchmarks/training.py" default --data "$cache" --precision bf16 --steps "${TIMED:-100}" \
      --set "training.batch_size=$batch" | tee "$out/speed.txt"
    awk -v batch="$batch" -v minutes="${MINUTES:-22}" '/^training / {print int($2 * 60 * minutes / batch)}' \
      "$out/speed.txt" > "$out/steps"
  fi
  steps=$(cat "$out/steps")
  budget=(--set "training.steps=$steps" "training.batch_size=$batch" "training.warmup=$((steps / 50))" \
    "training.ema_start=$((steps / 10))" training.ema_decay=0.995)
fi
while true; do
  # SIGTERM saves and exits 0; a run that has reached its last step ends at once
  timeout 580 lidarsynth train default --data "$cache" --validation "$out/validation" --out "$out" --precision bf16 \
    "${budget[@]}" | tee "$out/last.log"
  grep -q "stopped after step" "$out/last.log" || break
done
lidarsynth info "$out"
