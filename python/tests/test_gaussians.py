"""Gaussians: arrays, files, pictures."""

import pickle

import numpy as np
import pytest

import freerange


@pytest.fixture
def gaussians(scattered):
    return freerange.Gaussians(**scattered[0], up=(0, -1, 0))


def test_arrays_are_what_they_were(scattered, gaussians):
    given = scattered[0]
    given["quats"] /= np.linalg.norm(given["quats"], axis=1, keepdims=True)
    for field, value in given.items():
        found = getattr(gaussians, field)
        assert found.dtype == np.float32 and found.flags.c_contiguous and found.flags.writeable
        assert np.allclose(found, value, atol=1e-6), field
    assert len(gaussians) == 5 and gaussians.rows.shape == (5, 14)
    assert np.array_equal(freerange.Gaussians.from_rows(gaussians.rows).rows, gaussians.rows)
    again = pickle.loads(pickle.dumps(gaussians))
    assert np.array_equal(again.rows, gaussians.rows) and again.up == gaussians.up


def test_dlpack_takes_them_without_a_copy(gaussians):
    for field in ("means", "scales", "quats", "opacities", "colors", "rows"):
        array = getattr(gaussians, field)
        other = np.from_dlpack(array)
        assert np.shares_memory(array, other)


def test_extremes_of_opacity(scattered):
    given = dict(scattered[0], opacities=np.array([0.0, 1.0, 0.5, 0.25, 0.75]))
    gaussians = freerange.Gaussians(**given)
    assert np.isfinite(gaussians.rows).all()
    assert np.allclose(gaussians.opacities, given["opacities"], atol=2e-6)


@pytest.mark.parametrize("format", ["ply", "splat", "spz", "sog", "glb", "html"])
def test_files_come_back(gaussians, tmp_path, format):
    file = tmp_path / f"g.{format}"
    notes = gaussians.save(file)
    assert isinstance(notes, list)
    again = freerange.Gaussians.read(file, up=(0, -1, 0))
    order = np.argsort(again.opacities)
    tolerance = {"ply": 1e-6, "glb": 1e-6, "html": 1e-6}.get(format, 0.02)
    assert np.allclose(again.means[order], gaussians.means[np.argsort(gaussians.opacities)], atol=tolerance)
    assert len(again) == 5


def test_pictures_are_the_references(scattered, gaussians):
    _, c2w, k, width, height = scattered
    background = (0.2, 0.5, 0.9)
    rgb, alpha = freerange.render(**scattered[0], c2w=c2w, K=k, width=width, height=height, background=background)
    camera = (width, height, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), c2w.tolist())
    expected = freerange._core.reference(gaussians.rows.tobytes(), camera, background)
    for found, slow in zip((rgb, alpha), expected):
        assert np.allclose(found, np.frombuffer(slow).reshape(found.shape), atol=2e-6)
    again = gaussians.render(c2w, k, width, height, background)
    assert np.array_equal(again, rgb)
    # The same camera in OpenGL's axes, twice, before two colours.
    flipped = np.stack([c2w @ np.diag([1.0, -1.0, -1.0, 1.0])] * 2)[:, :3]
    both = gaussians.render(flipped, k, width, height, [background, (0, 0, 0)], convention="opengl")
    assert both.shape == (2, height, width, 3)
    assert np.array_equal(both[0], rgb) and np.all(both[1] <= both[0])


def bad(scattered, **change):
    gaussians, c2w, k, width, height = scattered
    return dict(gaussians, c2w=c2w, K=k, width=width, height=height) | change


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (dict(means=np.zeros((5, 2))), ValueError, ["means", "[n, 3]", "[5, 2]"]),
        (dict(scales=np.ones((4, 3))), ValueError, ["scales", "[5, 3]", "[4, 3]"]),
        (dict(scales=np.zeros((5, 3))), ValueError, ["scales", "above 0"]),
        (dict(quats=np.zeros((5, 4))), ValueError, ["quats[0]", "rotation"]),
        (dict(opacities=np.full(5, 1.5)), ValueError, ["opacities", "0 to 1", "1.5"]),
        (dict(opacities=np.full((5, 1), 0.5)), ValueError, ["opacities", "[5]", "[5, 1]"]),
        (dict(colors=np.full((5, 3), np.inf)), ValueError, ["colors[0, 0]", "finite", "inf"]),
        (dict(colors=[["red"] * 3] * 5), TypeError, ["colors", "numbers"]),
        (dict(c2w=np.eye(3)), ValueError, ["c2w", "[1, 4, 4]", "[1, 3, 3]"]),
        (dict(c2w=np.eye(4)[0]), ValueError, ["c2w", "[4, 4]", "[4]"]),
        (dict(K=np.eye(4)), ValueError, ["K", "[1, 3, 3]"]),
        (dict(K=np.array([[9, 1, 4], [0, 9, 3], [0, 0, 1]])), ValueError, ["K[0]", "[0, fy, cy]", "1.0"]),
        (dict(width=0), ValueError, ["width", "1 to 16384", "found 0"]),
        (dict(height=7.5), TypeError, ["height", "integer", "7.5"]),
        (dict(background=(1, 2)), ValueError, ["background", "[3]", "[2]"]),
        (dict(background=np.nan), ValueError, ["background", "finite"]),
        (dict(convention="cv"), ValueError, ["convention", "'cv'"]),
    ],
)
def test_bad_input_is_named(scattered, change, error, words):
    with pytest.raises(error) as caught:
        freerange.render(**bad(scattered, **change))
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_bad_files_are_named(gaussians, tmp_path):
    with pytest.raises(ValueError, match=r"\.ply, .*\.obj"):
        gaussians.save(tmp_path / "g.obj")
    with pytest.raises(FileNotFoundError):
        freerange.Gaussians.read(tmp_path / "none.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(ValueError, match="bad.ply"):
        freerange.Gaussians.read(tmp_path / "bad.ply")
    with pytest.raises(OSError):
        gaussians.save(tmp_path / "none" / "g.ply")
    with pytest.raises(ValueError, match="up"):
        freerange.Gaussians.read(tmp_path / "bad.ply", up=(0, 0, 0))
