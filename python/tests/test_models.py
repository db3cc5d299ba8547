"""Models and datasets as arrays."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import densify

from .conftest import cameras, images


def arrays(rows: int = 5, coefficients: int = 4) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    return {
        "means": rng.normal(size=(rows, 3)).astype(np.float32),
        "log_scales": rng.normal(-2.0, 0.1, size=(rows, 3)).astype(np.float32),
        "quats": rng.normal(size=(rows, 4)).astype(np.float32),
        "opacity_logits": rng.normal(size=rows).astype(np.float32),
        "sh": rng.normal(size=(rows, coefficients, 3)).astype(np.float32),
    }


def test_arrays_go_in_and_out(tmp_path: Path) -> None:
    given = arrays()
    model = densify.Model(**given)
    assert len(model) == 5 and model.sh_degree == 1
    for name, values in given.items():
        found = getattr(model, name)
        assert found.dtype == np.float32 and (found == values).all(), name
        found[...] = 0.0  # a copy
        assert (getattr(model, name) == values).all()
    again = densify.Model.load(model.save(tmp_path / "model.ply"))
    assert all((getattr(again, name) == values).all() for name, values in given.items())
    copy = pickle.loads(pickle.dumps(model))
    assert (copy.sh == model.sh).all() and copy.antialias == "none"
    assert len(densify.Model.load(densify.export(tmp_path / "model.ply", tmp_path / "model.glb", progress=False))) == 5


def test_any_layout_and_any_float_is_read() -> None:
    given = arrays()
    given["means"] = np.asfortranarray(given["means"].astype(np.float64))
    given["sh"] = np.repeat(given["sh"], 2, axis=0)[::2]
    given["log_scales"] = given["log_scales"].astype(np.float16)
    given["quats"] = [[1, 0, 0, 0]] * 5
    model = densify.Model(**given)
    assert (model.means == given["means"].astype(np.float32)).all() and (model.sh == given["sh"]).all()


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("means", np.zeros((5, 2)), ValueError, r"means: expected an array of shape \[rows, 3\]"),
        ("means", np.zeros(5), ValueError, "means"),
        ("log_scales", np.zeros((4, 3)), ValueError, r"shape \[5, 3\], found \[4, 3\]"),
        ("opacity_logits", np.zeros((5, 1)), ValueError, "opacity_logits"),
        ("quats", np.zeros((5, 4)), ValueError, "row 0 is not a rotation"),
        ("sh", np.zeros((5, 5, 3)), ValueError, "k = 1, 4, 9 or 16"),
        ("sh", np.zeros((5, 12)), ValueError, "k = 1, 4, 9 or 16"),
        ("means", np.full((5, 3), np.nan), ValueError, "row 0 has a value that is not finite"),
        ("means", np.full((5, 3), 1e300), ValueError, "not finite"),
        ("means", np.zeros((5, 3), complex), TypeError, "expected numbers"),
        ("means", [["a", "b", "c"]] * 5, TypeError, "expected numbers"),
        ("means", None, TypeError, "expected numbers"),
        ("origin", (0.0, 1.0), ValueError, "three numbers"),
        ("origin", (0.0, 1.0, np.inf), ValueError, "not finite"),
        ("antialias", "0.5", ValueError, "antialias"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow")
def test_wrong_arrays_are_refused(name: str, value: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        densify.Model(**{**arrays(), name: value})


def test_files_that_are_no_models_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "model.ply"
    with pytest.raises(densify.InputError):
        densify.Model.load(file)
    file.write_bytes(pickle.dumps({"means": 1}))
    with pytest.raises(densify.InputError):
        densify.Model.load(file)
    model = densify.Model(**arrays())
    with pytest.raises(densify.InputError, match="overwrite=True"):
        model.save(file)
    with pytest.raises(densify.InputError, match="folder"):
        model.save(tmp_path)
    with pytest.raises(densify.InputError, match="xyz"):
        model.save(tmp_path / "model.xyz")
    with pytest.raises(ValueError, match="coordinates"):
        model.save(tmp_path / "other.ply", coordinates="polar")


def test_a_model_is_rendered_where_it_is(tmp_path: Path) -> None:
    one = {"log_scales": [[-1.5] * 3], "quats": [[1.0, 0, 0, 0]], "opacity_logits": [6.0], "sh": [[[1.0, 0.0, -1.0]]]}
    model = densify.Model([[0.0, 0.0, 0.0]], **one)
    camera = cameras(3)[1]
    view = model.render(camera, background=(0.0, 0.0, 1.0), backend="cpu", threads=1)
    assert view.colour.shape == (24, 32, 3) and view.alpha.shape == view.depth.shape == (24, 32)
    assert view.alpha[12, 16] > 0.9 and view.alpha[0, 0] == 0.0 and view.colour[0, 0].tolist() == [0, 0, 1]
    # The camera is 4 units in front of the Gaussian.
    assert view.depth[12, 16] / view.alpha[12, 16] == pytest.approx(4.0, abs=0.05)
    # ½ + 0.282·sh, times alpha.
    assert view.colour[12, 16, 0] / view.alpha[12, 16] == pytest.approx(0.782, abs=0.002)
    view.save(tmp_path / "view.png")
    picture = pytest.importorskip("PIL.Image")
    assert (np.asarray(picture.open(tmp_path / "view.png")) == np.asarray(view.image())).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width and height"),
        ({"fx": -1.0}, "fx and fy"),
        ({"cx": np.nan}, "cx and cy"),
        ({"camera_from_world": np.zeros((4, 4))}, "last row|rotation"),
        ({"camera_from_world": np.diag([1.0, 1.0, -1.0, 1.0])}, "rotation"),
        ({"camera_from_world": np.diag([2.0, 2.0, 2.0, 1.0])}, "rotation"),
        ({"camera_from_world": np.full((4, 4), np.nan)}, "not finite"),
        ({"camera_from_world": np.eye(3)}, "shape"),
    ],
)
def test_wrong_cameras_are_refused(change: dict[str, Any], message: str) -> None:
    parts = {"width": 8, "height": 8, "fx": 8.0, "fy": 8.0, "cx": 4.0, "cy": 4.0, "camera_from_world": np.eye(4)}
    camera = densify.Camera(**{**parts, **change})
    with pytest.raises(ValueError, match=message):
        densify.Model(**arrays()).render(camera, backend="cpu")


def test_a_dataset_from_arrays_is_read_as_it_was_given(scene: Path) -> None:
    given = cameras(6)
    for split, views in [("test", [2, 4]), ("train", [0, 1, 3, 5])]:
        trainer_views = densify.cameras(_run_of(scene), split=split)  # type: ignore[arg-type]
        assert list(trainer_views) == [f"images/{view:05}.png" for view in views]
        for view, camera in zip(views, trainer_views.values()):
            assert (camera.width, camera.height, camera.fx, camera.cx) == (32, 24, 40.0, 16.0)
            assert camera.camera_from_world == pytest.approx(given[view].camera_from_world, abs=1e-9)


def _run_of(scene: Path) -> densify.Run:
    folder = scene.parent / "run_of_scene"
    if not folder.exists():
        densify.train(scene, output=folder, iterations=1, budget=50, eval=True, progress=False, backend="cpu")
    return densify.Run(folder)


def test_wrong_datasets_are_refused(tmp_path: Path) -> None:
    good: dict[str, Any] = {"images": images(3), "cameras": cameras(3)}
    for change, error, message in [
        ({"images": []}, ValueError, "as many"),
        ({"cameras": cameras(2)}, ValueError, "as many"),
        ({"images": [np.zeros((24, 32))] * 3}, ValueError, "image 0: expected"),
        ({"images": [np.zeros((20, 32, 3))] * 3}, ValueError, "32x20, but its camera is 32x24"),
        ({"images": [np.full((24, 32, 3), 2.0)] * 3}, ValueError, "from 0 to 1"),
        ({"images": [np.full((24, 32, 3), np.nan)] * 3}, ValueError, "from 0 to 1"),
        ({"images": [np.zeros((24, 32, 3), np.int64)] * 3}, TypeError, "uint8"),
        ({"points": np.zeros((3, 2))}, ValueError, "points"),
        ({"points": np.full((3, 3), np.inf)}, ValueError, "points"),
        ({"points": np.zeros((3, 3)), "colours": np.zeros((2, 3))}, ValueError, "colours"),
        ({"names": ["a", "a", "b"]}, ValueError, "names"),
        ({"names": ["../a", "b", "c"]}, ValueError, "names"),
        ({"test": [3]}, IndexError, "views 0 to 2"),
    ]:
        with pytest.raises(error, match=message):
            densify.write_dataset(tmp_path / "new", **{**good, **change})
        assert not (tmp_path / "new").exists(), message
    stacked = densify.write_dataset(tmp_path / "stacked", np.stack(images(3)), cameras(3))
    assert sorted(path.name for path in stacked.iterdir()) == ["images", "transforms.json"]
    (tmp_path / "file").write_text("mine")
    with pytest.raises(densify.InputError, match="not empty"):
        densify.write_dataset(tmp_path, **good)


def test_a_dataset_that_is_not_whole_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*paths: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="no space left"):
        densify.write_dataset(tmp_path / "new", images(3), cameras(3))
    assert not (tmp_path / "new" / "transforms.json").exists()


def test_a_dataset_in_memory_lasts_as_long_as_its_run(tmp_path: Path) -> None:
    dataset = densify.Dataset(images(3), cameras(3), points=np.random.default_rng(0).normal(size=(60, 3)))
    folder = dataset.folder
    run = densify.train(dataset, output=tmp_path / "run", iterations=2, budget=60, progress=False, backend="cpu")
    del dataset
    assert folder.is_dir() and len(list(run.render("train"))) == 3
    del run
    assert not folder.exists()
