"""`tdf imitate --depth`: files of cameras, what they show, what is taken, and messages about files that do not fit."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import CARRY
from PIL import Image

import tdf_jax as tdf
from tdf_jax._internal.errors import InputError
from tdf_jax.cli import camera
from tdf_jax.cli.main import main
from tdf_jax.cli.options import Settings
from tdf_jax.perception.choice import Choice

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]])
SPHERES = (((0.0, 0.0, 0.06), 0.06), ((0.18, 0.02, 0.04), 0.04))  # centre and radius, on a table at z = 0
TINY = ("--points", 60, "--num-poses", 4, "--queries", 8, "--num-starts", 6, "--no-plots")


def looking_down(x, z=0.6):
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = x, 0.0, z
    return T


def rendered(T):
    """Depths of two spheres on a table, by the formula of a ray and a sphere."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T @ T[:3, :3].T
    eye = T[:3, 3]
    depth = -eye[2] / rays[..., 2]
    for centre, radius in SPHERES:
        offset = eye - centre
        a, b, c = (rays**2).sum(axis=-1), rays @ offset, offset @ offset - radius**2
        inside = b**2 - a * c
        near = np.where(inside > 0, (-b - np.sqrt(np.abs(inside))) / a, np.inf)
        depth = np.minimum(depth, near)
    return depth


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Images, poses and intrinsics of two cameras."""
    folder = tmp_path_factory.mktemp("camera")
    for name, x in (("left", 0.0), ("right", 0.15)):
        T = looking_down(x)
        depth = rendered(T)
        np.save(folder / f"{name}.npy", depth)
        Image.fromarray(np.round(10_000 * depth).astype(np.uint16)).save(folder / f"{name}.png")
        np.savetxt(folder / f"{name}.txt", T)
        seen = np.zeros(depth.shape, np.uint8)
        points = tdf.points_from_depth(depth, K, T).reshape(HEIGHT, WIDTH, 3)
        seen[np.linalg.norm(points - SPHERES[1][0], axis=-1) < 1.01 * SPHERES[1][1]] = 255
        Image.fromarray(seen).save(folder / f"{name}_mask.png")
    np.savetxt(folder / "K.txt", K)
    np.save(folder / "K.npy", K)
    numbers = {"fx": FOCAL, "fy": FOCAL, "ppx": 79.5, "ppy": 59.5}
    (folder / "realsense.json").write_text(json.dumps(numbers))
    (folder / "open3d.json").write_text(json.dumps({"width": 160, "intrinsic_matrix": K.T.ravel().tolist()}))
    (folder / "ros.json").write_text(json.dumps({"camera_matrix": {"rows": 3, "data": K.ravel().tolist()}}))
    (folder / "k.json").write_text(json.dumps({"K": K.ravel().tolist()}))
    (folder / "empty.json").write_text("{}")
    return folder


def settings(files, *names, **keywords):
    given = {"depth": tuple(files / name for name in names), "intrinsics": (str(files / "K.txt"),)}
    return Settings(**(given | {"camera_pose": tuple(files / f"{Path(name).stem}.txt" for name in names)} | keywords))


def on_sphere(points, number):
    centre, radius = SPHERES[number]
    return np.abs(np.linalg.norm(points - centre, axis=1) - radius)


def test_every_sphere_is_an_object(files):
    seen = camera.read_scene(settings(files, "left.npy"))
    assert len(seen.clouds) == 2 and seen.world
    for number, cloud in enumerate(seen.clouds):
        assert on_sphere(cloud, number).max() < 1e-9 and len(cloud) > 100
    assert seen.pixels[0]["pixels"] == WIDTH * HEIGHT and seen.pixels[0]["invalid"] == 0
    assert camera.read_scene(Settings()) is None


def test_16_bit_images_are_scaled(files):
    exact, rounded = (
        camera.read_scene(settings(files, name, **words)).clouds[0]
        for name, words in (("left.npy", {}), ("left.png", {"depth_scale": 1e-4}))
    )
    assert abs(len(exact) - len(rounded)) <= 0.01 * len(exact)
    assert on_sphere(rounded, 0).max() < 1e-4


def test_several_images_are_merged(files):
    one, both = (camera.read_scene(settings(files, *names)) for names in (["left.npy"], ["left.npy", "right.npy"]))
    assert len(both.clouds[0]) > 1.5 * len(one.clouds[0])
    assert [Path(image["file"]).name for image in both.pixels] == ["left.npy", "right.npy"]
    assert max(on_sphere(cloud, number).max() for number, cloud in enumerate(both.clouds)) < 1e-9


def test_a_mask_is_one_object(files):
    masks = tuple(files / f"{name}_mask.png" for name in ("left", "right"))
    seen = camera.read_scene(settings(files, "left.npy", "right.npy", mask=masks))
    (cloud,) = seen.clouds
    assert on_sphere(cloud, 1).max() < 1e-9
    box = (0.0, -0.1, 0.05, 0.3, 0.1, 0.2)
    (cut,) = camera.read_scene(settings(files, "left.npy", "right.npy", mask=masks, workspace=box)).clouds
    assert 0 < len(cut) < len(cloud) and cut[:, 2].min() >= 0.05


def test_a_workspace_holds_the_objects(files):
    box = (-0.1, -0.1, -0.01, 0.1, 0.1, 0.3)
    (cloud,) = camera.read_scene(settings(files, "left.npy", workspace=box)).clouds
    assert on_sphere(cloud, 0).max() < 1e-9


@pytest.mark.parametrize(
    "intrinsics",
    ["K.npy", "realsense.json", "open3d.json", "ros.json", "k.json", ("150", "150", "79.5", "59.5"), tuple(K.ravel())],
    ids=str,
)
def test_intrinsics_are_read(files, intrinsics):
    words = (str(files / intrinsics),) if isinstance(intrinsics, str) else tuple(map(str, intrinsics))
    found = camera.read_scene(settings(files, "left.npy", intrinsics=words))
    np.testing.assert_array_equal(found.clouds[0], camera.read_scene(settings(files, "left.npy")).clouds[0])


def test_what_was_found_and_taken_is_said(files, monkeypatch, demonstration, small_model):
    monkeypatch.setattr(
        camera, "pick_object", lambda *a, **k: (None, Choice(1, None, np.array([0.7, 0.2]), np.full(2, np.nan)))
    )
    given = settings(files, "left.npy", points=50, camera_pose=None)
    seen = camera.read_scene(given)
    points, target, record = camera.choose(given, seen, small_model, None, demonstration, CARRY)
    assert len(points) == 50 and target is None and record["frame"] == "camera"
    assert {tuple(point) for point in points} <= {tuple(point) for point in seen.clouds[1]}
    assert [one["taken"] for one in record["clusters"]] == [None, "object"]
    lines = camera.table(record).splitlines()
    assert lines[1].endswith("0.70  -") and lines[2].endswith("0.20  object")
    assert str(len(seen.clouds[1])) in lines[2]


@pytest.mark.slow
def test_the_command_imitates_what_it_took(files, weights, tmp_path, capsys):
    words = ["imitate", "--weights", weights, "--out", tmp_path / "out", *TINY]
    words += ["--depth", files / "left.png", "--depth-scale", "1e-4", "--intrinsics", files / "K.txt"]
    words += ["--camera-pose", files / "left.txt", "--workspace", *"-0.2 -0.2 -0.01 0.3 0.2 0.3".split(), "--clusters"]
    main([str(word) for word in words])
    record = json.loads((tmp_path / "out" / "result.json").read_text())
    taken = [one["taken"] for one in record["camera"]["clusters"]]
    assert sorted(taken, key=str) == [None, "object"]
    assert record["target"]["points"] == 60 and record["errors"] is None
    assert record["camera"]["images"][0]["file"].endswith("left.png")
    out = capsys.readouterr().out
    assert "cluster" in out and "1 of 2 objects" in out
    residuals = [one["residual"] for one in record["camera"]["clusters"]]
    assert taken.index("object") == int(np.argmin(residuals))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--depth left.npy", "--depth needs --intrinsics"),
        ("--intrinsics 1 1 1 1", "--intrinsics is for --depth images"),
        ("--clusters", "--clusters is for --depth images"),
        ("--depth left.npy --intrinsics K.txt --target x.obj", "--target is for another object"),
        ("--depth left.npy --intrinsics K.txt --task bowl_on_mug", "--depth is .* and --task is"),
        ("--depth left.npy --intrinsics K.txt --target-pose random", "--target-pose random is for another"),
        ("--depth left.npy right.npy --intrinsics K.txt", "2 depth images without poses"),
        ("--depth left.npy right.npy --intrinsics K.txt --camera-pose left.txt", "--camera-pose has 1 files"),
        ("--depth left.npy --intrinsics K.txt K.txt", "--intrinsics has 2 files and --depth 1"),
        ("--depth left.npy --intrinsics 1 2 3", "--intrinsics has 3 numbers"),
        ("--depth left.npy --intrinsics none.txt", "there is no file .*none.txt"),
        ("--depth left.npy --intrinsics empty.json", "no intrinsics by a known name"),
        ("--depth none.png --intrinsics K.txt", "there is no file .*none.png"),
        ("--depth K.txt --intrinsics K.txt", "expected one of these. JPEG changes depths"),
        ("--depth left.png --intrinsics K.txt", "left.png: depth_scale is 1 .*--depth-scale 0.001"),
        ("--depth left.npy --intrinsics K.txt --depth-scale 0.001", "median depth"),
        ("--depth left.npy --intrinsics 300 300 159.5 119.5", "another resolution"),
        ("--depth left.npy --intrinsics K.txt --camera-pose K.txt", "T_world_camera has shape"),
        ("--depth left.npy --intrinsics K.txt --mask left_mask.png --clusters", "--mask says what the object is"),
        ("--depth left_mask.png --intrinsics K.txt", "8 bits"),
        ("--depth left.npy --intrinsics K.txt --workspace 0 0 0 -1 1 1", "xmin ymin zmin"),
        ("--depth left.npy --intrinsics K.txt --mask left_mask.png --workspace 3 3 3 4 4 4", "no point of the mask"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(files, weights, tmp_path, capsys, words, message):
    given = [
        str(files / word) if (files / word).exists() or word.startswith("none") else word for word in words.split()
    ]
    with pytest.raises(SystemExit) as stop:
        main(["imitate", "--weights", str(weights), "--out", str(tmp_path / "out"), *given])
    assert stop.value.code == 2
    error = capsys.readouterr().err.strip()
    assert error.startswith("tdf: error: ") and "\n" not in error
    assert re.search(message, error), error
    assert not (tmp_path / "out").exists()


def test_a_damaged_image_is_named(files, tmp_path):
    (tmp_path / "broken.png").write_bytes((files / "left.png").read_bytes()[:200])
    with pytest.raises(InputError, match=r"tdf imitate: .*broken.png cannot be (read|opened)"):
        camera.read_scene(dataclasses.replace(settings(files, "left.npy"), depth=(tmp_path / "broken.png",)))
