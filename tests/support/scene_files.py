"""Small scenes written to disk in the published layouts, from one ground truth."""

import json
import struct
from pathlib import Path

import numpy as np
from camera_cases import looking_at_origin, random_K

from roge_jax.geometry.cameras import Cameras, invert, opencv_to_opengl, quaternion

HEIGHT, WIDTH = 24, 40


def truth(views: int = 4) -> Cameras:
    """Inward cameras, every view with its own K."""
    rng = np.random.default_rng(7)
    cameras = looking_at_origin(views, height=HEIGHT, width=WIDTH)
    return Cameras(np.stack([random_K(rng, HEIGHT, WIDTH) for _ in range(views)]), cameras.c2w)


def picture(view: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """uint8 [h, w, 3], different in every view, pixel and direction."""
    y, x = np.mgrid[:height, :width]
    red, green = 255 * x // (width - 1), 255 * y // (height - 1)
    return np.stack([red, green, np.full_like(red, 40 * view + 20)], -1).astype(np.uint8)


def save(file: Path, pixels: np.ndarray, **options) -> None:
    from PIL import Image

    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(file, **options)


def intrinsic_fields(K: np.ndarray) -> dict:
    return {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def nerfstudio(folder: Path, cameras: Cameras, *, change: dict | None = None, **top) -> Path:
    """transforms.json with PNGs; `change` maps a frame number to fields to overwrite."""
    frames = []
    for view, (K, pose) in enumerate(zip(cameras.K, opencv_to_opengl(cameras.c2w), strict=True)):
        save(folder / "images" / f"{view:04d}.png", picture(view))
        entry = {"file_path": f"images/{view:04d}.png", "transform_matrix": pose.tolist()}
        entry |= intrinsic_fields(K)
        frames.append(entry | (change or {}).get(view, {}))
    content = {"camera_model": "PINHOLE", "w": WIDTH, "h": HEIGHT, **top, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def colmap(folder: Path, cameras: Cameras, binary: bool) -> Path:
    """A COLMAP model with one PINHOLE camera per view, written as the format's manual says."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    w2c = invert(cameras.c2w)
    q = np.roll(quaternion(w2c[:, :3, :3]), 1, axis=-1)  # scalar first
    names = [f"{view:04d}.png" for view in range(len(cameras))]
    for view, name in enumerate(names):
        save(folder / "images" / name, picture(view))
    parameters = np.stack([list(intrinsic_fields(K).values()) for K in cameras.K])
    order = [i for i in (2, 0, 3, 1) if i < len(names)]  # the reader must sort by name
    if not binary:
        lines = ["# Camera list"]
        for view, numbers in enumerate(parameters):
            values = " ".join(repr(float(n)) for n in numbers)
            lines.append(f"{view + 1} PINHOLE {WIDTH} {HEIGHT} {values}")
        (model / "cameras.txt").write_text("\n".join(lines) + "\n")
        lines = ["# Image list"]
        for view in order:
            numbers = " ".join(repr(float(n)) for n in [*q[view], *w2c[view, :3, 3]])
            points = "" if view == 3 else "1.5 2.5 -1 3.5 4.5 7"
            lines += [f"{view + 10} {numbers} {view + 1} {names[view]}", points]
        (model / "images.txt").write_text("\n".join(lines) + "\n")
        return folder
    data = struct.pack("<Q", len(names))
    for view, numbers in enumerate(parameters):
        data += struct.pack("<iiQQ4d", view + 1, 1, WIDTH, HEIGHT, *numbers)
    (model / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(names))
    for view in order:
        data += struct.pack("<I4d3dI", view + 10, *q[view], *w2c[view, :3, 3], view + 1)
        data += names[view].encode() + b"\0"
        data += struct.pack("<Q", view) + struct.pack("<ddq", 1.5, 2.5, -1) * view
    (model / "images.bin").write_bytes(data)
    return folder


def re10k(folder: Path, cameras: Cameras) -> Path:
    """A RealEstate10K text file; its time stamps have different numbers of digits."""
    lines, stamps = ["https://example.org/watch?v=x"], [900, 1200, 33000, 120000]
    for view, (K, pose) in enumerate(zip(cameras.K, invert(cameras.c2w), strict=True)):
        save(folder / "abc" / f"{stamps[view]}.png", picture(view))
        numbers = [K[0, 0] / WIDTH, K[1, 1] / HEIGHT, K[0, 2] / WIDTH, K[1, 2] / HEIGHT, 0, 0]
        numbers += pose[:3].ravel().tolist()
        lines.append(" ".join([str(stamps[view]), *(repr(float(n)) for n in numbers)]))
    (folder / "abc.txt").write_text("\n".join(lines) + "\n")
    return folder / "abc.txt"


def lvsm(folder: Path, cameras: Cameras) -> Path:
    """pixelSplat / LVSM: metadata/ID.json beside images/ID/."""
    frames = []
    for view, (K, pose) in enumerate(zip(cameras.K, invert(cameras.c2w), strict=True)):
        save(folder / "images" / "abc" / f"{view:05d}.png", picture(view))
        numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        entry = {"image_path": f"x/images/abc/{view:05d}.png", "fxfycxcy": numbers}
        frames.append(entry | {"w2c": pose.tolist()})
    (folder / "metadata").mkdir()
    (folder / "metadata" / "abc.json").write_text(json.dumps({"frames": frames}))
    return folder / "metadata" / "abc.json"


def cut3r(folder: Path, cameras: Cameras, key: str = "intrinsics", beside: bool = False) -> Path:
    """CUT3R's RealEstate10K or DL3DV folders, or (`beside`) its Virtual KITTI."""
    for view, (K, pose) in enumerate(zip(cameras.K, cameras.c2w, strict=True)):
        stem = f"{900 * (view + 1)}"  # 900, 1800, 2700, 3600: sorted as numbers
        if beside:
            save(folder / f"{view:05d}_rgb.png", picture(view))
            np.savez(folder / f"{view:05d}_cam.npz", camera_intrinsics=K, camera_pose=pose)
        else:
            save(folder / "rgb" / f"{stem}.png", picture(view))
            (folder / "cam").mkdir(exist_ok=True)
            np.savez(folder / "cam" / f"{stem}.npz", **{key: K, "pose": pose})
    return folder


def scannet(folder: Path, cameras: Cameras) -> Path:
    """ScanNet's export with one lost frame (number 2)."""
    for name in ("pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    K = np.eye(4)
    K[:3, :3] = cameras.K[0]
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", K)
    frames = [*range(2), None, *range(2, len(cameras))]
    for i, view in enumerate(frames):
        save(folder / "color" / f"{i * 5}.png", picture(0 if view is None else view))
        pose = np.full((4, 4), -np.inf) if view is None else cameras.c2w[view]
        np.savetxt(folder / "pose" / f"{i * 5}.txt", pose)
    return folder


def vkitti(folder: Path, cameras: Cameras) -> Path:
    """Virtual KITTI 2: camera 1 stands 0.532725 m to the right of camera 0."""
    extrinsic = ["frame cameraID r1,1 ..."]
    intrinsic = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    for view, pose in enumerate(cameras.c2w):
        for camera in (0, 1):
            file = folder / "frames" / "rgb" / f"Camera_{camera}" / f"rgb_{view:05d}.png"
            save(file, picture(view))
            shifted = pose.copy()
            shifted[:3, 3] += camera * 0.532725 * pose[:3, 0]
            numbers = " ".join(repr(float(n)) for n in invert(shifted).ravel())
            extrinsic.append(f"{view} {camera} {numbers}")
            K = cameras.K[view]
            intrinsic.append(f"{view} {camera} {K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}")
    (folder / "extrinsic.txt").write_text("\n".join(extrinsic) + "\n")
    (folder / "intrinsic.txt").write_text("\n".join(intrinsic) + "\n")
    return folder
