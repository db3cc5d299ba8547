"""Has other programs read every format that densify writes, and densify read the files of those programs.

    python models.py DENSIFY NODE_MODULES MODEL.ply...

splat-transform (node) reads each export. The number of rows, the values up to the format's precision, and the bounds
must be those of the PLY. Its rendering of the export must be close to its rendering of the PLY, which must be close to
densify's. As splat-transform does not read glTF, Khronos' validator checks the GLB, whose accessors are read here. The
pictures need Pillow, and a Vulkan driver for Dawn.
"""

import json
import math
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image, ImageChops, ImageStat

SIZE = (320, 240)
FOV = 50.0
# Lowest accepted PSNR [dB] between each export's picture and that of the PLY.
EXPORTS = {"m.ply": 99, "m.compressed.ply": 45, "m.spz": 45, "m.v4.spz": 45, "m.sog": 42}
# Lowest accepted PSNR [dB] between the two rasterisers, which differ in tile sizes, thresholds, and rounding to bytes.
LEAST_BETWEEN_RASTERISERS = 38

Row = dict[str, float]


def rows(path: Path) -> list[Row]:
    """The rows of a binary PLY of floats."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + 11
    names = [line.split()[2] for line in data[:end].decode().splitlines() if line.startswith("property float ")]
    count = (len(data) - end) // (4 * len(names))
    return [dict(zip(names, struct.unpack_from(f"<{len(names)}f", data, end + 4 * len(names) * i))) for i in range(count)]


def opacity(row: Row) -> float:
    return 1 / (1 + math.exp(-row["opacity"]))


def bounds(found: list[Row]) -> list[float]:
    return [limit(row[axis] for row in found) for axis in "xyz" for limit in (min, max)]


def compare(truth: list[Row], found: list[Row], label: str) -> None:
    """Checks that both have the same rows, to the precision of the coarsest format and its palette of coefficients."""
    assert len(truth) == len(found), f"{label}: {len(found)} rows"
    distance = max(abs(a - b) for a, b in zip(bounds(truth), bounds(found)))
    assert distance < 0.003, f"{label}: the bounds differ by {distance}"
    # A sample of about a hundred rows, since each is searched for in all rows. Rows with an opacity of 0 in a byte are
    # excluded, since writers drop their other values.
    visible = [row for row in truth if opacity(row) > 0.004]
    for row in visible[:: max(1, len(visible) // 100)]:
        distance = lambda other: math.dist([row[k] for k in "xyz"], [other[k] for k in "xyz"])
        # Density control creates several rows at one position: the most similar one is compared.
        nearest = sorted(found, key=distance)[:32]
        compared = ["opacity", *(f"{name}_{k}" for name in ("f_dc", "scale") for k in range(3))]
        other = min(nearest, key=lambda other: 100 * distance(other) + sum(abs(row[k] - other[k]) for k in compared))
        assert distance(other) < 0.003, f"{label}: positions differ by {distance(other)}"
        assert abs(opacity(row) - opacity(other)) < 0.004, f"{label}: opacity"
        for name, limit in [("scale_", 0.1), ("f_dc_", 0.06), ("f_rest_", 0.7)]:
            for key in (key for key in row if key.startswith(name)):
                assert abs(row[key] - other[key]) < limit, f"{label}: {key} {row[key]} {other[key]}"
        q, p = ([r[f"rot_{i}"] for i in range(4)] for r in (row, other))
        cosine = abs(sum(a * b for a, b in zip(q, p))) / math.hypot(*q) / math.hypot(*p)
        assert cosine > 0.9998, f"{label}: rotations differ"


def psnr(a: Path, b: Path) -> float:
    """The PSNR of two pictures [dB]; at most 99."""
    one, other = (Image.open(path).convert("RGB") for path in (a, b))
    assert one.size == other.size == SIZE, f"{a}, {b}: {one.size}, {other.size}"
    squares = sum(ImageStat.Stat(ImageChops.difference(one, other)).sum2)
    mean = squares / (3 * one.width * one.height)
    return min(99.0, 10 * math.log10(255**2 / mean)) if mean > 0 else 99.0


def glb_rows(path: Path) -> list[Row]:
    """The rows of a binary glTF of Gaussian splats in its mesh's own frame, with the names of the PLY."""
    data = path.read_bytes()
    magic, version, length, json_length = struct.unpack_from("<4sIII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data)), "this is not the header of a GLB"
    tree = json.loads(data[20 : 20 + json_length])
    binary = 20 + json_length + 8
    primitive = tree["meshes"][0]["primitives"][0]
    splatting = primitive["extensions"]["KHR_gaussian_splatting"]
    assert splatting["kernel"] == "ellipse" and "KHR_gaussian_splatting" in tree["extensionsUsed"], splatting
    # A half turn about x or z: each axis keeps or flips its sign.
    rotation = tree["nodes"][0].get("rotation", [0, 0, 0, 1])
    assert sorted(map(abs, rotation)) == [0, 0, 0, 1], f"a half turn is expected: {rotation}"

    def column(name: str) -> list[tuple[float, ...]]:
        accessor = tree["accessors"][primitive["attributes"][name]]
        view = tree["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126, f"{name} is not in floats"
        start = binary + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        return [struct.unpack_from(f"<{width}f", data, start + 4 * width * i) for i in range(accessor["count"])]

    names = ("POSITION", *(f"KHR_gaussian_splatting:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))
    position, rotation, scale, alpha = map(column, names)
    coefficients = [column(f"KHR_gaussian_splatting:SH_DEGREE_{l}_COEF_{k}") for l in range(4) for k in range(2 * l + 1)
                    if f"KHR_gaussian_splatting:SH_DEGREE_{l}_COEF_{k}" in primitive["attributes"]]
    found = []
    for i in range(len(position)):
        row = dict(zip("xyz", position[i])) | {f"scale_{k}": math.log(scale[i][k]) for k in range(3)}
        row |= {f"rot_{(k + 1) % 4}": rotation[i][k] for k in range(4)}
        row["opacity"] = math.log(alpha[i][0] / (1 - alpha[i][0]))
        row |= {f"f_dc_{c}": coefficients[0][i][c] for c in range(3)}
        rest = len(coefficients) - 1
        row |= {f"f_rest_{c * rest + k}": coefficients[k + 1][i][c] for c in range(3) for k in range(rest)}
        found.append(row)
    return found


def camera(truth: list[Row]) -> tuple[list[float], list[float], list[float], list[float]]:
    """A camera that looks at the middle of a model: its position, and its right, up and backward axes."""
    middle, reach = [], 0.0
    for axis in "xyz":
        values = sorted(row[axis] for row in truth)
        middle.append(values[len(values) // 2])
        reach = max(reach, values[len(values) * 9 // 10] - values[len(values) // 10])
    back = [0.48, 0.36, -0.8]
    right = [back[2] / math.hypot(back[0], back[2]), 0.0, -back[0] / math.hypot(back[0], back[2])]
    up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2], back[0] * right[1] - back[1] * right[0]]
    return [m + 1.5 * reach * b for m, b in zip(middle, back)], right, up, back


def main(densify: str, modules: str, *models: str) -> None:
    for model in models:
        with tempfile.TemporaryDirectory() as folder:
            check(densify, Path(modules), Path(model), Path(folder))


def check(densify: str, modules: Path, model: Path, folder: Path) -> None:
    splat_transform, validator = modules / ".bin/splat-transform", modules / "gltf-validator"
    run = lambda *words: subprocess.run([str(word) for word in words], check=True)
    truth = rows(model)
    at, right, up, back = camera(truth)
    path = [component for axis in zip(right, up, back, at) for component in axis] + [0, 0, 0, 1]
    frames, size = folder / "path.json", "x".join(map(str, SIZE))
    frames.write_text(json.dumps({"seconds": 1, "fps": 1, "camera_path": [{"camera_to_world": path, "fov": FOV}]}))
    # splat-transform rotates the PLY's frame by a half turn about z.
    turned = lambda v: ",".join(map(repr, [-v[0], -v[1], v[2]]))
    view = ["--camera-pos", turned(at), "--camera-target", turned([a - b for a, b in zip(at, back)])]
    view += ["--camera-up", turned(up), "--camera-fov", FOV, "--resolution", size]

    def picture(file: Path) -> Path:
        rendered = folder / f"{file.name}.webp"
        run(splat_transform, "-q", "-w", "-g", 0, file, *view, rendered)
        return rendered

    run(densify, "render", model, "--path", frames, "--size", size, "-o", folder / "own")
    of_ply = picture(model)
    between = psnr(next((folder / "own").glob("*.png")), of_ply)
    print(f"{model}, rendered by both: {between:.2f} dB")
    assert between >= LEAST_BETWEEN_RASTERISERS
    read_by_other, read_by_densify = folder / "read_by_other.ply", folder / "read_by_densify.ply"
    for name, least in EXPORTS.items():
        ours, theirs = folder / f"ours.{name}", folder / f"theirs.{name}"
        run(densify, "export", model, "-o", ours)
        run(splat_transform, "-q", "-w", ours, read_by_other)
        compare(truth, rows(read_by_other), f"{ours.name} read by splat-transform")
        run(splat_transform, "-q", "-w", "-g", "cpu", model, theirs)
        quality, their_quality = (psnr(picture(file), of_ply) for file in (ours, theirs))
        print(f"{name}, rendered by splat-transform: {quality:.2f} dB to the PLY; its own export {their_quality:.2f} dB")
        # A model early in training loses more to the format's precision.
        assert quality >= min(least, their_quality)
        run(densify, "export", theirs, "-o", read_by_densify, "--overwrite")
        compare(truth, rows(read_by_densify), f"{theirs.name} read by densify")
    ours, theirs = folder / "ours.glb", folder / "theirs.glb"
    run(densify, "export", model, "-o", ours)
    run("node", Path(__file__).with_name("validate.js"), validator, ours)
    compare(truth, glb_rows(ours), "ours.glb")
    run(splat_transform, "-q", "-w", model, theirs)
    run(densify, "export", theirs, "-o", read_by_densify, "--overwrite")
    compare(truth, rows(read_by_densify), "theirs.glb read by densify")
    print(f"{model}: the same in every format, in both directions")


if __name__ == "__main__":
    main(*sys.argv[1:])
