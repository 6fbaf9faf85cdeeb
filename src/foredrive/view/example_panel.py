"""One example of a report: recorded images, rendered images, predictions and the plan."""

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from matplotlib.figure import Figure
from PIL import Image, ImageDraw
from torch import Tensor

from foredrive.metrics.occupancy import ABOVE_GROUND_M
from foredrive.scene import Clip, Command, Example, Trajectory, VoxelSpec
from foredrive.view import palette
from foredrive.view.bev import EGO_OUTLINE_XY, draw_bev, legend_handles, path_points
from foredrive.view.html import Picture, picture
from foredrive.view.image_drawing import Camera, draw_path_on_image, resize
from foredrive.view.log_sheet import camera_rows
from foredrive.view.voxel_drawing import draw_comparison, draw_volume_pca, draw_voxels

CAMERA_WIDTH_PX, FRONT_WIDTH_PX = 400, 960
VOXELS_HW = (450, 820)
MAP_PX = 560
COMPARISON_KEY = (
    (palette.TRUE_POSITIVE, "hit"),
    (palette.FALSE_POSITIVE, "false alarm"),
    (palette.FALSE_NEGATIVE, "miss"),
    (palette.KNOWN_FREE, "known, free"),
    (palette.GROUND, "never seen by a beam"),
)


@dataclass(frozen=True)
class ExamplePanel:
    """A model's predictions for one example, without leading batch dimension."""

    title: str
    example: Example
    occupied: Bool[Tensor, "K Z Y X"]
    """Voxels predicted occupied, at now and at the K - 1 key frames after it, each in its own ego frame."""
    rendered: Float[Tensor, "C 3 h w"] | None
    """The camera images at now as rendered from the volume, RGB 0 to 1, of any size."""
    volume: Float[Tensor, "D Z Y X"] | None
    plan: Trajectory | None

    @property
    def spec(self) -> VoxelSpec:
        """Return the position and size of the voxel grids."""
        return self.example.occupancy.spec


@dataclass(frozen=True)
class ShownPanel:
    """An example's pictures for the page template."""

    title: str
    command: str
    speed: str
    plan: list[Picture]
    """The driven future and the plan: in the front camera, and from above."""
    cameras: dict[str, list[Picture]]
    """Recorded images and, in the same order, rendered images; empty if the log has no camera."""
    camera_columns: Literal["two", "three"]
    occupancy: list[Picture]
    """Occupancy at now in perspective: predicted, and seen by lidar."""
    above: list[Picture]
    later: list[Picture]
    """The imagined key frames, each in its own ego frame: in perspective, and compared from above."""
    key = COMPARISON_KEY
    above_ground_m = f"{ABOVE_GROUND_M:g}"


def show_panel(panel: ExamplePanel) -> ShownPanel:
    """Draw an example's pictures."""
    clip = panel.example.clip
    known_command, known_speed = bool(clip.command_valid), bool(clip.ego_speed_valid[clip.now])
    cameras = _cameras(panel)
    return ShownPanel(
        title=panel.title,
        command=palette.label(Command(int(clip.command))) if known_command else "unknown",
        speed=f"{float(clip.ego_speed_mps[clip.now]):.1f} m/s" if known_speed else "unknown",
        plan=_plan(panel),
        cameras=cameras,
        camera_columns="two" if len(next(iter(cameras.values()), [])) in (2, 4) else "three",
        occupancy=[
            picture(predicted_voxels(panel, 0), f"Predicted occupancy, {_content_text(panel, 0)}"),
            picture(labelled_voxels(panel, 0), "Occupancy seen by the lidar, coloured by height"),
        ],
        above=_above(panel),
        later=_later(panel),
    )


def front_camera(clip: Clip) -> int | None:
    """Return the camera with an image at now that points most straight ahead; None: there is none."""
    ahead = clip.rig.T_ego_cam[clip.now, :, 0, 2].masked_fill(~clip.image_valid[clip.now], -torch.inf)
    return int(ahead.argmax()) if bool(ahead.isfinite().any()) else None


def camera_with_paths(
    clip: Clip, index: int, plan: Trajectory | None, width_px: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the driven future (green) and the plan (red) on the ground of a camera's image at now."""
    image = clip.images[clip.now, index].permute(1, 2, 0).numpy()
    size_hw = (round(width_px * image.shape[0] / image.shape[1]), width_px)
    camera = Camera.of(clip.rig[clip.now], index).resized(size_hw)
    image = resize(image, size_hw)
    paths = [(clip.future, palette.EXPERT)] + ([(plan, palette.PLAN)] if plan is not None else [])
    for path, colour in paths:
        image = draw_path_on_image(image, path_points(path), camera, colour)
    return image


def plan_picture(clip: Clip, plan: Trajectory | None, reach_m: float) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the scene from above with the driven future and the plan, legend below."""
    figure = Figure(figsize=(5.6, 6.3), dpi=MAP_PX / 5.6, facecolor=palette.GROUND)
    draw_bev(figure.add_axes((0.125, 0.17, 0.855, 0.76)), clip, reach_m, plan)
    figure.legend(
        handles=legend_handles(clip, plan)[:12],
        loc="lower center",
        ncols=4,
        frameon=False,
        labelcolor=palette.INK,
        fontsize=8.5,
        handlelength=1.3,
        columnspacing=1.1,
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", facecolor=palette.GROUND)
    return np.asarray(Image.open(buffer).convert("RGB"))


def comparison_picture(panel: ExamplePanel, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw hits, false alarms and misses from above, `step` key frames after now."""
    grid, frame = panel.example.occupancy, panel.example.clip.now + step
    columns = draw_comparison(
        panel.occupied[step],
        grid.values[frame, 0] > 0.5,
        grid.known[frame],
        panel.spec,
        ABOVE_GROUND_M,
    )
    return with_ego(columns, panel.spec)


def volume_picture(panel: ExamplePanel) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the volume's principal components from above."""
    assert panel.volume is not None
    return with_ego(draw_volume_pca(panel.volume), panel.spec)


def predicted_voxels(panel: ExamplePanel, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw predicted occupancy in perspective, `step` key frames after now."""
    return draw_voxels(panel.occupied[step], panel.spec, VOXELS_HW)


def labelled_voxels(panel: ExamplePanel, step: int) -> UInt8[np.ndarray, "H W 3"]:
    """Draw occupancy that the lidar saw in perspective, `step` key frames after now."""
    grid, frame = panel.example.occupancy, panel.example.clip.now + step
    return draw_voxels((grid.values[frame, 0] > 0.5) & grid.known[frame], panel.spec, VOXELS_HW)


def _plan(panel: ExamplePanel) -> list[Picture]:
    clip, spec = panel.example.clip, panel.spec
    reach_m = 0.5 * max(spec.shape_zyx[1:]) * spec.voxel_m
    above = picture(plan_picture(clip, panel.plan, reach_m), "The same from above", "png")
    front = front_camera(clip)
    if front is None:
        return [above]
    caption = f"{clip.rig.names[front]}: driven future (green) and plan (red)"
    return [picture(camera_with_paths(clip, front, panel.plan, FRONT_WIDTH_PX), caption), above]


def _cameras(panel: ExamplePanel) -> dict[str, list[Picture]]:
    clip = panel.example.clip
    order = [camera for row in camera_rows(clip.rig[clip.now]) for camera in row]
    seen = [camera for camera in order if bool(clip.image_valid[clip.now, camera])]
    if not seen:
        return {}
    halves = {"Camera images": clip.images[clip.now]}
    if panel.rendered is not None:
        halves["Rendered from the volume"] = (panel.rendered.clamp(0, 1) * 255).byte()
    return {
        title: [picture(_as_wide(images[camera]), clip.rig.names[camera]) for camera in seen]
        for title, images in halves.items()
    }


def _above(panel: ExamplePanel) -> list[Picture]:
    """Draw occupancy at now from above, beside the volume."""
    across = f"{panel.spec.shape_zyx[2] * panel.spec.voxel_m:.0f} m across"
    above = [picture(comparison_picture(panel, 0), f"Prediction against lidar from above, {across}", "png")]
    if panel.volume is not None:
        caption = f"Volume: PCA to three channels, mean over height, {across}"
        above.append(picture(volume_picture(panel), caption, "png"))
    return above


def _content_text(panel: ExamplePanel, step: int) -> str:
    """Return the end of a caption, which says whether any voxel is occupied; the picture is black without."""
    return "coloured by height" if bool(panel.occupied[step].any()) else "of which there is none"


def _later(panel: ExamplePanel) -> list[Picture]:
    clip, pictures = panel.example.clip, []
    for step in range(1, len(panel.occupied)):
        when = f"+{float(clip.t_s[clip.now + step]):.1f} s"
        caption = f"Imagined occupancy at {when}, {_content_text(panel, step)}"
        pictures.append(picture(predicted_voxels(panel, step), caption))
        pictures.append(picture(comparison_picture(panel, step), f"Against lidar at {when}", "png"))
    return pictures


def with_ego(columns: UInt8[np.ndarray, "X Y 3"], spec: VoxelSpec) -> UInt8[np.ndarray, "H W 3"]:
    """Enlarge a picture of columns by a whole factor, and draw the vehicle's outline."""
    factor = max(1, round(MAP_PX / columns.shape[0]))
    canvas = Image.fromarray(columns).resize(
        (columns.shape[1] * factor, columns.shape[0] * factor), Image.Resampling.NEAREST
    )
    px_per_m = factor / spec.voxel_m
    outline = [
        ((spec.upper_m[1] - y) * px_per_m, (spec.upper_m[0] - x) * px_per_m) for x, y in EGO_OUTLINE_XY
    ]
    ImageDraw.Draw(canvas).polygon(outline, outline=palette.rgb255(palette.EGO), width=2)
    return np.asarray(canvas)


def _as_wide(image: UInt8[Tensor, "3 H W"]) -> UInt8[np.ndarray, "h w 3"]:
    height, width = image.shape[1:]
    return resize(image.permute(1, 2, 0).numpy(), (round(CAMERA_WIDTH_PX * height / width), CAMERA_WIDTH_PX))
