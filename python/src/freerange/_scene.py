"""Scenes: photos with cameras."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from . import _check, _core
from ._check import Array, Convention, Point, Upright
from ._gaussians import heed

Masks = Literal["auto", "alpha", "plain", "estimate"]
CameraFormat = Literal["transforms", "colmap", "polycam", "metashape", "realitycapture", "opf"]
_MASKS = ("auto", "alpha", "plain", "estimate")


class Scene:
    """Photos with cameras, undistorted and cut out.

    Made by `Scene.read` from a folder, `Scene.from_arrays` from arrays, `Scene.from_pycolmap` from a reconstruction in memory;
    `Model.reconstruct_scene` takes it.

    Attributes:
        names: names of the photos.
        images: `uint8 [h, w, 4]` each; alpha is the object's mask.
        intrinsics: `[v, 3, 3]`, in pixels; the center of the first pixel is at 0.5.
        c2w: `[v, 4, 4]`, camera to world, OpenCV's axes (x right, y down, z forward).
        further: the same four of photos that are only compared with, if the scene has such.
        notes: what was understood, for you to read.
    """

    _scene: _core.Scene
    names: list[str]
    images: list[Array]
    intrinsics: Array
    c2w: Array
    further: tuple[list[str], list[Array], Array, Array]
    notes: list[str]

    def __init__(self) -> None:
        raise TypeError("freerange.Scene is made by Scene.read(path), Scene.from_arrays(...) or Scene.from_pycolmap(...)")

    @classmethod
    def read(
        cls,
        path: str | PathLike[str],
        *,
        masks: Masks | str | PathLike[str] = "auto",
        invert_masks: bool = False,
        up: Upright | Literal["auto"] = "auto",
        center: Point | None = None,
        radius: float | None = None,
        max_side: int = 1024,
        images: str | PathLike[str] | None = None,
        cameras: CameraFormat | None = None,
        turntable: tuple[float, float] | str | None = None,
    ) -> Scene:
        """Reads a folder (or file) of cameras and its photos, as `freerange reconstruct` does.

        Args:
            path: the folder, or the file of cameras.
            masks: "alpha", "plain", "estimate", a folder of masks, or "auto", the first that is there.
            invert_masks: in files of masks black is the object.
            up: "z", "y", "cameras", a direction, or "auto", by the cameras' format.
            center, radius: where the object is, if that is known.
            max_side: longer sides of photos are shrunk to so many pixels.
            images: where the photos are, if not where the cameras say.
            cameras: the format, if the folder has several.
            turntable: elevation and field of view in degrees, of photos without cameras, turned in even steps.

        Raises:
            ValueError, OSError: the file, the field, what was expected and what was found.

        Warns:
            DroppedWarning: something of the scene is left out, or may be wrong.
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
        return cls._of(_core.read_scene(path, photos, _check.up(up)))

    @classmethod
    def from_arrays(
        cls,
        images: npt.ArrayLike,
        intrinsics: npt.ArrayLike | None = None,
        c2w: npt.ArrayLike | None = None,
        masks: npt.ArrayLike | None = None,
        *,
        viewmats: npt.ArrayLike | None = None,
        Ks: npt.ArrayLike | None = None,
        names: Sequence[str] | None = None,
        convention: Convention = "opencv",
        up: Upright = "z",
        center: Point | None = None,
        radius: float | None = None,
    ) -> Scene:
        """Makes a scene of arrays, and cuts the object out.

        Args:
            images, intrinsics, c2w, masks, viewmats, Ks, convention, up, center, radius: as `Model.reconstruct`.
            names: of the views, for messages; `images[0]` and so on by default.

        Raises:
            ValueError, TypeError: the field, what was expected and what was found.

        Warns:
            DroppedWarning: something given is left out, or may make the result wrong.
        """
        _check.no_scene(images, "Scene.read takes a folder")
        poses, k = _check.cameras_given(c2w, viewmats, intrinsics, Ks, "intrinsics")
        rgba = _check.images(images, masks)
        sizes = [(image.shape[1], image.shape[0]) for image in rgba]
        raw = _check.cameras(poses, k, sizes, convention, "intrinsics" if Ks is None else "Ks")
        called = [f"images[{i}]" for i in range(len(rgba))] if names is None else list(names)
        if len(called) != len(rgba) or not all(isinstance(name, str) for name in called):
            raise _check.refuse("names", f"a string for each of {len(rgba)} images", called)
        views = [(name, camera, image.tobytes()) for name, camera, image in zip(called, raw, rgba)]
        center = None if center is None else _check.point("center", center)
        radius = None if radius is None else _check.number("radius", radius)
        return cls._of(_core.scene_of_views(views, _check.up(up), center, radius))

    @classmethod
    def from_pycolmap(
        cls,
        reconstruction: Any,
        images: str | PathLike[str],
        *,
        masks: Masks | str | PathLike[str] = "auto",
        invert_masks: bool = False,
        up: Upright | Literal["auto"] = "auto",
        center: Point | None = None,
        radius: float | None = None,
        max_side: int = 1024,
    ) -> Scene:
        """Makes a scene of a `pycolmap.Reconstruction`: all camera models, with their distortion.

        Args:
            reconstruction: cameras and poses, in memory.
            images: the folder of the photos, by the names that the reconstruction has.
            masks, invert_masks, up, center, radius, max_side: as `Scene.read` has them.

        Raises:
            TypeError: it is no reconstruction.
            ValueError, OSError: as `Scene.read`.

        Warns:
            DroppedWarning: something of the scene is left out, or may be wrong.
        """
        if not hasattr(reconstruction, "write"):
            raise _check.wrong_type("reconstruction", "a pycolmap.Reconstruction", type(reconstruction).__name__)
        with tempfile.TemporaryDirectory() as folder:
            model = Path(folder) / "sparse" / "0"
            model.mkdir(parents=True)
            reconstruction.write(str(model))
            return cls.read(
                folder,
                masks=masks,
                invert_masks=invert_masks,
                up=up,
                center=center,
                radius=radius,
                max_side=max_side,
                images=images,
                cameras="colmap",
            )

    @classmethod
    def _of(cls, scene: _core.Scene) -> Scene:
        made = cls.__new__(cls)
        made._scene = scene
        made.names, made.images, made.intrinsics, made.c2w = _views_of(scene.views())
        made.further = _views_of(scene.further())
        made.notes = heed(scene.notes())
        return made

    @property
    def viewmats(self) -> Array:
        """`[v, 4, 4]`, world to camera, as gsplat and COLMAP have it."""
        return cast(Array, np.linalg.inv(self.c2w))

    @property
    def Ks(self) -> Array:
        """`intrinsics`, under gsplat's name."""
        return self.intrinsics

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"<freerange.Scene: {len(self)} views, {len(self.further[0])} further>"


def _views_of(told: list[tuple[str, _check.RawCamera, bytearray]]) -> tuple[list[str], list[Array], Array, Array]:
    """Names, RGBA images, intrinsics and poses of views that the part in Rust told of."""
    names, images, intrinsics, poses = [], [], [], []
    for name, (width, height, (fx, fy, cx, cy), c2w), rgba in told:
        names.append(name)
        images.append(np.frombuffer(rgba, dtype=np.uint8).reshape(height, width, 4))
        intrinsics.append([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        poses.append(c2w)
    return names, images, np.array(intrinsics).reshape(-1, 3, 3), np.array(poses).reshape(-1, 4, 4)
