"""The rasteriser in PyTorch."""

import subprocess
import sys

import numpy as np
import pytest

import freerange


def test_without_torch_it_says_so():
    code = "import sys; sys.modules['torch'] = None; import freerange, freerange.torch"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode != 0 and "ImportError: freerange.torch: expected PyTorch, found none" in run.stderr


    code = (
        "import sys; sys.modules['torch'] = None; import freerange\n"
        "freerange.Gaussians([[0, 0, 0]], [[1, 1, 1]], [[1, 0, 0, 0]], [0.5], [[0, 0, 0]]).to_torch()"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode != 0 and "ImportError: to_torch: expected PyTorch, found none: pip install" in run.stderr


torch = pytest.importorskip("torch")
import freerange.torch  # noqa: E402

FIELDS = ("means", "scales", "quats", "opacities", "colors")


def tensors(scattered, dtype=torch.float64):
    gaussians = {field: torch.tensor(scattered[0][field], dtype=dtype, requires_grad=True) for field in FIELDS}
    return gaussians, scattered[1:]


def test_gradients_are_those_of_differences(scattered):
    """`gradcheck`, in all five arrays and the background, of color, alpha and depth.

    The rasteriser computes in float32: pictures are rounded to 6e-8, and a difference over twice 5e-3 to 1e-5; its own error is of the
    order of 5e-3 squared. Hence steps and tolerances that are larger than those for doubles. The scene is one in which every
    Gaussian is drawn at every pixel, since pictures jump where an opacity of 1/255 is reached.
    """
    gaussians, (c2w, k, width, height) = tensors(scattered)
    background = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64, requires_grad=True)

    def pictures(*arrays):
        *arrays, background = arrays
        return tuple(freerange.render(*arrays, c2w, k, width, height, background, depth=True))

    arrays = (*gaussians.values(), background)
    assert torch.autograd.gradcheck(pictures, arrays, eps=5e-3, atol=2e-3, rtol=1e-2, nondet_tol=0.0)


def test_gradients_are_those_of_the_reference(scattered):
    """Against differences of the slow rasteriser, which computes in doubles, over steps that float32 holds exactly."""
    gaussians, (c2w, k, width, height) = tensors(scattered, torch.float32)
    rows = torch.tensor(freerange.Gaussians(**scattered[0]).rows, requires_grad=True)
    weights = torch.tensor(np.random.default_rng(3).normal(size=(height, width, 3)), dtype=torch.float32)
    from freerange.torch import rasterize

    rgb, alpha, _ = rasterize(rows, c2w, k, width, height, 0.25)
    ((rgb * weights).sum() + alpha.sum()).backward()
    camera = (width, height, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), c2w.tolist())

    def loss(values):
        rgb, alpha = freerange._core.reference(values.astype(np.float32).tobytes(), camera, (0.25, 0.25, 0.25))
        return (np.frombuffer(rgb) * weights.numpy().ravel()).sum() + np.frombuffer(alpha).sum()

    step = 2.0**-10
    start = np.round(rows.detach().numpy().astype(np.float64) / step) * step
    # At numbers that are multiples of the step.
    again = torch.tensor(start, dtype=torch.float32, requires_grad=True)
    rgb, alpha, _ = rasterize(again, c2w, k, width, height, 0.25)
    ((rgb * weights).sum() + alpha.sum()).backward()
    expected = np.zeros_like(start)
    for i in np.ndindex(start.shape):
        values = start.copy()
        values[i] += step
        above = loss(values)
        values[i] -= 2 * step
        expected[i] = (above - loss(values)) / (2 * step)
    error = np.abs(again.grad.numpy() - expected).max() / np.abs(expected).max()
    assert error < 2e-5, error


def test_gsplats_order_takes_its_cameras_by_name(scattered):
    gaussians, (c2w, k, width, height) = tensors(scattered, torch.float32)
    expected = freerange.render(*gaussians.values(), c2w, k, width, height).rgb
    gaussians["opacities"] = gaussians["opacities"][:, None]
    in_order = [gaussians[f] for f in ("means", "quats", "scales", "opacities", "colors")]
    viewmats = torch.tensor(np.linalg.inv(c2w))
    cameras = dict(viewmats=viewmats[None], Ks=torch.tensor(k)[None], width=width, height=height)
    found = freerange.render(*in_order, **cameras).rgb[0]
    assert torch.allclose(found, expected, atol=1e-6)
    found.sum().backward()
    for render in (freerange.render, freerange.torch.render):
        with pytest.raises(TypeError, match="c2w: .*viewmats=.*gsplat"):
            render(*in_order, viewmats[None], torch.tensor(k)[None], width, height)


def test_tensors_and_arrays_give_the_same(scattered):
    gaussians, (c2w, k, width, height) = tensors(scattered, torch.float32)
    rgb, alpha, z = freerange.render(*gaussians.values(), torch.tensor(c2w), torch.tensor(k), width, height, 0.5, depth=True)
    plain = freerange.render(**scattered[0], c2w=c2w, K=k, width=width, height=height, background=0.5, depth=True)
    assert np.allclose(z.detach(), plain.depth, atol=1e-5)
    names = ("means", "quats", "scales", "opacities", "colors")
    other = freerange.render(*(gaussians[f] for f in names), viewmats=np.linalg.inv(c2w), Ks=k, width=width, height=height, background=0.5)
    assert torch.allclose(other.rgb, rgb, atol=1e-6)
    assert rgb.dtype == torch.float32 and rgb.shape == (height, width, 3) and alpha.shape == (height, width)
    assert np.allclose(rgb.detach(), plain[0], atol=1e-5) and np.allclose(alpha.detach(), plain[1], atol=1e-5)
    several, *_ = freerange.render(*gaussians.values(), np.stack([c2w] * 3), k, width, height, torch.eye(3))
    assert several.shape == (3, height, width, 3)


def harmonic(scattered, degree):
    """Gaussians with harmonics, and two cameras: the second sees other colors."""
    given, c2w, k, width, height = scattered
    # Small enough that no color is cut off at 0, where there is no derivative.
    sh = 0.03 * np.random.default_rng(5).normal(size=(5, (degree + 1) ** 2 - 1, 3))
    given = dict(given, colors=0.3 + 0.4 * given["colors"])
    other = c2w.copy()
    other[:3, 3] += [0.6, 0.4, 0.3]
    return freerange.Gaussians(**given, sh=sh if degree else None), np.stack([c2w, other]), (k, width, height)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_are_those_of_arrays(scattered, degree):
    gaussians, poses, camera = harmonic(scattered, degree)
    made = gaussians.to_torch()
    if not degree:
        made["colors"] = (made["colors"][:, None] - 0.5) / 0.28209479177387814
    assert made["colors"].shape == (5, (degree + 1) ** 2, 3)
    for c2w in (poses, poses[1]):
        found = freerange.render(**made, c2w=c2w, K=camera[0], width=8, height=6, depth=True)
        for one, other in zip(found, gaussians.render(c2w, *camera, depth=True)):
            assert one.shape == other.shape and np.abs(one.numpy() - other).max() < 1e-5
    if degree:
        plain = freerange.Gaussians.from_rows(gaussians.rows)
        assert np.abs(plain.render(poses, *camera).rgb - gaussians.render(poses, *camera).rgb).max() > 1e-3
    # Colors that would be negative are black.
    made["colors"] = made["colors"] - 10.0
    found = freerange.render(**made, c2w=poses, K=camera[0], width=8, height=6, background=0.0).rgb
    assert (found == 0.0).all() if degree else (found < 0.0).any()
    with pytest.raises(ValueError, match=r"colors: .*k of 1, 4, 9 or 16, found \[5, 2, 3\]"):
        freerange.render(**(made | {"colors": torch.zeros(5, 2, 3)}), c2w=poses, K=camera[0])


def test_gradients_of_harmonics_are_those_of_differences(scattered):
    """In coefficients, backgrounds and means, which decide the viewing direction. Steps and tolerances are those of the test above."""
    gaussians, poses, (k, width, height) = harmonic(scattered, 3)
    made = {name: value.double() for name, value in gaussians.to_torch().items()}
    background = torch.tensor([[0.2, 0.5, 0.9], [0.7, 0.1, 0.4]], dtype=torch.float64)
    # Larger harmonics, so that the direction counts; a brighter constant, so that no color is cut off.
    made["colors"][:, 1:] *= 4.0
    made["colors"][:, 0] += 3.0

    def pictures(means, colors, background):
        changed = made | {"means": means, "colors": colors}
        return tuple(freerange.render(**changed, c2w=poses, K=k, width=width, height=height, background=background)[:2])

    arrays = [value.requires_grad_() for value in (made["means"].clone(), made["colors"].clone(), background)]
    assert torch.autograd.gradcheck(pictures, arrays, eps=5e-3, atol=2e-3, rtol=1e-2, nondet_tol=0.0)


def test_memory_is_shared(scattered):
    means = freerange.Gaussians(**scattered[0]).means
    assert torch.from_dlpack(means).data_ptr() == means.ctypes.data


def test_tensors_as_gsplat_takes_them(scattered):
    given = scattered[0]
    made = freerange.Gaussians(**given, up=(0, 0, 1)).to_torch()
    assert set(made) == {"means", "quats", "scales", "opacities", "colors"}
    assert made["means"].shape == (5, 3) and made["opacities"].shape == (5,) and made["colors"].dtype == torch.float32
    sh = np.zeros((5, 3, 3), dtype=np.float32)
    sh[:, 1] = 0.25
    colors = freerange.Gaussians(**given, sh=sh).to_torch()["colors"]
    assert colors.shape == (5, 4, 3)
    assert np.allclose(0.5 + 0.28209479177387814 * colors[:, 0].numpy(), given["colors"], atol=1e-6)
    assert np.array_equal(colors[:, 1:].numpy(), sh)
    again = freerange.Gaussians(**freerange.Gaussians(**given, sh=sh).to_torch())
    assert np.array_equal(again.sh, sh) and np.allclose(again.rows, freerange.Gaussians(**made).rows, atol=1e-5)


def test_it_can_be_optimised(scattered):
    """Colours that are wrong become right again."""
    gaussians, (c2w, k, width, height) = tensors(scattered, torch.float32)
    with torch.no_grad():
        target, *_ = freerange.render(*gaussians.values(), c2w, k, width, height)
    colors = torch.full((5, 3), 0.5, requires_grad=True)
    optimiser = torch.optim.Adam([colors], lr=0.05)
    losses = []
    for _ in range(200):
        rgb, *_ = freerange.render(*(gaussians | {"colors": colors}).values(), c2w, k, width, height)
        loss = ((rgb - target) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 1e-3 * losses[0]


def test_what_has_no_gradient_is_refused(scattered):
    gaussians, (c2w, k, width, height) = tensors(scattered)
    pose = torch.tensor(c2w, requires_grad=True)
    with pytest.raises(ValueError, match="c2w: .*no gradient"):
        freerange.render(*gaussians.values(), pose, k, width, height)
    rgb, *_ = freerange.render(*gaussians.values(), c2w, k, width, height)
    (first,) = torch.autograd.grad((rgb**2).sum(), gaussians["means"], create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable|twice"):
        first.sum().backward()
    with pytest.raises(TypeError, match="colors: expected a tensor"):
        freerange.render(*(gaussians | {"colors": scattered[0]["colors"]}).values(), c2w, k, width, height)
    with pytest.raises(ValueError, match=r"means: expected the shape \[5, 3\]"):
        freerange.render(*(gaussians | {"means": torch.zeros(5, 2)}).values(), c2w, k, width, height)
    with pytest.raises(ValueError, match="scales: expected numbers above 0"):
        freerange.render(*(gaussians | {"scales": torch.zeros(5, 3)}).values(), c2w, k, width, height)
