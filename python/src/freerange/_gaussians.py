"""Gaussians as arrays, their files and renders."""

from __future__ import annotations

import inspect
import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from . import _check, _core
from ._check import Array, Arrays, Convention, Floats, Point

# Channels of a row: center (3), log of the deviations (3), rotation w x y z (4), logit of the opacity, color (3).
CHANNELS = 14
# Opacities of 0 and 1 have no finite logit.
OPACITY_MARGIN = 1e-6
# Coefficients of a channel without the constant, by degree of the spherical harmonics.
SH_COEFFICIENTS = (0, 3, 8, 15)


class DroppedWarning(UserWarning):
    """Something that was given is left out, or may make the result wrong."""


# Folder of this package.
_PACKAGE = os.path.dirname(__file__)


def heed(notes: Iterable[tuple[bool, str]]) -> list[str]:
    """The notes' sentences. Those of what is left out, or may be wrong, are warnings as well."""
    told = list(notes)
    # A warning names the line of the user's that called this package, however deep the call is.
    frame, level = inspect.currentframe(), 1
    while frame is not None and os.path.dirname(frame.f_code.co_filename) == _PACKAGE:
        frame, level = frame.f_back, level + 1
    for grave, text in told:
        if grave:
            warnings.warn(text, DroppedWarning, stacklevel=level)
    return [text for _, text in told]


class Render(NamedTuple):
    """Images of Gaussians: arrays of NumPy or tensors of PyTorch, as the Gaussians were. Without `v` for a single camera.

    Attributes:
        rgb: color over the background, `[v, h, w, 3]`, sRGB-encoded, not clamped.
        alpha: 1 - transmittance, `[v, h, w]`.
        depth: mean camera z of what is seen, `[v, h, w]`, in the cameras' units; 0 where nothing is. None unless asked for.
    """

    rgb: Any
    alpha: Any
    depth: Any = None


def _of_bytes(data: bytearray, *shape: int) -> Floats:
    """Wraps the memory, without a copy."""
    return np.frombuffer(data, dtype=np.float32).reshape(shape)


class Gaussians:
    """3D Gaussians in the frame of the cameras they were made from.

    Every array is new, contiguous and `float32`, for you to keep: NumPy's and everybody else's who speaks DLPack
    (`torch.from_dlpack(g.means)` copies nothing). What you change in them does not change these Gaussians: make others
    of them, `Gaussians(means, scales, quats, opacities, colors)`.

    Attributes:
        up: the direction of up in their frame: files that fix their own (.glb, .spz) are turned by it.
        notes: what was understood of the photos or of the file, for you to read.
        seconds: seconds per stage of what made them.
        seed: what they were drawn with, if they are a sample.
    """

    __slots__ = ("_rows", "_sh", "notes", "seconds", "seed", "up")

    _rows: Floats
    _sh: Floats
    up: tuple[float, float, float]
    notes: list[str]
    seconds: dict[str, float]
    seed: int | None

    def __init__(
        self,
        means: npt.ArrayLike,
        scales: npt.ArrayLike,
        quats: npt.ArrayLike,
        opacities: npt.ArrayLike,
        colors: npt.ArrayLike,
        *,
        sh: npt.ArrayLike | None = None,
        up: Point = (0.0, 0.0, 1.0),
    ) -> None:
        """Makes Gaussians of arrays.

        Args:
            means: `[n, 3]`, centers.
            scales: `[n, 3]`, standard deviations, above 0.
            quats: `[n, 4]`, rotations w x y z of any length. `scales` and `quats` may be exchanged, as gsplat has them.
            opacities: `[n]` or `[n, 1]`, from 0 to 1.
            colors: `[n, 3]`, sRGB-encoded, mostly from 0 to 1. Or `[n, 1 + k, 3]`, all coefficients of spherical harmonics, as
                gsplat has them and `to_torch` gives them.
            sh: `[n, k, 3]` with k of 3, 8 or 15, spherical harmonics of degree 1 to 3 (gsplat's `shN`); none by default.
            up: the direction of up in their frame.

        Raises:
            ValueError, TypeError: the field, what was expected and what was found.
        """
        colors, sh = _check.coefficients(colors, sh)
        means, scales, quats, opacities, colors = _check.gaussians(means, scales, quats, opacities, colors)
        n = len(means)
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
        self._set(rows, _check.harmonics(sh, n), up=_check.point("up", up))

    def _set(
        self,
        rows: Floats,
        sh: Floats | None = None,
        *,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        notes: Iterable[str] = (),
        seconds: Iterable[tuple[str, float]] = (),
        seed: int | None = None,
    ) -> None:
        self._rows = rows
        self._sh = np.empty((len(rows), 0, 3), dtype=np.float32) if sh is None else sh
        self.up, self.notes, self.seconds, self.seed = up, list(notes), dict(seconds), seed

    @classmethod
    def _of(cls, data: bytearray, sh: Floats | None = None, **told: Any) -> Gaussians:
        made = cls.__new__(cls)
        made._set(_of_bytes(data, -1, CHANNELS), sh, **told)
        return made

    @classmethod
    def _of_splats(cls, splats: tuple[bytearray, int, bytearray], **told: Any) -> Gaussians:
        data, degree, harmonics = splats
        sh = _of_bytes(harmonics, -1, SH_COEFFICIENTS[degree], 3) if degree else None
        return cls._of(data, sh, **told)

    def _splats(self) -> tuple[bytes, int, bytes]:
        return self._rows.tobytes(), self.sh_degree, self._sh.tobytes()

    def _like(self, rows: Floats, sh: Floats) -> Gaussians:
        """Others, in the same frame and of the same origin."""
        made = Gaussians.__new__(Gaussians)
        made._set(rows, sh, up=self.up, notes=self.notes, seconds=self.seconds.items(), seed=self.seed)
        return made

    @classmethod
    def from_rows(cls, rows: npt.ArrayLike, *, up: Point = (0.0, 0.0, 1.0)) -> Gaussians:
        """Makes Gaussians of rows.

        Args:
            rows: `[n, 14]`, as the property `rows` has them.
            up: the direction of up in their frame.

        Raises:
            ValueError, TypeError: the field, what was expected and what was found.
        """
        found = _check.shaped("rows", rows, (None, CHANNELS), f"[n, {CHANNELS}]")
        made = cls.__new__(cls)
        made._set(np.array(found, dtype=np.float32), up=_check.point("up", up))
        return made

    @classmethod
    def read(cls, path: str | PathLike[str], *, up: Point | None = None) -> Gaussians:
        """Reads a .ply, .splat, .spz, .sog, .glb, .gltf, .usda or .usdz, or an .html that this program wrote.

        Args:
            path: the file.
            up: the direction of up in the frame that you want. Formats that fix theirs, as .glb, are turned into it.
                None is what the file says (a comment of a .ply, a page), else +z.

        Raises:
            ValueError, OSError: the file, what was expected and what was found.

        Warns:
            DroppedWarning: something of the file is left out.
        """
        splats, direction, notes = _core.read_gaussians(path, None if up is None else _check.point("up", up))
        return cls._of_splats(splats, up=tuple(direction), notes=heed(notes))

    @classmethod
    def concat(cls, parts: Iterable[Gaussians]) -> Gaussians:
        """All of several, one after the other, in the frame of the first. Harmonics get the highest degree of all.

        Args:
            parts: one or more.
        """
        listed = list(parts)
        if not listed:
            raise _check.refuse("parts", "one or more Gaussians", "none")
        for i, part in enumerate(listed):
            if not isinstance(part, Gaussians):
                raise _check.wrong_type(f"parts[{i}]", "Gaussians", type(part).__name__)
        k = max(part._sh.shape[1] for part in listed)
        sh = np.concatenate([np.pad(part._sh, ((0, 0), (0, k - part._sh.shape[1]), (0, 0))) for part in listed])
        return listed[0]._like(np.concatenate([part._rows for part in listed]), sh)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int | slice | npt.ArrayLike) -> Gaussians:
        """Some of them: by a number, a slice, numbers, or a mask, as an array's rows."""
        if isinstance(index, (int, np.integer)) and not isinstance(index, bool):
            if not -len(self) <= index < len(self):
                raise IndexError(f"Gaussian {index} of {len(self)}")
            index = [int(index)]
        elif not isinstance(index, slice):
            index = _check.indices(index, len(self))
        return self._like(self._rows[index].copy(), self._sh[index].copy())

    def __iter__(self) -> Iterator[Gaussians]:
        return (self[i] for i in range(len(self)))

    def __add__(self, other: Gaussians) -> Gaussians:
        return Gaussians.concat([self, other]) if isinstance(other, Gaussians) else NotImplemented

    def crop(self, low: Point, high: Point) -> Gaussians:
        """Those whose centers lie in a box.

        Args:
            low, high: `[3]`, corners of the box in their frame; numbers may be infinite.
        """
        least, most = _check.corner("low", low), _check.corner("high", high)
        if not (least < most).all():
            raise _check.refuse("high", f"a corner above low, {least.tolist()}", most.tolist())
        return self[((self._rows[:, 0:3] >= least) & (self._rows[:, 0:3] <= most)).all(axis=1)]

    def transform(self, matrix: npt.ArrayLike) -> Gaussians:
        """Moved by a similarity. Harmonics and up turn with them.

        Args:
            matrix: `[4, 4]` or `[3, 4]`, a rotation times a scale, and a translation.

        Raises:
            ValueError: it mirrors, shears or stretches.
        """
        scale, rotation, quat, translation = _check.similarity("matrix", matrix)
        moved = Gaussians._of_splats(_core.transform(*self._splats(), scale, quat, translation))
        made = self._like(moved._rows, moved._sh)
        x, y, z = (rotation @ np.array(self.up)).tolist()
        made.up = (x, y, z)
        return made

    def to_torch(self, device: Any = "cpu") -> dict[str, Any]:
        """Tensors under gsplat's names: `means`, `quats`, `scales`, `opacities`, `colors`, float32.

        `gsplat.rasterization(**g.to_torch("cuda"), viewmats=..., Ks=..., width=..., height=...)` draws them. With spherical
        harmonics `colors` holds all coefficients, `[n, 1 + k, 3]`: give `sh_degree=g.sh_degree` as well.
        `Gaussians(**tensors)` makes Gaussians of them again; PyTorch must be there.

        Args:
            device: of the tensors, as PyTorch names it.

        Raises:
            ImportError: PyTorch is not installed.
        """
        try:
            import torch
        except ImportError as error:
            raise ImportError("to_torch: expected PyTorch, found none: pip install torch") from error

        colors = self.colors
        if self.sh_degree:
            # gsplat, as 3DGS, adds 0.5 to what the constant of degree 0 gives.
            constant = (colors[:, None] - np.float32(0.5)) / np.float32(_check.SH_CONSTANT)
            colors = np.concatenate([constant, self._sh], axis=1)
        fields = {"means": self.means, "quats": self.quats, "scales": self.scales}
        fields |= {"opacities": self.opacities, "colors": colors}
        return {name: torch.from_numpy(value).to(device) for name, value in fields.items()}

    def __repr__(self) -> str:
        degree = f", spherical harmonics of degree {self.sh_degree}" if self.sh_degree else ""
        return f"<freerange.Gaussians: {len(self)}{degree}>"

    def __reduce__(self) -> Any:
        return _restored, (self._rows, self._sh, self.up, self.notes, self.seconds, self.seed)

    @property
    def sh(self) -> Floats:
        """`[n, k, 3]`: spherical harmonics of degree 1 and up, 3DGS's basis; k is 0, 3, 8 or 15. Results of models have none."""
        return self._sh.copy()

    @property
    def sh_degree(self) -> int:
        """0 to 3; 0: color is the same from everywhere."""
        return SH_COEFFICIENTS.index(self._sh.shape[1])

    @property
    def rows(self) -> Floats:
        """`[n, 14]`: center, natural log of the deviations, rotation w x y z, logit of the opacity, color."""
        return self._rows.copy()

    @property
    def means(self) -> Floats:
        """`[n, 3]`: centers, in the lengths of the cameras' frame."""
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

    def save(self, path: str | PathLike[str]) -> None:
        """Writes .ply, .splat, .spz, .sog, .glb, .usda, .usdz or .html (a page that shows them), by the extension.

        Args:
            path: the file.

        Raises:
            ValueError, OSError: no format has this extension, or the file cannot be written.

        Warns:
            DroppedWarning: the format cannot hold something, a sentence each.
        """
        _check.folder_of(path)
        heed(_core.write_gaussians(*self._splats(), path, self.up))

    def render(
        self,
        c2w: npt.ArrayLike | None = None,
        K: npt.ArrayLike | None = None,
        width: int = 512,
        height: int = 512,
        background: npt.ArrayLike = 1.0,
        *,
        viewmats: npt.ArrayLike | None = None,
        Ks: npt.ArrayLike | None = None,
        backgrounds: npt.ArrayLike | None = None,
        convention: Convention = "opencv",
        depth: bool = False,
    ) -> Render:
        """Images of them, `float32` arrays; color follows the viewing direction where there are spherical harmonics.

        Args:
            c2w, K, width, height, background, viewmats, Ks, convention, depth: as `freerange.render` has them.
            backgrounds: the same as `background`, gsplat's name.

        Returns:
            A `Render`.

        Raises:
            ValueError, TypeError: the field, what was expected and what was found.
        """
        poses, k = _check.cameras_given(c2w, viewmats, K, Ks, "K")
        background = _check.background_given(background, backgrounds)
        return _render(self, poses, k, width, height, background, convention, depth)


def _restored(
    rows: Floats,
    sh: Floats,
    up: tuple[float, float, float],
    notes: list[str],
    seconds: dict[str, float],
    seed: int | None,
) -> Gaussians:
    made = Gaussians.__new__(Gaussians)
    made._set(rows, sh, up=up, notes=notes, seconds=seconds.items(), seed=seed)
    return made


def raw_cameras(
    c2w: Any, K: Any, width: int, height: int, background: Any, convention: str
) -> tuple[list[_check.RawCamera], list[tuple[float, float, float]], bool]:
    """Cameras and backgrounds for the rasterizer, and whether it was a single camera."""
    size = (_check.count("width", width, 1, 16384), _check.count("height", height, 1, 16384))
    poses, k = _check.array("c2w", c2w), _check.array("K", K)
    single = poses.ndim == 2
    if single:
        poses = poses[None]
    if poses.ndim != 3 or len(poses) == 0:
        raise _check.refuse("c2w", "the shape [4, 4] or [v, 4, 4]", list(poses.shape))
    cameras = _check.cameras(poses, k, [size] * len(poses), convention, "K")
    return cameras, _check.color("background", background, len(poses)), single


def _render(
    gaussians: Gaussians, c2w: Any, K: Any, width: int, height: int, background: Any, convention: str, depth: bool
) -> Render:
    cameras, backgrounds, single = raw_cameras(c2w, K, width, height, background, convention)
    if gaussians.sh_degree:
        # Colors differ from camera to camera.
        eyes = [tuple(row[3] for row in camera[3][:3]) for camera in cameras]
        seen = [_core.seen_from(*gaussians._splats(), eye) for eye in eyes]  # type: ignore[arg-type]
        parts = [_core.rasterize(bytes(r), [c], [b], depth) for r, c, b in zip(seen, cameras, backgrounds)]
    else:
        parts = [_core.rasterize(gaussians._rows.tobytes(), cameras, backgrounds, depth)]

    def joined(arrays: Sequence[bytearray], *shape: int) -> Floats:
        return np.concatenate([_of_bytes(a, -1, height, width, *shape) for a in arrays])

    rgb = joined([part.rgb() for part in parts], 3)
    alpha = joined([part.alpha() for part in parts])
    mean = None
    if depth:
        z = joined([part.depth() for part in parts])
        mean = np.divide(z, alpha, out=np.zeros_like(z), where=alpha > 0.0)
    if single:
        return Render(rgb[0], alpha[0], None if mean is None else mean[0])
    return Render(rgb, alpha, mean)


def render(
    means: Arrays,
    scales: Arrays,
    quats: Arrays,
    opacities: Arrays,
    colors: Arrays,
    c2w: Arrays | None = None,
    K: Arrays | None = None,
    width: int = 512,
    height: int = 512,
    background: Arrays = 1.0,
    *,
    viewmats: Arrays | None = None,
    Ks: Arrays | None = None,
    backgrounds: Arrays | None = None,
    convention: Convention = "opencv",
    depth: bool = False,
) -> Render:
    """Renders Gaussians on the CPU: color over the background, alpha, and depth if asked for.

    Of PyTorch tensors the results are tensors that can be differentiated in all five arrays and in the background (once). Of NumPy
    arrays they are `float32` arrays.

    Args:
        means, scales, quats, opacities, colors: as `Gaussians` has them; gsplat's order (means, quats, scales, ...) is
            known by the shapes. `colors` may hold all coefficients of spherical harmonics, as `to_torch` gives them.
            With gsplat's order give its cameras by name, `viewmats=` and `Ks=`: the sixth argument is `c2w`.
        c2w: camera to world, `[4, 4]` or `[v, 4, 4]`; a fourth row may be left out. OpenCV's axes: x right, y down, z forward.
        K: `[v, 3, 3]`, or `[3, 3]` for all, in pixels; the center of the first pixel is at 0.5.
        width, height: in pixels.
        background: a number, a color `[3]`, or one for each view; white by default.
        viewmats: world to camera instead of `c2w`, as gsplat has it.
        Ks: the same as `K`.
        backgrounds: the same as `background`, gsplat's name.
        convention: "opengl" for OpenGL's and Blender's axes (y up, z backward).
        depth: whether the depth is computed.

    Returns:
        A `Render`.

    Raises:
        ValueError, TypeError: the field, what was expected and what was found.
    """
    _check.own_order(scales, quats, c2w)
    poses, k = _check.cameras_given(c2w, viewmats, K, Ks, "K")
    background = _check.background_given(background, backgrounds)
    loaded = sys.modules.get("torch")
    if loaded is not None and any(isinstance(a, loaded.Tensor) for a in (means, scales, quats, opacities, colors, background)):
        from .torch import _render as differentiable

        arrays = (means, scales, quats, opacities, colors)
        return differentiable(*arrays, poses, k, width, height, background, convention, depth)
    made = Gaussians(means, scales, quats, opacities, colors)
    return _render(made, poses, k, width, height, background, convention, depth)
