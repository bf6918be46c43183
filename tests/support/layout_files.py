"""Further published layouts, written to disk from one ground truth by their own rules (beside `scene_files`)."""

import json
import shutil
from pathlib import Path

import numpy as np
import scene_files as files
from scene_files import HEIGHT, WIDTH, picture, save

from roge_jax.geometry.cameras import Cameras, invert, opencv_to_opengl, quaternion


def one_K(cameras: Cameras, centred: bool = False) -> Cameras:
    """The same places, all with the first K (layouts that know one camera), square and centred if asked for."""
    K = cameras.K[0].copy()
    if centred:
        K = np.array([[K[0, 0], 0, WIDTH / 2], [0, K[0, 0], HEIGHT / 2], [0, 0, 1.0]])
    return Cameras(np.tile(K, (len(cameras), 1, 1)), cameras.c2w)


def llff(folder: Path, cameras: Cameras) -> Path:
    """poses_bounds.npy: 3x5 [R t (h, w, f)] with the axes down, right, backward, then near and far."""
    rows = []
    for view, (K, pose) in enumerate(zip(cameras.K, cameras.c2w, strict=True)):
        save(folder / "images" / f"IMG_{view:03d}.png", picture(view))
        right, down, forward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
        hwf = np.array([HEIGHT, WIDTH, K[0, 0]])
        matrix = np.stack([down, right, -forward, pose[:3, 3], hwf], -1)
        rows.append([*matrix.ravel(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def tum_lines(cameras: Cameras, start: float = 1305031102.0) -> list[str]:
    q = quaternion(cameras.c2w[:, :3, :3])
    rows = zip(cameras.c2w[:, :3, 3], q, strict=True)
    return [
        " ".join(map(repr, map(float, [start + 0.1 * i, *t, *r]))) for i, (t, r) in enumerate(rows)
    ]


def tum(folder: Path, cameras: Cameras) -> Path:
    """TUM's benchmark: rgb.txt, groundtruth.txt a few milliseconds off, and the intrinsics in a file."""
    lines = ["# color images", "# timestamp filename"]
    for view in range(len(cameras)):
        time = 1305031102.0 + 0.1 * view + 0.004
        save(folder / "rgb" / f"{time:.6f}.png", picture(view))
        lines.append(f"{time:.6f} rgb/{time:.6f}.png")
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    truth = ["# timestamp tx ty tz qx qy qz qw", *tum_lines(cameras)]
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    K = cameras.K[0]
    (folder / "calibration.txt").write_text(f"{K[0, 0]!r} {K[1, 1]!r} {K[0, 2]!r} {K[1, 2]!r}".replace("np.float64(", "").replace(")", ""))  # fmt: skip
    return folder


def kitti(folder: Path, cameras: Cameras) -> Path:
    """KITTI odometry: sequences/07 with calib.txt, poses/07.txt of camera 0, photos of camera 2 beside it."""
    sequence, offset = folder / "sequences" / "07", np.array([0.06, -0.01, 0.002])
    K = cameras.K[0]
    P2 = K @ np.hstack([np.eye(3), -offset[:, None]])
    rows = []
    for view, pose in enumerate(cameras.c2w):
        save(sequence / "image_2" / f"{view:06d}.png", picture(view))
        first = pose.copy()
        first[:3, 3] -= pose[:3, :3] @ offset
        rows.append(" ".join(repr(float(n)) for n in first[:3].ravel()))
    (folder / "poses").mkdir()
    (folder / "poses" / "07.txt").write_text("\n".join(rows) + "\n")
    numbers = " ".join(repr(float(n)) for n in P2.ravel())
    (sequence / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: {numbers}\n")
    return sequence


def blender(folder: Path, cameras: Cameras) -> Path:
    """transforms_train, _val and _test.json with camera_angle_x and names without an ending, equal in each."""
    angle = 2 * np.arctan(0.5 * WIDTH / cameras.K[0, 0, 0])
    gl = opencv_to_opengl(cameras.c2w)
    views = {"train": (0, 1), "val": (2,), "test": (3,)}
    for split, ids in views.items():
        frames = []
        for place, view in enumerate(ids):
            save(folder / split / f"r_{place}.png", picture(view))
            frames.append(
                {"file_path": f"./{split}/r_{place}", "transform_matrix": gl[view].tolist()}
            )
        content = {"camera_angle_x": angle, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


def framecrafter(folder: Path, cameras: Cameras, context: int) -> Path:
    """scene_data.npz with w2c_poses of contexts and targets; photos of the contexts in inputs/."""
    for view in range(context):
        save(folder / "inputs" / f"{view}.png", picture(view))
    np.savez(
        folder / "scene_data.npz",
        w2c_poses=invert(cameras.c2w),
        intrinsics=cameras.K,
        orig_wh=np.array([WIDTH, HEIGHT]),
        num_context=context,
    )
    return folder


def cut3r_color(folder: Path, cameras: Cameras) -> Path:
    """CUT3R's ScanNet: color/ and cam/, intrinsics 4x4."""
    (folder / "cam").mkdir()
    for view, (K, pose) in enumerate(zip(cameras.K, cameras.c2w, strict=True)):
        save(folder / "color" / f"{view:05d}.png", picture(view))
        four = np.eye(4)
        four[:3, :3] = K
        np.savez(folder / "cam" / f"{view:05d}.npz", intrinsics=four, pose=pose)
    return folder


def cut3r_co3d(folder: Path, cameras: Cameras) -> Path:
    """CUT3R's CO3D: an npz beside every photo."""
    for view, (K, pose) in enumerate(zip(cameras.K, cameras.c2w, strict=True)):
        save(folder / "images" / f"frame{view:06d}.png", picture(view))
        np.savez(folder / "images" / f"frame{view:06d}.npz", camera_intrinsics=K, camera_pose=pose)
    return folder


def cut3r_metadata(folder: Path, cameras: Cameras) -> Path:
    """scene_metadata.npz of ScanNet++ and ARKitScenes."""
    names = [f"DSC0{view:04d}" for view in range(len(cameras))]
    for view, name in enumerate(names):
        save(folder / "images" / f"{name}.png", picture(view))
    np.savez(
        folder / "scene_metadata.npz",
        images=np.array(names),
        trajectories=cameras.c2w,
        intrinsics=cameras.K,
    )
    return folder


def scannetpp(folder: Path, cameras: Cameras) -> Path:
    """dslr/nerfstudio/transforms_undistorted.json, names relative to another folder, a bad frame, test_frames."""
    made = files.nerfstudio(folder / "made", cameras)
    content = json.loads((made / "transforms.json").read_text())
    home = folder / "dslr" / "resized_undistorted_images"
    home.parent.mkdir()
    (made / "images").rename(home)
    for entry in content["frames"]:
        entry["file_path"] = entry["file_path"].removeprefix("images/")
    bad = content["frames"][0] | {"is_bad": True, "file_path": "bad.png"}
    save(home / "bad.png", picture(0))
    content["frames"], content["test_frames"] = [*content["frames"][:3], bad], content["frames"][3:]
    (folder / "dslr" / "nerfstudio").mkdir()
    file = folder / "dslr" / "nerfstudio" / "transforms_undistorted.json"
    file.write_text(json.dumps(content))
    shutil.rmtree(made)
    return folder


def nested(folder: Path, cameras: Cameras, name: str = "nerfstudio") -> Path:
    """DL3DV's benchmark: the scene one level down."""
    files.nerfstudio(folder / name, cameras)
    return folder


def colmap_dense(folder: Path, cameras: Cameras) -> Path:
    """COLMAP's own workspace after image_undistorter: dense/0/sparse and dense/0/images."""
    made = files.colmap(folder / "made", cameras, binary=True)
    (folder / "dense" / "0").mkdir(parents=True)
    (made / "sparse" / "0").rename(folder / "dense" / "0" / "sparse")
    (made / "images").rename(folder / "dense" / "0" / "images")
    shutil.rmtree(made)
    return folder


def colmap_input(folder: Path, cameras: Cameras) -> Path:
    """Before 3DGS's convert.py: photos in input/, the model straight in sparse/."""
    files.colmap(folder, cameras, binary=False)
    (folder / "images").rename(folder / "input")
    for file in (folder / "sparse" / "0").iterdir():
        file.rename(folder / "sparse" / file.name)
    (folder / "sparse" / "0").rmdir()
    return folder


def colmap_rig(folder: Path, cameras: Cameras) -> Path:
    """A rig: one folder per camera, equal names in each."""
    files.colmap(folder, cameras, binary=False)
    names = ["left/0.png", "left/1.png", "right/0.png", "right/1.png"]
    text = (folder / "sparse" / "0" / "images.txt").read_text()
    for view, name in enumerate(names):
        (folder / "images" / name).parent.mkdir(exist_ok=True)
        (folder / "images" / f"{view:04d}.png").rename(folder / "images" / name)
        text = text.replace(f"{view:04d}.png", name)
    (folder / "sparse" / "0" / "images.txt").write_text(text)
    return folder
