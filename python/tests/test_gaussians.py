"""Gaussians: arrays, files, pictures."""

import pickle
import warnings

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


def test_shapes_that_numpy_users_have(scattered):
    given, c2w, k, width, height = scattered
    expected = freerange.render(**given, c2w=c2w, K=k, width=width, height=height).rgb
    columns = dict(given, opacities=given["opacities"][:, None])
    for found in (
        freerange.render(**columns, c2w=c2w, K=k, width=width, height=height).rgb,
        freerange.render(**given, c2w=c2w, K=k[None], width=width, height=height).rgb,
        freerange.render(**given, c2w=c2w[None].repeat(3, axis=0), K=k[None], width=width, height=height).rgb[2],
        freerange.render(**given, c2w=c2w[None].repeat(2, axis=0), K=k, width=width, height=height).rgb[1],
    ):
        assert np.array_equal(found, expected)


def test_which_way_is_up_is_kept(gaussians, tmp_path):
    """In a comment of a .ply, in a page; other files have none, or an up of their own."""
    for name, up in [("ply", (0, -1, 0)), ("html", (0, -1, 0)), ("splat", (0, 0, 1)), ("glb", (0, 0, 1))]:
        gaussians.save(tmp_path / f"g.{name}")
        read = freerange.Gaussians.read(tmp_path / f"g.{name}")
        assert read.up == up, name
        assert freerange.Gaussians.read(tmp_path / f"g.{name}", up=(1, 0, 0)).up == (1, 0, 0)
    kept = freerange.Gaussians.read(tmp_path / "g.ply")
    assert np.array_equal(kept.means, gaussians.means)
    kept.save(tmp_path / "again.ply")
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "g.ply").read_bytes()


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", freerange.DroppedWarning)  # some formats fix their axes or have fewer bits
        gaussians.save(file)
    again = freerange.Gaussians.read(file, up=(0, -1, 0))
    order = np.argsort(again.opacities)
    tolerance = {"ply": 1e-6, "glb": 1e-6, "html": 1e-6}.get(format, 0.02)
    assert np.allclose(again.means[order], gaussians.means[np.argsort(gaussians.opacities)], atol=tolerance)
    assert len(again) == 5


def test_pictures_are_the_references(scattered, gaussians):
    _, c2w, k, width, height = scattered
    background = (0.2, 0.5, 0.9)
    rgb, alpha, none = freerange.render(**scattered[0], c2w=c2w, K=k, width=width, height=height, background=background)
    assert none is None
    camera = (width, height, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), c2w.tolist())
    expected = freerange._core.reference(gaussians.rows.tobytes(), camera, background)
    for found, slow in zip((rgb, alpha), expected):
        assert np.allclose(found, np.frombuffer(slow).reshape(found.shape), atol=2e-6)
    again = gaussians.render(c2w, k, width, height, background)
    assert np.array_equal(again.rgb, rgb) and np.array_equal(again.alpha, alpha)
    # The same camera in OpenGL's axes, twice, before two colours.
    flipped = np.stack([c2w @ np.diag([1.0, -1.0, -1.0, 1.0])] * 2)[:, :3]
    both = gaussians.render(flipped, k, width, height, [background, (0, 0, 0)], convention="opengl").rgb
    assert both.shape == (2, height, width, 3)
    assert np.array_equal(both[0], rgb) and np.all(both[1] <= both[0])


def test_gsplats_order_and_names(scattered):
    given, c2w, k, width, height = scattered
    expected = freerange.render(**given, c2w=c2w, K=k, width=width, height=height)
    in_order = [given[f] for f in ("means", "quats", "scales", "opacities", "colors")]
    viewmats = np.linalg.inv(c2w)
    for found in (
        freerange.render(*in_order, viewmats=viewmats, Ks=k, width=width, height=height),
        freerange.Gaussians(*in_order).render(viewmats=viewmats[None], Ks=k[None], width=width, height=height),
    ):
        assert np.allclose(found.rgb.reshape(height, width, 3), expected.rgb, atol=1e-6)
    black = freerange.render(*in_order, viewmats=viewmats, Ks=k, width=width, height=height, backgrounds=np.zeros((1, 3)))
    assert np.array_equal(black.rgb, freerange.render(**given, c2w=c2w, K=k, width=width, height=height, background=0.0).rgb)
    with pytest.raises(TypeError, match="either background or backgrounds, found both"):
        freerange.render(**given, c2w=c2w, K=k, background=0.5, backgrounds=0.5)
    with pytest.raises(TypeError, match="either c2w or viewmats, found both"):
        freerange.render(**given, c2w=c2w, viewmats=viewmats, K=k)
    with pytest.raises(TypeError, match="either K or Ks, found none"):
        freerange.render(**given, c2w=c2w)
    # Its cameras by position would be taken for camera to world.
    for arrays in (in_order, map(np.ndarray.tolist, in_order)):
        with pytest.raises(TypeError, match="c2w: .*viewmats=.*gsplat"):
            freerange.render(*arrays, viewmats, k, width, height)
    with pytest.raises(ValueError, match="viewmats: .*off by"):
        freerange.render(*in_order, viewmats=2.0 * viewmats[:3], Ks=k)


def test_depth_is_the_mean_z(scattered):
    """Of one opaque Gaussian the z of its center; of nothing 0."""
    _, c2w, k, width, height = scattered
    one = freerange.Gaussians([[0.05, -0.1, 0.0]], [[0.01, 0.01, 0.01]], [[1, 0, 0, 0]], [1.0], [[1, 1, 1]])
    rgb, alpha, depth = one.render(c2w, k, width, height, depth=True)
    assert depth.shape == (height, width) and depth.dtype == np.float32
    assert np.allclose(depth[alpha > 0], 2.0, atol=1e-5) and (alpha > 0).any()
    assert (depth[alpha == 0] == 0.0).all() and (alpha == 0).any()
    two = one.render(np.stack([c2w, c2w]), k, width, height, depth=True)
    assert two.depth.shape == (2, height, width) and np.array_equal(two.depth[1], depth)


def test_some_all_and_several(gaussians):
    n = len(gaussians)
    for index in (slice(1, 4), [0, 2], np.array([-1]), np.arange(n) > 2, 3):
        some = gaussians[index]
        assert np.array_equal(some.rows, np.atleast_2d(gaussians.rows[index])) and some.up == gaussians.up
    assert len(gaussians[[]]) == 0 and [len(g) for g in gaussians] == [1] * n
    both = gaussians + gaussians[:2]
    assert np.array_equal(both.rows, np.concatenate([gaussians.rows, gaussians.rows[:2]]))
    with pytest.raises(IndexError):
        gaussians[n]
    with pytest.raises(IndexError):
        gaussians[[0, -n - 1]]
    with pytest.raises(ValueError, match="mask"):
        gaussians[np.ones(n + 1, dtype=bool)]
    with pytest.raises(TypeError, match="index"):
        gaussians[[0.5]]
    with pytest.raises(TypeError):
        gaussians + 3
    with pytest.raises(ValueError, match="parts"):
        freerange.Gaussians.concat([])
    low, high = gaussians.means.min(axis=0) - 1, gaussians.means.max(axis=0) + 1
    assert len(gaussians.crop(low, high)) == n
    middle = np.sort(gaussians.means[:, 2])[n // 2] + 1e-4
    assert len(gaussians.crop(low, [high[0], high[1], middle])) == n // 2 + 1
    assert len(gaussians.crop(low, [np.inf, np.inf, middle])) == n // 2 + 1
    assert len(gaussians.crop([-np.inf] * 3, [np.inf] * 3)) == n
    with pytest.raises(ValueError, match="high"):
        gaussians.crop(high, low)
    with pytest.raises(ValueError, match="low: .*nan"):
        gaussians.crop([np.nan, 0, 0], high)


def harmonic(scattered, degree=3):
    k = (degree + 1) ** 2 - 1
    return freerange.Gaussians(**scattered[0], sh=0.1 * np.random.default_rng(5).normal(size=(5, k, 3)), up=(0, -1, 0))


def test_moved_with_their_camera_they_look_the_same(scattered):
    """A similarity of Gaussians and camera changes nothing that is seen, spherical harmonics among it; depth grows with the scale."""
    _, c2w, k, width, height = scattered
    axis = np.array([0.48, 0.6, 0.64])
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    for angle in (0.0, 1.1, np.pi):
        turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = 1.7 * turn, [3.0, -1.0, 0.5]
        moved_camera = np.eye(4)
        moved_camera[:3, :3] = turn @ c2w[:3, :3]
        moved_camera[:3, 3] = matrix[:3, :3] @ c2w[:3, 3] + matrix[:3, 3]
        for gaussians in (freerange.Gaussians(**scattered[0]), harmonic(scattered)):
            before = gaussians.render(c2w, k, width, height, depth=True)
            moved = gaussians.transform(matrix)
            after = moved.render(moved_camera, k, width, height, depth=True)
            assert np.allclose(after.rgb, before.rgb, atol=2e-5), angle
            assert np.allclose(after.depth, 1.7 * before.depth, rtol=1e-4)
            assert np.allclose(moved.up, turn @ np.array(gaussians.up), atol=1e-9)
    for bad_matrix, words in [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "no mirror"),
        (np.diag([1.0, 2.0, 1.0, 1.0]), "off by"),
        (np.eye(3), r"\[4, 4\]"),
        (np.ones((4, 4)) * np.nan, "finite"),
    ]:
        with pytest.raises(ValueError, match=words):
            gaussians.transform(bad_matrix)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_are_kept(scattered, tmp_path, degree):
    gaussians = harmonic(scattered, degree)
    assert gaussians.sh_degree == degree and f"degree {degree}" in repr(gaussians)
    gaussians.save(tmp_path / "g.ply")
    again = freerange.Gaussians.read(tmp_path / "g.ply", up=gaussians.up)
    assert np.allclose(again.sh, gaussians.sh, atol=1e-6) and again.sh_degree == degree
    assert np.array_equal(pickle.loads(pickle.dumps(gaussians)).sh, gaussians.sh)
    assert np.array_equal(gaussians[2:].sh, gaussians.sh[2:])
    plain = freerange.Gaussians(**scattered[0])
    joined = plain + gaussians
    assert joined.sh_degree == degree and not joined.sh[:5].any() and np.array_equal(joined.sh[5:], gaussians.sh)
    # Colors are those that 3DGS's formula gives in the direction of the camera: degree 1 by hand.
    _, c2w, k, width, height = scattered
    one = gaussians[0]
    if degree == 1:
        d = (one.means[0] - c2w[:3, 3]) / np.linalg.norm(one.means[0] - c2w[:3, 3])
        constant = 0.4886025119029199
        sh = one.sh[0]
        color = one.colors[0] + constant * (-d[1] * sh[0] + d[2] * sh[1] - d[0] * sh[2])
        same = freerange.Gaussians(one.means, one.scales, one.quats, one.opacities, [np.maximum(color, 0.0)])
        assert np.allclose(one.render(c2w, k, width, height).rgb, same.render(c2w, k, width, height).rgb, atol=1e-5)
    # All coefficients in one array, as gsplat has them.
    constant = (gaussians.colors[:, None] - 0.5) / 0.28209479177387814
    whole = freerange.Gaussians(**dict(scattered[0], colors=np.concatenate([constant, gaussians.sh], axis=1)))
    assert np.allclose(whole.rows, gaussians.rows, atol=1e-6) and np.array_equal(whole.sh, gaussians.sh)
    with pytest.raises(ValueError, match=r"colors: .*\[5, 2, 3\]"):
        freerange.Gaussians(**dict(scattered[0], colors=np.zeros((5, 2, 3))))
    with pytest.raises(TypeError, match="sh: .*both"):
        freerange.Gaussians(**dict(scattered[0], colors=np.zeros((5, 4, 3))), sh=gaussians.sh)
    with pytest.raises(ValueError, match="sh: .*3, 8 or 15"):
        freerange.Gaussians(**scattered[0], sh=np.zeros((5, 4, 3)))


def test_what_a_format_cannot_hold_is_a_warning(scattered, tmp_path):
    with pytest.warns(freerange.DroppedWarning, match="harmonics|viewing direction") as caught:
        harmonic(scattered).save(tmp_path / "g.splat")
    assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        harmonic(scattered).save(tmp_path / "g.ply")
        assert freerange.Gaussians.read(tmp_path / "g.ply").notes == []


def test_what_is_left_out_of_a_file_is_a_warning(gaussians, tmp_path):
    file = tmp_path / "g.ply"
    gaussians.save(file)
    header, end, rows = file.read_bytes().partition(b"end_header\n")
    not_finite = np.float32(np.nan).tobytes() + rows[4:]
    for content, words, left in [
        (header + b"element camera 0\nproperty float x\n" + end + rows, "elements left out: camera", 5),
        (header + end + not_finite, "1 Gaussians with numbers that are not finite are left out", 4),
    ]:
        file.write_bytes(content)
        with pytest.warns(freerange.DroppedWarning, match=words) as caught:
            again = freerange.Gaussians.read(file)
        assert [w.filename for w in caught] == [__file__] and len(again) == left
        assert again.notes == [str(caught[0].message)]


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
        (dict(opacities=np.full((5, 2), 0.5)), ValueError, ["opacities", "[5]", "[5, 2]"]),
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
    with pytest.raises(FileNotFoundError, match="expected a folder") as caught:
        gaussians.save(tmp_path / "none" / "g.ply")
    assert caught.value.filename == str(tmp_path / "none") and ".freerange-" not in str(caught.value)
    with pytest.raises(NotADirectoryError, match="bad.ply"):
        gaussians.save(tmp_path / "bad.ply" / "g.ply")
    with pytest.raises(ValueError, match="up"):
        freerange.Gaussians.read(tmp_path / "bad.ply", up=(0, 0, 0))
