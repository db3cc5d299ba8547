"""Training, stepping and finished runs."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import densify

from .conftest import SMALL, cameras, not_on_windows


def test_a_run_has_scores_curves_and_pictures(run: densify.Run, tmp_path: Path) -> None:
    assert run.scores["PSNR"] > 5.0 and run.summary["iterations"] == 60
    assert run.curves["step"].tolist() == [10, 20, 30, 40, 50, 60] and (run.curves["loss"] > 0).all()
    assert run.config["iterations"] == 60 and run.config["policy"] == "diet"
    assert len(run.model()) == run.summary["rows"] <= 300
    views = list(run.render())
    assert [view.name for view in views] == ["images/00002.png", "images/00004.png"]
    photograph = views[0].photograph
    assert photograph is not None and photograph.shape == views[0].colour.shape
    scores = run.evaluate("train")
    assert set(scores.views) == {f"images/{view:05}.png" for view in (0, 1, 3, 5)}
    assert scores.psnr == pytest.approx(np.mean([view["PSNR"] for view in scores.views.values()]))
    assert (run.folder / "results_train.json").is_file()
    page = run._repr_html_()
    assert page.count("data:image/png") == 2 and "PSNR" in page and "<svg" in page
    assert run.report(tmp_path / "report.html").stat().st_size > 10_000
    with pytest.raises(densify.InputError, match="overwrite=True"):
        run.report(tmp_path / "report.html")
    assert run.report().samefile(run.report())
    assert run.export(tmp_path / "model.sog", progress=False).is_file()


@not_on_windows
def test_text_in_pages_is_escaped(scene: Path, tmp_path: Path) -> None:
    run = densify.train(scene, output=tmp_path / "<b>x", progress=False, **SMALL)
    assert "<b>x" not in run._repr_html_().replace("<b>&lt;b&gt;x", "")


def test_options_are_checked_by_the_same_code(scene: Path, tmp_path: Path) -> None:
    for options, message in [
        ({"iteration": 5}, "did you mean `iterations`"),
        ({"budget": 0}, "budget"),
        ({"budget": "many"}, "budget"),
        ({"iterations": 2.5}, "iterations"),
        ({"iterations": 2**70}, "whole number"),
        ({"seed": 2**63}, "too large"),
        ({"backend": "abacus"}, "backend"),
        ({"knob": {"alpha": 1}}, "alpha"),
        ({"lr": {"quat": -1}}, "quat"),
        ({"test_iterations": [70]}, "70"),
        ({"policy_set": {"diet": {"rho": -1}}}, "rho"),
        ({"scene": tmp_path / "missing"}, "missing"),
    ]:
        with pytest.raises(densify.InputError, match=message) as raised:
            densify.train(**{"scene": scene, "output": tmp_path / "run", "progress": False, **SMALL, **options})
        assert raised.value.code == 2 and "--" not in str(raised.value), raised.value
    for options, error in [({"near": float("nan")}, ValueError), ({"budget": object()}, TypeError)]:
        with pytest.raises(error):
            densify.train(scene, output=tmp_path / "run", **options)  # type: ignore[arg-type]
    with pytest.raises(densify.InputError, match="exclude each other"):
        densify.train(scene, output=tmp_path / "run", resume=True, overwrite=True)
    with pytest.raises(TypeError, match="densify.policy"):
        densify.train(scene, policy=3, output=tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_run_is_kept_unless_told_otherwise(scene: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"output": tmp_path / "run", "progress": False, **SMALL}
    densify.train(scene, **options)
    with pytest.raises(densify.InputError, match="another run"):
        densify.train(scene, **options)
    assert densify.train(scene, overwrite=True, **options).folder == tmp_path / "run"
    with pytest.raises(densify.InputError, match="seed"):
        densify.train(scene, resume=True, output=tmp_path / "run", seed=7, progress=False)


def test_callbacks_and_their_exceptions(scene: Path, tmp_path: Path) -> None:
    steps: list[int] = []
    records: list[int] = []
    tests: list[int] = []
    densify.train(
        scene,
        output=tmp_path / "run",
        progress=False,
        eval=True,
        on_step=lambda step, loss, rows: steps.append(step),
        on_record=lambda record: records.append(record["step"]),
        on_test=lambda step, scores: tests.append(step),
        **SMALL,
    )
    assert steps == list(range(1, 61)) and records == [10, 20, 30, 40, 50, 60] and tests == [60]

    def fail(step: int, loss: float, rows: int) -> None:
        if step == 5:
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        densify.train(scene, output=tmp_path / "failed", progress=False, on_step=fail, **SMALL)
    # The run ended between two steps, with a checkpoint, and can be resumed.
    run = densify.train(scene, output=tmp_path / "failed", resume=True, progress=False)
    assert run.summary["iterations"] == 60 and run.summary["finished"]
    model = "point_cloud/iteration_60/point_cloud.ply"
    assert (run.folder / model).read_bytes() == (tmp_path / "run" / model).read_bytes()


@not_on_windows
def test_ctrl_c_stops_between_two_steps_with_a_checkpoint(scene: Path, tmp_path: Path) -> None:
    def interrupt(step: int, loss: float, rows: int) -> None:
        if step == 7:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(densify.Interrupted, match="SIGINT") as raised:
        densify.train(
            scene, output=tmp_path / "run", progress=False, on_step=interrupt, **{**SMALL, "iterations": 100_000}
        )
    assert isinstance(raised.value, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is before
    assert list((tmp_path / "run" / "checkpoints").glob("iteration_*"))


def test_runs_on_other_threads_leave_the_interpreter_free(scene: Path, tmp_path: Path) -> None:
    done: list[densify.Run] = []
    work = threading.Thread(
        target=lambda: done.append(densify.train(scene, output=tmp_path / "run", progress=False, **SMALL))
    )
    work.start()
    ticks = 0
    while work.is_alive():
        ticks += 1
        work.join(0.001)
    assert done[0].summary["finished"] and ticks > 3


def test_a_trainer_is_stepped(scene: Path, tmp_path: Path) -> None:
    trainer = densify.prepare(scene, output=tmp_path / "run", **SMALL)
    assert not (tmp_path / "run").exists() and trainer.iterations == 60 and trainer.rows == 200
    assert sum(buffer.bytes for buffer in trainer.ledger) >= trainer.total_bytes > 0
    first = trainer.step()
    assert first.step == 1 and first.rows == 200 and np.isfinite(first.loss) and first.name.endswith(".png")
    view = trainer.render(cameras(3)[1])
    assert view.colour.shape == (24, 32, 3)
    for step in trainer:
        if step.step == 20:
            trainer.stop()
            break
    with pytest.raises(densify.Interrupted, match="step 20"):
        list(trainer)
    # The request is answered, so the loop can be entered again.
    assert next(iter(trainer)).step == 21
    with pytest.raises(densify.InputError, match=r"trainer\.model\(\)\.render"):
        trainer.render(cameras(3, 64, 48)[1])
    assert len(trainer.model()) == trainer.rows and trainer.config["iterations"] == 60
    whole = densify.prepare(scene, output=tmp_path / "whole", **SMALL)
    assert [step.step for step in whole] == list(range(1, 61))
    run = densify.prepare(scene, output=tmp_path / "run", **SMALL).finish(progress=False)
    model = run.model()
    assert (model.means == whole.model().means).all() and (model.sh == whole.model().sh).all()
    stopped = densify.prepare(scene, output=tmp_path / "stopped", **SMALL)
    stopped.stop()
    with pytest.raises(densify.Interrupted):
        stopped.finish(progress=False)
    assert not stopped._stop.asked
    with pytest.raises(TypeError):
        densify.Trainer()
    with pytest.raises(TypeError):
        pickle.dumps(whole)


def test_a_trainer_that_has_failed_does_not_continue(scene: Path) -> None:
    from .made import make

    policy = make("fails_at_once", lambda now, rng, plan: 1 / 0)
    trainer = densify.prepare(scene, policy=policy, **SMALL)
    with pytest.raises(densify.PolicyError, match="division by zero") as raised:
        list(trainer)
    assert isinstance(raised.value.__cause__, ZeroDivisionError) and trainer
    for _ in range(2):
        with pytest.raises(RuntimeError, match="cannot continue: a step has failed"):
            trainer.step()
    # What was trained remains.
    assert len(trainer.model()) == trainer.rows == 200 and trainer.render(cameras(1)[0]).colour.shape == (24, 32, 3)


@not_on_windows
def test_ctrl_c_while_a_trainer_is_stepped(scene: Path) -> None:
    from .made import make

    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    trainer = densify.prepare(scene, policy=make("kills", plan), **SMALL)
    for loop in (lambda: list(trainer), lambda: [trainer.step() for _ in range(50)]):
        done = trainer.steps_done
        with pytest.raises(densify.Interrupted):
            loop()
        assert trainer.steps_done == done + 10 and signal.getsignal(signal.SIGINT) is before
    # A suspended loop leaves Ctrl-C to the program.
    loop_over = iter(trainer)
    next(loop_over)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_stepped_run_is_saved_and_resumed(scene: Path, tmp_path: Path) -> None:
    model = "point_cloud/iteration_60/point_cloud.ply"
    whole = densify.train(scene, output=tmp_path / "whole", progress=False, **SMALL)
    folder = tmp_path / "run"
    trainer = densify.prepare(scene, output=folder, **SMALL)
    for step in trainer:
        if step.step in (17, 25):
            assert trainer.save_checkpoint() == folder == trainer.save_checkpoint()
        if step.step == 30:
            break
    # Step 30 is not saved: the resumed run does steps 26 to 30 again.
    shutil.copytree(folder, tmp_path / "copy")
    resumed = densify.prepare(output=folder, resume=True)
    assert resumed.steps_done == 25 and resumed.iterations == 60
    assert [step.step for step in resumed] == list(range(26, 61))
    assert (resumed.model().means == whole.model().means).all()
    assert resumed.finish(progress=False).folder == folder
    assert (folder / model).read_bytes() == (whole.folder / model).read_bytes()
    # The first trainer would overwrite what the second one has done.
    for use in (trainer.save_checkpoint, lambda: trainer.finish(progress=False)):
        with pytest.raises(densify.InputError, match="another program has continued.* resume=True"):
            use()
    # A whole run and the command continue as well, and a saved trainer ends in its own folder.
    run = densify.train(output=tmp_path / "copy", resume=True, progress=False)
    assert (run.folder / model).read_bytes() == (whole.folder / model).read_bytes()
    third = densify.prepare(scene, output=tmp_path / "third", **SMALL)
    third.step()
    third.save_checkpoint()
    third.step()
    run = third.finish(progress=False)
    assert (run.folder / model).read_bytes() == (whole.folder / model).read_bytes()
    # Another run, and a folder that cannot be made, stay as they are; the trainer is not lost.
    before = sorted(path.name for path in whole.folder.iterdir())
    with pytest.raises(densify.InputError, match="another run; continue it with resume=True"):
        densify.prepare(scene, output=whole.folder, **SMALL)
    other = densify.prepare(scene, output=tmp_path / "file" / "run", **SMALL)
    (tmp_path / "file").touch()
    with pytest.raises(densify.DensifyError, match="file"):
        other.save_checkpoint()
    assert other.step().step == 1
    assert sorted(path.name for path in whole.folder.iterdir()) == before


def test_a_stepped_run_has_the_records_of_a_whole_one(scene: Path, tmp_path: Path) -> None:
    from .made import make

    policy = make("prunes_the_first", lambda now, rng, plan: plan.prune([0]))
    options: dict[str, Any] = {**SMALL, "eval": True, "policy": policy}
    whole = densify.train(scene, output=tmp_path / "whole", progress=False, **options)
    trainer = densify.prepare(scene, output=tmp_path / "run", **options)
    for step in trainer:
        if step.step == 25:
            trainer.save_checkpoint()
    # A step beyond the end would have no model.
    with pytest.raises(RuntimeError, match="trained to the end"):
        trainer.step()
    run = trainer.finish(progress=False)
    assert run.events == whole.events and len(run.events) > 3
    for name in ("step", "loss", "l1", "ssim", "rows"):
        assert (run.curves[name] == whole.curves[name]).all(), name
    assert run.scores == whole.scores and run.tests == {60: run.scores}
    assert run.summary["seconds"] > 0 and (np.diff(run.curves["seconds"]) > 0).all()


def test_objects_are_short_in_a_notebook(run: densify.Run, scene: Path) -> None:
    view = next(run.render())
    assert repr(view) == "<densify.Rendering images/00002.png 32x24>" and view._repr_png_().startswith(b"\x89PNG")
    for shown in (run.evaluate(), densify.plan(scene, budget=500, backend="cpu"), densify.policies()[0]):
        assert len(repr(shown)) < 500, shown
    known = {signal.name: signal for signal in densify.signals()}
    assert known["weight_max_root"].meaning.startswith("Sum over views of √w") and known["position"].width == 3
    assert not any("[" in signal.meaning and "](" in signal.meaning or "`" in signal.meaning for signal in known.values())


def test_progress_ends_with_the_last_step(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from densify import _progress

    drawn: list[str] = []
    monkeypatch.setattr(_progress.Listener, "_draw", lambda self: drawn.append(self._text))
    densify.train(scene, output=tmp_path / "run", **SMALL)
    assert drawn[-1].startswith("step 60/60 ") and len(drawn) < 30


@not_on_windows
def test_ctrl_c_in_a_loop_writes_a_checkpoint(scene: Path, tmp_path: Path) -> None:
    from .made import make

    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    trainer = densify.prepare(scene, policy=make("interrupts", plan), output=tmp_path / "run", **SMALL)
    with pytest.raises(densify.Interrupted, match="step 10; resume=True continues from the checkpoint in .*run"):
        list(trainer)
    assert densify.prepare(output=tmp_path / "run", resume=True).steps_done == 10


def test_ctrl_c_while_a_run_is_measured(run: densify.Run) -> None:
    from densify import _densify, _opened, _progress

    opened = _opened._open(run, None, None, None, {"backend": "cpu"})
    stop = _densify.Stop()
    stop.ask(by_signal=True)
    with pytest.raises(densify.Interrupted, match="SIGINT"):
        opened.evaluate("test", lpips=None, fit_exposure=False, listener=_progress.Listener(False), stop=stop)


def test_options_without_effect_are_refused(run: densify.Run, scene: Path, tmp_path: Path) -> None:
    for option in ({"iterations": 7}, {"resolution": 8}, {"near": 0.1}):
        (name,) = option
        for call in (densify.evaluate, densify.render, densify.view):
            with pytest.raises(densify.InputError, match=f"`{name}` has no effect"):
                call(run, backend="cpu", **option)  # type: ignore[operator]
    with pytest.raises(densify.InputError, match="`resolution` has no effect"):
        densify.compress(run, tmp_path / "small.ply", to=100, progress=False, resolution=2)
    model = run.export(tmp_path / "model.ply", progress=False)
    assert densify.evaluate(model, scene=scene, resolution=2, backend="cpu").psnr > 1.0
    with pytest.raises(densify.InputError, match="`budget` has no effect"):
        densify.evaluate(model, scene=scene, budget=7)


def test_a_run_is_opened_without_its_policies(run: densify.Run, tmp_path: Path) -> None:
    """A run may come from a stranger: only training imports the Python files that it names."""
    folder = tmp_path / "run"
    shutil.copytree(run.folder, folder)
    config, file, mark = folder / "config.toml", tmp_path / "policies.py", tmp_path / "imported"
    file.write_text(f"open({os.fspath(mark)!r}, 'w').close()\n")
    lines = [line for line in config.read_text().splitlines() if not line.startswith("policy_file")]
    config.write_text("\n".join([f"policy_file = [{json.dumps(os.fspath(file))}]", *lines]) + "\n")
    opened = densify.Run(folder)

    def use() -> None:
        assert opened.config["policy_file"] == [os.fspath(file)]
        assert opened.evaluate().psnr > 1.0 and len(list(opened.render())) == 2
        opened.report()
        densify.compress(opened, tmp_path / "s.ply", to=50, iterations=1, progress=False, overwrite=True)
        densify.view(opened, backend="cpu").close()

    use()
    assert not mark.exists()
    file.unlink()
    use()
    # The file is read each time, as a run in training changes it.
    config.write_text(config.read_text().replace("iterations = 60", "iterations = 61"))
    assert opened.config["iterations"] == 61


def test_a_trainer_in_use_by_another_thread(scene: Path) -> None:
    from .made import make

    seen: list[str] = []

    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        try:
            trainer.model()
        except RuntimeError as error:
            seen.append(str(error))

    trainer = densify.prepare(scene, policy=make("reenters", plan), **SMALL)
    list(trainer)
    assert seen == ["the trainer is in use by another thread"] * 6 and trainer.steps_done == 60


def test_memory_is_planned(scene: Path) -> None:
    planned = densify.plan(scene, budget=1000, backend="cpu")
    assert planned.total_bytes <= sum(buffer.bytes for buffer in planned.ledger)
    assert planned.rows and "budget" in str(planned)
    plain = densify.plan(scene, budget=100_000, policy="vanilla", backend="cpu").total_bytes
    from .vanilla_in_python import Vanilla

    # The copies that Python makes of the signals are a part of the promise.
    assert densify.plan(scene, budget=100_000, policy=Vanilla, backend="cpu").total_bytes > plain + 100_000 * 4 * 4


def test_another_checkpoint_is_refused(scene: Path, tmp_path: Path) -> None:
    run = densify.train(scene, output=tmp_path / "run", progress=False, **SMALL)
    (checkpoint,) = (run.folder / "checkpoints").iterdir()
    data = checkpoint.read_bytes()
    other_version = data.replace(b'"densify.version":"2"', b'"densify.version":"1"')
    assert other_version != data
    for damaged in (pickle.dumps([1, 2, 3]), data[:100], other_version):
        checkpoint.write_bytes(damaged)
        with pytest.raises(densify.InputError):
            densify.train(scene, output=run.folder, resume=True, iterations=70, progress=False)


def test_scenes_are_generated_and_compressed(tmp_path: Path) -> None:
    scene = densify.scenegen(
        "scene:spheres", tmp_path / "scene", size=(32, 24), train=6, test=2, grid=1, points={"count": 300}
    )
    assert (scene / "transforms_train.json").is_file()
    with pytest.raises(densify.InputError, match="did you mean `train`"):
        densify.scenegen("scene:spheres", tmp_path / "other", trainn=3)
    with pytest.raises(densify.InputError):
        densify.scenegen("scene:spheres", tmp_path / "scene")
    run = densify.train(scene, output=tmp_path / "run", progress=False, iterations=20, budget=300, backend="cpu")
    made = densify.compress(run, tmp_path / "small.ply", to=100, iterations=5, progress=False, backend="cpu")
    assert made.written.rows == len(densify.Model.load(made.file)) == 100
    with pytest.raises(ValueError, match="20k"):
        densify.compress(run, tmp_path / "other.ply", to="much")
    scores = densify.evaluate(made.file, scene=scene, backend="cpu")
    assert len(scores.views) == 2 and scores.geometry is not None
    with pytest.raises(densify.InputError, match="scene="):
        densify.evaluate(made.file)


def test_a_page_is_served(run: densify.Run) -> None:
    with densify.view(run, backend="cpu") as page:
        assert b"<html" in urllib.request.urlopen(page.url, timeout=10).read().lower()
        assert page.url in page._repr_html_()
    page.close()


def test_folders_that_are_no_runs(tmp_path: Path) -> None:
    with pytest.raises(densify.InputError, match="config.toml"):
        densify.Run(tmp_path)
    with pytest.raises(densify.InputError):
        densify.evaluate(tmp_path)


@not_on_windows
def test_the_command_is_the_same_program(run: densify.Run) -> None:
    def command(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-m", "densify", *words], capture_output=True, text=True)

    assert command("--version").stdout == f"densify {densify.__version__}\n"
    done = command("eval", os.fspath(run.folder), "--backend", "cpu")
    assert done.returncode == 0 and "mean" in done.stdout
    for words, code in [(["train"], 2), (["eval", "/no/such/run"], 2), (["--help"], 0), (["policies", "diet"], 0)]:
        assert command(*words).returncode == code, words
    scene = run.config["scene"]
    long = ["train", scene, "-o", os.fspath(run.folder.parent / "long"), "--budget", "300", "--iterations", "1000000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "densify", *long],
        stdout=subprocess.DEVNULL,
    )
    log = run.folder.parent / "long" / "stats" / "train.jsonl"
    while not (log.is_file() and log.stat().st_size > 0):
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
