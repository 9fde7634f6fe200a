"""The plug-in of `ffgs`."""

import numpy as np
import pytest

import freerange

torch = pytest.importorskip("torch")
ffgs = pytest.importorskip("ffgs")


@pytest.fixture
def views(bowl):
    images, intrinsics, c2w = bowl
    opencv = c2w @ np.diag([1.0, -1.0, -1.0, 1.0])
    rgb = torch.from_numpy(images[..., :3]).permute(0, 3, 1, 2)
    return ffgs.Views(rgb, torch.tensor(intrinsics), torch.tensor(opencv)), images[..., 3]


def test_a_saved_pipeline_gives_what_the_package_gives(views, bowl, model, tmp_path):
    given, masks = views
    from freerange.ffgs import pipeline

    pipeline(quality="draft", iterations=0, device="cpu").save_pretrained(tmp_path / "saved")
    # Found by its entry point: nothing of this package is named here.
    pipe = ffgs.GSPipeline.from_pretrained(tmp_path / "saved")
    out = pipe(given, masks=masks)
    images, intrinsics, c2w = bowl
    images = images[..., :3].astype(np.float32) / np.float32(255)
    expected = model.reconstruct(images, intrinsics, c2w, masks, convention="opengl", quality="draft", iterations=0)
    assert out.gaussians.means.shape == (1, len(expected), 3) and out.gaussians.sh_degree is None
    world = out.to_world().gaussians
    for found in (out.gaussians, world):
        for name in ("means", "scales", "opacities", "colors"):
            assert np.allclose(getattr(found, name)[0], getattr(expected, name), atol=1e-5), name
    out.gaussians.save_ply(tmp_path / "g.ply")
    again = freerange.Gaussians.read(tmp_path / "g.ply")
    assert np.allclose(again.means, expected.means, atol=1e-5)
    assert np.allclose(again.colors, expected.colors, atol=1e-5)
    both = ffgs.Views(given.images.expand(2, -1, -1, -1, -1), given.intrinsics.expand(2, -1, -1, -1), given.c2w.expand(2, -1, -1, -1))
    two = pipe(both, masks=np.stack([masks, masks]))
    assert torch.equal(two.gaussians.means[0], two.gaussians.means[1])


def test_fewer_gaussians_are_filled_with_invisible_ones(scattered):
    from freerange.ffgs import FreeRangeProcessor

    some = freerange.Gaussians(**scattered[0])
    made = FreeRangeProcessor().postprocess([some, some[:2]])
    assert made.opacities.shape == (2, 5) and (made.opacities[1, 2:] == 0).all() and (made.opacities[0] > 0).all()
    assert (made.quats.norm(dim=-1) - 1).abs().max() < 1e-5


def test_bad_input_is_named(views):
    from freerange.ffgs import FreeRangeProcessor

    given, masks = views
    for options, error, words in [
        (dict(masks=masks[:2]), ValueError, "masks: expected the shape"),
        (dict(scale=2), TypeError, "scale"),
    ]:
        with pytest.raises(error, match=words):
            FreeRangeProcessor().preprocess(given, torch.device("cpu"), **options)
    with pytest.raises(ValueError, match="c2w"):
        FreeRangeProcessor().preprocess(ffgs.Views(given.images), torch.device("cpu"))
    with pytest.raises(ValueError, match="unknown"):
        FreeRangeProcessor.from_dict({"upp": "z"})
