"""Gaussians as arrays, their files and their pictures."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from os import PathLike
from typing import Any

import numpy as np

from . import _check, _core
from ._check import Array, Floats

# Channels of a row: centre (3), log of the deviations (3), rotation w x y z (4), logit of the opacity, colour (3).
CHANNELS = 14
# Opacities of 0 and 1 have no finite logit.
OPACITY_MARGIN = 1e-6


def _of_bytes(data: bytearray, *shape: int) -> Floats:
    """Wraps the memory, without a copy."""
    return np.frombuffer(data, dtype=np.float32).reshape(shape)


class Gaussians:
    """3D Gaussians in the frame of the cameras they were made from.

    Every array is new, contiguous and `float32`, for you to keep: NumPy's and everybody else's who speaks DLPack
    (`torch.from_dlpack(g.means)` copies nothing). What you change in them does not change these Gaussians: make others
    of them, `Gaussians(means, scales, quats, opacities, colors)`.
    """

    __slots__ = ("_rows", "notes", "seconds", "seed", "up")

    _rows: Floats
    #: The direction of up in their frame: files that fix their own (.glb, .spz) are turned by it.
    up: tuple[float, float, float]
    #: What was understood of the photos or of the file, for you to read.
    notes: list[str]
    #: Seconds per stage of what made them.
    seconds: dict[str, float]
    #: What they were drawn with, if they are a sample.
    seed: int | None

    def __init__(
        self,
        means: Any,
        scales: Any,
        quats: Any,
        opacities: Any,
        colors: Any,
        *,
        up: Any = (0.0, 0.0, 1.0),
    ) -> None:
        """Of arrays, as the properties of these names have them."""
        means = _check.shaped("means", means, (None, 3), "[n, 3]")
        n = len(means)
        scales = _check.shaped("scales", scales, (n, 3), f"[{n}, 3]")
        quats = _check.shaped("quats", quats, (n, 4), f"[{n}, 4]")
        opacities = _check.shaped("opacities", opacities, (n,), f"[{n}]")
        colors = _check.shaped("colors", colors, (n, 3), f"[{n}, 3]")
        if n and not scales.min() > 0.0:
            raise _check.refuse("scales", "numbers above 0", scales.min())
        if n and (opacities.min() < 0.0 or opacities.max() > 1.0):
            raise _check.refuse("opacities", "numbers from 0 to 1", f"{opacities.min()} to {opacities.max()}")
        lengths = np.linalg.norm(quats.astype(np.float64), axis=1)
        if n and not lengths.min() > 1e-12:
            raise _check.refuse(f"quats[{int(np.argmin(lengths))}]", "a rotation", quats[np.argmin(lengths)].tolist())
        rows = np.empty((n, CHANNELS), dtype=np.float32)
        opacities = np.clip(opacities.astype(np.float64), OPACITY_MARGIN, 1.0 - OPACITY_MARGIN)
        rows[:, 0:3] = means
        rows[:, 3:6] = np.log(scales.astype(np.float64))
        rows[:, 6:10] = quats
        rows[:, 10] = np.log(opacities / (1.0 - opacities))
        rows[:, 11:14] = colors
        self._set(rows, up=_check.point("up", up))

    def _set(
        self,
        rows: Floats,
        *,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        notes: Iterable[str] = (),
        seconds: Iterable[tuple[str, float]] = (),
        seed: int | None = None,
    ) -> None:
        self._rows, self.up, self.notes, self.seconds, self.seed = rows, up, list(notes), dict(seconds), seed

    @classmethod
    def _of(cls, data: bytearray, **told: Any) -> Gaussians:
        made = cls.__new__(cls)
        made._set(_of_bytes(data, -1, CHANNELS), **told)
        return made

    @classmethod
    def from_rows(cls, rows: Any, *, up: Any = (0.0, 0.0, 1.0)) -> Gaussians:
        """Of rows as `rows` gives them."""
        found = _check.shaped("rows", rows, (None, CHANNELS), f"[n, {CHANNELS}]")
        made = cls.__new__(cls)
        made._set(np.array(found, dtype=np.float32), up=_check.point("up", up))
        return made

    @classmethod
    def read(cls, path: str | PathLike[str], *, up: Any = (0.0, 0.0, 1.0)) -> Gaussians:
        """From a .ply, .splat, .spz, .sog, .glb, or an .html that this program wrote.

        `up`: the direction of up in the frame that you want; .glb and .spz, which have +y up, are turned into it.
        """
        direction = _check.point("up", up)
        data, notes = _core.read_gaussians(path, direction)
        return cls._of(data, up=direction, notes=notes)

    def __len__(self) -> int:
        return len(self._rows)

    def __repr__(self) -> str:
        return f"<freerange.Gaussians: {len(self)}>"

    def __reduce__(self) -> Any:
        return _restored, (self._rows, self.up, self.notes, self.seconds, self.seed)

    @property
    def rows(self) -> Floats:
        """`[n, 14]`: centre, natural log of the deviations, rotation w x y z, logit of the opacity, colour."""
        return self._rows.copy()

    @property
    def means(self) -> Floats:
        """`[n, 3]`: centres, in the lengths of the cameras' frame."""
        return self._rows[:, 0:3].copy()

    @property
    def scales(self) -> Floats:
        """`[n, 3]`: standard deviations along each one's own axes, above 0."""
        scales: Floats = np.exp(self._rows[:, 3:6])
        return scales

    @property
    def quats(self) -> Floats:
        """`[n, 4]`: rotations from their own axes to the frame's, w x y z, of unit length."""
        raw = self._rows[:, 6:10].astype(np.float64)
        length = np.linalg.norm(raw, axis=1, keepdims=True)
        unit: Array = np.divide(raw, length, out=np.tile([1.0, 0.0, 0.0, 0.0], (len(raw), 1)), where=length > 0.0)
        return unit.astype(np.float32)

    @property
    def opacities(self) -> Floats:
        """`[n]`: from 0 to 1."""
        # Either form overflows on one side only, and is right there.
        with np.errstate(over="ignore"):
            return (1.0 / (1.0 + np.exp(-self._rows[:, 10].astype(np.float64)))).astype(np.float32)

    @property
    def colors(self) -> Floats:
        """`[n, 3]`: red, green, blue, sRGB-encoded as in image files; mostly from 0 to 1, not clamped."""
        return self._rows[:, 11:14].copy()

    def save(self, path: str | PathLike[str]) -> list[str]:
        """Writes .ply, .splat, .spz, .sog, .glb or .html (a page that shows them), by the extension.

        Returns what the format could not hold, a sentence each.
        """
        return _core.write_gaussians(self._rows.tobytes(), path, self.up)

    def render(
        self,
        c2w: Any,
        K: Any,
        width: int,
        height: int,
        background: Any = 1.0,
        *,
        convention: str = "opencv",
    ) -> Floats:
        """Pictures of them: `float32`, `[h, w, 3]`, or `[v, h, w, 3]` for `c2w [v, 4, 4]` and `K [v, 3, 3]`.

        Colours are those of image files (sRGB-encoded) and not clamped. `background`: a number, a colour, or one per view.
        See `freerange.render` for cameras and for gradients.
        """
        rgb, _ = _render(self._rows, c2w, K, width, height, background, convention)
        return rgb


def _restored(
    rows: Floats, up: tuple[float, float, float], notes: list[str], seconds: dict[str, float], seed: int | None
) -> Gaussians:
    made = Gaussians.__new__(Gaussians)
    made._set(rows, up=up, notes=notes, seconds=seconds.items(), seed=seed)
    return made


def raw_cameras(
    c2w: Any, K: Any, width: int, height: int, background: Any, convention: str
) -> tuple[list[_check.RawCamera], list[tuple[float, float, float]], bool]:
    """Cameras and backgrounds for the rasteriser, and whether it was a single camera."""
    size = (_check.count("width", width, 1, 16384), _check.count("height", height, 1, 16384))
    poses, k = _check.array("c2w", c2w), _check.array("K", K)
    single = poses.ndim == 2
    if single:
        poses, k = poses[None], k[None]
    if poses.ndim != 3 or len(poses) == 0:
        raise _check.refuse("c2w", "the shape [4, 4] or [v, 4, 4]", list(poses.shape))
    if not single and k.ndim == 2:
        k = np.broadcast_to(k, (len(poses), *k.shape))
    cameras = _check.cameras(poses, k, [size] * len(poses), convention, "K")
    return cameras, _check.color("background", background, len(poses)), single


def _render(
    rows: Floats, c2w: Any, K: Any, width: int, height: int, background: Any, convention: str
) -> tuple[Floats, Floats]:
    cameras, backgrounds, single = raw_cameras(c2w, K, width, height, background, convention)
    rendered = _core.rasterize(rows.tobytes(), cameras, backgrounds)
    rgb = _of_bytes(rendered.rgb(), len(cameras), height, width, 3)
    alpha = _of_bytes(rendered.alpha(), len(cameras), height, width)
    return (rgb[0], alpha[0]) if single else (rgb, alpha)


def render(
    means: Any,
    scales: Any,
    quats: Any,
    opacities: Any,
    colors: Any,
    c2w: Any,
    K: Any,
    width: int,
    height: int,
    background: Any = 1.0,
    *,
    convention: str = "opencv",
) -> tuple[Any, Any]:
    """Renders Gaussians: colour over the background, `[v, h, w, 3]`, and alpha, `[v, h, w]`; without v for one camera.

    Arrays as `Gaussians` has them. Of PyTorch tensors the results are tensors that can be differentiated in all five and in the
    background (once); the work is done on the CPU. Of NumPy arrays they are `float32` arrays.

    `c2w`: camera to world, `[4, 4]` or `[v, 4, 4]` (a fourth row may be left out), in OpenCV's axes (x right, y down, z forward), or with
    `convention="opengl"` in OpenGL's and Blender's (y up, z backward). `K`: in pixels; the centre of the first pixel lies at 0.5.
    """
    arrays = (means, scales, quats, opacities, colors)
    torch = sys.modules.get("torch")
    if torch is not None and any(isinstance(a, torch.Tensor) for a in (*arrays, background)):
        from .torch import render as differentiable

        return differentiable(*arrays, c2w, K, width, height, background, convention=convention)
    return _render(Gaussians(*arrays)._rows, c2w, K, width, height, background, convention)


def views_of(
    told: list[tuple[str, tuple[int, int, tuple[float, ...], list[list[float]]], bytearray]],
) -> tuple[list[str], list[Array], Array, Array]:
    """Names, RGBA pictures, intrinsics and poses of views that the part in Rust told of."""
    names, pictures, intrinsics, poses = [], [], [], []
    for name, (width, height, (fx, fy, cx, cy), c2w), rgba in told:
        names.append(name)
        pictures.append(np.frombuffer(rgba, dtype=np.uint8).reshape(height, width, 4))
        intrinsics.append([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        poses.append(c2w)
    return names, pictures, np.array(intrinsics).reshape(-1, 3, 3), np.array(poses).reshape(-1, 4, 4)
