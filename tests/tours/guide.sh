# Functions shared by the tours. A tour runs the commands in a section of a document as they are written.

fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

# Prints the commands of a section: its indented lines, without comments. Lines with a comment that
# begins with "in full" take hours and are skipped.
commands() { # DOCUMENT HEADING
    awk -v heading="$2" '
        /^#+ / { inside = $0 ~ "^#+ " heading "$" }
        inside && /^    / && !/# in full/' "$1" | sed 's/^ *//; s/ *#.*//'
}

# Prints and runs the commands of a section in the current folder, with PROGRAM as `densify`.
walk() { # DOCUMENT HEADING PROGRAM
    local lines
    lines="$(commands "$1" "$2")"
    [ -n "$lines" ] || fail "$1 has no commands under \"$2\""
    densify() { "$program" "$@"; }
    local program="$3" line
    while IFS= read -r line; do
        printf '\n$ %s\n' "$line"
        eval "$line"
    done <<<"$lines"
}

# Turns the fenced blocks below a heading into one script: a block ```sh is run, and a block
# ```LANGUAGE PATH is written to PATH. Other blocks are skipped.
recipe() { # DOCUMENT HEADING
    awk -v heading="$2" '
        /^#+ / && !fenced { inside = $0 ~ "^#+ " heading "$"; next }
        inside && /^ *```/ {
            if (fenced && path) print "END OF FILE"
            if (!fenced) {
                match($0, /^ */)
                path = $2
                if (path) printf "mkdir -p \"$(dirname %s)\"\ncat >%s <<\"END OF FILE\"\n", path, path
                is_used = path || $1 == "```sh"
            }
            fenced = !fenced
            next
        }
        inside && fenced && is_used { print /^ *$/ ? "" : substr($0, RLENGTH + 1) }' "$1"
}
