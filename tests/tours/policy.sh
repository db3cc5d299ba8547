#!/usr/bin/env bash
# Writing a policy: runs the commands of CONTRIBUTING.md from `cargo new` to a comparison, in a new crate.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
. "$here/guide.sh"
root="$(realpath "$here/../..")"
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
# Builds are kept for later runs.
CARGO_TARGET_DIR="$(realpath -m "${CARGO_TARGET_DIR:-$root/target}")/tours"
export CARGO_TARGET_DIR

cd "$folder"
# The recipe is changed in two ways: paths lead to this checkout, and this checkout's Cargo.lock is copied, since other
# versions are not available without a network. It is copied again before each `cargo add`, because `cargo test` removes
# unused dependencies from the lock file.
lock="cp '$root/Cargo.lock' ."
recipe "$root/CONTRIBUTING.md" 'A policy' |
    sed "s|\.\./densify|$root|g; s|^cd my_policy\$|&; $lock|; s|^cargo add |$lock; &|" >recipe.sh
bash -euxo pipefail recipe.sh 2>&1 | tee said.txt

has() { grep -qE "$1" "$2" || fail "$2 does not have: $1"; }
has 'test steady_conforms \.\.\. ok' said.txt
has '^test +PSNR [0-9.]+ dB' said.txt
has '\| steady +\|' my_policy/comparison/compare.md
has '\| vanilla +\|' my_policy/comparison/compare.md
# The tests and the program of the policy share one build of densify-policies.
built="$(grep -c 'Compiling densify-policies ' said.txt || true)"
[ "$built" -le 1 ] || fail "densify-policies was built $built times: its dependencies have other features in densify"
# Commands that need the missing feature are refused, and the error names it.
for words in 'train scene:spheres --backend gpu' 'devices'; do
    code=0
    # shellcheck disable=SC2086 # words
    "$CARGO_TARGET_DIR/release/my_policy" $words >refused.txt 2>&1 || code=$?
    [ $code -eq 2 ] || fail "$words: exit code $code, not 2"
    has 'without the feature `gpu`' refused.txt
done
echo 'passed'
