"""Policies written in Python: they plan as those in Rust, and mistakes are exceptions of the usual types."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import densify

from .conftest import SMALL
from .made import EXAMPLES, MANUAL, fails, make, train
from .vanilla_in_python import Vanilla

sys.path.insert(0, str(EXAMPLES))

from steady import Steady  # noqa: E402


@pytest.mark.parametrize(
    "settings",
    [
        {"tau": 1e-5, "grow_every": 10, "grow_from": 5, "grow_until": 55, "reset_every": 25},
        {"governor": True, "grow_every": 10, "grow_from": 5, "grow_until": 55, "max_scale_from": 20},
    ],
)
def test_vanilla_in_python_gives_the_bytes_of_vanilla_in_rust(
    scene: Path, tmp_path: Path, settings: dict[str, Any]
) -> None:
    ours = train(scene, Vanilla(**settings), tmp_path / "a")
    theirs = train(scene, "vanilla", tmp_path / "b", policy_set={"vanilla": settings})
    assert ours.events == theirs.events and any(event["added"] for event in ours.events)
    model = "point_cloud/iteration_60/point_cloud.ply"
    assert (ours.folder / model).read_bytes() == (theirs.folder / model).read_bytes()


def test_a_policy_of_40_lines_does_what_that_in_rust_does(scene: Path, tmp_path: Path) -> None:
    lines = [line for line in (EXAMPLES / "steady.py").read_text().splitlines() if line.strip()]
    assert len(lines[lines.index("import numpy as np") :]) <= 40
    run = train(scene, Steady(grow_every=10, grow_until=60), tmp_path / "run", budget=220)
    # As in tests/outside_policy: ten of 200 rows are split per event until the budget is reached.
    assert [event["cause"] for event in run.events] == ["steady"] * 5
    assert [event["after"] for event in run.events] == [210, 220, 220, 220, 220]
    assert any(event["denied"] for event in run.events)


def test_policies_conform_and_are_listed() -> None:
    for policy in (Steady, Vanilla):
        densify.check_policy(policy)
    info = next(info for info in densify.policies() if info.name == "steady")
    assert info.parameters == {"grow_every": "100", "grow_until": "15000"}
    assert info.manual.startswith("# steady") and "steady.py:" in info.place
    with pytest.raises(densify.DensifyError, match="leaves at least one row"):
        densify.check_policy(make("all_gone", lambda now, rng, plan: plan.prune(range(now.rows))))
    reads_undeclared = make("undeclared", lambda now, rng, plan: now["age"])
    with pytest.raises(densify.DensifyError, match="age was read but not declared"):
        densify.check_policy(reads_undeclared)


def test_ranges_of_the_manual_page_are_enforced(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(densify.InputError, match="`steady.grow_every`: 0 is out of range"):
        train(scene, Steady(grow_every=0), tmp_path / "run")
    with pytest.raises(densify.InputError, match="did you mean `grow_every`"):
        train(scene, "steady", tmp_path / "run", policy_set={"steady": {"grow_evry": 1}})
    with pytest.raises(densify.InputError, match="did you mean `steady`"):
        train(scene, "steadi", tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_classes_that_cannot_be_policies_are_refused() -> None:
    def register(name: str = "refused", **members: Any) -> None:
        plan = {"needs": lambda self, scene: None, "is_due": None, "plan": lambda self, *event: None}
        plan["is_due"] = lambda self, step: True
        body = {"__doc__": MANUAL, "__annotations__": {"every": int}, "every": 10, **plan, **members}
        densify.policy(name, summary="", source="")(type("Refused", (), body))

    for members, error, message in [
        ({"__doc__": None}, ValueError, "docstring"),
        ({"__doc__": "# no table"}, ValueError, "no row for the parameter `every`"),
        ({"__doc__": MANUAL.replace("10", "20")}, ValueError, "default 10, not 20"),
        ({"__doc__": MANUAL.replace(">= 1", "some")}, ValueError, "range `some`"),
        ({"__doc__": MANUAL + "| x | 1 | | | |\n"}, ValueError, "`x` is not a parameter"),
        ({"every": [1]}, (TypeError, ValueError), "every|list"),
        ({"plan": None}, TypeError, "no method `plan`"),
        ({"name": "diet"}, ValueError, "`diet` is registered twice"),
    ]:
        with pytest.raises(error, match=message):
            register(members.pop("name", "refused"), **members)
    assert all(info.name != "refused" for info in densify.policies())


def test_the_same_class_again_replaces(scene: Path, tmp_path: Path) -> None:
    make("again", lambda now, rng, plan: plan.cause("first"))
    make("again", lambda now, rng, plan: (plan.prune([0]), plan.cause("second")))
    assert {event["cause"] for event in train(scene, "again", tmp_path / "run").events} == {"second"}

    class Other:
        __doc__ = MANUAL
        every: int = 10

        def needs(self, scene: densify.Scene) -> densify.Needs:
            return densify.Needs()

        def is_due(self, step: int) -> bool:
            return False

        def plan(self, now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
            pass

    with pytest.raises(ValueError, match="registered twice"):
        densify.policy("again", summary="", source="")(Other)


def test_a_class_that_cannot_be_constructed_ends_the_run_before_it_begins(scene: Path, tmp_path: Path) -> None:
    def broken(self: Any) -> None:
        raise RuntimeError("no licence")

    policy = make("unmade", lambda now, rng, plan: None, __post_init__=broken)
    with pytest.raises(densify.InputError, match="no licence") as raised:
        train(scene, policy, tmp_path / "run")
    assert isinstance(raised.value.__cause__, RuntimeError) and not (tmp_path / "run").exists()
    for needs, message in [
        ({"signals": ["opaciti"]}, "opaciti"),
        ({"least_resolution": 2.0}, "least_resolution is 2"),
        ({"full_depth": float("nan")}, "JSON"),
        ({"scratch_bytes": 2**64 - 1}, "scratch_bytes"),
    ]:
        policy = make("unmade", lambda now, rng, plan: None, needs=needs, signals=needs.pop("signals", ()))
        with pytest.raises(densify.InputError, match=message):
            train(scene, policy, tmp_path / "run")


def test_inputs_are_copies_that_cannot_be_written(scene: Path, tmp_path: Path) -> None:
    kept: list[Any] = []
    names = ("opacity", "position", "orientation", "visible_count")

    def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        assert now["opacity"].shape == (now.rows,) and now["orientation"].shape == (now.rows, 4)
        for name in names:
            assert now[name].dtype == np.float32
            with pytest.raises(ValueError, match="read-only"):
                now[name][0] = 1.0
            # Unlocking a copy harms nothing.
        with pytest.raises(KeyError, match="did you mean `opacity`"):
            now["opacitie"]  # type: ignore[index]
        with pytest.raises(KeyError, match="not declared"):
            now["age"]
        kept.append((now, now["opacity"], now["opacity"].copy(), plan, rng))
        plan.prune([0])

    train(scene, make("keeps", plan, signals=names), tmp_path / "run")
    assert len(kept) == 6
    for now, opacity, copy, plan_object, rng in kept:
        assert (opacity == copy).all() and (now["opacity"] == copy).all()
        with pytest.raises(RuntimeError, match="the event of this plan is over"):
            plan_object.prune([0])
        assert rng.uniform(3).shape == (3,)


def test_random_numbers_depend_on_the_seed_and_the_step(scene: Path, tmp_path: Path) -> None:
    def draws(folder: str, seed: int) -> list[Any]:
        drawn: list[Any] = []

        def plan(now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
            rows, counts = rng.draw(now["opacity"], 50)
            calls = [rng.uniform(50), rng.uniform(50), rng.normal(50)[:, 0], rng.normal(50)[:, 0]]
            assert np.abs(np.corrcoef(calls) - np.eye(4)).max() < 0.6
            assert counts.sum() == 50 and rng.normal().shape == (now.rows, 3)
            chosen = rng.choice(now["opacity"], 5)
            drawn.append((rng.uniform(4).tolist(), rows.tolist(), chosen.tolist(), rng.generator().random()))

        train(scene, make("draws", plan, every=30), tmp_path / folder, seed=seed)
        return drawn

    first = draws("a", 1)
    assert first == draws("b", 1) and first != draws("c", 2) and first[0] != first[1]


def test_state_is_saved_and_restored(scene: Path, tmp_path: Path) -> None:
    def plan(self: Any, now: Any, rng: Any, plan: densify.Plan) -> None:
        self.count += 1
        self.log.append(now.step)
        plan.prune(np.arange(now.rows)[1:2])
        plan.cause(f"event{self.count}")

    counted = make("counted", plan, count=densify.state(0), log=densify.state([]))
    whole = train(scene, counted, tmp_path / "whole")
    train(scene, counted, tmp_path / "parts", iterations=60, checkpoint_every=25)
    # A second process would not find the class, but this one does.
    for checkpoint in (tmp_path / "parts" / "checkpoints").glob("iteration_60*"):
        checkpoint.unlink()
    resumed = densify.train(output=tmp_path / "parts", scene=scene, policy=counted, resume=True, progress=False)
    assert [event["cause"] for event in resumed.events] == [f"event{n}" for n in range(1, 7)]
    model = "point_cloud/iteration_60/point_cloud.ply"
    assert (resumed.folder / model).read_bytes() == (whole.folder / model).read_bytes()
    densify.check_policy(counted)


def test_state_that_is_not_json_ends_the_run(scene: Path, tmp_path: Path) -> None:
    for number, value in enumerate([object(), float("nan"), {1: 2}, np.zeros(3), 2**70, b"bytes"]):

        def plan(self: Any, now: Any, rng: Any, plan: Any) -> None:
            self.count = value

        with pytest.raises(densify.PolicyError, match="state `count`"):
            train(scene, make("stateful", plan, count=densify.state(0)), tmp_path / str(number))


def test_state_is_after_an_event_what_a_resume_restores(scene: Path, tmp_path: Path) -> None:
    seen: list[Any] = []

    def plan(self: Any, now: Any, rng: Any, plan: Any) -> None:
        seen.append((list(self.table), self.one is self.two))
        self.table = {"b": 1, "a": 2}
        self.one = self.two = [1]

    members = {"table": densify.state({}), "one": densify.state([]), "two": densify.state([])}
    train(scene, make("orders", plan, **members), tmp_path / "run")
    assert seen == [([], False)] + [(["a", "b"], False)] * 5
    deep: Any = []
    for _ in range(200):
        deep = [deep]
    for number, value in enumerate(["\ud800", deep]):

        def unparsable(self: Any, now: Any, rng: Any, plan: Any) -> None:
            self.count = value

        with pytest.raises(densify.PolicyError, match="the state cannot be saved"):
            train(scene, make("unparsable", unparsable, count=densify.state(0)), tmp_path / f"bad{number}")


def test_a_subclass_is_a_policy_only_if_it_is_decorated(scene: Path, tmp_path: Path) -> None:
    class Undecorated(Steady):
        pass

    for policy in (Undecorated, Undecorated()):
        with pytest.raises(TypeError, match="@densify.policy"):
            train(scene, policy, tmp_path / "run")

    @densify.policy("often", summary="a test", source="a test")
    class Often(Steady):
        """# often

        | name | default | range | unit | meaning |
        |---|---|---|---|---|
        | grow_every | 100 | >= 1 | steps | interval |
        | grow_until | 15000 | >= 0 | step | end (exclusive) |
        | more | 2 | >= 0 | | more |
        """

        more: int = 2

    info = next(info for info in densify.policies() if info.name == "often")
    assert info.parameters == {"grow_every": "100", "grow_until": "15000", "more": "2"}
    assert Often(more=3).more == 3


def test_copies_of_candidates_are_planned(scene: Path) -> None:
    def bytes_of(capacity: int) -> int:
        wanted = densify.Candidates(from_=1, until=50, rows_per_candidate=10, capacity=capacity)
        policy = make("collects", lambda now, rng, plan: None, needs={"candidates": wanted})
        return densify.plan(scene, policy=policy, budget=300, backend="cpu").total_bytes

    # Once in the backend's list, and once in the copy that an event takes.
    assert bytes_of(3_000_000) - bytes_of(1_000_000) == 2 * 32 * 2_000_000


def test_other_attributes_cannot_be_set(scene: Path, tmp_path: Path) -> None:
    def plan(self: Any, now: Any, rng: Any, plan: Any) -> None:
        self.memory = 1

    assert isinstance(fails(scene, plan, tmp_path / "run").__cause__, AttributeError)


def test_the_pickle_of_another_program_is_no_state() -> None:
    from densify import _policy

    policy = make("pickled", lambda now, rng, plan: None, count=densify.state(0))()
    for text in ["null", "[1]", '{"other": 1}', '{"count": 1, "more": 2}']:
        with pytest.raises(ValueError):
            _policy.restore_state(policy, text)
    _policy.restore_state(policy, '{"count": 7}')
    _policy.restore_state(policy, '{"count": 0.5}')
    assert policy.count == 0.5
    _policy.restore_state(policy, '{"count": 7}')
    assert policy.count == 7 and json.loads(_policy.state_of(policy) or "") == {"count": 7}


def test_schedules_and_views(scene: Path, tmp_path: Path) -> None:
    seen: list[Any] = []
    aux = densify.Aux(columns=["weight_max", "pixel_count"], map=densify.PixelMap(error=1.0), points=5)

    def observe(self: Any, view: densify.View) -> None:
        with pytest.raises(KeyError, match="not declared"):
            view["depth"]
        seen.append((view.step, len(view.points), view["weight_max"].shape == (view.rows,), view.loss > 0))

    policy = make(
        "schedules",
        lambda now, rng, plan: plan.prune([0]),
        needs={
            "aux": aux,
            "cadence": densify.Cadence(all=2),
            "pixel_loss": "huber",
            "loss_terms": densify.LossTerms(opacity=0.01),
            "noise": densify.NoiseTerm(1.0, 100.0, 0.005),
            "least_resolution": 0.5,
        },
        every=30,
        observe=observe,
        aux_views=lambda self, step, rows, budget: 2,
        cadence=lambda self, step: densify.Cadence(all=1 + step % 2),
        loss_terms=lambda self, step: densify.LossTerms(opacity=0.01 / step),
        noise=lambda self, step: None if step > 30 else densify.NoiseTerm(1.0, 100.0, 0.005),
        resolution=lambda self, step: 0.5 if step < 20 else 1.0,
    )
    train(scene, policy, tmp_path / "run")
    assert seen == [(30, 5, True, True)] * 2 + [(60, 5, True, True)] * 2
    for name, answer, message in [
        ("cadence", lambda self, step: 3, "densify.Cadence"),
        ("resolution", lambda self, step: 2.0, "resolution is 2"),
        ("is_due", lambda self, step: "maybe" if step == 7 else False, "bool"),
        ("noise", lambda self, step: None if step < 5 else 1 / 0, "division by zero"),
    ]:
        policy = make("schedules", lambda now, rng, plan: None, **{name: answer})
        with pytest.raises(densify.DensifyError, match=message):
            train(scene, policy, tmp_path / name)


def test_a_single_policy_file_needs_no_list(scene: Path, tmp_path: Path) -> None:
    file = EXAMPLES / "steady.py"
    for name, given in (("text", str(file)), ("path", file), ("list", [str(file)])):
        run = train(scene, "steady", tmp_path / name, policy_file=given)
        assert run.config["policy_file"] == [str(file.resolve())]


def test_a_run_is_the_same_in_another_process(scene: Path, tmp_path: Path) -> None:
    """The command knows the policies of a file, trains with them, and resumes their runs."""
    words = [sys.executable, "-m", "densify"]
    folder = tmp_path / "run"
    options = ["--iterations", "60", "--budget", "220", "--init", "random", "--init-points", "200", "--quiet"]
    file = ["--policy", "steady", "--policy-file", str(EXAMPLES / "steady.py")]
    settings = ["--policy-set", "steady.grow_every=10", "--policy-set", "steady.grow_until=60"]
    done = subprocess.run(
        [*words, "train", str(scene), "-o", str(folder), *file, *settings, *options, "--backend", "cpu"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    here = train(scene, Steady(grow_every=10, grow_until=60), tmp_path / "here", budget=220)
    model = "point_cloud/iteration_60/point_cloud.ply"
    assert (folder / model).read_bytes() == (here.folder / model).read_bytes()
    longer = [*words, "train", str(scene), "-o", str(folder), "--resume", "--iterations", "70", "--quiet"]
    done = subprocess.run(longer, capture_output=True, text=True)
    assert done.returncode == 0 and (folder / "point_cloud" / "iteration_70").is_dir(), done.stderr
    for wrong, message in [("missing.py", "there is no file"), ("no_such_module", "No module named")]:
        done = subprocess.run([*words, "train", "x", "--policy-file", wrong], capture_output=True, text=True)
        assert done.returncode == 2 and message in done.stderr, done.stderr


def test_trade_measures_knobs_under_a_python_policy(scene: Path, tmp_path: Path) -> None:
    study = ["trade", str(scene), "--knobs", "alpha_min:1/64", "--seeds", "1", "-i", "30", "-b", "220"]
    options = ["--policy", "steady", "--policy-file", str(EXAMPLES / "steady.py"), "--init", "random"]
    done = subprocess.run(
        [sys.executable, "-m", "densify", *study, "-o", str(tmp_path / "trade"), "--", *options, "--test-every", "3"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "alpha_min" in done.stdout, done.stdout + done.stderr
    runs = [json.loads(line) for line in (tmp_path / "trade" / "trade.jsonl").read_text().splitlines()]
    assert len(runs) == 2 and (tmp_path / "trade" / "trade.html").is_file()
    (config, *_) = (tmp_path / "trade").rglob("config.toml")
    assert 'policy = "steady"' in config.read_text()


def test_the_plug_in_of_pytest_runs_the_conformance_suite(tmp_path: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pytest", "-q", str(tmp_path), *words]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    done = run("--densify", str(EXAMPLES / "steady.py"))
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
    broken = tmp_path / "broken.py"
    text = (EXAMPLES / "steady.py").read_text().replace('"steady"', '"broken"')
    broken.write_text(
        text.replace('plan.prune(densify.spare_one(faint, now["opacity"]))', "plan.prune(range(now.rows))")
    )
    done = run("--densify", str(broken))
    assert done.returncode == 1 and "leaves at least one row" in done.stdout, done.stdout + done.stderr
    assert run("--densify", "missing.py").returncode == 4


def test_a_file_that_starts_a_run_when_it_is_imported_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "runs.py"
    output = tmp_path / "run"
    file.write_text(
        f"import densify\ndensify.train('scene:spheres', iterations=1, budget=300, output={str(output)!r})\n"
    )
    with pytest.raises(densify.InputError, match="__main__"):
        densify.import_policies(str(file))


def test_a_resumed_run_notes_that_its_policy_has_changed(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "changing.py"
    file.write_text((EXAMPLES / "steady.py").read_text().replace('"steady"', '"changing"'))
    folder = tmp_path / "run"
    options = {"policy": "changing", "policy_file": [str(file)], "output": folder, **SMALL}
    densify.train(scene, progress=False, **options)
    saved = densify.Run(folder).config["resolved"]["policy"]
    assert f"numpy {np.__version__}, changing.py with SHA-256" in saved
    file.write_text(file.read_text() + "# changed\n")
    words = ["train", str(scene), "-o", str(folder), "--resume", "--iterations", "70"]
    done = subprocess.run([sys.executable, "-m", "densify", *words], capture_output=True, text=True)
    assert done.returncode == 0 and f"the policy was {saved}, and is now" in done.stdout, done.stdout


def test_comparison_of_a_class(scene: Path, tmp_path: Path) -> None:
    compared = densify.compare(
        scene,
        [Steady(grow_every=10), "vanilla"],
        budget=220,
        seeds=1,
        iterations=20,
        output=tmp_path / "comparison",
        progress=False,
        threads=2,
        backend="cpu",
    )
    assert "steady" in compared.summary and compared.page.is_file() and len(compared.runs) == 2
    local = make("local", lambda now, rng, plan: None)
    local.__densify_policy__ = type(local.__densify_policy__)("local", None)  # type: ignore[attr-defined]
    with pytest.raises(densify.InputError, match="not in a file"):
        densify.compare(scene, [local], budget=220)


def test_a_policy_by_name_brings_its_file(scene: Path, tmp_path: Path) -> None:
    file = tmp_path / "named.py"
    file.write_text((EXAMPLES / "steady.py").read_text().replace('"steady"', '"named"'))
    densify.import_policies(str(file))
    assert train(scene, "named", tmp_path / "run").config["policy_file"] == [str(file.resolve())]
    compared = densify.compare(
        scene,
        ["named:grow_every=10", "vanilla"],
        budget="0.22k",
        seeds=1,
        iterations=20,
        output=tmp_path / "comparison",
        progress=False,
        threads=2,
        backend="cpu",
    )
    assert "named" in compared.summary and len(compared.runs) == 2
    with pytest.raises(ValueError, match="200k"):
        densify.compare(scene, ["named"], budget="much", output=tmp_path / "other")


def test_a_comparison_takes_memory_hours_and_a_rule(scene: Path, tmp_path: Path) -> None:
    def compare(**options: Any) -> densify.Comparison:
        output, short = tmp_path / "limits", {"iterations": 20, "progress": False, "threads": 2, "backend": "cpu"}
        return densify.compare(scene, ["vanilla", "diet"], output=output, **short, **options)

    # Runs are other processes, so what this one holds does not count.
    held = np.ones(20_000_000)
    compared = compare(memory={scene.name: "120MiB"}, seeds=1, hours=24)
    del held
    assert [run["memory"] for run in compared.runs] == [120 << 20] * 2
    decided = compare(budget=220, until_decided="mean", max_seeds=3)
    assert "mean over the scenes" in decided.summary
    with pytest.raises(ValueError, match="neither"):
        compare(budget=220, until_decided="all")
    with pytest.raises(ValueError, match="512MiB"):
        compare(memory="much")
    for wrong in [{"budget": 220, "hours": 0}, {"budget": 220, "max_seeds": 13}, {}]:
        with pytest.raises(densify.InputError):
            compare(**wrong)


def test_helpers_sort_as_in_rust() -> None:
    values = np.array([1.0, np.nan, 3.0, 3.0, -np.inf], dtype=np.float64)
    assert densify.top_k(values, 3).tolist() == [2, 3, 0]
    assert densify.largest([0, 1, 4], values, 5).tolist() == [0, 4, 1]
    assert densify.smallest(np.array([True, False, True, True, True]), values, 2).tolist() == [4, 0]
    assert densify.mean_over_views([6.0, 1.0], [3.0, 0.0]).tolist() == [2.0, 0.0]
    assert densify.spare_one([0, 1], np.array([0.2, 0.1], np.float32)).tolist() == [1]
    assert densify.quantile([1.0, 2.0, np.nan], 0.5) == 1.5 and densify.quantile([], 0.5) is None
    for call, error in [
        (lambda: densify.top_k(["a"], 1), TypeError),
        (lambda: densify.top_k([[1.0]], 1), ValueError),
        (lambda: densify.top_k([1.0], -1), OverflowError),
        (lambda: densify.largest([7], [1.0], 1), IndexError),
        (lambda: densify.mean_over_views([1.0], [1.0, 2.0]), ValueError),
        (lambda: densify.quantile([1.0], 2.0), ValueError),
    ]:
        with pytest.raises(error):
            call()
