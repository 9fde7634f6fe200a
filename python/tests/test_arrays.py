"""What users give by mistake, or in another form: it is told, or taken."""

import warnings

import numpy as np
import pytest

import freerange

from conftest import BOWL

QUICK = dict(iterations=0, symmetry="off", set={"refine.passes": 1})


@pytest.fixture
def given(bowl):
    """Images with a mask apart, intrinsics and poses in OpenCV's axes."""
    images, intrinsics, c2w = bowl
    masks = images[..., 3] >= 128
    rgb = np.where(masks[..., None], images[..., :3], np.uint8(0))
    return rgb, masks, intrinsics, c2w @ np.diag([1.0, -1.0, -1.0, 1.0])


def of_arrays(images, intrinsics, c2w, masks=None, **more):
    return freerange.Scene.from_arrays(images, intrinsics, c2w, masks, **more)


def told(*arguments, **more):
    """Sentences of warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = of_arrays(*arguments, **more)
    texts = [str(w.message) for w in caught]
    assert all(w.category is freerange.DroppedWarning and text in scene.notes for w, text in zip(caught, texts))
    return "; ".join(texts)


@pytest.mark.parametrize("rounding", [None, 6, 4])
def test_world_to_camera_is_not_taken_for_camera_to_world(model, given, rounding):
    """With masks, and before any are looked for."""
    images, masks, intrinsics, c2w = given
    inverse = np.linalg.inv(c2w)
    inverse = inverse if rounding is None else np.round(inverse, rounding)
    for outlines in (masks, None):
        with pytest.raises(ValueError, match="cameras: .*all of them at one place.*world-to-camera"):
            model.reconstruct(images, intrinsics, inverse, outlines, **QUICK)
    with pytest.raises(ValueError, match="world-to-camera"):
        of_arrays(images, intrinsics, inverse, masks)


def test_scenes_are_not_images(model):
    scene = freerange.Scene.read(BOWL)
    for wrong in (scene, BOWL, str(BOWL)):
        with pytest.raises(TypeError, match="images: .*reconstruct_scene takes a Scene or a folder.*found (Scene|str|Posix)"):
            model.reconstruct(wrong)
        with pytest.raises(TypeError, match="images: .*Scene.read"):
            of_arrays(wrong, None, None)
    with pytest.raises(TypeError, match="scene: .*reconstruct takes arrays.*ndarray"):
        model.reconstruct_scene(np.zeros((4, 8, 8, 3)))


def test_one_camera_matrix_for_all(given):
    images, masks, intrinsics, c2w = given
    expected = of_arrays(images, intrinsics, c2w, masks)
    for k in (intrinsics[0], intrinsics[:1]):
        assert np.array_equal(of_arrays(images, k, c2w, masks).intrinsics, expected.intrinsics)
        found = freerange.Scene.from_arrays(images, Ks=k, viewmats=np.linalg.inv(c2w), masks=masks)
        assert np.array_equal(found.Ks, expected.Ks)
    with pytest.raises(ValueError, match=r"intrinsics: .*\[4, 3, 3\], or \[3, 3\] for all views, found \[2, 3, 3\]"):
        of_arrays(images, intrinsics[:2], c2w, masks)


def test_masks_of_other_integers(given):
    images, masks, intrinsics, c2w = given
    expected = of_arrays(images, intrinsics, c2w, masks).images
    for kind in (np.int64, np.uint16, np.int32, np.uint8):
        for outlines in (masks.astype(kind), masks.astype(kind) * kind(255), masks.astype(kind)[..., None]):
            assert np.array_equal(of_arrays(images, intrinsics, c2w, outlines).images, expected), kind
    for outlines in (masks[..., None], masks[..., None].astype(np.float32), [m[..., None] for m in masks]):
        assert np.array_equal(of_arrays(images, intrinsics, c2w, outlines).images, expected)
    for wrong, found in ((masks * 256, "0 to 256"), (-masks.astype(np.int64), "-1 to 0")):
        with pytest.raises(ValueError, match=rf"masks\[0\]: expected integers from 0 to 255, found {found}"):
            of_arrays(images, intrinsics, c2w, wrong)
    with pytest.raises(ValueError, match=r"masks\[0\]: .*\[512, 512\].*\[512, 512, 3\]"):
        of_arrays(images, intrinsics, c2w, np.repeat(masks[..., None], 3, axis=-1))


def test_what_may_be_wrong_with_arrays_is_a_warning(model, given):
    """As the command line's `inspect` says it, and more; before the work begins, and once."""
    images, masks, intrinsics, c2w = given
    assert "size" not in told(images, intrinsics, c2w, masks)
    assert "only 3 photos" in told(images[:3], intrinsics[:3], c2w[:3], masks[:3])
    twice = (np.concatenate([a, a[:1]]) for a in (intrinsics, c2w))
    others = [np.concatenate([images, images[1:2]]), *twice, np.concatenate([masks, masks[1:2]])]
    assert "same pose: images[0] and images[4]" in told(*others)
    half = intrinsics * np.array([[0.5], [0.5], [1.0]])
    assert "intrinsics of photos of another size" in told(images, half, c2w, masks)
    begun = []
    with pytest.warns(freerange.DroppedWarning, match="only 3 photos") as caught:
        made = model.reconstruct(
            images[:3], intrinsics[:3], c2w[:3], masks[:3], **QUICK, on_step=lambda _: begun.append(len(caught))
        )
    texts = [str(w.message) for w in caught]
    assert begun[0] == len(texts) == len(set(texts)) and {w.filename for w in caught} == {__file__}
    assert [n for n in made.notes if n in texts] == texts
