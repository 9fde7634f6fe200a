"""Posed photos of an object in, 3D Gaussians out.

    import freerange

    scene = freerange.Scene.read("examples/bowl")                # any folder that the program reads
    model = freerange.load()                                     # the bundled checkpoint
    gaussians = model.reconstruct_scene(scene)
    gaussians.save("object.glb")                                 # format by extension
    image = gaussians.render(scene.c2w[0], scene.intrinsics[0], 512, 512).rgb

`Model.reconstruct` takes arrays instead; `Scene.from_arrays` and `Scene.from_pycolmap` make scenes of what is in memory. Cameras are
camera to world in OpenCV's axes (`c2w`, `intrinsics`), or world to camera under gsplat's names (`viewmats`, `Ks`).
`freerange.torch` has the rasterizer with gradients. What is left out is a `DroppedWarning`.
"""

from ._core import __version__, devices
from ._gaussians import DroppedWarning, Gaussians, Render, render
from ._model import Model, Step, load
from ._scene import Scene

__all__ = [
    "DroppedWarning",
    "Gaussians",
    "Model",
    "Render",
    "Scene",
    "Step",
    "__version__",
    "devices",
    "load",
    "render",
]
