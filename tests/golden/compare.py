"""Compares the output of two programs. Ignores what varies between two runs of one program: times, speeds, measured
memory, and folders.
"""

import json
import re
import struct
from array import array
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

from cases import INTENDED

# Written, but not compared. TensorBoard's file repeats stats/train.jsonl with times.
IGNORED = ("*events.out.tfevents.*", "*densify.lock", "*local.lock", "case.json")
# Must exist and not be empty; the contents, full of times and measured memory, are not compared.
PRESENT = ("report.html", "compare/*.html", "trade/*.html", "compare/growth-*.svg", "trade/pareto-*.svg")
# Text for people: its figures must be the same, in any order; changed words are only reported.
WORDS = ("*.out", "*.err", "*.log", "*requirements.json", "*.md")
# Keys of JSON with a time or measured memory.
VARYING_KEYS = {"seconds", "cpu_seconds", "resident_bytes", "peak_bytes", "ledger_bytes"}
# Parts of text that are left out: the pattern of the files, and the regular expression of the text.
VARYING = (
    ("*plan.toml", r"^(merge_)?memory = \d+\n"),  # includes measured memory
    ("*.err", r"^(step \d+/\d+|rendered \d+ of \d+ views).*\n?"),  # progress
    ("*.log", r"^step \d+/\d+.*\n?"),
    ("*.*", r"^time .*\n"),  # in the summary of a run
    ("*.*", r"[\d.,]+ [KMG]iB at its peak, [\d.,]+ [KMG]iB promised|; peak [\d.,]+ [KMG]iB"),
    ("*blocks.out", r"^(started|ended) .*\n"),  # tasks run side by side
    ("*blocks.out", r"^#SBATCH --mem=.*\n"),
    ("*trade.out", r"(?<=\.\d\d) +\d+\.\d{3} +\d+\.\d{3}$"),  # time and peak memory of a knob
    ("*policies.out", r" \([\w/.]+\.rs:\d+\)"),  # where a policy is registered
)
# Lines of printed text whose figures depend on measured memory, and so may differ.
LOOSE_LINES = re.compile(r"program and dataset|^  (total|left|degree \d) |--memory \d+MiB holds|"
                         r"^(coarse|block-\S+|merge) ")
# Largest accepted difference between two such figures, as a share of the larger one.
LOOSE = 0.4
FIGURE = re.compile(r"(?<![\w.])[-+]?\d+(?:,\d{3})*(?:\.\d+)?(?:e[-+]?\d+)?")


def is_only_present(name: str) -> bool:
    """True if the contents of a file are not compared."""
    return any(fnmatch(name, pattern) for pattern in PRESENT)


def difference(name: str, reference: Path, program: Path, folders: list[tuple[str, str]], dropped: list[str]):
    """The first difference between two files, None if they are the same, or "" if only words differ. `folders` are
    replaced in text; lines that match one of `dropped` are left out."""
    if is_only_present(name):
        return None if program.stat().st_size else "empty"
    left, right = reference.read_bytes(), program.read_bytes()
    if name.endswith(".safetensors"):
        return arrays_difference(*(checkpoint_arrays(it) for it in (left, right)))
    if left == right:
        return None
    if left.startswith(b"ply\n") and right.startswith(b"ply\n"):
        return ply_difference(left, right)
    try:
        left, right = (fixed_text(name, it.decode(), folders, dropped) for it in (left, right))
    except UnicodeDecodeError:
        return bytes_difference(left, right)
    if any(fnmatch(name, pattern) for pattern in WORDS):
        return words_difference(left, right)
    if name.endswith((".json", ".jsonl")):
        return json_difference(left, right)
    return lines_difference(left, right)


def fixed_text(name: str, content: str, folders: list[tuple[str, str]], dropped: list[str]) -> str:
    """The text of a file, without the parts that vary."""
    for folder, word in folders:
        content = content.replace(folder, word)
    for pattern, part in VARYING:
        if fnmatch(name, pattern):
            content = re.sub(part, "", content, flags=re.MULTILINE)
    kept = "\n".join(line for line in content.splitlines() if not any(re.search(it, line) for it in dropped))
    # The last key of an object, if it was left out, leaves a comma.
    return re.sub(r",(?=\s*[}\]])", "", kept) if dropped and name.endswith(".json") else kept


def lines_difference(left: str, right: str):
    """The first line that differs."""
    if left == right:
        return None
    left, right = left.splitlines(), right.splitlines()
    for number, (one, other) in enumerate(zip(left, right), 1):
        if one != other:
            return f"line {number}: {one[:200]!r}, now {other[:200]!r}"
    return f"{len(left)} lines, now {len(right)}" if len(left) != len(right) else None


def words_difference(left: str, right: str):
    """The first difference between the figures of two texts, in any order; "" if only words differ."""
    left, right = without_varying_columns(left), without_varying_columns(right)
    if left == right:
        return None
    sides = []
    for side in (left, right):
        lines = side.splitlines()
        loose = [figure for line in lines if LOOSE_LINES.search(line) for figure in figures(line)]
        sides.append((Counter(it for line in lines if not LOOSE_LINES.search(line) for it in figures(line)), loose))
    (exact, loose), (exact_now, loose_now) = sides
    gone, new = exact - exact_now, exact_now - exact
    if gone or new:
        line = lines_difference(left, right)
        return f"figures {listed(gone)}, now {listed(new)}; {line}"
    if len(loose) != len(loose_now):
        return f"{len(loose)} figures of memory, now {len(loose_now)}"
    for one, other in zip(loose, loose_now):
        one, other = (float(it.replace(",", "")) for it in (one, other))
        if abs(one - other) > LOOSE * max(abs(one), abs(other)):
            return f"a figure of memory is {one}, now {other}"
    alike = [[FIGURE.sub("#", line) if LOOSE_LINES.search(line) else line for line in side.splitlines()]
             for side in (left, right)]
    # The width of a column depends on its figures, so spaces are ignored.
    squeezed = [[" ".join(line.split()) for line in side] for side in alike]
    return None if squeezed[0] == squeezed[1] else ""


def figures(line: str) -> list[str]:
    """The numbers in a line."""
    return FIGURE.findall(line)


def listed(counted: Counter) -> str:
    """The first few figures, as text."""
    found = [it for it, times in counted.items() for _ in range(times)]
    return (", ".join(found[:5]) + (", ..." if len(found) > 5 else "")) or "none"


def without_varying_columns(text: str) -> str:
    """Markdown without the columns of times and measured memory."""
    lines, varying = [], []
    for line in text.splitlines():
        cells = line.split("|") if line.startswith("|") else []
        if not cells:
            varying = []
        elif not varying:
            varying = [bool(re.search(r"time|peak (memory|×|\[MiB\])", cell)) for cell in cells]
        if cells and any(varying):
            line = "|".join("" if it else cell for cell, it in zip(cells, varying))
        lines.append(line)
    return "\n".join(lines)


def json_difference(left: str, right: str):
    """The first value that differs, in JSON or in lines of JSON."""
    def values(text: str):
        try:
            return json.loads(text)
        except json.JSONDecodeError:
            return [json.loads(line) for line in text.splitlines()]

    try:
        return value_difference(values(left), values(right))
    except json.JSONDecodeError:
        return lines_difference(left, right)


def value_difference(left, right, path: str = ""):
    """The first value that differs, with its path."""
    if isinstance(left, dict) and isinstance(right, dict):
        # This line of the ledger is measured.
        if "program and dataset" in (left.get("what"), right.get("what")):
            left, right = ({**it, "bytes": 0} for it in (left, right))
        if list(left) != list(right):
            return f"{path}: keys {list(left)}, now {list(right)}"
        pairs = [(key, left[key], right[key]) for key in left if key not in VARYING_KEYS]
        # The times of the stages are not compared, only the names of the stages.
        pairs = [(key, *((list(it) for it in both) if key == "stage_seconds" else both)) for key, *both in pairs]
    elif isinstance(left, list) and isinstance(right, list):
        if len(left) != len(right):
            return f"{path}: {len(left)} entries, now {len(right)}"
        pairs = [(place, *both) for place, both in enumerate(zip(left, right))]
    else:
        # NaN is the same as NaN.
        return None if repr(left) == repr(right) else f"{path}: {left!r}, now {right!r}"
    for key, *both in pairs:
        found = value_difference(*both, f"{path}/{key}")
        if found is not None:
            return found
    return None


def bytes_difference(left: bytes, right: bytes):
    """The first byte that differs."""
    if left == right:
        return None
    place = next((place for place, (one, other) in enumerate(zip(left, right)) if one != other),
                 min(len(left), len(right)))
    return f"byte {place} of {len(left)}, now of {len(right)}"


def checkpoint_arrays(content: bytes) -> dict[str, tuple[str, bytes]]:
    """The arrays of a safetensors file: name to type with shape, and bytes. Its metadata has times."""
    length = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + length])
    arrays = {}
    for name, entry in header.items():
        if name != "__metadata__":
            begin, end = (8 + length + offset for offset in entry["data_offsets"])
            arrays[name] = (f"{entry['dtype']}{entry['shape']}", content[begin:end])
    return arrays


def arrays_difference(left: dict[str, tuple[str, bytes]], right: dict[str, tuple[str, bytes]]):
    """The first array that differs."""
    if sorted(left) != sorted(right):
        return f"arrays {sorted(left)}, now {sorted(right)}"
    for name, (shape, content) in left.items():
        shape_now, content_now = right[name]
        if shape != shape_now:
            return f"{name} is {shape}, now {shape_now}"
        if content != content_now:
            floats = floats_difference(content, content_now) if shape.startswith("F32") else None
            return f"{name} {shape}: {floats or bytes_difference(content, content_now)}"
    return None


def ply_difference(left: bytes, right: bytes):
    """The first line of the header that differs, or else the first value."""
    (header, body), (header_now, body_now) = (it.split(b"end_header\n", 1) for it in (left, right))
    if header != header_now or b"binary_little_endian" not in header or len(body) != len(body_now):
        return lines_difference(header.decode(), header_now.decode()) or bytes_difference(body, body_now)
    return floats_difference(body, body_now) or bytes_difference(body, body_now)


def floats_difference(left: bytes, right: bytes) -> str | None:
    """The first float that differs, how many differ, and the largest difference."""
    if len(left) != len(right) or len(left) % 4:
        return None
    # As integers, since NaN differs from itself.
    bits, bits_now = array("I", left), array("I", right)
    different = [place for place, (one, other) in enumerate(zip(bits, bits_now)) if one != other]
    floats, floats_now = array("f", left), array("f", right)
    if not different:
        return None
    first, most = different[0], max(abs(floats[place] - floats_now[place]) for place in different)
    return (f"float {first}: {floats[first]:.9g}, now {floats_now[first]:.9g}; {len(different)} of {len(bits)} differ, "
            f"by at most {most:.3g}")


def files_of(folder: Path) -> list[str]:
    """The files of a case that are compared."""
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    return sorted(name for name in names if not any(fnmatch(name, pattern) for pattern in IGNORED))


def compare(case: str, reference: Path, program: Path, folders: list[tuple[str, str]]):
    """Compares the output of a case. Returns the number of files, the differences, the files in which only words
    differ, and the reasons of the intended differences that it found."""
    names, names_now = files_of(reference), files_of(program)
    differing, words, reasons = [], [], []
    codes, codes_now = (json.loads((it / "case.json").read_text())["codes"] for it in (reference, program))
    if codes != codes_now:
        differing.append(f"exit codes {codes}, now {codes_now}")
    for name in sorted({*names, *names_now}):
        if name not in names_now:
            found = "missing"
        elif name not in names:
            found = "not written by the reference"
        else:
            found = difference(name, reference / name, program / name, folders, [])
        intended = [it for it in INTENDED if fnmatch(case, it.cases) and fnmatch(name, it.files)]
        if found is not None and intended:
            unexplained = None
            if all(it.lines for it in intended) and name in names and name in names_now:
                lines = [it.lines for it in intended]
                unexplained = difference(name, reference / name, program / name, folders, lines)
            if not unexplained:
                found = unexplained
                reasons += [it.reason for it in intended]
        if found == "":
            words.append(name)
        elif found is not None:
            differing.append(f"{name}: {found}")
    return len(names), differing, words, sorted(set(reasons))
