"""What a run leaves in its folder."""

SCENE = {"images", "sparse", "transforms.json"}  # as which other tools open it
PREVIEW_ALONE = sorted({"contact_sheet.png", "frames", "run.json", "video.mp4"} | SCENE)
