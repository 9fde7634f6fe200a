"""Arguments, checked field by field: what is wrong is said with the field, what was expected and what was found."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Literal, Union

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
RawCamera = tuple[int, int, tuple[float, ...], list[list[float]]]
Up = Union[str, tuple[float, float, float]]
# What users give: arrays or tensors; three numbers; which way is up in the cameras' frame.
if TYPE_CHECKING:
    import torch

    Arrays = Union[npt.ArrayLike, torch.Tensor]
else:
    Arrays = npt.ArrayLike
Point = Union[Sequence[float], Array]
Upright = Union[Literal["z", "y", "cameras"], Point]

Convention = Literal["opencv", "opengl"]
CONVENTIONS = ("opencv", "opengl")
# Value of the spherical harmonic of degree 0.
SH_CONSTANT = 0.28209479177387814
# OpenGL's cameras have y up and z backward.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def refuse(field: str, expected: str, found: object) -> ValueError:
    return ValueError(f"{field}: expected {expected}, found {found}")


def wrong_type(field: str, expected: str, found: object) -> TypeError:
    return TypeError(f"{field}: expected {expected}, found {found}")


def array(field: str, value: Any, kinds: str = "iuf", expected: str = "numbers") -> Array:
    """An array of one of these kinds of element."""
    try:
        found = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as error:
        raise wrong_type(field, f"an array of {expected}", f"{type(value).__name__} ({error})") from None
    if found.dtype.kind not in kinds:
        raise wrong_type(field, f"an array of {expected}", f"{type(value).__name__} of {found.dtype}")
    return found


def shaped(field: str, value: Any, shape: tuple[int | None, ...], names: str) -> Array:
    """An array of finite numbers of this shape; `None` is any length."""
    found = array(field, value)
    if found.ndim != len(shape) or any(e is not None and e != f for e, f in zip(shape, found.shape)):
        raise refuse(field, f"the shape {names}", list(found.shape))
    finite(field, found)
    return found


def finite(field: str, found: Array) -> None:
    if found.dtype.kind == "f" and not np.isfinite(found).all():
        at = np.unravel_index(int(np.argmin(np.isfinite(found))), found.shape)
        raise refuse(f"{field}[{', '.join(map(str, at))}]", "a finite number", found[at])


def count(field: str, value: Any, least: int, most: int | None = None) -> int:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise wrong_type(field, "an integer", f"{value!r}")
    if value < least or (most is not None and value > most):
        expected = f"at least {least}" if most is None else f"{least} to {most}"
        raise refuse(field, expected, value)
    return int(value)


def number(field: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise wrong_type(field, "a number", f"{value!r}")
    if not np.isfinite(value):
        raise refuse(field, "a finite number", value)
    return float(value)


def point(field: str, value: Any) -> tuple[float, float, float]:
    x, y, z = shaped(field, value, (3,), "[3]").tolist()
    return (float(x), float(y), float(z))


def corner(field: str, value: Any) -> Array:
    """Three numbers, of which some may be infinite."""
    found = array(field, value).astype(np.float64)
    if found.shape != (3,):
        raise refuse(field, "the shape [3]", list(found.shape))
    if np.isnan(found).any():
        raise refuse(field, "numbers or infinity", found.tolist())
    return found


def folder_of(path: str | PathLike[str]) -> None:
    """Refuses a file in a folder that does not exist."""
    folder = os.path.dirname(os.path.abspath(path))
    if not os.path.isdir(folder):
        number, found = (errno.ENOTDIR, "a file") if os.path.lexists(folder) else (errno.ENOENT, "none")
        raise OSError(number, f"expected a folder to write to, found {found}", folder)


def up(value: Any) -> Up:
    return value if isinstance(value, str) else point("up", value)


def color(field: str, value: Any, views: int) -> list[tuple[float, float, float]]:
    """One color for all views, or one for each."""
    found = array(field, value)
    if found.shape not in ((), (3,), (views, 3)):
        raise refuse(field, f"a number, the shape [3] or [{views}, 3]", list(found.shape))
    finite(field, found)
    return [tuple(row) for row in np.broadcast_to(found, (views, 3)).astype(np.float64).tolist()]


def gaussians(
    means: Any, scales: Any, quats: Any, opacities: Any, colors: Any
) -> tuple[Array, Array, Array, Array, Array]:
    """The five arrays; scales and quaternions in either order, which their shapes tell."""
    if gsplats_order(scales, quats):
        scales, quats = quats, scales
    means = shaped("means", means, (None, 3), "[n, 3]")
    n = len(means)
    if np.shape(opacities) == (n, 1):
        opacities = array("opacities", opacities)[:, 0]
    return (
        means,
        shaped("scales", scales, (n, 3), f"[{n}, 3]"),
        shaped("quats", quats, (n, 4), f"[{n}, 4]"),
        shaped("opacities", opacities, (n,), f"[{n}]"),
        shaped("colors", colors, (n, 3), f"[{n}, 3]"),
    )


def gsplats_order(scales: Any, quats: Any) -> bool:
    """Whether what is called scales are quaternions, and the other way round."""
    last = [tuple(getattr(a, "shape", None) or np.shape(a))[-1:] for a in (scales, quats)]
    return last == [(4,), (3,)]


def own_order(scales: Any, quats: Any, c2w: Any) -> None:
    """Refuses gsplat's order with `c2w`, since its sixth argument is `viewmats`."""
    if c2w is not None and gsplats_order(scales, quats):
        ours = "c2w after means, scales, quats, opacities, colors; or viewmats=..., Ks=... by name in gsplat's order"
        raise wrong_type("c2w", ours, "c2w after means, quats, scales, ...: gsplat has viewmats there")


def coefficients(colors: Any, sh: Any) -> tuple[Any, Any]:
    """Colors and harmonics apart, also where `colors` holds all coefficients."""
    if np.ndim(colors) != 3:
        return colors, sh
    if sh is not None:
        raise wrong_type("sh", "none beside colors of the shape [n, k, 3]", "both")
    found = array("colors", colors)
    if found.shape[1:] not in ((1, 3), (4, 3), (9, 3), (16, 3)):
        raise refuse("colors", "the shape [n, 3], or [n, k, 3] with k of 1, 4, 9 or 16", list(found.shape))
    return 0.5 + SH_CONSTANT * found[:, 0], found[:, 1:]


def background_given(background: Any, backgrounds: Any) -> Any:
    """The background, under one of its two names."""
    if backgrounds is None:
        return background
    if not (isinstance(background, float) and background == 1.0):
        raise wrong_type("background", "either background or backgrounds", "both")
    return backgrounds


def harmonics(value: Any, n: int) -> Floats | None:
    """Spherical harmonics without the constant, of `n` Gaussians."""
    if value is None:
        return None
    found = array("sh", value)
    if found.ndim != 3 or found.shape[0] != n or found.shape[1] not in (0, 3, 8, 15) or found.shape[2] != 3:
        raise refuse("sh", f"the shape [{n}, k, 3] with k of 0, 3, 8 or 15", list(found.shape))
    finite("sh", found)
    return np.array(found, dtype=np.float32)


def indices(value: Any, n: int) -> Array:
    """Numbers of some of `n` things, or a mask of them."""
    found = np.asarray(value)
    if found.dtype.kind == "b":
        if found.shape != (n,):
            raise refuse("index", f"a mask of the shape [{n}]", list(found.shape))
        return found
    if found.size == 0:
        return np.zeros(0, dtype=np.int64)
    if found.dtype.kind not in "iu" or found.ndim != 1:
        raise wrong_type("index", "a number, a slice, numbers or a mask", f"{type(value).__name__} of {found.dtype}")
    if found.min() < -n or found.max() >= n:
        raise IndexError(f"Gaussians {found.min()} to {found.max()} of {n}")
    return found


def similarity(
    field: str, value: Any
) -> tuple[float, Array, tuple[float, float, float, float], tuple[float, float, float]]:
    """Scale, rotation (as a matrix, and as w x y z) and translation of a similarity."""
    m = array(field, value).astype(np.float64)
    if m.shape not in ((4, 4), (3, 4)):
        raise refuse(field, "the shape [4, 4] or [3, 4]", list(m.shape))
    finite(field, m)
    if m.shape == (4, 4) and np.abs(m[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise refuse(field, "a last row of [0, 0, 0, 1]", m[3].tolist())
    cube = float(np.linalg.det(m[:3, :3]))
    scale = float(np.cbrt(cube))
    if not scale > 0.0:
        raise refuse(field, "a rotation times a scale above 0, no mirror", f"a determinant of {cube:g}")
    r = m[:3, :3] / scale
    off = float(np.abs(r @ r.T - np.eye(3)).max())
    if off > 1e-4:
        raise refuse(field, "a rotation times a scale", f"axes that are off by {off:.2g}")
    # The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): no case is special.
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0.0, 0.0, 0.0],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], 0.0, 0.0],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], 0.0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1].tolist()
    tx, ty, tz = m[:3, 3].tolist()
    return scale, r, (w, x, y, z), (tx, ty, tz)


def cameras_given(c2w: Any, viewmats: Any, K: Any, Ks: Any, k_name: str) -> tuple[Any, Any]:
    """Camera to world and intrinsics, each under one of its two names."""
    if (K is None) == (Ks is None):
        raise wrong_type(k_name, f"either {k_name} or Ks", "none" if K is None else "both")
    if (c2w is None) == (viewmats is None):
        raise wrong_type("c2w", "either c2w or viewmats", "none" if c2w is None else "both")
    return (c2w if viewmats is None else inverted("viewmats", viewmats)), (Ks if K is None else K)


def inverted(field: str, value: Any) -> Array:
    """Camera to world of rigid world to camera, `[..., 4, 4]` or `[..., 3, 4]`."""
    m = array(field, value).astype(np.float64)
    if m.ndim not in (2, 3) or m.shape[-2:] not in ((4, 4), (3, 4)):
        raise refuse(field, "the shape [v, 4, 4] or [v, 3, 4]", list(m.shape))
    finite(field, m)
    r, t = m[..., :3, :3], m[..., :3, 3:]
    off = float(np.abs(r @ np.swapaxes(r, -1, -2) - np.eye(3)).max()) if m.size else 0.0
    if off > 1e-3:
        raise refuse(field, "rotations and translations", f"axes that are off by {off:.2g}")
    back = np.swapaxes(r, -1, -2)
    return np.concatenate([back, -back @ t], axis=-1)


def cameras(
    c2w: Any, intrinsics: Any, sizes: Sequence[tuple[int, int]], convention: str, k_name: str
) -> list[RawCamera]:
    """Cameras of images of these widths and heights, as the part in Rust takes them."""
    if convention not in CONVENTIONS:
        raise refuse("convention", " or ".join(map(repr, CONVENTIONS)), f"{convention!r}")
    views = len(sizes)
    k = array(k_name, intrinsics).astype(np.float64)
    if k.shape not in ((views, 3, 3), (1, 3, 3), (3, 3)):
        raise refuse(k_name, f"the shape [{views}, 3, 3], or [3, 3] for all views", list(k.shape))
    finite(k_name, k)
    k = np.broadcast_to(k, (views, 3, 3))
    poses = array("c2w", c2w)
    if poses.shape not in ((views, 4, 4), (views, 3, 4)):
        raise refuse("c2w", f"the shape [{views}, 4, 4] or [{views}, 3, 4]", list(poses.shape))
    finite("c2w", poses)
    poses = poses.astype(np.float64)
    if poses.shape[1] == 3:
        last = np.broadcast_to(np.array([0.0, 0.0, 0.0, 1.0]), (views, 1, 4))
        poses = np.concatenate([poses, last], axis=1)
    if convention == "opengl":
        poses = poses @ _FLIP
    raw: list[RawCamera] = []
    for i, (width, height) in enumerate(sizes):
        (fx, skew, cx), (zero, fy, cy), last = k[i].tolist()
        field = f"{k_name}[{i}]"
        if skew != 0.0 or zero != 0.0 or last != [0.0, 0.0, 1.0]:
            raise refuse(field, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", k[i].tolist())
        if fx <= 0.0 or fy <= 0.0:
            raise refuse(field, "focal lengths above 0", f"{fx} and {fy}")
        raw.append((width, height, (fx, fy, cx, cy), poses[i].tolist()))
    return raw


def _listed(field: str, value: Any, names: str) -> list[Any]:
    """An array's first axis, or a sequence."""
    if isinstance(value, (str, bytes)) or not hasattr(value, "__len__") or not hasattr(value, "__getitem__"):
        raise wrong_type(field, f"an array {names} or a sequence of arrays", type(value).__name__)
    return [value[i] for i in range(len(value))]


def _bytes(field: str, found: Array) -> npt.NDArray[np.uint8]:
    """8 bits, of these or of floats from 0 to 1."""
    if found.dtype == np.uint8:
        return found
    if found.dtype.kind == "b":
        return found.astype(np.uint8) * np.uint8(255)
    if found.dtype.kind != "f":
        raise wrong_type(field, "uint8, or floats from 0 to 1", found.dtype)
    finite(field, found)
    low, high = (float(found.min()), float(found.max())) if found.size else (0.0, 0.0)
    # What resampling in float32 leaves of 0 and 1.
    if low < -1e-5 or high > 1.0 + 1e-5:
        raise refuse(field, "floats from 0 to 1 (or uint8)", f"{low:g} to {high:g}")
    return np.rint(np.clip(found, 0.0, 1.0) * 255.0).astype(np.uint8)


def _mask(field: str, value: Any, size: tuple[int, ...]) -> Array:
    """A mask of an image of this size; integers as `uint8`."""
    mask = array(field, value, "biuf", "bool, integers from 0 to 255, or floats from 0 to 1")
    if mask.shape == (*size, 1):
        mask = mask[..., 0]
    if mask.shape != size:
        raise refuse(field, f"the shape {list(size)} of its image", list(mask.shape))
    if mask.dtype.kind in "iu" and mask.dtype != np.uint8:
        if mask.min() < 0 or mask.max() > 255:
            raise refuse(field, "integers from 0 to 255", f"{mask.min()} to {mask.max()}")
        mask = mask.astype(np.uint8)
    return mask


def _white(masks: Iterable[Array | None]) -> np.uint8:
    """The factor that makes masks of 8 bits reach 255: 255 where they hold 0 and 1, else 1. The maximum over all masks decides."""
    largest = max((int(m.max()) for m in masks if m is not None and m.dtype == np.uint8 and m.size), default=0)
    return np.uint8(255 if largest == 1 else 1)


def no_scene(value: Any, instead: str) -> None:
    """Refuses a scene, or the folder of one, where images are expected."""
    if isinstance(value, (str, bytes, PathLike)) or hasattr(value, "_scene"):
        raise wrong_type("images", f"an array [v, h, w, 3 or 4] ({instead})", type(value).__name__)


def images(value: Any, masks: Any) -> list[npt.NDArray[np.uint8]]:
    """RGBA of 8 bits, each `[h, w, 4]`; opaque where nothing tells the object."""
    listed = _listed("images", value, "[v, h, w, 3 or 4]")
    if len(listed) < 2:
        raise refuse("images", "at least 2", len(listed))
    given: list[Any] = [None] * len(listed)
    if masks is not None:
        given = _listed("masks", masks, "[v, h, w]")
        if len(given) != len(listed):
            raise refuse("masks", f"one for each of {len(listed)} images", len(given))
    pictures: list[Array] = []
    outlines: list[Array | None] = []
    for i, (one, outline) in enumerate(zip(listed, given)):
        found = array(f"images[{i}]", one, expected="uint8, or floats from 0 to 1")
        if found.ndim != 3 or found.shape[2] not in (3, 4) or 0 in found.shape:
            raise refuse(f"images[{i}]", "the shape [h, w, 3] or [h, w, 4]", list(found.shape))
        pictures.append(found)
        outlines.append(None if outline is None else _mask(f"masks[{i}]", outline, found.shape[:2]))
    of_alpha, of_masks = _white(p[..., 3] for p in pictures if p.shape[2] == 4), _white(outlines)
    result = []
    for i, (found, mask) in enumerate(zip(pictures, outlines)):
        rgba = np.full((*found.shape[:2], 4), 255, dtype=np.uint8)
        rgba[..., : found.shape[2]] = _bytes(f"images[{i}]", found)
        if found.shape[2] == 4 and found.dtype == np.uint8:
            rgba[..., 3] *= of_alpha
        if mask is not None:
            share = _bytes(f"masks[{i}]", mask) * (of_masks if mask.dtype == np.uint8 else np.uint8(1))
            rgba[..., 3] = rgba[..., 3] * share.astype(np.uint16) // 255
            rgba[rgba[..., 3] == 0] = 0
        result.append(rgba)
    return result
