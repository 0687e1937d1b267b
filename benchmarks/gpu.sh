#!/usr/bin/env bash
# Measure a machine with a GPU in about ten minutes: the tests of devices, a scene trained for a given time, restyled frames
# a second, a new style to its first frame, and 3D Gaussians of the same scene trained in as much time (by gsplat where it is
# installed, which compiles its kernels at the first use), with what their steps cost. Writes one JSON with rows and goals.
#
#   benchmarks/gpu.sh --scene DIR [--images images_4] [--minutes 3] [--method fprf] [--long STEPS] [--output FILE]
#                     [-- FLAGS OF fprf train]
#   benchmarks/gpu.sh --dry            the same steps on a CPU, at a tiny size, on the embedded scene
#
# --scene is an LLFF capture. Semantics are those of the method, which need no download; name others after the `--`, for example
# -- --semantic.encoder dino --semantic.encoder.model FOLDER
# --long also trains that many steps (30000 in the paper) and compares; it can take an hour.
#
# A step that fails or takes too long is reported and the others go on; the exit status is then 1. Nothing is downloaded or
# installed: where fprf is not installed, this checkout is used, with packages from PYTHONPATH (a wheel's path will do).
# PYTHON names another interpreter than `python`.
set -uo pipefail
here=$(cd "$(dirname "$0")" && pwd)
root=$(dirname "$here")
python=${PYTHON:-python}

scene="" images=images_4 minutes=3 method=fprf long=0 output="$here/results/gpu.json" dry=0
while [ $# -gt 0 ]; do
    case "$1" in
        --scene) scene=$2; shift 2 ;;
        --images) images=$2; shift 2 ;;
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
export PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}"
"$python" "$here/gpu_check.py" "$work/site" || exit 2
[ ! -d "$work/site" ] || export PYTHONPATH="$work/site:$PYTHONPATH"

tests=(-q -c "$root/pyproject.toml" -o addopts= -o filterwarnings=default -W "ignore::pytest.PytestConfigWarning")
if [ "$dry" = 1 ]; then
    method=fprf-lite device=cpu limit=3600
    data=(--data garden --downscale 8)
    time=(--steps 20) again=(--steps 40)
    size=(--rays 500 --repeats 2) points=(--points 2000)
    photographs=("${data[@]}")
    tests+=("$root/tests/test_pretend_cuda.py")
    [ "$long" = 0 ] || long=40
    export OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1
else
    if [ -z "$scene" ]; then echo "error: --scene is missing; name an LLFF capture, or try --dry" >&2; exit 2; fi
    if ! "$python" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
        echo "error: torch sees no CUDA device here; try --dry" >&2
        exit 2
    fi
    device=cuda:0 limit=0
    data=(--data "$scene" --datamanager.parser llff --datamanager.parser.images "$images")
    time=(--minutes "$minutes") again=(--steps "$long")
    size=(--rays 100000 --repeats 3) points=(--points 262144)
    photographs=(--data "$scene" --parser llff --parser.images "$images")
    tests+=(-m gpu "$root/tests/test_gpu.py" "$root/tests/ops/test_rasterise_gsplat.py" "$root/tests/ops/test_triplane.py")
fi

# step NAME SECONDS COMMAND...: run it, note its exit status, print the end of its log where it failed.
step() {
    local name=$1 seconds=$2 begun=$SECONDS status=0
    shift 2
    [ "$limit" = 0 ] || seconds=$limit
    echo "== $name: $*"
    timeout -k 5 "$seconds" "$@" >"$work/$name.log" 2>&1 || status=$?
    printf '{"step": "%s", "status": %d, "seconds": %d}\n' "$name" "$status" $((SECONDS - begun)) >>"$work/steps.jsonl"
    [ "$status" = 0 ] || tail -n 25 "$work/$name.log"
}

whole=$(awk "BEGIN { print int(60 * $minutes + 60) }")
fprf=("$python" -m fprf)
step tests 150 "$python" -m pytest "${tests[@]}"
step train "$whole" "${fprf[@]}" train "$method" "${data[@]}" "${time[@]}" --device "$device" --output "$work/run" "$@"
step eval 40 "${fprf[@]}" eval "$work/run" --no-images --device "$device"
step speed 300 "$python" -m benchmarks speed "$work/run" "${size[@]}" "${points[@]}" --device "$device" --output "$work/speed.json"
step gaussians "$((whole + 600))" "${fprf[@]}" train fprf-splats "${photographs[@]}" "${time[@]}" --device "$device" \
    --output "$work/gaussians"
step eval-gaussians 60 "${fprf[@]}" eval "$work/gaussians" --no-images --device "$device"
step steps 60 "$python" -m benchmarks gaussians --training --times 20 --device "$device" --output "$work/training.json"
if [ "$long" != 0 ]; then
    step train-long 7200 "${fprf[@]}" train "$method" "${data[@]}" "${again[@]}" --device "$device" --output "$work/long" "$@"
    step eval-long 60 "${fprf[@]}" eval "$work/long" --no-images --device "$device"
fi
"$python" -m benchmarks.gpu_rows "$work" --output "$output"
