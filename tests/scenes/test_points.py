"""Sparse points of scenes: read from COLMAP's files and PLY, and what they say about how far away things are."""

import json
import struct
import warnings

import numpy as np
import pytest
import scene_files as files

from roge_jax.errors import UserError
from roge_jax.geometry.cameras import CameraWarning
from roge_jax.geometry.trajectories import make_path
from roge_jax.scenes.points import Points, depth_of, read_ply, write_ply
from roge_jax.scenes.scene import load_scene

CAMERAS = files.truth()
COUNT = 60


def cloud(rng=None) -> tuple[np.ndarray, np.ndarray, list[list[int]]]:
    """Points around the origin, where all cameras look, their colours, and the photos that see each (10 to 13)."""
    rng = rng or np.random.default_rng(0)
    xyz = rng.uniform(-0.2, 0.2, (COUNT, 3))
    return (
        xyz,
        rng.integers(0, 255, (COUNT, 3)),
        [[10 + i % 2, 12, 13][: 2 + i % 2] for i in range(COUNT)],
    )


def add_points(folder, binary):
    xyz, rgb, tracks = cloud()
    model = folder / "sparse" / "0"
    if binary:
        data = struct.pack("<Q", COUNT)
        for i in range(COUNT):
            data += struct.pack("<Q3d3BdQ", i + 1, *xyz[i], *rgb[i], 0.5, len(tracks[i]))
            data += b"".join(struct.pack("<II", image, 0) for image in tracks[i])
        (model / "points3D.bin").write_bytes(data)
        return
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"]
    for i in range(COUNT):
        track = " ".join(f"{image} 0" for image in tracks[i])
        lines.append(
            " ".join(
                [str(i + 1), *(repr(float(x)) for x in xyz[i]), *map(str, rgb[i]), "0.5", track]
            )
        )
    (model / "points3D.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("binary", [True, False])
def test_points_of_a_colmap_model(tmp_path, binary):
    folder = files.colmap(tmp_path, CAMERAS, binary)
    assert load_scene(folder).points is None
    add_points(folder, binary)
    scene = load_scene(folder)
    xyz, rgb, tracks = cloud()
    np.testing.assert_allclose(scene.points.xyz, xyz)
    np.testing.assert_array_equal(scene.points.rgb, rgb)
    for view in range(4):  # photo VIEW.png is image 10 + VIEW
        want = [i for i in range(COUNT) if 10 + view in tracks[i]]
        assert scene.points.seen[view].tolist() == want
    pose = scene.cameras.c2w[2]
    want = np.median((xyz[scene.points.seen[2]] - pose[:3, 3]) @ pose[:3, 2])
    assert scene.depth(2) == pytest.approx(want)
    assert scene.depth(3) == pytest.approx(4.0, rel=0.1)


def test_points_of_a_transforms_json(tmp_path):
    folder = files.nerfstudio(tmp_path, CAMERAS)
    assert load_scene(folder).depth(0) is None
    xyz, rgb, _ = cloud()
    write_ply(folder / "cloud.ply", Points(xyz, rgb))
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "cloud.ply"}))
    scene = load_scene(folder)
    np.testing.assert_allclose(scene.points.xyz, xyz, atol=1e-7)
    np.testing.assert_array_equal(scene.points.rgb, rgb)
    assert scene.points.seen is None
    assert scene.depth(0) == pytest.approx(4.0, rel=0.1)


def test_points_beside_and_behind_a_photo_do_not_count():
    K, pose = np.array([[20.0, 0, 20], [0, 20, 12], [0, 0, 1]]), np.eye(4)
    cameras = CAMERAS[:1].replace(K=K[None], c2w=pose[None])
    ahead = np.tile([[0.1, 0.1, 2.0]], (30, 1))
    others = np.tile([[0.0, 0.0, -5.0], [90.0, 0.0, 3.0]], (100, 1))
    assert depth_of(Points(np.concatenate([ahead, others])), cameras, 0, (24, 40)) == 2.0
    assert depth_of(Points(others), cameras, 0, (24, 40)) is None
    assert depth_of(Points(ahead[:5]), cameras, 0, (24, 40)) is None


def test_presets_turn_around_what_the_photo_sees(tmp_path):
    """Cameras side by side, of which nothing says how far away things are but the points."""
    from test_inputs import read

    cameras = CAMERAS[:3].replace(K=CAMERAS.K[:3], c2w=np.tile(np.eye(4), (3, 1, 1)))
    cameras.c2w[:, 0, 3] = [0.0, 0.1, 0.2]
    folder = files.nerfstudio(tmp_path, cameras)
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) + np.array([0, 0, 7])
    write_ply(folder / "cloud.ply", Points(xyz))
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(content | {"ply_file_path": "cloud.ply"}))
    words = ("--scene", folder, "--context", "0,1,2", "--frames", "5", "--trajectory")
    _, scene, photos, path = read(*words, "orbit:degrees=20")
    depth = scene.depth(photos.ids[0])
    assert depth == pytest.approx(7.0, rel=0.05)
    want = make_path("orbit", photos.cameras, 5, focus=depth, degrees=20)
    np.testing.assert_allclose(path.c2w, want.c2w)
    _, _, photos, path = read(*words, "orbit:degrees=20,focus=3")  # the user's word
    want = make_path("orbit", photos.cameras, 5, focus=3.0, degrees=20)
    np.testing.assert_allclose(path.c2w, want.c2w)


def test_ply_files_of_other_programs(tmp_path):
    xyz, _, _ = cloud()
    head = "ply\nformat {} 1.0\ncomment made elsewhere\nelement vertex {}\n" + "".join(
        f"property {kind} {name}\n"
        for kind, name in (("double", "x"), ("double", "y"), ("double", "z"), ("float", "nx"))
    )
    text = (
        head.format("ascii", COUNT)
        + "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    text += "".join(f"{x!r} {y!r} {z!r} 0\n" for x, y, z in xyz.tolist())
    (tmp_path / "a.ply").write_text(text)
    found = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.xyz, xyz)
    assert found.rgb is None
    rows = b"".join(struct.pack(">3df", *row, 0.0) for row in xyz)
    data = (head.format("binary_big_endian", COUNT) + "end_header\n").encode() + rows
    (tmp_path / "b.ply").write_bytes(data)
    np.testing.assert_array_equal(read_ply(tmp_path / "b.ply").xyz, xyz)
    for content in (data[:-9], b"ply\n", data.replace(b"double z", b"double w")):
        (tmp_path / "b.ply").write_bytes(content)
        with pytest.raises(UserError, match=r"b\.ply: "):
            read_ply(tmp_path / "b.ply")


def test_damaged_points_cost_a_warning_not_the_scene(tmp_path):
    folder = files.colmap(tmp_path, CAMERAS, binary=True)
    add_points(folder, True)
    file = folder / "sparse" / "0" / "points3D.bin"
    file.write_bytes(file.read_bytes()[:-20])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(folder)
    with pytest.warns(CameraWarning, match=r"points are not used: .*points3D.bin: damaged"):
        assert scene.points is None
    assert scene.depth(0) is None
