"""The cases that golden.py runs, and the intended differences.

In commands, `{data}` is the folder of the test data (DENSIFY_SHARED/data).
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Case:
    """Commands to run one after another in a new folder."""

    name: str
    # Without the program's name; split into words as a shell does.
    commands: tuple[str, ...]
    # Name of a case whose output by the reference program is copied into the folder before either program runs.
    start: str | None = None
    # Files and folders to delete from that copy.
    without: tuple[str, ...] = ()
    needs_gpu: bool = False
    # Expected exit code of the last command; that of the others is 0.
    code: int = 0
    # Parameter of a policy (POLICY.NAME=VALUE) that the tested program needs to do what the reference always does, if
    # the reference does not have it.
    as_before: str | None = None


@dataclass(frozen=True)
class Intended:
    """An intended difference. Shell patterns give the cases and their files."""

    cases: str
    files: str
    # Regular expression of the lines that may differ, before and after the change; None: the whole file may.
    lines: str | None
    reason: str


MEMORY_TABLE = r"^memory promised|MiB\)?$|promised in all$|MiB of --memory$"
INTENDED = [
    Intended("*", "*.out", MEMORY_TABLE, "train prints the table of memory only with -v"),
    Intended("extra/blocks", "*/logs/*.log", MEMORY_TABLE, "train prints the table of memory only with -v"),
    Intended("extra/meshes", "*/scene.json", None, "the notes of the scene generator are in plain English"),
    Intended("*", "*geometry*.json", r'"(weight_before_surface|spread)":', "measurements that the reference lacks"),
    Intended("*", "*.out", r"^(depth spread along rays|weight before the surface)", "measurements that it lacks"),
    Intended("*", "*config.toml", r'^coordinates = "auto"$', "an option that the reference does not have"),
    Intended("*", "*config.toml", r"^remove_floaters = false$", "an option that the reference does not have"),
    Intended("*", "*config.toml", r'^moment_storage = "(f32|auto)"$', "auto, the default, is f32 on the CPU"),
    Intended("*", "*config.toml", r'^pixel_loss = "l1"$', "a parameter that the reference does not have"),
]

SCENES = {"spheres": "scene:spheres", "room256": "{data}/room256", "fox": "{data}/fox -r 8"}
# The policies that use another pixel loss than the reference in scenes with many views.
AS_BEFORE = {policy: f"{policy}.pixel_loss=l1" for policy in ("diet", "merit")}
BACKENDS = {"native": "--backend cpu", "gpu": "--backend gpu --deterministic"}
# The policies of --quick: the default, one that relocates Gaussians, and the original method.
QUICK = ("diet", "mcmc", "vanilla")


def all_cases(policies: list[str]) -> list[Case]:
    """All cases, for the registered policies."""
    return list(training(policies)) + list(resuming(policies)) + list(extras())


def is_quick(case: Case) -> bool:
    """True if --quick includes a case."""
    kind, *rest = case.name.split("/")
    if kind == "extra":
        return True
    if kind == "native":
        return rest[0] in QUICK and rest[1] == "spheres"
    return kind in ("grow", "resume") and rest[-1] in QUICK and "gpu" not in rest


def training(policies: list[str]):
    """All policies on all scenes with both backends, and longer runs from few Gaussians, in which all policies edit."""
    train = "train {} -o run {} --policy {} -b 4k --seed 0 --iterations {}"
    for backend, flags in BACKENDS.items():
        for policy in policies:
            for scene, words in SCENES.items():
                command = train.format(words, flags, policy, 300) + " --eval --checkpoint-every 100"
                yield Case(f"{backend}/{policy}/{scene}", (command,), needs_gpu=backend == "gpu",
                           as_before=AS_BEFORE.get(policy))
    sparse = "scene:spheres --init random --init-points 1500"
    for policy in policies:
        yield Case(f"grow/{policy}", (train.format(sparse, BACKENDS["native"], policy, 1000),),
                   as_before=AS_BEFORE.get(policy))
    yield Case("gpu/diet/grow", (train.format(sparse, BACKENDS["gpu"], "diet", 600),), needs_gpu=True,
               as_before=AS_BEFORE["diet"])


def resuming(policies: list[str]):
    """Runs that resume from a checkpoint written by the reference program in the middle of a run."""
    resume = ("train -o run --resume",)
    without = ("run/checkpoints/iteration_300.safetensors", "run/point_cloud")
    for backend in BACKENDS:
        for policy in policies if backend == "native" else QUICK:
            start = f"{backend}/{policy}/spheres"
            yield Case(f"resume/{backend}/{policy}", resume, start, without, needs_gpu=backend == "gpu")
    without = ("run/checkpoints/iteration_60.safetensors", "run/point_cloud")
    for kind in ("exposure", "freeze", "memory"):
        yield Case(f"extra/resume-{kind}", resume, f"extra/{kind}", without)


def small(more: str = "", preset: str = "spheres", size: int = 48, points: int = 1000) -> str:
    """The command that renders a scene of 16 small images."""
    return f"scenegen --preset {preset} -o scene --size {size} --train 12 --test 4 --points {points} --samples 2 {more}"


def run(output: str, more: str = "", budget: str = "1k", iterations: int = 60, backend: str = "native") -> str:
    """The command that trains on the scene of `small`."""
    return (f"train scene -o {output} {BACKENDS[backend]} -b {budget} --seed 0 --iterations {iterations} "
            f"--checkpoint-every 20 --eval {more}")


MODEL = "model/point_cloud/iteration_60/point_cloud.ply"


def extras():
    """Everything else that refactoring may break, on small scenes: --quick includes all of it."""
    yield Case("extra/lists", ("policies", "policies diet", "knobs", "scenegen --list"))
    yield Case("extra/init", (small(), run("model"), run("run", f"--init {MODEL}"),
                              run("full", f"--init {MODEL} --init-rates full --sh-degree 1", budget="500")))
    yield Case("extra/freeze", (small(), run("model"), run("run", f"--freeze {MODEL}", budget="2k"),
                                run("both", f"--freeze {MODEL} --init {MODEL} --policy mcmc", budget="3k")))
    # Without an explicit budget, --memory would make the budget depend on measured memory.
    yield Case("extra/memory", (small(points=5000), run("run", "--preset tiny-memory --memory 64MiB", budget="4k"),
                                run("knobs", "--knob param_storage=f16 --knob alpha_min=1/64 --image-cache 0")))
    yield Case("extra/presets", (small(), run("exact", "--preset exact"), run("fast", "--preset fast")))
    yield Case("extra/bands", (small(size=96), run("run", "--tile-cap 2000"),
                               run("whole", "--tile-cap 100000 --threads 1")))
    yield Case("extra/masks", (small("--passers-by 0.5"), run("run"), run("inverted", "--invert-masks"),
                               run("carved", "--mask-mode background --background random")))
    yield Case("extra/lens", (small("--lens fisheye:0.02,-0.005"), run("run"), run("kept", "--keep-fov")))
    yield Case("extra/exposure", (small("--exposure-jitter 1"), run("run", "--exposure on"),
                                  run("auto", "--exposure auto --sh-degree auto"),
                                  "eval run --backend cpu --fit-exposure", "export run -o run.ply"))
    yield Case("extra/budget", (small(), run("run", "--policy mcmc", budget="auto:2k", iterations=400),
                                run("scattered", "--init random --background white --near 0.1 --full")))
    yield Case("extra/run", (small(), run("run", "--save-iterations 30 --test-iterations 20,40")))
    yield Case("extra/again", ("train --config run/config.toml -o again --lr mean_start=0.0002",), "extra/run")
    yield Case("extra/eval", ("eval run --backend cpu", "eval run --backend cpu --split train --iteration 30",
                              "eval run/point_cloud/iteration_30/point_cloud.ply --scene scene --backend cpu",
                              "eval run --backend cpu --fail-below psnr=99 --fail-above depth.rmse=0"),
               "extra/run", code=4)
    yield Case("extra/export", ("export run --format all -o all --scene scene --backend cpu",
                                "export run --iteration 30 -o early.spz",
                                *(f"export all/run.{extension} -o again/{extension}.ply"
                                  for extension in ("compressed.ply", "glb", "ply", "sog", "spz", "v4.spz"))),
               "extra/run")
    yield Case("extra/compress", ("compress run --to 500 -o small.ply --iterations 30 --backend cpu",
                                  "compress run --to 30kB -o small.sog --iterations 10 --backend cpu",
                                  "compress run --to 12kB --format any -o any --iterations 10 --backend cpu"),
               "extra/run")
    yield Case("extra/render", ("render run -o pictures --side-by-side --depth --alpha --backend cpu",
                                "render run -o orbit --path orbit --frames 6 --size 40x30 --video orbit.webp "
                                "--depth --backend cpu",
                                "render run -o spiral --path spiral --frames 3 --backend cpu"), "extra/run")
    yield Case("extra/report", ("report run -o report.html",), "extra/run")
    yield Case("extra/plan", (small(), "plan scene --backend cpu -b 4k",
                              "plan scene --backend cpu --memory 64MiB -b 2k",
                              "plan scene --backend cpu -b 1M --preset tiny-memory --exposure on --eval",
                              "plan scene:spheres --backend cpu -b 50k --policy mini-splatting --tile-cap 100k",
                              "plan scene --backend cpu --memory 1MiB"), code=2)
    options = "-- --iterations 120 --backend cpu --threads 1 --sh-degree 1"
    yield Case("extra/blocks", (small(preset="table", points=2000),
                                f"blocks plan scene -o city --rows 2k --blocks 2x2 --coarse-rows 1k {options}",
                                "blocks submit city", "blocks status city", "blocks merge city -o city.spz",
                                f"blocks plan scene -o slurm --bytes 300kB --blocks 2 {options}",
                                "blocks submit slurm --engine slurm --dry-run",
                                "blocks submit slurm --engine hq --dry-run"))
    study = "-b 1k --seeds 2 --iterations 100"
    yield Case("extra/study", (small(), f"compare scene --policies vanilla,eagles {study} -o compare -- --backend cpu",
                               f"trade scene --knobs alpha_min:1/64 {study} -o trade -- --backend cpu"))
    yield Case("extra/meshes", tuple(f"scenegen {mesh} -o {name} --size 48 --train 3 --test 1 --points 200 --samples 1"
                                     for name, mesh in MESHES.items()))
    yield Case("extra/datasets", tuple(f"train {{data}}/{folder} --backend cpu -b 2k --seed 0 --iterations 20 --eval"
                                       for folder in ("beercan -o beercan -r 2", "chair -o chair -r 4", "cup -o cup",
                                                      "office -o office")), as_before=AS_BEFORE["diet"])
    yield Case("extra/models", tuple(f"export {{data}}/splats/{model} -o {place}.ply"
                                     for place, model in enumerate(MODELS)), code=2)
    yield from gpu_extras()


def gpu_extras():
    """The options for which the GPU backend has its own code."""
    def gpu(more: str, budget: str = "1k") -> str:
        return run("run", more, budget, iterations=30, backend="gpu")

    for name, *commands in (
        ("freeze", small(), run("model"), gpu(f"--freeze {MODEL} --policy mcmc", budget="2k")),
        ("bands", small(size=96), gpu("--tile-cap 2000")),
        ("exposure", small("--exposure-jitter 1"), gpu("--exposure on --knob alpha_min=1/64")),
        ("masks", small("--passers-by 0.5"), gpu("--background random"), "eval run --backend gpu",
         "plan scene --backend gpu -b 4k", "render run -o pictures --depth --alpha --backend gpu"),
    ):
        yield Case(f"gpu/extra/{name}", tuple(commands), needs_gpu=True)


MESHES = {
    "suzanne": "{data}/meshes/gltf/IridescenceSuzanne/glTF-Binary/IridescenceSuzanne.glb",
    "sparse": "{data}/meshes/gltf/SimpleSparseAccessor/glTF/SimpleSparseAccessor.gltf",
    "colours": "{data}/meshes/gltf/BoxVertexColors/glTF/BoxVertexColors.gltf",
    "cornell": "{data}/meshes/obj/cornell-box-mcguire/CornellBox-Original.obj",
}
# Models by other programs; the last one is refused.
MODELS = (
    "train-1000.ply",
    "guitar.compressed.ply",
    "playcanvas_test.compressed_sh3.ply",
    "cesium_khr_gaussian_splatting_spz.glb",
    "gsplat-rs/minimal_ascii.ply",
    "gsplat-rs/minimal_binary.ply",
    "gsplat-rs/minimal_v4_degree0.spz",
    "metalsplatter/test-splat.3-points-from-train.splat",
    "metalsplatter/test-splat.3-points-from-train.spz",
    "splat-transform/minimal-raw.spz",
    "splat-transform/minimal-v2.spz",
    "splat-transform/minimal-v4.spz",
    "splat-transform/minimal.splat",
    "splat-transform/minimal.ksplat",
)
