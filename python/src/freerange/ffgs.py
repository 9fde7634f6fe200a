"""The plug-in for `ffgs`, the interface of feed-forward splat models: `GSPipeline.from_pretrained(folder)` runs this package.

    from ffgs import GSPipeline, Views
    from freerange.ffgs import pipeline

    pipe = pipeline(quality="draft")               # or GSPipeline.from_pretrained of what pipe.save_pretrained wrote
    out = pipe(Views(images, intrinsics, c2w), masks=masks)
    out.gaussians.save_ply("object.ply")           # in the frame of c2w

`Views` has no alpha: give `masks` `[v, h, w]` or `[b, v, h, w]`, or leave the masks to the program (a plain background, or poses and
colors). Made for ffgs 0.1.0.dev1.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

try:
    import torch
    from ffgs import GSPipeline, Views
    from ffgs.geometry import ModelFrame
    from ffgs.processor import Prepared, Processor
    from ffgs.registry import ModelSpec
    from ffgs.types import Gaussians as Splats
    from huggingface_hub import PyTorchModelHubMixin
except ImportError as error:
    raise ImportError(f"freerange.ffgs: expected PyTorch and ffgs: pip install ffgs ({error})") from error

from . import _check
from ._check import Arrays, Upright
from ._gaussians import Gaussians
from ._model import Quality, load

__all__ = ["SPEC", "FreeRange", "FreeRangeConfig", "FreeRangeProcessor", "pipeline"]


class FreeRange(torch.nn.Module, PyTorchModelHubMixin):
    """A model of this package. Its weights are those of the checkpoint, not of this module, which has none."""

    def __init__(
        self,
        checkpoint: str | None = None,
        device: str = "auto",
        quality: Quality = "default",
        iterations: int | None = None,
        seed: int = 0,
    ) -> None:
        """Loads a model.

        Args:
            checkpoint, device: as `freerange.load`; None is the bundled model.
            quality, iterations, seed: as `Model.reconstruct`.
        """
        super().__init__()
        self.model = load(checkpoint, device=device)
        self.options: dict[str, Any] = {"quality": quality, "iterations": iterations, "seed": seed}
        # Files of no weights at all cannot be written.
        self.register_buffer("_none", torch.zeros(1))

    def forward(self, samples: list[dict[str, Any]]) -> list[Gaussians]:
        """One set of Gaussians for each sample, in the frame of its cameras.

        Args:
            samples: arguments of `Model.reconstruct`, as `FreeRangeProcessor.preprocess` makes them.
        """
        return [self.model.reconstruct(**sample, **self.options) for sample in samples]


@dataclass
class FreeRangeConfig:
    """Settings of the processor.

    Attributes:
        up: which way is up in the frame of the cameras: "z", "y", "cameras" or a direction.
        background: color behind the Gaussians in renders.
        near: nearest depth of renders, in the cameras' units.
        far: farthest depth of renders, in the cameras' units.
    """

    up: Upright = "z"
    background: list[float] = field(default_factory=lambda: [1.0, 1.0, 1.0])
    near: float = 1e-2
    far: float = 1e4


class FreeRangeProcessor(Processor):
    """Views as this package takes them, at their own size and in their own frame."""

    config_cls = FreeRangeConfig
    camera_input = "required"

    def preprocess(self, views: Views, device: torch.device, masks: Arrays | None = None) -> Prepared:
        """Views, with masks where there are any.

        Args:
            views: images with cameras.
            device: not used; the model has its own.
            masks: `[v, h, w]` or `[b, v, h, w]`, white is the object.
        """
        views.require("intrinsics", "c2w", by="freerange")
        images = views.images.permute(0, 1, 3, 4, 2).cpu().float().numpy()  # [b, v, h, w, 3]
        poses = views.c2w.cpu().double().numpy()
        # As they were given: `pixel_k` rounds them to 32 bits.
        exact = views.cameras.pixel_k if views.normalized_intrinsics else views.intrinsics
        k = exact.cpu().double().numpy()
        listed: list[Any] = [None] * len(images)
        if masks is not None:
            given = _check.array("masks", masks.cpu() if isinstance(masks, torch.Tensor) else masks, "biuf")
            given = given[None] if given.ndim == 3 else given
            if given.shape != images.shape[:4]:
                raise _check.refuse("masks", f"the shape {list(images.shape[:4])}", list(given.shape))
            listed = list(given)
        samples = [
            {"images": i, "intrinsics": j, "c2w": c, "masks": m, "up": self.config.up}
            for i, j, c, m in zip(images, k, poses, listed)
        ]
        # The model works in the frame of the cameras.
        here = torch.eye(4).repeat(len(images), 1, 1)
        return Prepared(samples, ModelFrame(here, 1.0))

    def postprocess(self, model_output: list[Gaussians]) -> Splats:
        """Batched Gaussians; where samples have fewer than others, invisible ones follow.

        Args:
            model_output: Gaussians of each sample.
        """
        most = max(len(g) for g in model_output)

        def batch(name: str, filler: list[float] | float) -> torch.Tensor:
            rows = [torch.from_numpy(getattr(g, name)) for g in model_output]
            filled = [torch.tensor(filler).expand(most - len(r), *r.shape[1:]) for r in rows]
            return torch.stack([torch.cat(pair) for pair in zip(rows, filled)])

        return Splats(
            means=batch("means", 0.0),
            scales=batch("scales", 1e-6),
            quats=batch("quats", [1.0, 0.0, 0.0, 0.0]),
            opacities=batch("opacities", 0.0),
            colors=batch("colors", 0.0),
            sh_degree=None,
        )

    def render_planes(self, frame: ModelFrame | None) -> tuple[float, float]:
        """Nearest and farthest depth.

        Args:
            frame: not used; the settings are in the cameras' units.
        """
        return self.config.near, self.config.far

    @property
    def background(self) -> tuple[float, float, float]:
        """Color behind the Gaussians."""
        red, green, blue = self.config.background
        return (red, green, blue)


SPEC = ModelSpec("freerange", FreeRange, FreeRangeProcessor, display_name="free-range")


def pipeline(
    *,
    up: Upright = "z",
    checkpoint: str | None = None,
    device: str = "auto",
    quality: Quality = "default",
    iterations: int | None = None,
    seed: int = 0,
) -> GSPipeline:
    """A pipeline of ffgs.

    Args:
        up: which way is up in the frame of the cameras.
        checkpoint, device, quality, iterations, seed: as `FreeRange` has them.
    """
    model = FreeRange(checkpoint=checkpoint, device=device, quality=quality, iterations=iterations, seed=seed)
    return GSPipeline(model, FreeRangeProcessor(up=up), SPEC.model_type)
