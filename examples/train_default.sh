#!/usr/bin/env bash
# From nothing to the default weights, in chunks of under ten minutes; run again, it goes on where it was.
# Usage: train_default.sh OUT [--cpu]. With a GPU: 60,000 steps of 64; --cpu: the 5,000 steps of 4 of the shipped weights.
set -euo pipefail
out=$1
cache=$out/streets
if [ "${2:-}" = "--cpu" ]; then
  export ACCELERATE_USE_CPU=true
  images=3072 options=(--save-every 250 --precision bf16)
  budget=()
else
  images=32768 options=(--precision bf16)
  budget=(--set training.steps=60000 training.batch_size=64 training.warmup=1000 training.ema_decay=0.995)
fi
lidarsynth data synthetic "$cache" -n "$images" --seed 4
lidarsynth data synthetic "$out/validation" -n 64 --seed 777
while true; do
  # SIGTERM saves and exits 0; a run that has reached its last step ends at once
  timeout 580 lidarsynth train default --data "$cache" --validation "$out/validation" --out "$out" \
    "${options[@]}" "${budget[@]}" | tee "$out/last.log"
  grep -q "stopped after step" "$out/last.log" || break
done
lidarsynth info "$out"
