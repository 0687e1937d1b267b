#!/usr/bin/env bash
# The GPU figures: a scene trained for a given time, restyled frames a second, a new style to its first frame, and the
# tri-plane kernel against the memory's speed. Writes one JSON with rows and goals.
#
#   benchmarks/gpu.sh --scene DIR [--minutes 3] [--method fprf] [--long STEPS] [--output FILE] [-- FLAGS OF fprf train]
#   benchmarks/gpu.sh --dry            the same steps on a CPU, at a tiny size, on the embedded scene
#
# --scene is an LLFF capture with a folder images_4; encoder weights are named after the `--`, for example
#   -- --content.encoder.weights vgg19.safetensors --semantic.encoder.weights dino.safetensors
# --long also trains that many steps (30000 in the paper) and compares; it can take an hour.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)

scene="" minutes=3 method=fprf long=0 output="$here/results/gpu.json" dry=0
while [ $# -gt 0 ]; do
    case "$1" in
        --scene) scene=$2; shift 2 ;;
        --minutes) minutes=$2; shift 2 ;;
        --method) method=$2; shift 2 ;;
        --long) long=$2; shift 2 ;;
        --output) output=$2; shift 2 ;;
        --dry | --dry-run) dry=1; shift ;;
        --) shift; break ;;
        -h | --help) sed -n '2,/^set -/p' "$0" | sed -n 's/^# \{0,1\}//p'; exit 0 ;;
        *) echo "error: $1: no such flag; $0 --help lists them" >&2; exit 2 ;;
    esac
done

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
if [ "$dry" = 1 ]; then
    method=fprf-lite
    data=(--data town --datamanager.parser town --datamanager.parser.views 6 --datamanager.parser.width 48
        --datamanager.parser.height 36)
    time=(--steps 20 --device cpu) again=(--steps 40 --device cpu)
    size=(--rays 500 --repeats 2 --device cpu) points=(--points 2000)
    [ "$long" = 0 ] || long=40
    export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
else
    if [ -z "$scene" ]; then echo "error: --scene is missing; name an LLFF capture, or try --dry" >&2; exit 2; fi
    if ! python -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
        echo "error: torch sees no CUDA device here; try --dry" >&2
        exit 2
    fi
    data=(--data "$scene" --datamanager.parser llff --datamanager.parser.images images_4)
    time=(--minutes "$minutes" --device cuda) again=(--steps "$long" --device cuda)
    size=(--rays 762048 --repeats 10 --device cuda) points=(--points 1048576)
fi

python -m fprf train "$method" "${data[@]}" "${time[@]}" --output "$work/run" "$@"
python -m fprf eval "$work/run" --no-images --device "${time[3]}"
python -m fprf bench speed "$work/run" "${size[@]}" "${points[@]}" --output "$work/speed.json"
python -m fprf bench profile "$work/run" "${size[@]}" --operators 15 --output "$work/profile.json"
if [ "$long" != 0 ]; then
    python -m fprf train "$method" "${data[@]}" "${again[@]}" --output "$work/long" "$@"
    python -m fprf eval "$work/long" --no-images --device "${again[3]}"
fi
python "$here/gpu_rows.py" "$work" --output "$output"
