# What the tours share: the commands of a document's section, run as they stand there.

fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

# Prints the commands of a section: its indented lines, without comments. Lines whose comment begins
# with "in full" take hours, and are left out.
commands() { # DOCUMENT HEADING
    awk -v heading="$2" '
        /^#+ / { inside = $0 ~ "^#+ " heading "$" }
        inside && /^    / && !/# in full/' "$1" | sed 's/^ *//; s/ *#.*//'
}

# Runs them in the current folder, each printed first. PROGRAM stands in for `densify`.
walk() { # DOCUMENT HEADING PROGRAM
    local shown
    shown="$(commands "$1" "$2")"
    [ -n "$shown" ] || fail "$1 shows no command under \"$2\""
    densify() { "$program" "$@"; }
    local program="$3" line
    while IFS= read -r line; do
        printf '\n$ %s\n' "$line"
        eval "$line"
    done <<<"$shown"
}

# Prints the blocks that are fenced below a heading as one script: ```sh is run, and ```LANGUAGE PATH is
# written to PATH. Other blocks are only to be read.
recipe() { # DOCUMENT HEADING
    awk -v heading="$2" '
        /^#+ / && !fenced { inside = $0 ~ "^#+ " heading "$"; next }
        inside && /^ *```/ {
            if (fenced && path) print "END OF FILE"
            if (!fenced) {
                match($0, /^ */)
                path = $2
                if (path) printf "mkdir -p \"$(dirname %s)\"\ncat >%s <<\"END OF FILE\"\n", path, path
                shown = path || $1 == "```sh"
            }
            fenced = !fenced
            next
        }
        inside && fenced && shown { print /^ *$/ ? "" : substr($0, RLENGTH + 1) }' "$1"
}
