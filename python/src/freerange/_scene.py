"""Scenes on disk."""

from __future__ import annotations

from os import PathLike, fspath
from typing import Any

from . import _check, _core
from ._check import Array
from ._gaussians import views_of

_MASKS = ("auto", "alpha", "plain", "estimate")


class Scene:
    """Photos with cameras, freed of their lenses and cut out.

    `names`, `images` (a list of `uint8 [h, w, 4]`, alpha is the object's mask), `intrinsics [v, 3, 3]` and `c2w [v, 4, 4]` (OpenCV's axes)
    of the views to reconstruct from; `further` the same of views that are only compared with, if the scene has such.
    """

    _scene: _core.Scene
    names: list[str]
    images: list[Array]
    intrinsics: Array
    c2w: Array
    #: Names, images, intrinsics, c2w.
    further: tuple[list[str], list[Array], Array, Array]
    #: What was understood, for you to read.
    notes: list[str]

    def __init__(self) -> None:
        raise TypeError("freerange.Scene is read from disk: Scene.read(path); views in memory go to Model.reconstruct")

    @classmethod
    def read(
        cls,
        path: str | PathLike[str],
        *,
        masks: str | PathLike[str] = "auto",
        invert_masks: bool = False,
        up: Any = "auto",
        center: Any = None,
        radius: float | None = None,
        max_side: int = 1024,
        images: str | PathLike[str] | None = None,
        cameras: str | None = None,
        turntable: tuple[float, float] | str | None = None,
    ) -> Scene:
        """Reads a folder (or file) of cameras and its photos; options as of `freerange reconstruct`.

        `masks`: "alpha", "plain", "estimate", a folder of masks, or "auto", the first that is there. `up`: "z", "y", "cameras", a
        direction, or "auto". `turntable`: elevation and field of view in degrees, of photos without cameras.
        """
        named = masks if isinstance(masks, str) and masks in _MASKS else None
        if isinstance(turntable, (tuple, list)):
            turntable = ",".join(str(_check.number("turntable", v)) for v in turntable)
        photos = {
            "cameras": cameras,
            "turntable": turntable,
            "images": images,
            "masks": named or "auto",
            "mask_folder": None if named else fspath(masks),
            "invert_masks": invert_masks,
            "max_side": _check.count("max_side", max_side, 64, 16384),
            "center": None if center is None else _check.point("center", center),
            "radius": None if radius is None else _check.number("radius", radius),
        }
        made = cls.__new__(cls)
        made._scene = _core.read_scene(path, photos, _check.up(up))
        made.names, made.images, made.intrinsics, made.c2w = views_of(made._scene.views())
        made.further = views_of(made._scene.further())
        made.notes = made._scene.notes()
        return made

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"<freerange.Scene: {len(self)} views, {len(self.further[0])} further>"
