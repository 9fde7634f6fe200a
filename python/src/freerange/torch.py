"""The rasterizer for PyTorch: `render` is differentiable in Gaussians and backgrounds. It computes on the CPU, in float32."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

try:
    import torch
except ImportError as error:
    raise ImportError("freerange.torch: expected PyTorch, found none: pip install torch") from error

from . import _check, _core
from ._check import Arrays, Convention
from ._gaussians import CHANNELS, OPACITY_MARGIN, Render, raw_cameras

__all__ = ["rasterize", "render"]


def _bytes(tensor: torch.Tensor) -> bytes:
    # A tensor of another device, type or order is copied here.
    return tensor.detach().to("cpu", torch.float32).contiguous().numpy().tobytes()


def _tensor(data: bytearray, shape: tuple[int, ...], like: torch.Tensor) -> torch.Tensor:
    if not data:
        return torch.zeros(shape, dtype=like.dtype, device=like.device)
    return torch.frombuffer(data, dtype=torch.float32).reshape(shape).to(like.device, like.dtype)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rows: torch.Tensor, backgrounds: torch.Tensor, cameras: list[_check.RawCamera], depth: bool
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        views, (width, height) = len(cameras), cameras[0][:2]
        rendered = _core.rasterize(_bytes(rows), cameras, [tuple(b) for b in backgrounds.detach().tolist()], depth)
        ctx.rendered, ctx.like, ctx.depth = rendered, (rows.new_empty(0), backgrounds.new_empty(0), rows.shape), depth
        rgb = _tensor(rendered.rgb(), (views, height, width, 3), rows)
        alpha = _tensor(rendered.alpha(), (views, height, width), rows)
        return rgb, alpha, _tensor(rendered.depth(), (views, height, width) if depth else (0,), rows)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, d_rgb: torch.Tensor, d_alpha: torch.Tensor, d_depth: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, None, None]:
        rows, backgrounds, shape = ctx.like
        d_z = _bytes(d_depth) if ctx.depth else b""
        d_rows, d_backgrounds = ctx.rendered.backward(_bytes(d_rgb), _bytes(d_alpha), d_z)
        return _tensor(d_rows, shape, rows), _tensor(d_backgrounds, (len(d_rgb), 3), backgrounds), None, None


def _cameras(
    c2w: Arrays, K: Arrays, width: int, height: int, background: Arrays, convention: str, like: torch.Tensor
) -> tuple[list[_check.RawCamera], torch.Tensor, bool]:
    """Cameras, backgrounds `[v, 3]`, and whether it was a single camera."""
    for field, value in (("c2w", c2w), ("K", K)):
        if isinstance(value, torch.Tensor) and value.requires_grad:
            raise _check.refuse(field, "a tensor that needs no gradient: there is none for cameras", "one that does")
    c2w, K = (v.detach().cpu() if isinstance(v, torch.Tensor) else v for v in (c2w, K))
    plain = background.detach().cpu() if isinstance(background, torch.Tensor) else background
    cameras, colors, single = raw_cameras(c2w, K, width, height, plain, convention)
    if isinstance(background, torch.Tensor):
        return cameras, background.expand(len(cameras), 3), single
    return cameras, torch.tensor(colors, dtype=like.dtype, device=like.device), single


def _images(
    rows: Sequence[torch.Tensor], cameras: list[_check.RawCamera], backgrounds: torch.Tensor, single: bool, depth: bool
) -> Render:
    """Images of rows: one set for all cameras, or one for each."""
    if len(rows) == 1:
        rgb, alpha, z = _Rasterize.apply(rows[0], backgrounds, cameras, depth)
    else:
        parts = [_Rasterize.apply(r, backgrounds[i : i + 1], [cameras[i]], depth) for i, r in enumerate(rows)]
        rgb, alpha, z = (torch.cat(part) for part in zip(*parts))
    # The mean z of what is seen; where nothing is, 0 without a gradient.
    mean = torch.where(alpha > 0, z / torch.where(alpha > 0, alpha, 1.0), 0.0) if depth else None
    if single:
        return Render(rgb[0], alpha[0], None if mean is None else mean[0])
    return Render(rgb, alpha, mean)


def rasterize(
    rows: torch.Tensor,
    c2w: Arrays,
    K: Arrays,
    width: int,
    height: int,
    background: Arrays = 1.0,
    *,
    convention: Convention = "opencv",
    depth: bool = False,
) -> Render:
    """As `render`, of rows without bounds (logs and logits), as an optimizer likes them.

    Args:
        rows: `[n, 14]`, as `Gaussians.rows` has them.
        c2w, K, width, height, background, convention, depth: as `freerange.render` has them.

    Returns:
        A `Render` of tensors.

    Raises:
        ValueError, TypeError: the field, what was expected and what was found.
    """
    if not isinstance(rows, torch.Tensor):
        raise _check.wrong_type("rows", "a tensor", type(rows).__name__)
    if rows.ndim != 2 or rows.shape[1] != CHANNELS:
        raise _check.refuse("rows", f"the shape [n, {CHANNELS}]", list(rows.shape))
    if not rows.is_floating_point():
        raise _check.wrong_type("rows", "floats", rows.dtype)
    cameras, backgrounds, single = _cameras(c2w, K, width, height, background, convention, rows)
    return _images([rows], cameras, backgrounds, single, depth)


def _basis(d: torch.Tensor) -> torch.Tensor:
    """3DGS's spherical harmonics of degree 1 to 3, `[n, 15]`, at unit directions `[n, 3]`."""
    x, y, z = d.unbind(dim=-1)
    xx, yy, zz = x * x, y * y, z * z
    one, mixed, axis, difference = (math.sqrt(v / math.pi) for v in (3 / 4, 15 / 4, 5 / 16, 15 / 16))
    outer, product, inner, pole, skew = (math.sqrt(v / math.pi) for v in (35 / 32, 105 / 4, 21 / 32, 7 / 16, 105 / 16))
    first = [-one * y, one * z, -one * x]
    second = [mixed * x * y, -mixed * y * z, axis * (3 * zz - 1), -mixed * x * z, difference * (xx - yy)]
    third = [-outer * y * (3 * xx - yy), product * x * y * z, -inner * y * (5 * zz - 1), pole * z * (5 * zz - 3)]
    third += [-inner * x * (5 * zz - 1), skew * z * (xx - yy), -outer * x * (xx - 3 * yy)]
    return torch.stack(first + second + third, dim=-1)


def _seen(means: torch.Tensor, colors: torch.Tensor, camera: _check.RawCamera) -> torch.Tensor:
    """Colors `[n, 3]` of coefficients `[n, k, 3]` as a camera sees them."""
    eye = torch.tensor([row[3] for row in camera[3][:3]], dtype=means.dtype, device=means.device)
    basis = _basis(torch.nn.functional.normalize(means - eye, dim=-1))[:, : colors.shape[1] - 1]
    return (0.5 + _check.SH_CONSTANT * colors[:, 0] + (basis[..., None] * colors[:, 1:]).sum(dim=1)).clamp_min(0.0)


def render(
    means: torch.Tensor,
    scales: torch.Tensor,
    quats: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    c2w: Arrays,
    K: Arrays,
    width: int,
    height: int,
    background: Arrays = 1.0,
    *,
    convention: Convention = "opencv",
    depth: bool = False,
) -> Render:
    """`freerange.render` of tensors: color, alpha and depth, with gradients in all five arrays and in the background.

    Args:
        means, scales, quats, opacities: as `freerange.render` has them.
        colors: `[n, 3]`, or `[n, k, 3]` with k of 1, 4, 9 or 16: all coefficients of spherical harmonics, as `to_torch` gives
            them. Their gradient also reaches the means, which decide the viewing direction.
        c2w, K, width, height, background, convention, depth: as `freerange.render` has them.

    Returns:
        A `Render` of tensors.

    Raises:
        ValueError, TypeError: the field, what was expected and what was found.
    """
    _check.own_order(scales, quats, c2w)
    return _render(means, scales, quats, opacities, colors, c2w, K, width, height, background, convention, depth)


def _render(
    means: Any,
    scales: Any,
    quats: Any,
    opacities: Any,
    colors: Any,
    c2w: Any,
    K: Any,
    width: int,
    height: int,
    background: Any,
    convention: Convention,
    depth: bool,
) -> Render:
    """`render`, with scales and quaternions in either order."""
    if _check.gsplats_order(scales, quats):
        scales, quats = quats, scales
    if isinstance(opacities, torch.Tensor) and opacities.ndim == 2 and opacities.shape[1] == 1:
        opacities = opacities[:, 0]
    harmonic = getattr(colors, "ndim", 0) == 3
    n = len(means) if getattr(means, "ndim", 0) else 0
    fields = {"means": means, "scales": scales, "quats": quats, "opacities": opacities, "colors": colors}
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "colors": (n, 3)}
    for field, value in fields.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            found = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise _check.wrong_type(field, "a tensor of floats", found)
        if field == "colors" and harmonic:
            if tuple(value.shape) not in [(n, k, 3) for k in (1, 4, 9, 16)]:
                raise _check.refuse(field, f"the shape [{n}, 3], or [{n}, k, 3] with k of 1, 4, 9 or 16", list(value.shape))
        elif tuple(value.shape) != shapes[field]:
            raise _check.refuse(field, f"the shape {list(shapes[field])}", list(value.shape))
    if n and not bool((scales > 0).all()):
        raise _check.refuse("scales", "numbers above 0", float(scales.min()))
    if n and not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise _check.refuse("opacities", "numbers from 0 to 1", f"{float(opacities.min())} to {float(opacities.max())}")
    logits = torch.logit(opacities, eps=OPACITY_MARGIN)
    cameras, backgrounds, single = _cameras(c2w, K, width, height, background, convention, means)
    if harmonic and colors.shape[1] > 1:
        # Colors differ from camera to camera.
        seen = [_seen(means, colors, camera) for camera in cameras]
    else:
        seen = [0.5 + _check.SH_CONSTANT * colors[:, 0] if harmonic else colors]
    rows = [torch.cat([means, scales.log(), quats, logits[:, None], color], dim=1) for color in seen]
    return _images(rows, cameras, backgrounds, single, depth)
