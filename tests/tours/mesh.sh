#!/usr/bin/env bash
# Tour "Test against known geometry": starts from a mesh and runs the README's commands, up to the test for continuous
# integration.
#
# tests/tours/mesh.sh PROGRAM MESH
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
. "$here/guide.sh"
[ $# -eq 2 ] || fail 'usage: mesh.sh PROGRAM MESH'
program="$(realpath "$1")" mesh="$(realpath "$2")"
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT

cp "$mesh" "$folder/chair.glb"
cd "$folder"
walk "$here/../../README.md" 'Test against known geometry' "$program" | tee said.txt

# With a limit above the model's PSNR, the same test fails.
test="$(commands "$here/../../README.md" 'Test against known geometry' | grep -- --fail-below)"
code=0
(densify() { "$program" "$@"; }; eval "$test --fail-below psnr=99") || code=$?
[ "$code" -eq 4 ] || fail "a PSNR below 99 dB gives exit code $code, not 4"
echo 'passed'
