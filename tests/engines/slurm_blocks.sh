#!/usr/bin/env bash
# Trains a scene in four blocks with Slurm, killing one of the tasks, and without Slurm; the merged models must be
# identical. Then does the same for a comparison of policies. Called by slurm.sh:
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
    # A task that has a checkpoint, as others may begin again.
    saved="$(sed -n 's/^\(block-[0-9-]*\) .*running, saved [1-9].*/\1/p' <<<"$state" | head -n 1 || true)"
    if [ -z "$killed" ] && [ -n "$saved" ]; then
        # SIGKILL, like the system when memory runs out.
        killed="$(pgrep -f "^$program blocks run $scratch/slurm $saved" | head -n 1 || true)"
        [ -n "$killed" ] && kill -9 "$killed"
    fi
    grep -q '^merge *complete' <<<"$state" && break
    sleep 0.5
done
squeue --noheader
"$program" blocks status "$scratch/slurm"
[ -n "$killed" ] || fail 'no task was killed'
grep -q 'resume   from step' "$scratch"/slurm/logs/densify-blocks-*.log || fail 'no task has resumed from a checkpoint'
cmp "$scratch/local/merged.ply" "$scratch/slurm/merged.ply" || fail 'the model trained with Slurm differs'

study() { # FOLDER OPTION...
    "$program" compare "$scratch/scene" -o "$scratch/$1" --policies vanilla,diet --budget 1k --seeds 1 --iterations 200 \
        "${@:2}" -- --backend cpu --threads 1 --sh-degree 0
}
study local-study >/dev/null
study slurm-study --engine slurm
for _ in $(seq 240); do
    [ -f "$scratch/slurm-study/compare.md" ] && break
    sleep 0.5
    study slurm-study --engine slurm >/dev/null
done
models() { grep -o '"run":"[^"]*"\|"model":[0-9]*' "$scratch/$1/compare.jsonl" | sort; }
[ "$(models local-study)" = "$(models slurm-study)" ] || fail 'the runs of the comparison with Slurm differ'
echo "$(wc -l <"$scratch/slurm-study/compare.jsonl") runs of the comparison are identical"
echo "the models are identical: $(stat -c %s "$scratch/slurm/merged.ply") bytes, with one task killed and requeued"
