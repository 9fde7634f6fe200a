"""The rasterizer for PyTorch: `render` can be differentiated in Gaussians and backgrounds. It computes on the CPU, in float32."""

from __future__ import annotations

from typing import Any

try:
    import torch
except ImportError as error:
    raise ImportError("freerange.torch: expected PyTorch, found none: pip install torch") from error

from . import _check, _core
from ._check import Convention
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


def rasterize(
    rows: torch.Tensor,
    c2w: Any,
    K: Any,
    width: int,
    height: int,
    background: Any = 1.0,
    *,
    convention: Convention = "opencv",
    depth: bool = False,
) -> Render:
    """As `render`, of rows `[n, 14]` as `Gaussians.rows` has them: without bounds, as an optimizer likes them."""
    if not isinstance(rows, torch.Tensor):
        raise _check.wrong_type("rows", "a tensor", type(rows).__name__)
    if rows.ndim != 2 or rows.shape[1] != CHANNELS:
        raise _check.refuse("rows", f"the shape [n, {CHANNELS}]", list(rows.shape))
    if not rows.is_floating_point():
        raise _check.wrong_type("rows", "floats", rows.dtype)
    for field, value in (("c2w", c2w), ("K", K)):
        if isinstance(value, torch.Tensor) and value.requires_grad:
            raise _check.refuse(field, "a tensor that needs no gradient: there is none for cameras", "one that does")
    c2w, K = (v.detach().cpu() if isinstance(v, torch.Tensor) else v for v in (c2w, K))
    plain = background.detach().cpu() if isinstance(background, torch.Tensor) else background
    cameras, colors, single = raw_cameras(c2w, K, width, height, plain, convention)
    if isinstance(background, torch.Tensor):
        backgrounds = background.expand(len(cameras), 3)
    else:
        backgrounds = torch.tensor(colors, dtype=rows.dtype, device=rows.device)
    rgb, alpha, z = _Rasterize.apply(rows, backgrounds, cameras, depth)
    # The mean z of what is seen; where nothing is, 0 without a gradient.
    mean = torch.where(alpha > 0, z / torch.where(alpha > 0, alpha, 1.0), 0.0) if depth else None
    if single:
        return Render(rgb[0], alpha[0], None if mean is None else mean[0])
    return Render(rgb, alpha, mean)


def render(
    means: torch.Tensor,
    scales: torch.Tensor,
    quats: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    c2w: Any,
    K: Any,
    width: int,
    height: int,
    background: Any = 1.0,
    *,
    convention: Convention = "opencv",
    depth: bool = False,
) -> Render:
    """`freerange.render` of tensors: color, alpha and depth, with gradients in all five arrays and in the background."""
    if getattr(scales, "shape", (0,))[-1:] == (4,) and getattr(quats, "shape", (0,))[-1:] == (3,):
        scales, quats = quats, scales  # gsplat's order
    n = len(means) if getattr(means, "ndim", 0) else 0
    fields = {"means": means, "scales": scales, "quats": quats, "opacities": opacities, "colors": colors}
    shapes = {"means": (n, 3), "scales": (n, 3), "quats": (n, 4), "opacities": (n,), "colors": (n, 3)}
    for field, value in fields.items():
        if not isinstance(value, torch.Tensor) or not value.is_floating_point():
            found = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
            raise _check.wrong_type(field, "a tensor of floats", found)
        if tuple(value.shape) != shapes[field]:
            raise _check.refuse(field, f"the shape {list(shapes[field])}", list(value.shape))
    if n and not bool((scales > 0).all()):
        raise _check.refuse("scales", "numbers above 0", float(scales.min()))
    if n and not bool(((opacities >= 0) & (opacities <= 1)).all()):
        raise _check.refuse("opacities", "numbers from 0 to 1", f"{float(opacities.min())} to {float(opacities.max())}")
    logits = torch.logit(opacities, eps=OPACITY_MARGIN)
    rows = torch.cat([means, scales.log(), quats, logits[:, None], colors], dim=1)
    return rasterize(rows, c2w, K, width, height, background, convention=convention, depth=depth)
