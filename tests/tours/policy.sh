#!/usr/bin/env bash
# An author of a policy: CONTRIBUTING.md's way from `cargo new` to a comparison, in a crate of its own.
set -euo pipefail
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"
. "$here/guide.sh"
root="$(realpath "$here/../..")"
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
# What is built stays for the next time.
CARGO_TARGET_DIR="$(realpath -m "${CARGO_TARGET_DIR:-$root/target}")/tours"
export CARGO_TARGET_DIR

cd "$folder"
# The checkout lies elsewhere, and dependencies have its versions: without a network there are no others. `cargo test`
# removes from the copy what the policy does not need, so the trainer, added later, needs a copy of its own.
lock="cp '$root/Cargo.lock' ."
recipe "$root/CONTRIBUTING.md" 'A policy' |
    sed "s|\.\./densify|$root|g; s|^cd my_policy\$|&; $lock|; s|^cargo add |$lock; &|" >recipe.sh
bash -euxo pipefail recipe.sh 2>&1 | tee said.txt

has() { grep -qE "$1" "$2" || fail "$2 does not have: $1"; }
has 'test steady_conforms \.\.\. ok' said.txt
has '^test +PSNR [0-9.]+ dB' said.txt
has '\| steady +\|' my_policy/comparison/compare.md
has '\| vanilla +\|' my_policy/comparison/compare.md
# What a policy's tests are built from serves for its program too.
built="$(grep -c 'Compiling densify-policies ' said.txt || true)"
[ "$built" -le 1 ] || fail "densify-policies was built $built times: its dependencies have other features in densify"
# What was left out is refused by name.
for words in 'train scene:spheres --backend gpu' 'devices'; do
    code=0
    # shellcheck disable=SC2086 # words
    "$CARGO_TARGET_DIR/release/my_policy" $words >refused.txt 2>&1 || code=$?
    [ $code -eq 2 ] || fail "$words: exit code $code, not 2"
    has 'without the feature `gpu`' refused.txt
done
echo 'passed'
