"""What a finished video leaves in its folder: videos, frames, their cameras, a contact sheet, and the record of the run."""

from pathlib import Path
from typing import Any

from ..config import RoGeConfig, to_dict
from ..files import video_io
from ..files.entry import Clock, environment
from ..files.folders import write_json
from ..scenes.paths import transforms
from ..scenes.scene import Scene
from .photos import Photos
from .video import Result


def write_outputs(
    folder: Path, result: Result, photos: Photos, fps: float, *, generated: bool = True
) -> None:
    """All files but run.json. Where nothing is generated the frames are the preview, which is not written twice."""
    height, width = result.frames.shape[1:3]
    names = video_io.write_frames(folder / "frames", result.frames)
    write_json(folder / "transforms.json", transforms(names, result.cameras, height, width))
    video_io.write_video(folder / "video.mp4", result.frames, fps)
    rows: dict[str, Any] = {"photos": photos.images}
    if generated:
        video_io.write_video(folder / "preview.mp4", result.preview, fps)
        rows["generated"] = result.frames
    rows["preview (reconstruction)"] = result.preview
    video_io.write_png(folder / "contact_sheet.png", video_io.contact_sheet(rows))


def record(
    program: str,
    arguments: dict[str, Any],
    config: RoGeConfig,
    settings: dict[str, Any],
    scene: Scene,
    photos: Photos,
    result: Result,
    clock: Clock,
    *,
    generated: bool = True,
) -> dict[str, Any]:
    """run.json: everything needed to know what was made and to make it again."""
    info, stages = result.normalisation, clock.record()
    pace = (
        {}
        if generated
        else {"seconds_per_frame": stages["preview"]["seconds"] / len(result.frames)}
    )
    return {
        "program": program,
        **environment(),
        "arguments": arguments,
        "generated": generated,
        "settings": settings,
        "scene": {
            "source": scene.source,
            "photos": len(scene),
            "context": list(photos.ids),
            "context_names": [scene.names[i] for i in photos.ids],
        },
        "scale": {
            "divisor": info.divisor,
            "status": info.status,
            "rule": info.rule,
            "context_reach": info.context_reach,
            "target_reach": info.target_reach,
        },
        "frames": len(result.frames),
        "size": list(result.frames.shape[1:3]),
        "evaluations": result.evaluations,
        "windows": list(result.windows),
        "warnings": [one._asdict() for one in result.warnings],
        "stages": stages,
        **pace,
        "config": to_dict(config),
    }
