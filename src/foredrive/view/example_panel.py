"""One example of a report: recorded images, rendered images, predictions and the plan."""

import datetime
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

from foredrive.runs import ExamplePrediction
from foredrive.scene import Clip, Command, Example, Trajectory, VoxelSpec
from foredrive.tasks.occupancy.scores import ABOVE_GROUND_M
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY, draw_bev, legend_handles, path_points, with_legend
from foredrive.view.html import Picture, picture
from foredrive.view.image_drawing import Camera, draw_path_on_image, resize, to_image
from foredrive.view.log_sheet import camera_rows
from foredrive.view.task_pictures import task_pictures
from foredrive.view.voxel_drawing import draw_comparison, draw_volume_pca, draw_voxels

CAMERA_WIDTH_PX, FRONT_WIDTH_PX = 400, 960
VOXELS_HW = (450, 820)
MAP_PX = 560
COMPARISON_KEY = (
    (palette.TRUE_POSITIVE, "hit"),
    (palette.FALSE_POSITIVE, "false alarm"),
    (palette.FALSE_NEGATIVE, "miss"),
    (palette.KNOWN_FREE, "known, free"),
    (palette.GROUND, "unknown"),
)


@dataclass(frozen=True)
class ExamplePanel:
    """An example's pictures for the page template."""

    title: str
    command: str
    speed: str
    plan: list[Picture]
    """The driven future and the plan: in the front camera, and from above."""
    tasks: list[list[Picture]]
    """Rows of truth and prediction of task heads; empty without heads."""
    cameras: dict[str, list[Picture]]
    """Recorded images and, in the same order, rendered images; empty if the log has no camera."""
    camera_columns: Literal["two", "three"]
    occupancy: list[Picture]
    """Occupancy at now in perspective: predicted, and labelled."""
    above: list[Picture]
    later: list[Picture]
    """The imagined key frames, each in its own ego frame: in perspective, and compared from above."""
    key = COMPARISON_KEY
    above_ground_m = f"{ABOVE_GROUND_M:g}"


def draw_example(shown: ExamplePrediction) -> ExamplePanel:
    """Draw an example's pictures."""
    clip = shown.example.clip
    known_command, known_speed = bool(clip.command_valid), bool(clip.ego_speed_valid[clip.now])
    cameras = _cameras(shown)
    return ExamplePanel(
        title=example_title(shown.example),
        command=palette.label(Command(int(clip.command))) if known_command else "unknown",
        speed=f"{float(clip.ego_speed_mps[clip.now]):.1f} m/s" if known_speed else "unknown",
        plan=_plan(shown),
        tasks=task_pictures(shown, front_camera(clip)),
        cameras=cameras,
        # Two or four images make full rows of two, other numbers look better in rows of three
        camera_columns="two" if len(next(iter(cameras.values()), [])) in (2, 4) else "three",
        occupancy=[
            picture(predicted_voxels(shown, 0), f"Predicted occupancy, {_content_text(shown, 0)}"),
            picture(labelled_voxels(shown, 0), "Labelled occupancy, coloured by height"),
        ],
        above=_above(shown),
        later=_later(shown),
    )


def example_title(example: Example) -> str:
    """Return the log of an example, and the time of its now."""
    log, _, t_us = example.key[0].rpartition("@")
    taken = datetime.datetime.fromtimestamp(int(t_us) * 1e-6, datetime.UTC)
    return f"{log} at {taken:%Y-%m-%d %H:%M:%S}.{taken.microsecond // 10_000:02d} UTC"


def front_camera(clip: Clip) -> int | None:
    """Return the camera with an image at now that points most straight ahead; None: there is none."""
    # The x component of the optical axis in the ego frame; cameras without an image never win
    ahead = clip.rig.T_ego_cam[clip.now, :, 0, 2].masked_fill(~clip.image_valid[clip.now], -torch.inf)
    return int(ahead.argmax()) if bool(ahead.isfinite().any()) else None


def camera_with_paths(clip: Clip, index: int, plan: Trajectory, width_px: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the driven future (green) and the plan (red) on the ground of a camera's image at now."""
    image = clip.images[clip.now, index].permute(1, 2, 0).numpy()
    size_hw = (round(width_px * image.shape[0] / image.shape[1]), width_px)
    camera = Camera.of(clip.rig[clip.now], index).resized(size_hw)
    image = resize(image, size_hw)
    for path, colour in ((clip.future, palette.EXPERT), (plan, palette.PLAN)):
        image = draw_path_on_image(image, path_points(path), camera, colour)
    return image


def plan_picture(clip: Clip, plan: Trajectory, reach_m: float) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the scene from above with the driven future and the plan, legend below."""
    figure = Figure(figsize=(5.6, 6.3), dpi=MAP_PX / 5.6, facecolor=palette.GROUND)
    draw_bev(figure.add_axes((0.125, 0.17, 0.855, 0.76)), clip, reach_m, plan)
    return with_legend(figure, legend_handles(clip, plan)[:12])


def comparison_picture(shown: ExamplePrediction, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw hits, false alarms and misses from above, `step` key frames after now."""
    grid, frame = shown.example.occupancy, shown.example.clip.now + step
    columns = draw_comparison(
        shown.occupied[step],
        grid.values[frame, 0] > 0.5,
        grid.known[frame],
        shown.example.occupancy.spec,
        ABOVE_GROUND_M,
    )
    return with_ego(columns, shown.example.occupancy.spec)


def predicted_voxels(shown: ExamplePrediction, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw predicted occupancy in perspective, `step` key frames after now."""
    return draw_voxels(shown.occupied[step], shown.example.occupancy.spec, VOXELS_HW)


def labelled_voxels(shown: ExamplePrediction, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw labelled occupancy in perspective, `step` key frames after now."""
    grid, frame = shown.example.occupancy, shown.example.clip.now + step
    return draw_voxels(
        (grid.values[frame, 0] > 0.5) & grid.known[frame], shown.example.occupancy.spec, VOXELS_HW
    )


def _plan(shown: ExamplePrediction) -> list[Picture]:
    clip, spec = shown.example.clip, shown.example.occupancy.spec
    reach_m = 0.5 * max(spec.shape_zyx[1:]) * spec.voxel_m
    above = picture(plan_picture(clip, shown.plan, reach_m), "The same from above", "png")
    front = front_camera(clip)
    if front is None:
        return [above]
    caption = f"{clip.rig.names[front]}: driven future (green) and plan (red)"
    return [picture(camera_with_paths(clip, front, shown.plan, FRONT_WIDTH_PX), caption), above]


def _cameras(shown: ExamplePrediction) -> dict[str, list[Picture]]:
    clip = shown.example.clip
    order = [camera for row in camera_rows(clip.rig[clip.now]) for camera in row]
    seen = [camera for camera in order if bool(clip.image_valid[clip.now, camera])]
    if not seen:
        return {}
    halves = {"Camera images": clip.images[clip.now].float() / 255}
    if shown.rendered is not None:
        halves["Rendered from the volume"] = shown.rendered
    height, width = clip.rig.size_hw
    size_hw = (round(CAMERA_WIDTH_PX * height / width), CAMERA_WIDTH_PX)
    return {
        title: [picture(resize(to_image(images[camera]), size_hw), clip.rig.names[camera]) for camera in seen]
        for title, images in halves.items()
    }


def _above(shown: ExamplePrediction) -> list[Picture]:
    """Draw occupancy at now from above, beside the volume."""
    spec = shown.example.occupancy.spec
    _, rows, columns = spec.shape_zyx
    across = f"{rows * spec.voxel_m:.0f} m wide and {columns * spec.voxel_m:.0f} m long"
    volume = with_ego(draw_volume_pca(shown.volume), spec)
    return [
        picture(comparison_picture(shown, 0), f"Prediction and labels from above, {across}", "png"),
        picture(volume, f"Volume: PCA to three channels, mean over height, {across}", "png"),
    ]


def _content_text(shown: ExamplePrediction, step: int) -> str:
    """Return the end of a caption; without occupied voxels the picture is black."""
    return "coloured by height" if bool(shown.occupied[step].any()) else "no voxel is occupied"


def _later(shown: ExamplePrediction) -> list[Picture]:
    clip, pictures = shown.example.clip, []
    for step in range(1, len(shown.occupied)):
        when = f"+{float(clip.t_s[clip.now + step]):.1f} s"
        caption = f"Imagined occupancy at {when}, {_content_text(shown, step)}"
        pictures.append(picture(predicted_voxels(shown, step), caption))
        pictures.append(picture(comparison_picture(shown, step), f"Prediction and labels at {when}", "png"))
    return pictures


def with_ego(columns: UInt8[np.ndarray, "X Y 3"], spec: VoxelSpec) -> UInt8[np.ndarray, "H W 3"]:
    """Enlarge a picture of columns by a whole factor, and draw the vehicle's outline."""
    factor = max(1, round(MAP_PX / columns.shape[0]))
    canvas = Image.fromarray(columns).resize(
        (columns.shape[1] * factor, columns.shape[0] * factor), Image.Resampling.NEAREST
    )
    px_per_m = factor / spec.voxel_m
    # Rows run backwards from the front edge, columns to the right from the left edge
    outline = [
        ((spec.upper_m[1] - y) * px_per_m, (spec.upper_m[0] - x) * px_per_m) for x, y in EGO_OUTLINE_XY
    ]
    ImageDraw.Draw(canvas).polygon(outline, outline=palette.rgb255(palette.EGO), width=2)
    return np.asarray(canvas)
