"""The model."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, Literal, overload

import numpy as np
import numpy.typing as npt

from . import _check, _core
from ._check import Convention, Point, Upright
from ._gaussians import Gaussians, heed
from ._scene import Scene

Quality = Literal["draft", "default", "high"]
Detect = Literal["auto", "off"]
Init = Literal["fit", "flow"]
Precision = Literal["f32", "bf16", "f16", "auto"]


@dataclass(frozen=True)
class Step:
    """How far a reconstruction has come.

    Attributes:
        stage: "canonicalize", "symmetry", "propose", "refine" or "optimize", in this order; the last three for each sample.
        sample: which of the samples is worked on, from 0.
        done: steps of the stage that are done; 0 when it begins.
        total: all its steps.
        loss: the photometric loss of the last step of a fit or of the optimization.
        gaussians: the Gaussians by now, in your cameras' frame; None when a stage begins, in "symmetry", and while other
            proposals than the first are worked on.
    """

    stage: str
    sample: int
    done: int
    total: int
    loss: float | None
    gaussians: Gaussians | None


OnStep = Callable[[Step], object]


def load(
    checkpoint: str | PathLike[str] | None = None,
    *,
    device: str = "auto",
    encoder_weights: str | PathLike[str] | None = None,
) -> Model:
    """Loads a model, ready for one object after the other.

    Args:
        checkpoint: a file, `hf:owner/name[@revision]` for one on the Hugging Face hub, or None for the bundled one.
        device: "auto", "cpu", or what `freerange.devices()` lists.
        encoder_weights: the folder of a frozen encoder's published weights.

    Raises:
        ValueError, OSError: a name that is none, a file that cannot be read.
        RuntimeError: a device that cannot be opened.
    """
    return Model(_core.load(checkpoint, device, encoder_weights))


class Model:
    """A model on a device; `freerange.load` gives one. It can be shared between threads."""

    __slots__ = ("_model",)

    def __init__(self, model: _core.Model) -> None:
        if not isinstance(model, _core.Model):
            raise TypeError("freerange.Model comes from freerange.load(checkpoint)")
        self._model = model

    def __repr__(self) -> str:
        return f"<freerange.Model: {self.gaussians} Gaussians, up to {self.network_views} views, on {self.device}>"

    @property
    def device(self) -> str:
        """Where it computes, as it was named."""
        return self._model.device

    @property
    def network_views(self) -> int:
        """Most views that the network sees by default: as many as at once in training."""
        return self._model.network_views

    @property
    def gaussians(self) -> int:
        """Gaussians that the network makes; the optimization may make more of them."""
        return self._model.gaussians

    @property
    def provenance(self) -> Any:
        """What the checkpoint says of its making."""
        return json.loads(self._model.provenance)

    @overload
    def reconstruct(
        self,
        images: npt.ArrayLike,
        intrinsics: npt.ArrayLike | None = None,
        c2w: npt.ArrayLike | None = None,
        masks: npt.ArrayLike | None = None,
        *,
        viewmats: npt.ArrayLike | None = None,
        Ks: npt.ArrayLike | None = None,
        convention: Convention = "opencv",
        up: Upright = "z",
        center: Point | None = None,
        radius: float | None = None,
        seed: int = 0,
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> Gaussians: ...
    @overload
    def reconstruct(
        self,
        images: npt.ArrayLike,
        intrinsics: npt.ArrayLike | None = None,
        c2w: npt.ArrayLike | None = None,
        masks: npt.ArrayLike | None = None,
        *,
        viewmats: npt.ArrayLike | None = None,
        Ks: npt.ArrayLike | None = None,
        convention: Convention = "opencv",
        up: Upright = "z",
        center: Point | None = None,
        radius: float | None = None,
        seed: Sequence[int],
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> list[Gaussians]: ...
    def reconstruct(
        self,
        images: npt.ArrayLike,
        intrinsics: npt.ArrayLike | None = None,
        c2w: npt.ArrayLike | None = None,
        masks: npt.ArrayLike | None = None,
        *,
        viewmats: npt.ArrayLike | None = None,
        Ks: npt.ArrayLike | None = None,
        convention: Convention = "opencv",
        up: Upright = "z",
        center: Point | None = None,
        radius: float | None = None,
        seed: int | Sequence[int] = 0,
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> Gaussians | list[Gaussians]:
        """Reconstructs an object from two or more posed images of it.

        Args:
            images: `[v, h, w, 3]` or `[v, h, w, 4]` (alpha is the object's mask), `uint8` or floats from 0 to 1,
                sRGB-encoded; a sequence where their sizes differ.
            intrinsics: `[v, 3, 3]`, or `[3, 3]` for all views, in pixels; the center of the first pixel is at 0.5.
            c2w: camera to world, `[v, 4, 4]` or `[v, 3, 4]`, in OpenCV's axes (x right, y down, z forward).
            masks: `[v, h, w]` or `[v, h, w, 1]`, white is the object: bool, floats from 0 to 1, or integers. The largest
                value of all masks of integers is 255 or 1; that of alpha, too. Without masks and without alpha a plain
                background is cut away, else poses and colors show the object (`notes` of the result says how sure).
            viewmats: world to camera instead of `c2w`, as gsplat has it.
            Ks: the same as `intrinsics`.
            convention: "opengl" for OpenGL's and Blender's axes (y up, z backward).
            up: which way is up in the cameras' frame: "z" and "y" are its third and second axis, "cameras" goes by how
                they are held; or a direction. COLMAP's frames have no upright z: pass "cameras", or give
                `reconstruct_scene` a `Scene`, which finds it (`Scene.read`, `Scene.from_pycolmap`).
            center, radius: where the object is, if that is known.
            seed: a number, or several for a list of as many samples.
            quality: "draft", "default" or "high"; the options that follow are the preset's if they are None.
            iterations: steps of the optimization on the photos.
            symmetry: "auto" or "off".
            init: "fit" or "flow", where the proposals come from.
            precision: of the network: "f32", "bf16", "f16" or "auto".
            network_views: most images that the network sees.
            set: further fields of the pipeline by their paths, as in `{"propose.count": 2}`.
            on_step: called with a `Step` after each. What it raises ends the work, as Ctrl-C does.

        Returns:
            Gaussians in the cameras' frame; a list of them where `seed` is several.

        Raises:
            ValueError, TypeError: the field, what was expected and what was found.
            RuntimeError: a device or the arithmetic failed.

        Warns:
            DroppedWarning: something given is left out, or may make the result wrong.
        """
        _check.no_scene(images, "reconstruct_scene takes a Scene or a folder")
        poses, k = _check.cameras_given(c2w, viewmats, intrinsics, Ks, "intrinsics")
        seeds, chosen = _options(seed, quality, iterations, symmetry, init, precision, network_views, set)
        rgba = _check.images(images, masks)
        sizes = [(image.shape[1], image.shape[0]) for image in rgba]
        cameras = _check.cameras(poses, k, sizes, convention, "intrinsics" if Ks is None else "Ks")
        views = [(f"images[{i}]", camera, p.tobytes()) for i, (camera, p) in enumerate(zip(cameras, rgba))]
        center = None if center is None else _check.point("center", center)
        radius = None if radius is None else _check.number("radius", radius)
        report = _told(on_step)
        # Before masks are looked for, which takes its time.
        self._model.check(chosen)
        scene = _core.scene_of_views(views, _check.up(up), center, radius)
        heed(scene.notes())
        return self._reconstruct(scene, chosen, report, seeds, seed)

    @overload
    def reconstruct_scene(
        self,
        scene: Scene | str | PathLike[str],
        *,
        seed: int = 0,
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> Gaussians: ...
    @overload
    def reconstruct_scene(
        self,
        scene: Scene | str | PathLike[str],
        *,
        seed: Sequence[int],
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> list[Gaussians]: ...
    def reconstruct_scene(
        self,
        scene: Scene | str | PathLike[str],
        *,
        seed: int | Sequence[int] = 0,
        quality: Quality = "default",
        iterations: int | None = None,
        symmetry: Detect | None = None,
        init: Init | None = None,
        precision: Precision | None = None,
        network_views: int | None = None,
        set: Mapping[str, object] | None = None,
        on_step: OnStep | None = None,
    ) -> Gaussians | list[Gaussians]:
        """Reconstructs a scene, or the folder of one: to the byte what the command line makes of it.

        Args:
            scene: a `Scene`, or what `Scene.read` reads.
            seed, quality, iterations, symmetry, init, precision, network_views, set, on_step: as `reconstruct`.

        Returns:
            Gaussians in the cameras' frame; a list of them where `seed` is several.

        Raises:
            ValueError, TypeError, OSError: the file or field, what was expected and what was found.
            RuntimeError: a device or the arithmetic failed.

        Warns:
            DroppedWarning: something of the scene is left out, or may make the result wrong.
        """
        seeds, chosen = _options(seed, quality, iterations, symmetry, init, precision, network_views, set)
        if not isinstance(scene, (Scene, str, PathLike)):
            raise _check.wrong_type("scene", "a Scene or a folder (reconstruct takes arrays)", type(scene).__name__)
        report = _told(on_step)
        if not isinstance(scene, Scene):
            self._model.check(chosen)
            scene = Scene.read(scene)
        return self._reconstruct(scene._scene, chosen, report, seeds, seed)

    def _reconstruct(
        self, scene: _core.Scene, chosen: dict[str, Any], report: Any, seeds: list[int], seed: int | Sequence[int]
    ) -> Gaussians | list[Gaussians]:
        """Of a scene whose notes were heeded when it was made."""
        result = self._model.reconstruct_scene(scene, chosen, report)
        known = len(scene.notes())
        notes = [text for _, text in result[2][:known]] + heed(result[2][known:])
        return _made(result, notes, seeds, seed)


def _options(
    seed: int | Sequence[int],
    quality: str,
    iterations: int | None,
    symmetry: str | None,
    init: str | None,
    precision: str | None,
    network_views: int | None,
    fields: Mapping[str, object] | None,
) -> tuple[list[int], dict[str, Any]]:
    """Seeds, and every option; those that are not given are None."""
    given = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else [seed]
    seeds = [_check.count("seed", s, 0, 2**64 - 1) for s in given]
    if not 1 <= len(seeds) <= 64:
        raise _check.refuse("seed", "an integer or 1 to 64 of them", f"{len(seeds)} of them")
    if fields is not None and not (isinstance(fields, Mapping) and all(isinstance(key, str) for key in fields)):
        raise _check.wrong_type("set", "a dictionary of names and values", f"{fields!r}")
    names = {"quality": quality, "symmetry": symmetry, "init": init, "precision": precision}
    for name, value in names.items():
        if value is not None and not isinstance(value, str):
            raise _check.wrong_type(name, "a name", f"{value!r}")
    counts = {"iterations": (iterations, 0), "network_views": (network_views, 1)}
    chosen: dict[str, Any] = {"seeds": seeds, **names}
    chosen["set"] = [(key, json.dumps(value)) for key, value in (fields or {}).items()]
    for name, (number, least) in counts.items():
        chosen[name] = None if number is None else _check.count(name, number, least, 2**31)
    return seeds, chosen


def _told(on_step: OnStep | None) -> Any:
    if on_step is None:
        return None
    if not callable(on_step):
        raise _check.wrong_type("on_step", "a function of a Step", type(on_step).__name__)

    def told(stage: str, sample: int, done: int, total: int, loss: float | None, cloud: bytearray | None) -> None:
        on_step(Step(stage, sample, done, total, loss, None if cloud is None else Gaussians._of(cloud)))

    return told


def _made(result: Any, notes: list[str], seeds: list[int], seed: int | Sequence[int]) -> Gaussians | list[Gaussians]:
    samples, up, _, seconds = result
    made = [Gaussians._of(s, up=tuple(up), notes=notes, seconds=seconds, seed=n) for s, n in zip(samples, seeds)]
    return made if isinstance(seed, (Sequence, np.ndarray)) else made[0]
