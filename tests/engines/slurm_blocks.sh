#!/usr/bin/env bash
# Trains a scene in four blocks with Slurm, kills one task on the way, and compares the merged model with that of this
# machine alone, byte for byte. Then a comparison of policies is handed in and collected. Called by slurm.sh:
#
#   tests/engines/slurm.sh tests/engines/slurm_blocks.sh PROGRAM
set -euo pipefail

program="$(realpath "$1")"
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT
fail() { printf 'error: %s\n' "$*" >&2; cat "$scratch"/slurm/logs/* >&2 || true; exit 1; }

"$program" scenegen --preset table -o "$scratch/scene" --size 64 --train 24 --test 4 --points 2000
for engine in local slurm; do
    "$program" blocks plan "$scratch/scene" -o "$scratch/$engine" --rows 2k --blocks 2x2 --coarse-rows 1k -- \
        -i 3000 --backend cpu --threads 1 --sh-degree 1 --checkpoint-every 50 >/dev/null
done
"$program" blocks submit "$scratch/local" >/dev/null
"$program" blocks submit "$scratch/slurm" --engine slurm

killed=''
for _ in $(seq 600); do
    state="$("$program" blocks status "$scratch/slurm")"
    if [ -z "$killed" ] && grep -q '^block-.*running, saved [1-9]' <<<"$state"; then
        # SIGKILL, as for a process that has taken too much memory.
        killed="$(pgrep -f "^$program blocks run $scratch/slurm block-" | head -n 1)"
        [ -n "$killed" ] && kill -9 "$killed"
    fi
    grep -q '^merge *complete' <<<"$state" && break
    sleep 0.5
done
squeue --noheader
"$program" blocks status "$scratch/slurm"
[ -n "$killed" ] || fail 'no task was killed'
grep -q 'resume   from step' "$scratch"/slurm/logs/densify-blocks-*.log || fail 'no task has gone on from a checkpoint'
cmp "$scratch/local/merged.ply" "$scratch/slurm/merged.ply" || fail 'Slurm made another model'

study() {
    "$program" compare "$scratch/scene" -o "$scratch/$1" --policies vanilla,diet --budget 1k --seeds 1 --iterations 200 \
        "${@:2}" -- --backend cpu --threads 1 --sh-degree 0
}
study alone >/dev/null
study handed --engine slurm
for _ in $(seq 240); do
    [ -f "$scratch/handed/compare.md" ] && break
    sleep 0.5
    study handed --engine slurm >/dev/null
done
models() { grep -o '"run":"[^"]*"\|"model":[0-9]*' "$scratch/$1/compare.jsonl" | sort; }
[ "$(models alone)" = "$(models handed)" ] || fail 'Slurm made other runs'
echo "the same $(wc -l <"$scratch/handed/compare.jsonl") runs of a study"
echo "the same model of $(stat -c %s "$scratch/slurm/merged.ply") bytes, with one task killed and requeued"
