#!/usr/bin/env bash
# Tour "Train on your photographs": starts from a dataset and runs the README's commands, up to the pictures of a model.
#
# tests/tours/photographs.sh PROGRAM DATASET [FOLDER]: the pictures are kept in FOLDER, which must be new.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
. "$here/guide.sh"
[ $# -ge 2 ] || fail 'usage: photographs.sh PROGRAM DATASET [FOLDER]'
program="$(realpath "$1")" dataset="$(realpath "$2")"
folder="${3:-$(mktemp -d)}"
[ $# -ge 3 ] || trap 'rm -rf "$folder"' EXIT

mkdir -p "$folder/data"
cp -r "$dataset" "$folder/data/garden"
cd "$folder"
walk "$here/../../README.md" 'Train on your photographs' "$program" | tee said.txt

# The model shows the scene, and its pictures have been written.
psnr="$(sed -n 's/^test *PSNR \([0-9.]*\) dB.*/\1/p' said.txt)"
awk -v psnr="$psnr" 'BEGIN { exit !(psnr > 20) }' || fail "the model has a PSNR of ${psnr:-none} dB"
mapfile -t pictures < <(find pictures -name "*.pair.png" -size +0)
[ "${#pictures[@]}" -gt 0 ] || fail "there is no picture"
echo "passed: ${#pictures[@]} pictures at $psnr dB in $folder/pictures"
