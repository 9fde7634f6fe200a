"""Every step of a reconstruction in the Rerun viewer: pip install rerun-sdk

python rerun_steps.py SCENE             opens the viewer
python rerun_steps.py SCENE steps.rrd   writes a file for it
"""

import sys

import numpy as np
import rerun as rr

import freerange


def main() -> None:
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    rr.init("freerange", spawn=len(sys.argv) == 2, strict=True)
    if len(sys.argv) == 3:
        rr.save(sys.argv[2])
    scene = freerange.Scene.read(sys.argv[1])
    rr.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for i, (name, image, k, c2w) in enumerate(zip(scene.names, scene.images, scene.intrinsics, scene.c2w)):
        camera = f"world/cameras/{i}"
        height, width = image.shape[:2]
        rr.log(camera, rr.Transform3D(translation=c2w[:3, 3], mat3x3=c2w[:3, :3]), static=True)
        rr.log(camera, rr.Pinhole(image_from_camera=k, width=width, height=height), static=True)
        rr.log(camera, rr.Image(image[..., :3]).compress(), static=True)
        rr.log(f"{camera}/name", rr.TextDocument(name), static=True)

    steps = 0

    def show(step: freerange.Step) -> None:
        nonlocal steps
        rr.set_time("step", sequence=steps)
        steps += 1
        rr.log("stage", rr.TextLog(f"{step.stage} {step.done} of {step.total}"))
        if step.loss is not None:
            rr.log(f"loss/{step.stage}", rr.Scalars(step.loss))
        # Fits and the optimization take hundreds of steps that differ little.
        if step.gaussians is not None and (step.stage == "refine" or step.done % 10 == 0):
            g = step.gaussians
            quats = g.quats[:, [1, 2, 3, 0]]  # Rerun's order is x y z w
            colors = np.column_stack([np.clip(g.colors, 0.0, 1.0), g.opacities])
            ellipsoids = rr.Ellipsoids3D(
                centers=g.means, half_sizes=2.0 * g.scales, quaternions=quats, colors=colors, fill_mode="solid"
            )
            rr.log("world/gaussians", ellipsoids)

    gaussians = freerange.load().reconstruct_scene(scene, on_step=show)
    print(f"{gaussians} after {steps} steps")


if __name__ == "__main__":
    main()
