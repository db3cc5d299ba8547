"""Converts a splat PLY to each format and back, once with densify and once with splat-transform in between.

    python models.py DENSIFY SPLAT_TRANSFORM MODEL.ply          needs node
"""

import math
import struct
import subprocess
import sys
import tempfile
from pathlib import Path


def rows(path: Path) -> list[dict[str, float]]:
    """The rows of a binary PLY of floats."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    names = [line.split()[2] for line in data[:end].decode().splitlines() if line.startswith("property float ")]
    count = (len(data) - end) // (4 * len(names))
    return [dict(zip(names, struct.unpack_from(f"<{len(names)}f", data, end + 4 * len(names) * i))) for i in range(count)]


def compare(truth: list[dict[str, float]], found: list[dict[str, float]], what: str) -> None:
    """Positions and logarithms of scales to the steps of the coarsest format; coefficients to its palette."""
    assert len(truth) == len(found), f"{what}: {len(found)} rows"
    opacity = lambda row: 1 / (1 + math.exp(-row["opacity"]))
    for row in truth:
        apart = lambda other: math.dist([row[k] for k in "xyz"], [other[k] for k in "xyz"])
        other = min(found, key=apart)
        assert apart(other) < 0.003, f"{what}: {apart(other)} apart"
        assert abs(opacity(row) - opacity(other)) < 0.004, f"{what}: opacity"
        for name, limit in [("scale_", 0.05), ("f_dc_", 0.03), ("f_rest_", 0.7)]:
            for key in (key for key in row if key.startswith(name)):
                assert abs(row[key] - other[key]) < limit, f"{what}: {key} {row[key]} {other[key]}"
        q, p = ([r[f"rot_{i}"] for i in range(4)] for r in (row, other))
        cosine = abs(sum(a * b for a, b in zip(q, p))) / math.hypot(*q) / math.hypot(*p)
        assert cosine > 0.9998, f"{what}: turned"


def main(densify: str, other: str, model: str) -> None:
    truth = rows(Path(model))
    with tempfile.TemporaryDirectory() as folder:
        there, here = Path(folder, "there.ply"), Path(folder, "here.ply")
        for name in ("m.compressed.ply", "m.spz", "m.v4.spz", "m.sog"):
            ours, theirs = Path(folder, f"ours.{name}"), Path(folder, f"theirs.{name}")
            subprocess.run([densify, "export", model, "-o", ours], check=True)
            subprocess.run([other, "-q", "-w", ours, there], check=True)
            compare(truth, rows(there), f"{ours.name} read by splat-transform")
            subprocess.run([other, "-q", "-w", "-g", "cpu", model, theirs], check=True)
            subprocess.run([densify, "export", theirs, "-o", here, "--overwrite"], check=True)
            compare(truth, rows(here), f"{theirs.name} read by densify")
        subprocess.run([other, "-q", "-w", model, Path(folder, "m.glb")], check=True)
        subprocess.run([densify, "export", Path(folder, "m.glb"), "-o", here, "--overwrite"], check=True)
        compare(truth, rows(here), "glb read by densify")
    print(f"{model}: the same in every format, both ways")


if __name__ == "__main__":
    main(*sys.argv[1:])
