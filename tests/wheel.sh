#!/usr/bin/env bash
# The wheel in dist/, in an environment of its own: PYTHON FOLDER [torch]. `make wheel` runs it for each Python.
set -euo pipefail
python=$1 folder=$2 torch=${3:-}
wheel=$(ls "$PWD"/dist/*.whl)
"$python" -m venv "$folder/venv"
install() { "$folder/venv/bin/pip" install --quiet --disable-pip-version-check "$@"; }
if [ -n "$torch" ]; then
  install --constraint constraints.txt torch
  install "$wheel[synthetic]"
else
  install numpy einops safetensors tyro tqdm pillow platformdirs tomli
  install --no-deps "$wheel"
fi
cd "$folder"
python=venv/bin/python lidarsynth=venv/bin/lidarsynth
$python -W error -c "
import numpy as np, lidarsynth as ls
xyz = np.random.default_rng(0).normal(0, 10, (500, 3)).astype(np.float32)
ls.write('scan.ply', ls.Scan(xyz))
assert np.array_equal(ls.read('scan.ply').xyz, xyz)"
$lidarsynth --version
for verb in complete upsample project generate streets sensor view train info; do $lidarsynth $verb --help > /dev/null; done
if [ -n "$torch" ]; then
  $lidarsynth generate -n 1 --steps 2 --no-picture --sensor vlp-16 --out made
  $lidarsynth complete made/000000.ply --sensor vlp-16 --no-picture --out dense.pcd
fi
cd - > /dev/null
rm -rf "$folder"
