#!/usr/bin/env python3
"""Checks that this densify computes the same as an older revision, byte for byte.

    tests/golden/golden.py                          # builds this checkout and d34cba2, and compares all cases
    tests/golden/golden.py --quick                  # three policies on the CPU and all small cases: a minute
    tests/golden/golden.py 'native/*' '*/exposure'  # the cases that match a shell pattern
    tests/golden/golden.py --instructions           # compares instructions of ten training steps, with valgrind
    tests/golden/golden.py --prove                  # checks that a small change to any kind of file is noticed

Run it by hand before and after refactoring. It needs Python 3.11, the test data (DENSIFY_SHARED or ../shared) and, for
the cases whose names begin with gpu or resume/gpu, lavapipe (apt-get install mesa-vulkan-drivers).

Both programs run the cases of cases.py on the same machine, because results differ between processors and drivers. The
reference's output is kept in target/golden, so the reference runs only once. Files (for checkpoints, their arrays),
printed text and exit codes are compared. Times, speeds and measured memory are ignored (compare.py). The figures in
printed text must be the same; changed words are only reported, unless --words is given. The cases named resume
continue from checkpoints that the reference wrote.

Prints one line per case. The exit code is 1 if any case differs. Intended differences are listed in cases.py, with
their reasons.
"""

import argparse
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from pathlib import Path

from cases import Case, all_cases, is_quick
from compare import compare, difference, files_of, fixed_text, is_only_present

ROOT = Path(__file__).resolve().parents[2]
REVISION = "d34cba2"
# Largest ratio of instructions that passes.
MOST_INSTRUCTIONS = 1.01


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("patterns", nargs="*", metavar="PATTERN", help="only cases that match a shell pattern")
    parser.add_argument("--program", type=Path, help="program to test [default: built from this checkout]")
    parser.add_argument("--reference-program", type=Path, help="reference program [default: built from --revision]")
    parser.add_argument("--revision", default=REVISION, help="revision of the reference [default: %(default)s]")
    parser.add_argument("--store", type=Path, default=ROOT / "target/golden", metavar="DIR",
                        help="folder for outputs [default: target/golden]")
    parser.add_argument("--quick", action="store_true", help="only the cases that take seconds")
    parser.add_argument("--no-gpu", action="store_true", help="skip the cases that need lavapipe")
    parser.add_argument("--words", action="store_true", help="treat changed words in printed text as differences")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="number of cases to run at once [default: 1]")
    modes = parser.add_mutually_exclusive_group()
    modes.add_argument("--list", action="store_true", help="print the names of the cases")
    modes.add_argument("--record", action="store_true", help="only run the reference program")
    modes.add_argument("--instructions", action="store_true", help="compare the instructions of ten training steps")
    modes.add_argument("--prove", action="store_true", help="check that a small change to any kind of file is noticed")
    return parser.parse_args()


def main() -> None:
    args = arguments()
    store = args.store.resolve()
    store.mkdir(parents=True, exist_ok=True)
    data = Path(os.environ.get("DENSIFY_SHARED", ROOT.parent / "shared")).resolve() / "data"
    if not data.is_dir():
        sys.exit(f"{data} does not exist; set DENSIFY_SHARED to the folder that contains data/")
    reference = Program(args.reference_program or build_revision(args.revision, store), store, data)
    policies = re.findall(r"^([a-z0-9-]+)  ", reference.printed("policies"), re.MULTILINE)
    chosen = [case for case in all_cases(policies)
              if (not args.quick or is_quick(case)) and not (args.no_gpu and case.needs_gpu)
              and (not args.patterns or any(fnmatch(case.name, pattern) for pattern in args.patterns))]
    if not chosen:
        sys.exit("no case matches; --list prints the names")
    if args.list:
        print(*(case.name for case in chosen), sep="\n")
        return
    started = time.monotonic()
    if not args.instructions:
        if any(case.needs_gpu for case in chosen) and "VK_DRIVER_FILES" not in reference.environment:
            sys.exit("lavapipe is not installed (apt-get install mesa-vulkan-drivers); --no-gpu skips its cases")
        record(reference, chosen, {case.name: case for case in all_cases(policies)}, args.jobs)
    if args.prove:
        sys.exit(prove(reference, chosen))
    if args.record:
        print(f"{len(chosen)} cases in {reference.outputs}, {time.monotonic() - started:.0f} s")
        return
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    program = Program(args.program or build(ROOT, target), store, data)
    if args.instructions:
        sys.exit(compare_instructions(reference, program))
    program.start_anew(store / f"tested-{program.outputs.name}")
    sys.exit(compare_all(reference, program, chosen, args, started))


class Program:
    """A program, and the folder of its output. Each program has its own folder for each kind of machine."""

    def __init__(self, path: Path, store: Path, data: Path):
        self.path = path.resolve(strict=True)
        self.store = store
        self.data = data
        self.environment = dict(os.environ, NO_COLOR="1", XDG_RUNTIME_DIR=str(store), NODEVICE_SELECT="1")
        self.environment.pop("RUST_LOG", None)
        drivers = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
        if drivers:
            self.environment.setdefault("VK_DRIVER_FILES", str(drivers[0]))
        machine = set(re.findall(r"^(?:model name|flags)\s*:.*", Path("/proc/cpuinfo").read_text(), re.MULTILINE))
        content = self.path.read_bytes() + "".join(sorted(machine)).encode() + self.printed("devices").encode()
        self.set_outputs(store / hashlib.sha256(content).hexdigest()[:12])

    def set_outputs(self, folder: Path) -> None:
        """Sets the folder of the output. Built-in scenes are cached beside it."""
        self.outputs = folder
        self.environment["XDG_CACHE_HOME"] = f"{folder}-cache"

    def start_anew(self, folder: Path) -> None:
        """Sets the folder of the output, and empties it."""
        self.set_outputs(folder)
        for it in (folder, f"{folder}-cache"):
            shutil.rmtree(it, ignore_errors=True)

    def printed(self, words: str) -> str:
        """Runs a command and returns its standard output."""
        done = subprocess.run([self.path, *words.split()], capture_output=True, text=True, env=self.environment)
        return done.stdout

    def as_reference(self, case: Case, reference: "Program") -> list[str]:
        """The commands of a case, with the parameter that makes this program do what the reference does without it."""
        if not case.as_before:
            return list(case.commands)
        policy, parameter = case.as_before.split("=")[0].split(".")
        known = [f"| {parameter} |" in it.printed(f"policies {policy}") for it in (self, reference)]
        more = f" --policy-set {case.as_before}" if known == [True, False] else ""
        return [command + more * command.startswith("train ") for command in case.commands]

    def run(self, case: Case, reference: "Program") -> Path:
        """Runs a case unless it has been run already. Returns the folder of its output."""
        folder = self.outputs / case.name
        commands = case.commands if self is reference else self.as_reference(case, reference)
        described = {"commands": list(commands), "start": case.start, "without": list(case.without)}
        try:
            recorded = json.loads((folder / "case.json").read_text())
            if all(recorded[key] == value for key, value in described.items()):
                return folder
        except FileNotFoundError:
            pass
        shutil.rmtree(folder, ignore_errors=True)
        if case.start:
            printed = shutil.ignore_patterns("*.out", "*.err", "case.json", "densify.lock")
            shutil.copytree(reference.outputs / case.start, folder, ignore=printed)
            for name in case.without:
                path = folder / name
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        folder.mkdir(parents=True, exist_ok=True)
        started, codes = time.monotonic(), []
        for number, command in enumerate(commands, 1):
            words = [word.replace("{data}", str(self.data)) for word in shlex.split(command)]
            name = folder / f"{number}-{words[0]}"
            with open(f"{name}.out", "wb") as out, open(f"{name}.err", "wb") as err:
                done = subprocess.run([self.path, *words], cwd=folder, stdin=subprocess.DEVNULL, stdout=out,
                                      stderr=err, env=self.environment, timeout=3600)
            codes.append(done.returncode)
        described |= {"codes": codes, "seconds": round(time.monotonic() - started, 1)}
        (folder / "case.json").write_text(json.dumps(described, indent=1))
        return folder


def build(checkout: Path, target: Path) -> Path:
    """Builds the program of a checkout."""
    subprocess.run(["cargo", "build", "--release", "--locked", "--package", "densify"], cwd=checkout, check=True,
                   env=dict(os.environ, CARGO_TARGET_DIR=str(target)))
    return target / "release/densify"


def build_revision(revision: str, store: Path) -> Path:
    """Builds an older revision in its own worktree."""
    checkout = store / f"source-{revision}"
    if not checkout.exists():
        subprocess.run(["git", "worktree", "add", "--force", "--detach", checkout, revision], cwd=ROOT, check=True)
    program = checkout / "target/release/densify"
    return program if program.exists() else build(checkout, checkout / "target")


def record(reference: Program, chosen: list[Case], by_name: dict[str, Case], jobs: int) -> None:
    """Runs the reference, and checks that no command fails unexpectedly. Cases that others start from are run first."""
    # Renders the scene in advance, as rendering it within a case would raise the measured memory.
    reference.printed("plan scene:spheres --backend cpu")
    starts = {by_name[case.start] for case in chosen if case.start}
    with ThreadPoolExecutor(jobs) as pool:
        for wave in (starts, [case for case in chosen if case not in starts]):
            for folder in pool.map(lambda case: reference.run(case, reference), wave):
                recorded = json.loads((folder / "case.json").read_text())
                name = folder.relative_to(reference.outputs).as_posix()
                if recorded["codes"] != [0] * (len(recorded["codes"]) - 1) + [by_name[name].code]:
                    sys.exit(f"the reference has failed with exit codes {recorded['codes']}: {folder}")


def compare_all(reference: Program, program: Program, chosen: list[Case], args: argparse.Namespace, started: float):
    """Runs and compares the cases, and prints a line for each."""
    program.printed("plan scene:spheres --backend cpu")
    folders = folders_of(reference, program)

    def one(case: Case):
        folder = program.run(case, reference)
        return case, folder, compare(case.name, reference.outputs / case.name, folder, folders)

    counts = {"same": 0, "intended": 0, "differs": 0}
    with ThreadPoolExecutor(args.jobs) as pool:
        for case, folder, (files, differing, words, reasons) in pool.map(one, chosen):
            if args.words:
                differing += [f"{name}: other words" for name in words]
                words = []
            verdict = "differs" if differing else "intended" if reasons else "same"
            counts[verdict] += 1
            notes = differing[:1] or reasons or [f"{files} files"]
            if words and not differing:
                notes.append(f"other words in {', '.join(words)}")
            print(f"{verdict:9}{case.name:32} {'; '.join(notes)}", flush=True)
            for line in differing[1:10]:
                print(f"{'':41} {line}")
            if len(differing) > 10:
                print(f"{'':41} and {len(differing) - 10} more")
            if not differing:
                shutil.rmtree(folder)
    print(f"{counts['same']} same, {counts['intended']} with intended differences, {counts['differs']} that differ, "
          f"in {time.monotonic() - started:.0f} s")
    if counts["differs"]:
        print(f"compare {reference.outputs} with {program.outputs}")
    return int(counts["differs"] > 0)


def folders_of(*programs: Program) -> list[tuple[str, str]]:
    """The paths that may appear in text, each with a word that replaces it."""
    found = []
    for it in programs:
        found += [(str(it.outputs), "OUTPUTS"), (str(it.path), "densify"), (it.path.name, "densify"),
                  (str(it.data), "DATA")]
    return found


def prove(reference: Program, chosen: list[Case]) -> int:
    """Changes a digit or a bit in each kind of file, and checks that the comparison notices it."""
    kinds: dict[str, tuple[Path, Path]] = {}
    for case in chosen:
        folder = reference.outputs / case.name
        for name in files_of(folder):
            if (folder / name).stat().st_size and not is_only_present(name):
                # One file of each kind: iteration_300 and iteration_60 are the same kind.
                kinds.setdefault(re.sub(r"\d+", "N", Path(name).name), (folder, Path(name)))
    folders = folders_of(reference)
    changed = reference.store / "changed"
    missed = 0
    for kind, (folder, name) in sorted(kinds.items()):
        content = (folder / name).read_bytes()
        for changed_content in corrupted(content):
            changed.write_bytes(changed_content)
            found = difference(str(name), folder / name, changed, folders, [])
            # An empty description means that only words differ, as in a file without figures. This is noticed, too.
            if found is not None:
                break
        # Some files contain only progress messages, which vary.
        compared = not is_text(content) or bool(fixed_text(str(name), content.decode(), folders, []))
        missed += found is None and compared
        print(f"{'noticed' if found is not None else 'MISSED' if compared else 'varies':9}{kind:36}{found or ''}"[:160])
    changed.unlink()
    print(f"{missed} of {len(kinds)} kinds missed")
    return int(missed > 0)


def is_text(content: bytes) -> bool:
    """True for UTF-8 text."""
    try:
        return bool(content.decode()) and b"\0" not in content
    except UnicodeDecodeError:
        return False


def corrupted(content: bytes):
    """Yields changed copies. In text, one digit is changed; each copy changes another digit, from the middle outwards,
    because a digit may be in a line that varies. In other data, one bit is changed."""
    middle = len(content) // 2
    digits = [place for place, byte in enumerate(content) if chr(byte).isdigit()] if is_text(content) else []
    for place in sorted(digits, key=lambda place: abs(place - middle))[:300]:
        yield content[:place] + (b"3" if content[place] == ord("8") else b"8") + content[place + 1 :]
    if not digits:
        yield content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


def compare_instructions(reference: Program, program: Program) -> int:
    """Compares the instructions of ten training steps. Returns the exit code."""
    if not shutil.which("valgrind"):
        sys.exit("valgrind is not installed (apt-get install valgrind)")
    known = Path(f"{reference.outputs}-instructions")
    if not known.exists():
        known.write_text(str(instructions(reference)))
    before, now = int(known.read_text()), instructions(program)
    print(f"{before:,} instructions for ten steps, now {now:,}: {100 * (now / before - 1):+.3f} %, "
          f"at most {100 * (MOST_INSTRUCTIONS - 1):+.0f} %")
    return int(now > MOST_INSTRUCTIONS * before)


def instructions(program: Program) -> int:
    """Counts the instructions of a run of ten steps with 4,000 Gaussians. With one thread, few views and nothing to
    evaluate, the count varies by 0.001 %, and most of it is training."""
    folder = Path(f"{program.outputs}-counted")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "views.txt").write_text("".join(f"images/train_00{view}.png\n" for view in range(4)))
    train = (f"train {program.data}/room256 -o run --views views.txt --backend cpu --threads 1 -b 4k --seed 0 "
             "--iterations 10 --checkpoint-every 0 --quiet")
    valgrind = ["valgrind", "--tool=callgrind", "--callgrind-out-file=counted"]
    done = subprocess.run([*valgrind, program.path, *train.split()], cwd=folder, capture_output=True, text=True,
                          env=program.environment)
    if done.returncode:
        sys.exit(f"valgrind: {done.stderr}")
    counted = re.search(r"^(?:totals|summary): (\d+)", (folder / "counted").read_text(), re.MULTILINE)
    shutil.rmtree(folder)
    return int(counted[1])


if __name__ == "__main__":
    main()
