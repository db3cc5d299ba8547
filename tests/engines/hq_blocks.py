"""Trains a scene in blocks with HyperQueue and without it; the merged models must be identical.

    python3 tests/engines/hq_blocks.py PROGRAM

Needs the package hyperqueue. The package has no command `hq`, so the tasks of the job file, with their dependencies
and resources, are submitted through its API to a server and two workers that this script starts.
"""

import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from hyperqueue import Job, LocalCluster
from hyperqueue.cluster import WorkerConfig
from hyperqueue.ffi.protocol import ResourceRequest


def main(program: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)

        def densify(*words: str) -> str:
            done = subprocess.run([program, *words], capture_output=True, text=True)
            if done.returncode:
                sys.exit(f"densify {' '.join(words)}: {done.stderr}")
            return done.stdout

        scene = scratch / "scene"
        size = "--size 48 --train 24 --test 4 --points 2000"
        densify("scenegen", "--preset", "table", "-o", str(scene), *size.split())
        train = "-i 400 --backend cpu --threads 1 --sh-degree 1"
        for engine in ["local", "hq"]:
            folder = str(scratch / engine)
            blocks = f"plan {scene} -o {folder} --rows 2k --blocks 2x2 --coarse-rows 1k -- {train}"
            densify("blocks", *blocks.split())
        densify("blocks", "submit", str(scratch / "local"))
        folder = scratch / "hq"
        job_file = tomllib.loads(densify("blocks", "submit", str(folder), "--engine", "hq", "--dry-run"))
        (folder / "logs").mkdir()
        job, tasks = Job(name=job_file["name"]), {}
        for task in job_file["task"]:
            (request,) = task["request"]
            tasks[task["id"]] = job.program(
                task["command"],
                deps=[tasks[before] for before in task.get("deps", [])],
                stdout=task["stdout"],
                stderr=task["stderr"],
                resources=ResourceRequest(**request["resources"]),
                crash_limit=task["crash_limit"],
            )
        with LocalCluster() as cluster:
            for _ in range(2):
                cluster.start_worker(WorkerConfig(cores=1))
            client = cluster.client()
            client.wait_for_jobs([client.submit(job)])
        if "6 complete, 0 to go" not in densify("blocks", "status", str(folder)):
            sys.exit(densify("blocks", "status", str(folder)))
        local, hq = [(scratch / engine / "merged.ply").read_bytes() for engine in ["local", "hq"]]
        if local != hq:
            sys.exit("the model trained with HyperQueue differs")
        print(f"the models are identical: {len(hq)} bytes")


main(sys.argv[1])
