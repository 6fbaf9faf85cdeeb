"""A file of Rerun (.rrd) of a log, of a run's predictions on it, and of its reconstruction.

Its entities are a tree of frames: world, world/ego and world/ego/cam/NAME, with z ahead. What a frame lacks
is cleared, since Rerun would show the data of the frame before.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun
import rerun.blueprint
import torch
from jaxtyping import Float64
from torch import Tensor

from foredrive.data import LogPath
from foredrive.data.logs import Log
from foredrive.errors import InputError
from foredrive.files import atomic_path
from foredrive.methods.reconstruction.gaussians import Gaussians
from foredrive.methods.reconstruction.scene_graph import STATIC
from foredrive.methods.reconstruction.tracks import states_at
from foredrive.runs import Run
from foredrive.runs.reconstruction.reconstruction_run import OpenedReconstruction
from foredrive.scene import Category, Trajectory, VoxelSpec
from foredrive.view import palette
from foredrive.view.log_contents import CameraContent, FrameContent, log_contents

WORLD, EGO, SCENE = "world", "world/ego", "world/scene"
TIME, FRAME = "time", "frame"
"""Timelines: the time of the log, and the number of the frame."""
FAR_M = 10_000.0
"""Rerun places things in single precision, so worlds that begin farther from their origin are moved there."""
SAME_M = 0.01
"""A scene begins at the first pose of its log, to within this."""
LINE_M, POINT_M, OCCUPIED_OPACITY = 0.05, 0.03, 0.3
"""Radii of lines and points, m, and the opacity of voxels."""


def write_log_rerun(
    path: LogPath,
    file: Path,
    run: Run | None = None,
    rebuilt: OpenedReconstruction | None = None,
    tick: Callable[[], None] = lambda: None,
) -> list[str]:
    """Write images, sweeps, boxes, map, poses and driven path of a log, and a blueprint that shows them.

    With a run, the plan and the predicted occupancy of now are in the file too, with a reconstruction its
    Gaussians. The world's origin may be moved (`FAR_M`); `world_offset_m` of the recording's properties is
    what was subtracted from places.

    Args:
        path: the log.
        file: where the file goes.
        run: a trained run whose predictions are added.
        rebuilt: a reconstruction of the log.
        tick: called after each frame.

    Returns:
        The entities in the file.

    Raises:
        InputError: the log cannot be read, it lacks the cameras of the run, the reconstruction is of another
            log, or the file cannot be written.
    """
    if file.suffix != ".rrd":
        raise InputError(f"{file}: the name must end in .rrd")
    log = Log(path)
    first_m = log.T_world_ego[0, :3, 3]
    offset_m = np.round(first_m) if np.abs(first_m).max() > FAR_M else np.zeros(3)
    if rebuilt is not None:
        moved_m = np.abs(rebuilt.vehicle.T_world_scene.numpy() - log.T_world_ego[0])[:3].max()
        if moved_m > SAME_M:
            raise InputError(f"{rebuilt.folder}: a reconstruction of another log than {path.name}")
    with atomic_path(file) as temporary:
        writer = _Rerun(rerun.RecordingStream("foredrive", recording_id=path.name), offset_m)
        writer.stream.set_log_time_enabled(False)  # the time of writing
        writer.stream.save(temporary)
        writer.stream.send_property("foredrive", rerun.AnyValues(log=path.name, world_offset_m=offset_m))
        writer.log(WORLD, rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        splats = None if rebuilt is None else _Splats(writer, rebuilt)
        for number, content in enumerate(log_contents(path, run)):
            writer.stream.set_time(TIME, timestamp=np.datetime64(content.t_us, "us"))
            writer.stream.set_time(FRAME, sequence=number)
            _write_sensors(writer, content)
            _write_labels(writer, content, number)
            if run is not None:
                _write_prediction(writer, content, run.recipe.clips.voxels)
            if splats is not None:
                splats.show((content.t_us - int(log.t_us[0])) * 1e-6)
            tick()
        writer.stream.send_blueprint(_blueprint(writer.cameras))
        try:
            writer.stream.flush()
        except RuntimeError as error:  # the reason is in Rerun's own log alone
            raise InputError(f"{file}: Rerun cannot write it; is the disk full?") from error
        writer.stream.disconnect()
    return sorted(writer.entities)


class _Rerun:
    """A stream that knows its entities, and clears those that a frame lacks.

    Args:
        stream: a recording.
        offset_m: what is subtracted from places in the world.
    """

    def __init__(self, stream: rerun.RecordingStream, offset_m: Float64[np.ndarray, "3"]) -> None:
        self.stream, self.offset_m = stream, offset_m
        self.entities, self.cameras = set[str](), dict[str, None]()
        self._shown = set[str]()

    def log(self, entity: str, archetype: rerun.AsComponents, *, static: bool = False) -> None:
        """Write an entity at the time that is set."""
        self.entities.add(entity)
        self._shown.add(entity)
        self.stream.log(entity, archetype, static=static)

    def clear(self, entity: str) -> None:
        """Clear an entity if it is shown."""
        if entity in self._shown:
            self._shown.remove(entity)
            self.stream.log(entity, rerun.Clear(recursive=False))

    def place(self, entity: str, T: Float64[Tensor, "4 4"], *, of_world: bool = False) -> None:
        """Write the pose of an entity in its parent."""
        moved_m = T[:3, 3].numpy() - (self.offset_m if of_world else 0.0)
        self.log(entity, rerun.Transform3D(translation=moved_m, mat3x3=T[:3, :3].numpy()))


def _write_sensors(writer: _Rerun, content: FrameContent) -> None:
    writer.place(EGO, content.T_world_ego, of_world=True)
    names = [camera.name for camera in content.cameras]
    writer.cameras |= dict.fromkeys(names)
    for name in writer.cameras:
        if name not in names:
            writer.clear(f"{_entity(name)}/image")
    for camera in content.cameras:
        _write_camera(writer, camera)
    entity = f"{EGO}/lidar"
    if content.sweep is None:
        writer.clear(entity)
        return
    sweep = content.sweep[content.sweep.valid & content.sweep.returned]
    colours = palette.range_colours(sweep.range_m.numpy())
    writer.log(entity, rerun.Points3D(sweep.points_ego.numpy(), colors=colours, radii=POINT_M))


def _write_camera(writer: _Rerun, camera: CameraContent) -> None:
    """Write an image without its distortion: a camera of Rerun is a pinhole."""
    entity = _entity(camera.name)
    # At the time of the frame, so that the motion until the exposure is in the pose
    writer.place(entity, camera.T_ego_cam.double())
    height, width = camera.size_hw
    pinhole = rerun.Pinhole(
        image_from_camera=camera.K.numpy(),
        resolution=(width, height),
        camera_xyz=rerun.ViewCoordinates.RDF,
    )
    writer.log(entity, pinhole)
    kind = "image/png" if camera.encoded.startswith(b"\x89PNG") else "image/jpeg"
    writer.log(f"{entity}/image", rerun.EncodedImage(contents=camera.encoded, media_type=kind))


def _write_labels(writer: _Rerun, content: FrameContent, number: int) -> None:
    entity = f"{EGO}/boxes"
    if content.boxes is None:
        writer.clear(entity)
    else:
        boxes = content.boxes
        half = 0.5 * boxes.yaw.numpy()
        none = np.zeros_like(half)
        pairs = zip(boxes.category.tolist(), boxes.track_id.tolist(), strict=True)
        shown = rerun.Boxes3D(
            centers=boxes.centre.numpy(),
            sizes=boxes.size_lwh.numpy(),
            quaternions=np.stack([none, none, np.sin(half), np.cos(half)], axis=-1),
            colors=content.box_colours(),
            labels=[f"{palette.label(Category(kind))} {track}" for kind, track in pairs],
        )
        writer.log(entity, shown)
    _write_path(writer, f"{EGO}/driven", content.driven, palette.EXPERT)
    if content.map_lines:
        strips = [points - writer.offset_m for points, _ in content.map_lines]
        colours = [colour for _, colour in content.map_lines]
        writer.log(f"{WORLD}/map/{number}", rerun.LineStrips3D(strips, colors=colours, radii=LINE_M))


def _write_path(writer: _Rerun, entity: str, path: Trajectory, colour: str) -> None:
    """Write the first alternative of a trajectory from the vehicle on, as far as it is valid."""
    xy = path.xy[0][path.valid[0]].numpy()
    if not len(xy):
        writer.clear(entity)
        return
    points = np.pad(np.pad(xy, ((1, 0), (0, 0))), ((0, 0), (0, 1)))
    writer.log(entity, rerun.LineStrips3D([points], colors=[palette.rgb255(colour)], radii=LINE_M))


def _write_prediction(writer: _Rerun, content: FrameContent, spec: VoxelSpec) -> None:
    plan, occupancy = f"{EGO}/plan", f"{EGO}/occupancy"
    if content.plan is None or content.occupied is None:
        writer.clear(plan)
        writer.clear(occupancy)
        return
    _write_path(writer, plan, content.plan, palette.PLAN)
    zyx = content.occupied.nonzero().numpy()
    # By height, so that the road differs from what stands on it
    share = (zyx[:, 0] + 0.5) / spec.shape_zyx[0]
    voxels = rerun.VoxelGridMap(
        np.ascontiguousarray(zyx[:, ::-1], np.int32),  # x y z
        [spec.voxel_m] * 3,
        colors=(255 * palette.HEIGHT_MAP(share)[:, :3]).astype(np.uint8),
        translation=spec.lower_m,
        opacity=OCCUPIED_OPACITY,
    )
    writer.log(occupancy, voxels)


class _Splats:
    """The Gaussians of a reconstruction: the static part is written once, actors move.

    Args:
        writer: the file.
        rebuilt: the reconstruction.
    """

    def __init__(self, writer: _Rerun, rebuilt: OpenedReconstruction) -> None:
        self._writer, self._graph = writer, rebuilt.scene.graph
        T = rebuilt.vehicle.T_world_scene
        moved_m = T[:3, 3].numpy() - writer.offset_m
        place = rerun.Transform3D(translation=moved_m, mat3x3=T[:3, :3].numpy())
        writer.log(SCENE, place, static=True)
        static = _gaussians(self._graph.content.preview(STATIC))
        writer.log(f"{SCENE}/static", static, static=True)
        self._shown = set[int]()

    @torch.no_grad()
    def show(self, t_s: float) -> None:
        """Write the actors that are there at a time of the scene. Their looks are written when they come."""
        states = states_at(self._graph.tracks, t_s)
        for row, number in enumerate(self._graph.tracks.track_id.tolist()):
            entity = f"{SCENE}/actor/{number}"
            if not bool(states.present[row]):
                self._writer.clear(f"{entity}/splats")
                self._shown.discard(number)
                continue
            self._writer.place(entity, states.T_scene_actor[row].double())
            if number not in self._shown:
                self._writer.log(f"{entity}/splats", _gaussians(self._graph.content.preview(row)))
                self._shown.add(number)


@torch.no_grad()
def _gaussians(gaussians: Gaussians) -> rerun.GaussianSplats3D:
    """Return Gaussians with their albedo, without the effect of decoders."""
    gaussians = gaussians.map_tensors(lambda tensor: tensor.detach().cpu())
    opacity = gaussians.opacity_logit.sigmoid()[:, None]
    rgba = torch.cat([gaussians.feature[:, :3].clamp(0, 1), opacity], dim=-1)
    return rerun.GaussianSplats3D(
        gaussians.mean_m.numpy(),
        scales=gaussians.log_scale.exp().numpy(),
        # w x y z here, x y z w there
        quaternions=torch.nn.functional.normalize(gaussians.quaternion, dim=-1).roll(-1, -1).numpy(),
        colors=(255 * rgba).round().byte().numpy(),
    )


def _entity(camera: str) -> str:
    return f"{EGO}/cam/{camera}"


def _blueprint(cameras: dict[str, None]) -> rerun.blueprint.Blueprint:
    """Return a view that follows the vehicle, beside the images."""
    parts = rerun.blueprint
    around = parts.Spatial3DView(
        origin=WORLD, name="around", eye_controls=parts.EyeControls3D(tracking_entity=EGO)
    )
    images = [parts.Spatial2DView(origin=_entity(name), contents="$origin/**", name=name) for name in cameras]
    shown = parts.Horizontal(around, parts.Grid(*images), column_shares=[3, 2]) if images else around
    return parts.Blueprint(shown, parts.TimePanel(timeline=TIME), collapse_panels=True)
