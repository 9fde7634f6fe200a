"""Images to Gaussians."""

import ast
import importlib.util
import json
import re
import shutil
import subprocess
import threading
import time
import typing
import warnings
from pathlib import Path

import numpy as np
import pytest

import freerange

from conftest import BOWL


def psnr(a, b):
    return -10.0 * np.log10(np.mean((np.clip(a, 0, 1) - b) ** 2))


def over_white(rgba):
    rgba = rgba.astype(np.float64) / 255.0
    return rgba[..., :3] * rgba[..., 3:] + 1.0 - rgba[..., 3:]


def test_the_readmes_five_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "examples").symlink_to(BOWL.parent)
    text = (BOWL.parent.parent / "README.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) == 5
    told = {}
    exec(code, told)
    assert (tmp_path / "bowl.glb").stat().st_size > 100_000
    assert told["image"].shape == (512, 512, 3)


STAGES = ["canonicalize", "symmetry", "propose", "refine", "optimize"]


def test_same_bytes_as_the_command_line(program, model, bowl, tmp_path):
    """Of the folder, and of arrays that NumPy and Pillow have read: with every default, and with options."""
    for arguments, options in [
        ([], {}),
        (
            ["--seed", "3", "--iterations", "10", "--symmetry", "off", "--set", "propose.count=1", "--set", "refine.passes=2"],
            dict(seed=3, iterations=10, symmetry="off", set={"propose.count": 1, "refine.passes": 2}),
        ),
    ]:
        out = tmp_path / f"out{len(arguments)}"
        subprocess.run([program, "reconstruct", BOWL, "-o", out, "--device", "cpu", *arguments], check=True)
        expected = (out / "gaussians.ply").read_bytes()
        of_scene = model.reconstruct_scene(BOWL, **options)
        of_scene.save(tmp_path / "scene.ply")
        assert (tmp_path / "scene.ply").read_bytes() == expected
        if options:
            images, intrinsics, c2w = bowl
            of_arrays = model.reconstruct(images, intrinsics, c2w, convention="opengl", **options)
            of_arrays.save(tmp_path / "arrays.ply")
            assert (tmp_path / "arrays.ply").read_bytes() == expected


def test_the_result_looks_like_the_images(model, bowl):
    images, intrinsics, c2w = bowl
    c2w = c2w @ np.diag([1.0, -1.0, -1.0, 1.0])
    h, w = images.shape[1:3]
    steps = []
    gaussians = model.reconstruct(images, intrinsics, c2w, iterations=100, set={"propose.count": 1}, on_step=steps.append)
    pictures = gaussians.render(c2w, intrinsics, w, h).rgb
    assert pictures.shape == (4, h, w, 3) and pictures.dtype == np.float32
    assert min(psnr(p, over_white(i)) for p, i in zip(pictures, images)) > 30.0
    stages = [step.stage for step in steps]
    assert [s for i, s in enumerate(stages) if i == 0 or stages[i - 1] != s] == STAGES
    last = steps[-1]
    assert (last.done, last.total) == (100, 100) and last.loss > 0.0
    assert np.array_equal(last.gaussians.means, gaussians.means)
    passes = [s for s in steps if s.stage == "refine"]
    assert len([s for s in passes if s.gaussians is not None]) == passes[-1].total
    assert list(gaussians.seconds) == STAGES and gaussians.seed == 0


def test_masks_alpha_and_floats_tell_the_same(model, bowl):
    images, intrinsics, c2w = bowl
    images = np.where(images[..., 3:] == 0, np.uint8(0), images)
    quick = dict(convention="opengl", iterations=0, symmetry="off", set={"refine.passes": 1})
    with_alpha = model.reconstruct(images, intrinsics, c2w, **quick)
    for rgb, masks in [
        (images[..., :3], images[..., 3]),
        (list(images[..., :3]), list(images[..., 3] / np.float32(255))),
        (images.astype(np.float64) / 255.0, None),
    ]:
        same = model.reconstruct(rgb, intrinsics, c2w, masks, **quick)
        assert np.array_equal(same.rows, with_alpha.rows)
    # Without any, the plain background goes.
    white = np.rint(over_white(images) * 255).astype(np.uint8)
    cut = model.reconstruct(white, intrinsics, c2w, **quick)
    assert any("plain background of 4 photos" in note for note in cut.notes)
    assert len(cut) == len(with_alpha)


def test_masks_of_zeros_and_ones(bowl):
    """As many tools write them. The largest value of all masks decides, not each photo's own."""
    images, intrinsics, c2w = bowl
    solid = images[..., 3] >= 128
    rgb = np.where(solid[..., None], images[..., :3], np.uint8(0))
    ones = solid.astype(np.uint8)

    def cut_out(images, masks=None):
        return freerange.Scene.from_arrays(images, intrinsics, c2w, masks, convention="opengl").images

    expected = cut_out(rgb, ones * np.uint8(255))
    assert {0, 255} == set(np.unique(expected[0][..., 3]))
    for masks in (ones, list(ones), solid, solid.astype(np.float32), [solid[0], ones[1], solid[2].astype(np.float64), ones[3]]):
        assert np.array_equal(cut_out(rgb, masks), expected)
    assert np.array_equal(cut_out(np.concatenate([rgb, ones[..., None]], axis=-1)), expected)
    # Both at once: each has a maximum of its own.
    assert np.array_equal(cut_out(np.concatenate([rgb, ones[..., None]], axis=-1), ones * np.uint8(255)), expected)
    for masks in (np.concatenate([ones[:1], ones[1:] * np.uint8(255)]), np.zeros_like(ones), ones * np.float32(1 / 255)):
        with pytest.raises(ValueError, match=r"images\[0\].*empty"):
            cut_out(rgb, masks)


def test_seeds_are_samples(model, bowl):
    images, intrinsics, c2w = bowl
    quick = dict(convention="opengl", iterations=0, init="flow", symmetry="off", set={"propose.flow.steps": 2, "refine.passes": 1})
    two = model.reconstruct(images, intrinsics, c2w, seed=[5, 6], **quick)
    assert [g.seed for g in two] == [5, 6]
    assert not np.array_equal(two[0].means, two[1].means)
    one = model.reconstruct(images, intrinsics, c2w, seed=6, **quick)
    assert np.array_equal(one.rows, two[1].rows)


def test_scenes_are_read(bowl):
    images, intrinsics, c2w = bowl
    scene = freerange.Scene.read(BOWL)
    assert len(scene) == 4 and len(scene.further[0]) > 0 and scene.notes is not None
    assert np.array_equal(np.stack(scene.images), images)
    assert np.allclose(scene.intrinsics, intrinsics)
    assert np.allclose(scene.c2w, c2w @ np.diag([1.0, -1.0, -1.0, 1.0]), atol=1e-6)


def test_scenes_of_arrays_and_names_of_gsplat(model, bowl):
    """Arrays under gsplat's names, as a scene and at once, give the same."""
    images, intrinsics, c2w = bowl
    opencv = c2w @ np.diag([1.0, -1.0, -1.0, 1.0])
    quick = dict(iterations=0, symmetry="off", set={"refine.passes": 1})
    scene = freerange.Scene.from_arrays(images, viewmats=np.linalg.inv(opencv), Ks=intrinsics, names=list("abcd"))
    assert scene.names == list("abcd") and len(scene.further[0]) == 0
    # The file's rotations are rounded; they become exact ones.
    assert np.allclose(scene.c2w, opencv, atol=1e-6) and np.allclose(scene.viewmats @ scene.c2w, np.eye(4), atol=1e-12)
    assert np.array_equal(scene.Ks, intrinsics)
    expected = model.reconstruct(images, viewmats=np.linalg.inv(opencv), Ks=intrinsics, **quick)
    assert np.array_equal(model.reconstruct_scene(scene, **quick).rows, expected.rows)
    assert len(model.reconstruct_scene(BOWL, **quick)) == len(expected)
    with pytest.raises(ValueError, match="names"):
        freerange.Scene.from_arrays(images, intrinsics, opencv, names=["a"])
    with pytest.raises(TypeError, match="reconstruction"):
        freerange.Scene.from_pycolmap({}, BOWL)


def test_a_reconstruction_of_pycolmap(bowl, tmp_path):
    """Cameras with distortion, in memory: as our reader takes them from disk. In a process of its own, since both bring libraries of
    images."""
    pytest.importorskip("pycolmap")
    code = """
import sys, numpy as np, pycolmap, freerange
folder, images = sys.argv[1:]
poses = np.load(folder + "/c2w.npy")
model = pycolmap.Reconstruction()
camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=512, height=512, params=[560.0, 256.0, 256.0, 0.02], camera_id=1)
model.add_camera_with_trivial_rig(camera)
for i, c2w in enumerate(poses):
    pose = np.linalg.inv(c2w)[:3]
    image = pycolmap.Image(name=f"r_{i}.png", camera_id=1, image_id=i + 1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
scene = freerange.Scene.from_pycolmap(model, images)
assert len(scene) == len(poses), scene
assert np.allclose(scene.c2w[:, :3, 3], poses[:, :3, 3], atol=1e-5), scene.c2w
assert any("SIMPLE_RADIAL" in note or "distort" in note for note in scene.notes), scene.notes
"""
    import sys

    np.save(tmp_path / "c2w.npy", bowl[2] @ np.diag([1.0, -1.0, -1.0, 1.0]))
    for i in range(4):
        told = json.loads((BOWL / "transforms_train.json").read_text())["frames"][i]["file_path"]
        shutil.copy((BOWL / told).with_suffix(".png"), tmp_path / f"r_{i}.png")
    run = subprocess.run([sys.executable, "-c", code, tmp_path, tmp_path], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


class Colmap:
    """What `Scene.from_pycolmap` uses of a reconstruction: it writes itself as text."""

    def __init__(self, bowl, names):
        images, self.intrinsics, self.c2w = bowl
        self.height, self.width = images.shape[1:3]
        self.names = names

    def write(self, folder):
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics[0]
        lines = []
        for i, name in enumerate(self.names):
            pose = np.linalg.inv(self.c2w[i] @ np.diag([1.0, -1.0, -1.0, 1.0]))
            rotation = freerange._check.similarity("pose", pose)[2]
            lines.append(" ".join(map(str, [i + 1, *rotation, *pose[:3, 3], 1, name])) + "\n\n")
        (Path(folder) / "cameras.txt").write_text(f"1 PINHOLE {self.width} {self.height} {fx} {fy} {cx} {cy}\n")
        (Path(folder) / "images.txt").write_text("".join(lines))
        (Path(folder) / "points3D.txt").write_text("")


@pytest.fixture
def copy(tmp_path):
    """A copy of the example's photos, with their cameras."""
    shutil.copytree(BOWL / "train", tmp_path / "train")
    shutil.copy(BOWL / "transforms_train.json", tmp_path / "transforms.json")
    return tmp_path


def test_what_a_scene_leaves_out_is_a_warning(copy, bowl, model):
    """Once, and at the line that called the package. Of three photos it is also said that they are few."""

    def of_loss(caught):
        return [w for w in caught if not re.search("only 3 photos|no photo from", str(w.message))]

    with pytest.warns(freerange.DroppedWarning, match="1 photos have no camera and are left out: 003.png") as caught:
        scene = freerange.Scene.from_pycolmap(Colmap(bowl, ["000.png", "001.png", "002.png"]), copy / "train")
    assert len(scene) == 3 and {w.filename for w in caught} == {__file__} and len(of_loss(caught)) == 1
    (copy / "masks").mkdir()
    shutil.copy(copy / "train" / "000.png", copy / "masks" / "other.png")
    with pytest.warns(freerange.DroppedWarning, match="none of its 1 images has a photo's name") as caught:
        freerange.Scene.read(copy)
    assert [w.filename for w in caught] == [__file__]
    shutil.rmtree(copy / "masks")
    (copy / "train" / "003.png").unlink()
    with pytest.warns(freerange.DroppedWarning, match="1 of 4 photos with cameras are not there and left out") as caught:
        scene = freerange.Scene.read(copy)
    assert {w.filename for w in caught} == {__file__} and len(scene) == 3 and len(of_loss(caught)) == 1
    assert str(of_loss(caught)[0].message) in scene.notes
    quick = dict(iterations=0, symmetry="off", set={"propose.count": 1, "refine.passes": 1})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The scene has said so.
        known = model.reconstruct_scene(scene, **quick)
    assert str(of_loss(caught)[0].message) in known.notes
    with pytest.warns(freerange.DroppedWarning, match="1 of 4 photos") as caught:
        read = model.reconstruct_scene(copy, **quick)
    assert {w.filename for w in caught} == {__file__} and len(of_loss(caught)) == 1 and read.notes == known.notes


def test_what_a_scene_assumes_is_a_note(copy):
    told = json.loads((copy / "transforms.json").read_text())
    told["frames"][0]["file_path"] = "train/000.jpg"
    (copy / "transforms.json").write_text(json.dumps(told))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not any("other names" in note for note in freerange.Scene.read(BOWL).notes)
        assert any("000.png for 000.jpg" in note for note in freerange.Scene.read(copy).notes)


def functions_of(module):
    """Public functions, methods and classes in a module's source, since its imports may be missing: name, docstring, arguments with
    their types, fields."""
    tree = ast.parse(Path(importlib.util.find_spec(module).origin).read_text())
    public = [node for node in tree.body if not getattr(node, "name", "_").startswith("_")]
    for kind in [node for node in public if isinstance(node, ast.ClassDef)]:
        fields = [f.target.id for f in kind.body if isinstance(f, ast.AnnAssign)]
        yield kind.name, ast.get_docstring(kind), {}, fields
        methods = [node for node in kind.body if isinstance(node, ast.FunctionDef)]
        public += [node for node in methods if node.name == "__init__" or not node.name.startswith("_")]
    for function in [node for node in public if isinstance(node, ast.FunctionDef)]:
        arguments = function.args
        assert not arguments.vararg and not arguments.kwarg, function.name
        listed = [a for a in arguments.posonlyargs + arguments.args + arguments.kwonlyargs if a.annotation]
        yield function.name, ast.get_docstring(function), {a.arg: ast.unparse(a.annotation) for a in listed}, []


@pytest.mark.parametrize("module", ["freerange.torch", "freerange.ffgs"])
def test_help_of_what_needs_other_packages_is_readable(module):
    found = list(functions_of(module))
    assert {"freerange.torch": "rasterize", "freerange.ffgs": "pipeline"}[module] in [name for name, *_ in found]
    for name, text, arguments, fields in found:
        assert text, name
        assert all(a in text.partition("Args:")[2] for a in arguments), f"{name}: {arguments}"
        assert "Any" not in arguments.values(), f"{name}: {arguments}"
        assert all(f"{f}: " in text.partition("Attributes:")[2] for f in fields), f"{name}: {fields}"


def test_help_is_readable():
    """Every public function and method has its arguments in its signature and under `Args:`; classes have theirs under `Attributes:`."""
    import inspect

    found = [freerange.load, freerange.render, freerange.devices]
    for kind in (freerange.Gaussians, freerange.Model, freerange.Scene):
        public = [member for name, member in inspect.getmembers(kind, callable) if not name.startswith("_")]
        found += [getattr(member, "__func__", member) for member in public]
    found.append(freerange.Gaussians.__init__)
    assert len(found) > 15
    for function in found:
        text = inspect.getdoc(function) or ""
        names = [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]
        kinds = {parameter.kind for parameter in inspect.signature(function).parameters.values()}
        assert not kinds & {inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL}, function
        told = text.partition("Args:")[2]
        assert text and all(name in told for name in names), f"{function.__qualname__}: {names}"
        # Types of other packages may be anything; those of arrays are told, and can be looked up.
        types = {name: kind for name, kind in getattr(function, "__annotations__", {}).items() if kind == "Any"}
        assert not set(types) - {"return", "reconstruction", "device"}, f"{function.__qualname__}: {types}"
        assert function is freerange.devices or typing.get_type_hints(function)
    for kind in (freerange.Gaussians, freerange.Render, freerange.Scene, freerange.Step):
        told = inspect.getdoc(kind).partition("Attributes:")[2]
        assert all(f"{name}: " in told for name in kind.__annotations__ if not name.startswith("_")), kind


def test_an_exception_in_on_step_ends_the_work(model):
    class Enough(Exception):
        pass

    seen = []

    def stop(step):
        seen.append(step)
        if step.stage == "propose" and step.done == 3:
            raise Enough

    with pytest.raises(Enough):
        model.reconstruct_scene(BOWL, symmetry="off", on_step=stop)
    assert seen[-1].done == 3


def test_ctrl_c_ends_the_work(tmp_path):
    """In a program of its own, interrupted when it is in the middle."""
    code = (
        "import freerange, signal, sys\n"
        # What is started in the background inherits that interrupts are ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "model = freerange.load(device='cpu')\n"
        "scene = freerange.Scene.read(sys.argv[1])\n"
        "print('begin', flush=True)\n"
        "try:\n"
        "    model.reconstruct_scene(scene, iterations=100000)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', flush=True)\n"
    )
    import signal
    import sys

    child = subprocess.Popen([sys.executable, "-c", code, str(BOWL)], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "begin\n"
    time.sleep(1.0)
    begin = time.monotonic()
    child.send_signal(signal.SIGINT)
    assert child.stdout.readline() == "interrupted\n"
    assert time.monotonic() - begin < 5.0
    assert child.wait() == 0


def test_other_threads_run_meanwhile(model):
    """A thread that counts gets on while this one computes: the interpreter is not held."""
    count, done = 0, threading.Event()

    def counting():
        nonlocal count
        while not done.is_set():
            count += 1
            time.sleep(0.001)

    thread = threading.Thread(target=counting)
    thread.start()
    begin = time.monotonic()
    model.reconstruct_scene(BOWL, iterations=0)
    seconds = time.monotonic() - begin
    done.set()
    thread.join()
    assert count > 50 * seconds


def spoiled(array, at):
    array = array.copy()
    array[at] = np.nan
    return array


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(images=lambda i, k, c: i[:1]), ValueError, ["images", "at least 2", "found 1"]),
        (dict(images=lambda i, k, c: i[..., :2]), ValueError, ["images[0]", "[h, w, 3]", "[512, 512, 2]"]),
        (dict(images=lambda i, k, c: i.astype(np.int64)), TypeError, ["images[0]", "uint8", "int64"]),
        (dict(images=lambda i, k, c: i.astype(np.float32)), ValueError, ["images[0]", "from 0 to 1", "255"]),
        (dict(images=lambda i, k, c: "bowl"), TypeError, ["images", "found str"]),
        (dict(images=lambda i, k, c: np.full(i.shape, np.nan)), ValueError, ["images[0][0, 0, 0]", "finite", "nan"]),
        (dict(images=lambda i, k, c: np.zeros_like(i)), ValueError, ["images[0]", "empty"]),
        (dict(intrinsics=lambda i, k, c: k[:2]), ValueError, ["intrinsics", "[4, 3, 3]", "[2, 3, 3]"]),
        (dict(intrinsics=lambda i, k, c: -k), ValueError, ["intrinsics[0]", "[0, 0, 1]", "-1.0"]),
        (dict(intrinsics=lambda i, k, c: k * np.array([[-1, 1, 1], [1, 1, 1], [1, 1, 1]])), ValueError, ["focal"]),
        (dict(c2w=lambda i, k, c: 2 * c), ValueError, ["c2w[0]", "last row"]),
        (dict(c2w=lambda i, k, c: c[:, :3] * [2, 2, 2, 1]), ValueError, ["c2w[0]", "rotation", "scale of 2.0"]),
        (dict(c2w=lambda i, k, c: c[:, :3] * [-1, 1, 1, 1]), ValueError, ["c2w[0]", "mirrored"]),
        (dict(c2w=lambda i, k, c: spoiled(c, (2, 1, 3))), ValueError, ["c2w[2, 1, 3]", "finite"]),
        (dict(c2w=lambda i, k, c: [["a"]]), TypeError, ["c2w", "numbers"]),
        (dict(masks=lambda i, k, c: i[:3, ..., 3]), ValueError, ["masks", "each of 4", "found 3"]),
        (dict(masks=lambda i, k, c: i[:, 1:, :, 3]), ValueError, ["masks[0]", "[512, 512]", "[511, 512]"]),
        (dict(seed=-1), ValueError, ["seed", "0 to", "-1"]),
        (dict(seed=1.5), TypeError, ["seed", "integer", "1.5"]),
        (dict(seed=[]), ValueError, ["seed", "1 to 64"]),
        (dict(network_views=0), ValueError, ["network_views", "1 to", "found 0"]),
        (dict(set={"optimize.max_resolution": 300}), ValueError, ["optimize.max_resolution", "256", "found 300"]),
        (dict(set={"refine.pases": 3}), ValueError, ["refine.pases", "refine.passes"]),
        (dict(set=3), TypeError, ["set", "dictionary", "3"]),
        (dict(iterations="many"), TypeError, ["iterations", "integer", "'many'"]),
        (dict(symmetry="on"), ValueError, ["symmetry", "'auto' or 'off'", "'on'"]),
        (dict(init="zero"), ValueError, ["init", "'fit' or 'flow'", "'zero'"]),
        (dict(precision="f8"), ValueError, ["precision", "'bf16'", "'f8'"]),
        (dict(quality="best"), ValueError, ["quality", "'high'", "'best'"]),
        (dict(refinement=3), TypeError, ["refinement", "unexpected keyword"]),
        (dict(quality=3), TypeError, ["quality", "a name", "3"]),
        (dict(viewmats=lambda i, k, c: c), TypeError, ["c2w", "viewmats", "both"]),
        (dict(Ks=lambda i, k, c: k), TypeError, ["intrinsics", "Ks", "both"]),
        (dict(convention="blender"), ValueError, ["convention", "'opengl'", "'blender'"]),
        (dict(up="north"), ValueError, ["up", "'cameras'", "'north'"]),
        (dict(up=(0, 0, 0)), ValueError, ["up", "not all zero"]),
        (dict(center=(0, 0)), ValueError, ["center", "[3]", "[2]"]),
        (dict(radius=-1.0), ValueError, ["radius", "above 0"]),
        (dict(on_step=3), TypeError, ["on_step", "function", "int"]),
    ],
)
def test_bad_input_is_named(model, bowl, change, error, words):
    arguments = dict(zip(("images", "intrinsics", "c2w"), bowl), convention="opengl")
    for field, value in change.items():
        arguments[field] = value(*bowl) if callable(value) else value
    with pytest.raises(error) as caught:
        model.reconstruct(**arguments)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_bad_files_and_names_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="none.safetensors"):
        freerange.load(tmp_path / "none.safetensors")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(b"\0" * 100)
    with pytest.raises(ValueError, match="broken.safetensors"):
        freerange.load(broken)
    with pytest.raises(ValueError, match="hf:owner/name"):
        freerange.load("hf:none")
    with pytest.raises(ValueError, match="device: .*'gpu'"):
        freerange.load(device="gpu")
    with pytest.raises(FileNotFoundError):
        freerange.Scene.read(tmp_path / "none")
    with pytest.raises(ValueError, match="transforms"):
        freerange.Scene.read(tmp_path)
    with pytest.raises(ValueError, match="max_side"):
        freerange.Scene.read(BOWL, max_side=1)
    with pytest.raises(ValueError, match="turntable.*'400.0,60.0'"):
        freerange.Scene.read(BOWL, turntable=(400, 60))
    with pytest.raises(TypeError, match="Scene.read"):
        freerange.Scene()
    with pytest.raises(TypeError, match="freerange.load"):
        freerange.Model(None)


def test_what_it_says_of_itself(model):
    assert freerange.devices()[-1][0] == "cpu"
    assert model.device == "cpu" and model.gaussians == 2048 and model.network_views == 6
    assert model.provenance["configuration"]
    assert "2048 Gaussians" in repr(model)
    json.dumps(model.provenance)
