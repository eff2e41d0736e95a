#!/bin/sh
# Every system that the paper compares with, trained for the same time: ten minutes of one CPU core each, at reduced
# width, on synthetic streets. Killed at any moment, the same command goes on.
#
#   sh examples/equal_budget.sh [CACHE] [OUT]     default: cache/streets (made if it is not there), runs/equal
#
# The steps are those of ten minutes on one core of an AMD EPYC with bfloat16; on another machine they take another time.
set -eu
cache=${1:-cache/streets}
out=${2:-runs/equal}
lidarsynth data synthetic "$cache" --count 3072 --seed 4

images="data.sensor=hdl-64e-kitti data.projection=auto data.width=1024"
gan="training.batch_size=8 training.ema_half_life=500 adversarial.warmup_images=1000 adversarial.augmentation_images=20000"

train() {  # name, preset, steps, fields
    name=$1 preset=$2 steps=$3
    shift 3
    lidarsynth train "$preset" --data "$cache" --out "$out/$name" --threads 1 --workers 0 --precision bf16 \
        --save-every 200 --keep 1 --sample-every 100000 --set $images training.steps="$steps" "$@"
}

train r2dm r2dm-h 1100 model.base_channels=32 'model.num_residual_blocks=[2,2,2,2]' 'model.stem=[2,4]' \
    training.batch_size=4 training.learning_rate=0.001 training.warmup=50 training.ema_decay=0.98 training.ema_start=100
train lidargen lidargen 300 model.base_channels=16 training.batch_size=2 training.learning_rate=0.001 \
    training.warmup=50 training.decay=cosine training.ema_decay=0.98 training.ema_start=20 score.sigma_max=1
train vanilla-gan vanilla-gan 680 model.base_channels=8 adversarial.max_channels=128 $gan
train dusty-v1 dusty-v1 612 model.base_channels=8 adversarial.max_channels=128 $gan
train dusty-v2 dusty-v2 148 model.base_channels=8 adversarial.max_channels=64 $gan
train lidar-sr lidar-sr 1000 model.base_channels=16 training.batch_size=4 training.learning_rate=0.001
train iln iln 235 model.base_channels=32 training.batch_size=4 training.learning_rate=0.0005
