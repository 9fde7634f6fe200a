"""Posed photos of an object in, 3D Gaussians out.

    import freerange

    model = freerange.load()                                     # the shipped checkpoint
    gaussians = model.reconstruct(images, intrinsics, c2w)       # NumPy arrays; cameras in OpenCV's axes
    gaussians.save("object.glb")
    picture = gaussians.render(c2w[0], intrinsics[0], 512, 512)  # float32 [h, w, 3]

`Scene.read` reads folders of photos with cameras; `freerange.torch` has the rasteriser with gradients.
"""

from ._core import __version__, devices
from ._gaussians import Gaussians, render
from ._model import Model, Step, load
from ._scene import Scene

__all__ = ["Gaussians", "Model", "Scene", "Step", "__version__", "devices", "load", "render"]
