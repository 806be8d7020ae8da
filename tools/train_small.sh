#!/usr/bin/env bash
# Trains the small network from random weights and exports OUT/small.safetensors; run again, it resumes.
#
#     tools/train_small.sh MAPS.npz MESHES MATERIALS OUT
#
# MESHES: folder of GLB files.  MATERIALS: folder of material sets.  Variables: MINUTES of training (95), VIEWS (3000) and
# SAMPLES (360) to render, DEVICE (cpu), PROCESSES that divide each batch (cpu: one per core, cuda: 1).
# DEVICE=cuda first runs the tests that compare CPU and CUDA.  DRY_RUN=1: two samples and two steps of each stage.
set -euo pipefail
if [ $# != 4 ]; then
    sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
maps=$1 meshes=$2 materials=$3 out=$4
device=${DEVICE:-cpu} processes=${PROCESSES:-$([ "${DEVICE:-cpu}" = cuda ] && echo 1 || nproc)}
minutes=${MINUTES:-95} views=${VIEWS:-3000} samples=${SAMPLES:-360}
held_out=(--held-out validation) end=()
if [ -n "${DRY_RUN:-}" ]; then
    views=2 samples=2 held_out=(--first 900000 --count 1) end=(--steps 2)
fi

render() { reli3d-data render "$out/$1" --maps "$maps" "${@:2}"; }
# train STAGE DATA RUN SHARE BATCH OPTIONS...: SHARE of the minutes in percent; BATCH objects, rounded up to the processes
train() {
    local time=(--minutes "$(awk "BEGIN { print $minutes * $4 / 100 }")" --batch $((($5 + processes - 1) / processes * processes)))
    OMP_NUM_THREADS=$((($(nproc) + processes - 1) / processes)) torchrun --nproc-per-node "$processes" -m reli3d.cli.train \
        "$out/$2" "$out/$3" --stage "$1" --device "$device" --bfloat16 "${time[@]}" "${end[@]}" "${@:6}"
}

if [ "$device" = cuda ]; then pytest -q -k cuda "$(dirname "$0")/../tests"; fi
render views --views 5 --size 128 --views-only --count "$views" --meshes "$meshes" --materials "$materials"
render samples --views 9 --count $((samples / 2))
render samples --views 9 --first 200000000 --count $((samples / 2)) --meshes "$meshes" --materials "$materials"
render validation --views 9 "${held_out[@]}"
train pixels views p64 32 24 --image-size 64 --rate 3e-3
train pixels views p128 16 20 --image-size 128 --weights "$out/p64/state.pt"
train small samples run 52 8 --rate 1e-3 --pyramid-rate 0.1 --maps "$maps" --weights "$out/p128/state.pt"
reli3d-train "$out/samples" "$out/run" --validation "$out/validation" --export "$out/small.safetensors"
[ "$(stat -c %s "$out/small.safetensors")" -lt 16000000 ] || { echo "$out/small.safetensors: above 16 MB" >&2; exit 1; }
