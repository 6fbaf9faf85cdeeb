"""Draws the picture of docs/tasks.md: `python docs/draw/tasks.py [LOG]`. It records a town without LOG."""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from PIL import Image

from foredrive.data import ClipConfig, ClipDataset, LogPath, find_one_log
from foredrive.data.clip_config import TaskTruthConfig
from foredrive.geometry.boxes import box_corners
from foredrive.scene import Boxes, Example, VoxelSpec
from foredrive.scene.agent_futures import AgentFutures
from foredrive.scene.conditions import CONDITIONS, BackgroundTraffic
from foredrive.scene.map_elements import (
    ElementKind,
    InstanceRaster,
    MapElements,
    MapRaster,
    PlaneSpec,
    RasterLayer,
)
from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels
from foredrive.sensors.rigs import camera_rig
from foredrive.sensors.vehicle import roof_lidar
from foredrive.towns.recorder import record
from foredrive.towns.sensing.capture import SensorSuite

OUT = Path(__file__).parents[1] / "tasks_truth.jpg"
TOWN, SECONDS, SEED, RATE_HZ, NOW_S = "Town03", 15.0, 1, 2.0, 8.0
IMAGE_HW = (216, 384)
VOXELS = VoxelSpec((-40.0, -40.0, -1.0), 0.4, (16, 200, 200))
CAMERAS = ("pcam_l0", "pcam_f0", "pcam_r0")
MAX_BYTES = 300_000
ELEMENT_COLOURS = {
    ElementKind.DIVIDER: "#e8a33d",
    ElementKind.CROSSING: "#3f78d8",
    ElementKind.BOUNDARY: "#c0392b",
    ElementKind.CENTRELINE: "#b8c4cc",
}
LAYER_COLOURS = {
    RasterLayer.DRIVABLE: (0.86, 0.88, 0.90),
    RasterLayer.DIVIDER: (0.91, 0.64, 0.24),
    RasterLayer.CROSSING: (0.25, 0.47, 0.85),
    RasterLayer.BOUNDARY: (0.75, 0.22, 0.17),
}
CLASS_COLOURS = {
    "car": (0, 130, 255),
    "truck": (150, 60, 220),
    "bus": (255, 200, 0),
    "bicycle": (220, 20, 60),
    "motorcycle": (255, 90, 0),
    "pedestrian": (255, 0, 200),
    "driveable_surface": (150, 150, 155),
    "sidewalk": (205, 170, 190),
    "terrain": (170, 205, 120),
    "manmade": (215, 205, 185),
    "vegetation": (40, 140, 50),
}


def read_example(log: LogPath, now_s: float) -> Example:
    """The truth around one time of a log."""
    tasks = TaskTruthConfig(elements_lw_m=(100.0, 50.0))
    part_s = (now_s, now_s + 1.0)
    config = ClipConfig(0, 0, IMAGE_HW, VOXELS, cameras=CAMERAS, tasks=tasks, part_s=part_s)
    return ClipDataset([log], config, None)[0]


def from_above(axes: Axes, title: str, reach_m: float = 50.0) -> None:
    """Forward is up, left is left."""
    axes.set(xlim=(reach_m, -reach_m), ylim=(-reach_m, reach_m), aspect="equal", title=title)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.plot([0.9, -0.9, -0.9, 0.9, 0.9], [-1.0, -1.0, 3.7, 3.7, -1.0], color="black", lw=1.2, zorder=5)


def show(axes: Axes, rgb: np.ndarray, spec: PlaneSpec) -> None:
    """A picture [Y X 3] on a grid of the ego frame."""
    (x0, y0), (x1, y1) = spec.lower_m, spec.upper_m
    axes.imshow(rgb.swapaxes(0, 1), origin="lower", extent=(y0, y1, x0, x1), interpolation="nearest")


def draw_elements(axes: Axes, elements: MapElements) -> None:
    """Each polyline in the colour of its kind, with a dot at its ends."""
    for vertices, valid, kind in zip(elements.vertices, elements.valid, elements.kind.tolist(), strict=True):
        x, y = vertices[valid].numpy().T
        centre = kind == ElementKind.CENTRELINE
        axes.plot(y, x, color=ELEMENT_COLOURS[ElementKind(kind)], lw=0.8 if centre else 1.6, zorder=1)
        if not centre:
            axes.plot(y[[0, -1]], x[[0, -1]], ".", color=ELEMENT_COLOURS[ElementKind(kind)], ms=4)
    for kind, colour in ELEMENT_COLOURS.items():
        axes.plot([], [], color=colour, label=kind.name.lower())
    axes.legend(loc="lower left", fontsize=6, framealpha=0.9)


def draw_agents(axes: Axes, boxes: Boxes, futures: AgentFutures) -> None:
    """Outlines, track ids, and the positions of the next 6 s."""
    corners = box_corners(boxes.centre, boxes.size_lwh, boxes.yaw)[:, [0, 1, 2, 3, 0], :2].numpy()
    palette = plt.get_cmap("tab20")
    for row, outline in enumerate(corners):
        track = int(boxes.track_id[row])
        colour = palette(track % 20)
        axes.plot(outline[:, 1], outline[:, 0], color=colour, lw=1.0, zorder=3)
        path = futures.xy[row][futures.valid[row]].numpy()
        if len(path) and np.linalg.norm(path[-1] - boxes.centre[row, :2].numpy()) > 1.0:
            axes.plot(path[:, 1], path[:, 0], "-o", color=colour, lw=0.8, ms=1.8, zorder=4)
            axes.text(outline[0, 1], outline[0, 0], str(track), fontsize=6.5, color=colour, clip_on=True)


def raster_rgb(raster: MapRaster) -> np.ndarray:
    """The drivable area below, lines above."""
    rgb = np.ones((*raster.spec.shape_yx, 3))
    for layer in (RasterLayer.DRIVABLE, RasterLayer.DIVIDER, RasterLayer.CROSSING, RasterLayer.BOUNDARY):
        rgb[raster.layers[layer].numpy()] = LAYER_COLOURS[layer]
    return rgb


def semantic_rgb(semantics: SemanticVoxels) -> np.ndarray:
    """The highest occupied voxel of each column; pale where no camera sees it."""
    names = VOXEL_CLASSES[semantics.taxonomy]
    index = semantics.index.numpy()
    occupied = index != len(names) - 1
    top = len(index) - 1 - occupied[::-1].argmax(axis=0)
    y, x = np.indices(top.shape)
    table = np.array([CLASS_COLOURS.get(name, (0, 0, 0)) for name in names]) / 255
    rgb = table[index[top, y, x]]
    rgb = np.where(semantics.camera_mask.numpy()[top, y, x, None], rgb, 0.6 + 0.4 * rgb)
    rgb[~occupied.any(axis=0)] = 1.0
    return rgb


def instance_rgb(instances: InstanceRaster) -> np.ndarray:
    """Steps over each other, from now (dark) to the last (pale), in the colours of the tracks."""
    rgb = np.ones((*instances.spec.shape_yx, 3))
    steps = len(instances.track_id)
    palette = np.array([plt.get_cmap("tab20")(k)[:3] for k in range(20)])
    for step in reversed(range(steps)):
        cells = instances.track_id[step].numpy()
        colour = palette[(cells - 1) % 20]
        share = 1.0 - 0.75 * step / (steps - 1)
        rgb = np.where((cells > 0)[..., None], 1.0 - share * (1.0 - colour), rgb)
    return rgb


def draw(example: Example, out: Path) -> None:
    """Images above; polylines and agents, raster layers, semantic voxels, vehicles over time below."""
    clip, truth = example.clip, example.truth
    assert truth is not None
    figure = plt.figure(figsize=(13, 5.3))
    grid = figure.add_gridspec(2, 4, height_ratios=(0.72, 1), hspace=0.12, wspace=0.04)
    images = figure.add_subplot(grid[0, :])
    images.imshow(np.concatenate([image.permute(1, 2, 0).numpy() for image in clip.images[0]], axis=1))
    images.set_axis_off()
    below = [figure.add_subplot(grid[1, column]) for column in range(4)]
    voxel_plane = PlaneSpec(VOXELS.lower_m[:2], VOXELS.voxel_m, VOXELS.shape_zyx[1:])
    from_above(below[0], "map elements, boxes, 6 s futures")
    if truth.elements is not None and truth.futures is not None:
        draw_elements(below[0], truth.elements)
        draw_agents(below[0], clip.boxes[0], truth.futures)
    if truth.raster is not None:
        show(below[1], raster_rgb(truth.raster), truth.raster.spec)
    from_above(below[1], "raster layers")
    if truth.semantics is not None:
        show(below[2], semantic_rgb(truth.semantics), voxel_plane)
    from_above(below[2], "semantic voxels (pale: unseen by cameras)", 40.0)
    if truth.instances is not None:
        show(below[3], instance_rgb(truth.instances), truth.instances.spec)
    from_above(below[3], "vehicles now and in 2 s")
    for axes in below:
        axes.title.set_fontsize(8)
    figure.savefig(out.with_suffix(".png"), dpi=140, bbox_inches="tight", pad_inches=0.05)
    with Image.open(out.with_suffix(".png")) as picture:
        for quality in range(92, 40, -4):
            picture.convert("RGB").save(out, quality=quality)
            if out.stat().st_size <= MAX_BYTES:
                break
    out.with_suffix(".png").unlink()


def main() -> None:
    """Draw the frame of a log given on the command line, or of a town that is recorded for it."""
    if len(sys.argv) > 1:
        draw(read_example(find_one_log(Path(sys.argv[1])), NOW_S), OUT)
        return
    with tempfile.TemporaryDirectory() as folder:
        sensors = SensorSuite(camera_rig(IMAGE_HW), roof_lidar())
        traffic = BackgroundTraffic(vehicles=24, pedestrians=16)
        log = record(
            TOWN, SECONDS, SEED, Path(folder), RATE_HZ, sensors, traffic, conditions=CONDITIONS["clear"]
        )
        draw(read_example(log, NOW_S), OUT)


if __name__ == "__main__":
    main()
