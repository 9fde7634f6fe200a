"""The model."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, overload

import numpy as np

from . import _check, _core
from ._gaussians import Gaussians
from ._scene import Scene


@dataclass(frozen=True)
class Step:
    """How far a reconstruction has come."""

    #: "canonicalize", "symmetry", "propose", "refine" or "optimize", in this order; the last three for each sample.
    stage: str
    #: Which of the samples is worked on, from 0.
    sample: int
    #: Steps of the stage that are done; 0 when it begins.
    done: int
    #: All its steps.
    total: int
    #: The photometric loss of the last step of a fit or of the optimization.
    loss: float | None
    #: The Gaussians by now, in your cameras' frame; none when a stage begins, in "symmetry", and while other proposals than the
    #: first are worked on.
    gaussians: Gaussians | None


OnStep = Callable[[Step], object]


def load(
    checkpoint: str | PathLike[str] | None = None,
    *,
    device: str = "auto",
    encoder_weights: str | PathLike[str] | None = None,
) -> Model:
    """A model, ready for one object after the other.

    `checkpoint`: a file, `hf:owner/name[@revision]` for one on the Hugging Face hub, or none for the one in this package. `device`:
    "auto", "cpu", or what `freerange.devices()` lists. `encoder_weights`: the folder of a frozen encoder's published weights.
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
        self, images: Any, intrinsics: Any, c2w: Any, masks: Any = None, *, seed: int = 0, **options: Any
    ) -> Gaussians: ...
    @overload
    def reconstruct(
        self, images: Any, intrinsics: Any, c2w: Any, masks: Any = None, *, seed: Sequence[int], **options: Any
    ) -> list[Gaussians]: ...
    def reconstruct(
        self,
        images: Any,
        intrinsics: Any,
        c2w: Any,
        masks: Any = None,
        *,
        seed: int | Sequence[int] = 0,
        convention: str = "opencv",
        up: Any = "z",
        center: Any = None,
        radius: float | None = None,
        on_step: OnStep | None = None,
        **options: Any,
    ) -> Gaussians | list[Gaussians]:
        """Reconstructs an object from two or more posed images of it.

        `images`: `[v, h, w, 3]` or `[v, h, w, 4]` (alpha is the object's mask), `uint8` or floats from 0 to 1, sRGB-encoded; a
        sequence where their sizes differ. `intrinsics`: `[v, 3, 3]`, in pixels; the centre of the first pixel lies at 0.5. `c2w`: camera to
        world, `[v, 4, 4]` or `[v, 3, 4]`, in OpenCV's axes (x right, y down, z forward), or with `convention="opengl"` in OpenGL's and
        Blender's (y up, z backward). `masks`: `[v, h, w]`, bool, `uint8` or floats, white is the object; without them and without alpha
        a plain background is cut away, else poses and colours tell the object (`notes` of the result says how sure).

        `seed`: an integer, or several for a list of as many samples (drawn together, they differ in rounding from one alone). `up`: which way is up in the cameras' frame: "z", "y", "cameras" or a
        direction. `center`, `radius`: where the object is, if that is known. `on_step`: called with a `Step` after each; what it
        raises ends the work, as Ctrl-C does.

        Further options are those of the command line: `quality` ("draft", "default" or "high"), `iterations`, `symmetry` ("auto" or
        "off"), `init` ("fit" or "flow"), `precision`, `network_views`, and `set`, a dictionary of further fields by their paths, as in
        `set={"propose.count": 2}`.
        """
        seeds, chosen = _options(seed, options)
        pictures = _check.images(images, masks)
        sizes = [(picture.shape[1], picture.shape[0]) for picture in pictures]
        cameras = _check.cameras(c2w, intrinsics, sizes, convention, "intrinsics")
        views = [(f"images[{i}]", camera, p.tobytes()) for i, (camera, p) in enumerate(zip(cameras, pictures))]
        center = None if center is None else _check.point("center", center)
        radius = None if radius is None else _check.number("radius", radius)
        result = self._model.reconstruct(views, chosen, _check.up(up), center, radius, _told(on_step))
        return _made(result, seeds, seed)

    @overload
    def reconstruct_scene(self, scene: Scene | str | PathLike[str], *, seed: int = 0, **options: Any) -> Gaussians: ...
    @overload
    def reconstruct_scene(
        self, scene: Scene | str | PathLike[str], *, seed: Sequence[int], **options: Any
    ) -> list[Gaussians]: ...
    def reconstruct_scene(
        self,
        scene: Scene | str | PathLike[str],
        *,
        seed: int | Sequence[int] = 0,
        on_step: OnStep | None = None,
        **options: Any,
    ) -> Gaussians | list[Gaussians]:
        """Reconstructs a scene, or the folder of one: to the byte what the command line makes of it. Options as `reconstruct`."""
        seeds, chosen = _options(seed, options)
        if not isinstance(scene, Scene):
            scene = Scene.read(scene)
        return _made(self._model.reconstruct_scene(scene._scene, chosen, _told(on_step)), seeds, seed)


_COUNTS = {"iterations": 0, "network_views": 1}
_NAMES = ("quality", "symmetry", "init", "precision")


def _options(seed: int | Sequence[int], options: dict[str, Any]) -> tuple[list[int], dict[str, Any]]:
    """Seeds, and every option; those that are not given are `None`."""
    known = (*_NAMES, *_COUNTS, "set")
    for name in options:
        if name not in known:
            raise TypeError(f"{name}: expected one of the options {', '.join(known)}, found another name")
    given = list(seed) if isinstance(seed, (Sequence, np.ndarray)) else [seed]
    seeds = [_check.count("seed", s, 0, 2**64 - 1) for s in given]
    if not 1 <= len(seeds) <= 64:
        raise _check.refuse("seed", "an integer or 1 to 64 of them", f"{len(seeds)} of them")
    fields = options.get("set") or {}
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise _check.wrong_type("set", "a dictionary of names and values", f"{fields!r}")
    chosen: dict[str, Any] = {"seeds": seeds, "set": [(key, json.dumps(value)) for key, value in fields.items()]}
    for name in (*_NAMES, *_COUNTS):
        value = options.get(name)
        if value is None:
            pass
        elif name in _COUNTS:
            value = _check.count(name, value, _COUNTS[name], 2**31)
        elif not isinstance(value, str):
            raise _check.wrong_type(name, "a name", f"{value!r}")
        chosen[name] = value
    return seeds, chosen


def _told(on_step: OnStep | None) -> Any:
    if on_step is None:
        return None
    if not callable(on_step):
        raise _check.wrong_type("on_step", "a function of a Step", type(on_step).__name__)

    def told(stage: str, sample: int, done: int, total: int, loss: float | None, cloud: bytearray | None) -> None:
        on_step(Step(stage, sample, done, total, loss, None if cloud is None else Gaussians._of(cloud)))

    return told


def _made(result: Any, seeds: list[int], seed: int | Sequence[int]) -> Gaussians | list[Gaussians]:
    samples, up, notes, seconds = result
    made = [Gaussians._of(s, up=tuple(up), notes=notes, seconds=seconds, seed=n) for s, n in zip(samples, seeds)]
    return made if isinstance(seed, (Sequence, np.ndarray)) else made[0]
