#!/usr/bin/env bash
# Trains the small network from random weights and exports OUT/small.safetensors; run again, it resumes.
#
#     tools/train_small.sh DATA OUT
#
# DATA: archive of pack_training_data.py, or a folder with maps.npz, meshes/, materials/ and, optionally, shapes/.
# Variables: MINUTES of training (95), VIEWS (3000) and SAMPLES (360) to render, DEVICE (cpu), PROCESSES that divide each
# batch (cpu: one per core, at most 8; cuda: 1).  DEVICE=cuda first runs the tests that compare CPU and CUDA,
# unless SKIP_TESTS=1.  DRY_RUN=1: few samples and two steps of each stage, in OUT/dry_run.
set -euo pipefail
if [ $# != 2 ]; then
    sed -n '2,9s/^# \{0,1\}//p' "$0" >&2
    exit 2
fi
data=$1 out=$2
minutes=${MINUTES:-95} views=${VIEWS:-3000} samples=${SAMPLES:-360}
held_out=(--held-out validation) end=()
if [ -n "${DRY_RUN:-}" ]; then
    out=$out/dry_run views=2 samples=4 held_out=(--first 900000 --count 1) end=(--steps 2)
fi
device=${DEVICE:-cpu} cores=$(nproc)
processes=${PROCESSES:-$([ "$device" = cuda ] && echo 1 || echo $((cores < 8 ? cores : 8)))}
precision=$(python -c "from reli3d.nn.weights import fastest_dtype as f; print('--bfloat16' if 'b' in str(f('$device')) else '')")

if [ -f "$data" ]; then
    if [ ! -d "$out/data" ]; then
        rm -rf "$out/incomplete"
        mkdir -p "$out/incomplete"
        tar -xf "$data" -C "$out/incomplete"
        mv "$out/incomplete" "$out/data"
    fi
    [ "$out/data" -nt "$data" ] || { echo "$data is newer than $out/data: use another OUT" >&2; exit 2; }
    data=$out/data
fi
textured=(--meshes "$data/meshes" --materials "$data/materials") shapes=()
[ ! -d "$data/shapes" ] || shapes=(--shapes "$data/shapes")

render() { reli3d-data render "$out/$1" --maps "$data/maps.npz" "${@:2}"; }
# train STAGE DATA RUN SHARE BATCH OPTIONS...: SHARE of the minutes in percent; BATCH: objects per step, rounded up to
# a multiple of the processes
train() {
    local time=(--minutes "$(awk "BEGIN { print $minutes * $4 / 100 }")" --batch $((($5 + processes - 1) / processes * processes)))
    OMP_NUM_THREADS=$(((cores + processes - 1) / processes)) torchrun --nproc-per-node "$processes" -m reli3d.cli.train \
        "$out/$2" "$out/$3" --stage "$1" --device "$device" $precision "${time[@]}" "${end[@]}" "${@:6}"
}
# start BEFORE RUN: the weights that RUN starts from, unless they are newer than RUN
start() {
    if [ -e "$out/$2/state.pt" ] && [ "$out/$1/state.pt" -nt "$out/$2/state.pt" ]; then
        echo "$out/$1 was trained after $out/$2: remove $out/$2" >&2
        exit 1
    fi
}

if [ "$device" = cuda ] && [ ! -e "$out/p64" ] && [ -z "${SKIP_TESTS:-}" ]; then
    pytest -q -k cuda "$(dirname "$0")/../tests" || { echo "train with SKIP_TESTS=1 if these failures are harmless" >&2; exit 1; }
fi
render views --views 5 --size 128 --views-only --count "$views" "${textured[@]}"
render samples --views 9 --count $((samples / 4))
render samples --views 9 --first 100000000 --count $((samples / 4)) "${shapes[@]}"
render samples --views 9 --first 200000000 --count $((samples / 2)) "${textured[@]}"
render validation --views 9 "${held_out[@]}"
train pixels views p64 32 24 --image-size 64 --rate 3e-3
start p64 p128
train pixels views p128 16 20 --image-size 128 --weights "$out/p64/state.pt"
start p128 run
train small samples run 52 8 --rate 1e-3 --pyramid-rate 0.1 --maps "$data/maps.npz" --weights "$out/p128/state.pt"
reli3d-train "$out/samples" "$out/run" --validation "$out/validation" --export "$out/small.safetensors"
[ "$(wc -c < "$out/small.safetensors")" -lt 16000000 ] || { echo "$out/small.safetensors: above 16 MB" >&2; exit 1; }
