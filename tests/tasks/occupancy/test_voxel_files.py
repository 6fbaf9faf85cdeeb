"""Folders of semantic voxels: figures by hand, and what is said of files that do not fit."""

import io
import math
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from tasks.folders_of_voxels import (
    LIDAR_M,
    OCC3D_FREE,
    OPENOCC_FREE,
    XYZ,
    street,
    write_annotations,
    write_infos,
    write_result,
    write_truth,
)

from foredrive.errors import InputError
from foredrive.tasks.occupancy.files import LIDAR_POSITION_M, VoxelFiles, find_voxels, read_frame, read_poses
from foredrive.tasks.occupancy.protocols import OCC3D_CLASSES, OPENOCC_CLASSES
from foredrive.tasks.occupancy.score import score_voxels

ROAD, WALL = (OCC3D_CLASSES.index(name) for name in ("driveable_surface", "manmade"))
OPEN_ROAD, OPEN_WALL, OPEN_CAR = (
    OPENOCC_CLASSES.index(name) for name in ("driveable_surface", "manmade", "car")
)
SEEN = np.ones(XYZ, np.uint8)


@pytest.fixture
def occ3d(tmp_path: Path) -> tuple[Path, Path]:
    """Two frames of one scene; the wall is predicted one cell too far in one, and not at all in the other."""
    true = street(OCC3D_FREE, ROAD, WALL)
    camera = SEEN.copy()
    camera[152:] = 0  # behind the wall's first two cells
    for token in ("a", "b"):
        write_truth(
            tmp_path / "gts", "scene-0001", token, semantics=true, mask_camera=camera, mask_lidar=SEEN
        )
    write_result(tmp_path / "results", "a", street(OCC3D_FREE, ROAD, WALL, wall_x=151))
    write_result(tmp_path / "results", "b", pred=street(OCC3D_FREE, ROAD, OCC3D_FREE).reshape(-1))
    return tmp_path / "results", tmp_path / "gts"


def test_occ3d_by_hand(occ3d: tuple[Path, Path]) -> None:
    figures = score_voxels(find_voxels(*occ3d))
    assert (figures["data_set"], figures["frames"]) == ("occ3d", 2)
    # Cells of the wall, each 200 x 8 voxels: true 150-152 twice; predicted 151-153 once. Hits: 151, 152.
    assert figures["occupancy.occ3d_unmasked.iou_pct.manmade"] == pytest.approx(100 * 2 / 7)
    # Under the camera mask, cells 150 and 151 alone count: one hit of four.
    assert figures["occupancy.occ3d.iou_pct.manmade"] == pytest.approx(100 * 1 / 4)
    assert figures["occupancy.occ3d_both.iou_pct.manmade"] == pytest.approx(100 * 1 / 4)
    assert figures["occupancy.occ3d_lidar.miou_pct"] == figures["occupancy.occ3d_unmasked.miou_pct"]
    assert figures["occupancy.occ3d.miou_pct"] == pytest.approx((100 + 25) / 2)
    assert figures["occupancy.occ3d.frames_counted"] == 2
    assert math.isnan(figures["occupancy.occ3d.iou_pct.car"])
    assert not [key for key in figures if "rayiou" in key]  # nothing tells where the lidar was


@pytest.mark.parametrize("kind", ["infos", "annotations"])
def test_rays_from_the_lidar_of_the_drive(occ3d: tuple[Path, Path], tmp_path: Path, kind: str) -> None:
    positions = {"a": 0.0, "b": 4.0}
    poses = (
        write_infos(tmp_path / "infos.pkl", positions)
        if kind == "infos"
        else write_annotations(tmp_path / "annotations.json", positions, "scene-0001")
    )
    files = find_voxels(*occ3d, poses)
    assert files.origins_m is not None
    x, y, z = LIDAR_M
    assert files.origins_m["a"] == pytest.approx(np.array([[x, y, z], [x + 4, y, z]]), abs=1e-6)
    assert files.origins_m["b"] == pytest.approx(np.array([[x - 4, y, z], [x, y, z]]), abs=1e-6)
    figures = score_voxels(files)
    wall = [figures[f"occupancy.occ3d.rayiou_{m}m_pct"] for m in (1, 2, 4)]
    # In frame a the wall is seen 0.4 m too far, along oblique rays more; in frame b it is not seen.
    assert 50 < wall[0] < wall[1] <= wall[2] < 100
    assert figures["occupancy.occ3d.rayiou_pct"] == pytest.approx(np.mean(wall))


def test_openocc_with_flow(tmp_path: Path) -> None:
    """A car 20 m ahead at 5 m/s, predicted at 4 m/s, as is all else that stands still."""
    true = street(OPENOCC_FREE, OPEN_ROAD, OPEN_WALL)
    true[150:153, 95:105, 2:6] = OPEN_CAR
    flow = np.zeros((*XYZ, 2), np.float32)
    flow[true == OPEN_CAR] = [5.0, 0.0]
    guess = flow - np.array([1.0, 0.0], np.float32)
    write_truth(tmp_path / "openocc_v2", "scene-0001", "a", semantics=true, flow=flow)
    write_result(tmp_path / "results", "a", semantics=true, flow=guess.reshape(-1, 2).astype(np.float16))
    poses = write_infos(tmp_path / "infos.pkl", {"a": 0.0})
    figures = score_voxels(find_voxels(tmp_path / "results", tmp_path / "openocc_v2", poses))
    assert figures["occupancy.openocc.rayiou_pct"] == pytest.approx(100.0)
    assert figures["occupancy.openocc.mave_mps"] == pytest.approx(1.0, abs=1e-3)
    assert figures["occupancy.openocc.occ_score"] == pytest.approx(0.9, abs=1e-3)
    assert figures["frames_without_velocity"] == 0
    assert figures["occupancy.openocc.miou_pct"] == pytest.approx(100.0)
    write_result(tmp_path / "results", "a", semantics=true)
    still = score_voxels(find_voxels(tmp_path / "results", tmp_path / "openocc_v2", poses))
    assert still["frames_without_velocity"] == 1
    assert still["occupancy.openocc.mave_mps"] == pytest.approx(5.0)
    # The server's code counts the road and the wall around the car too, which do not move.
    assert still["occupancy.openocc_server.mave_mps"] < 1.0


def test_a_prediction_may_lie_in_the_layout_of_the_truth(occ3d: tuple[Path, Path]) -> None:
    figures = score_voxels(find_voxels(occ3d[1], occ3d[1]))
    assert figures["occupancy.occ3d.miou_pct"] == 100.0


def test_frames_of_the_poses_alone_are_scored(occ3d: tuple[Path, Path], tmp_path: Path) -> None:
    """Occ3D's folder holds training and validation frames: the file of poses is the split."""
    (occ3d[0] / "b.npz").unlink()
    with pytest.raises(InputError, match=r"results: has no prediction of frame b of .*gts$"):
        find_voxels(*occ3d)
    files = find_voxels(*occ3d, write_infos(tmp_path / "infos.pkl", {"a": 0.0}))
    assert set(files.truth) == {"a"}


def test_results_of_other_frames(occ3d: tuple[Path, Path], tmp_path: Path) -> None:
    other = write_result(tmp_path / "other", "c", np.zeros(XYZ, np.uint8)).parent
    with pytest.raises(
        InputError, match=r"other: holds none of the 2 frames of .*gts: is it another split\?"
    ):
        find_voxels(other, occ3d[1])
    write_result(occ3d[0], "c", np.zeros(XYZ, np.uint8))
    with pytest.raises(InputError, match=r"results/c.npz: .*gts has no frame c$"):
        find_voxels(*occ3d)
    poses = write_infos(tmp_path / "infos.pkl", {"a": 0.0, "b": 1.0, "c": 2.0, "d": 3.0})
    with pytest.raises(InputError, match=r"gts: has no labels of frame c, which .* lists \(and 1 more\)"):
        find_voxels(*occ3d, poses)


def test_folders_without_such_files(occ3d: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"results: holds no SCENE/TOKEN/labels.npz"):
        find_voxels(occ3d[0], occ3d[0])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: holds neither TOKEN.npz nor SCENE/TOKEN/labels.npz"):
        find_voxels(tmp_path / "empty", occ3d[1])
    write_truth(occ3d[1], "scene-0002", "a", semantics=np.zeros(XYZ, np.uint8))
    with pytest.raises(InputError, match=r"scene-0002/a/labels.npz: frame a is also in .*scene-0001"):
        find_voxels(*occ3d)


def one_frame(tmp_path: Path, truth: dict[str, np.ndarray], result: dict[str, np.ndarray]) -> VoxelFiles:
    write_truth(tmp_path / "gts", "s", "a", **truth)
    write_result(tmp_path / "results", "a", **result)
    return find_voxels(tmp_path / "results", tmp_path / "gts")


FREE_SPACE = np.full(XYZ, OCC3D_FREE, np.uint8)
OCC3D_TRUTH = {"semantics": FREE_SPACE, "mask_camera": SEEN, "mask_lidar": SEEN}
OPENOCC_TRUTH = {"semantics": np.full(XYZ, OPENOCC_FREE, np.uint8), "flow": np.zeros((*XYZ, 2), np.float32)}


@pytest.mark.parametrize(
    ("result", "message"),
    [
        ({"semantics": np.full(XYZ, 18, np.uint8)}, "semantics: unknown class 18; there are 0 to 17"),
        ({"pred": np.full(XYZ, -1, np.int8)}, "pred: unknown class -1; there are 0 to 17"),
        ({"pred": FREE_SPACE[:100]}, r"pred: expected 200 x 200 x 16 values, .* \(100, 200, 16\)"),
        ({"pred": FREE_SPACE.T}, r"pred: expected 200 x 200 x 16 values, .* \(16, 200, 200\)"),
        ({"pred": np.zeros(XYZ, np.float32)}, "pred: values of type float32 cannot be used"),
        ({"pred": np.array([{}], dtype=object)}, r"pred: expected 200 x 200 x 16 values, .* \(1,\)"),
        ({"logits": FREE_SPACE}, "has no array named semantics, pred"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path: Path, result: dict[str, np.ndarray], message: str) -> None:
    files = one_frame(tmp_path, OCC3D_TRUTH, result)
    with pytest.raises(InputError, match=f"results/a.npz: {message}"):
        read_frame(files, "a")


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    files = one_frame(tmp_path, OCC3D_TRUTH, {"pred": np.full(XYZ, None, dtype=object)})
    with pytest.raises(InputError, match="pred: values of type object cannot be used"):
        read_frame(files, "a")


def test_a_header_that_promises_too_much_is_not_read(tmp_path: Path) -> None:
    """A file of some bytes that claims 10^15 values is refused by its shape, without any memory."""
    files = one_frame(tmp_path, OCC3D_TRUTH, {"pred": FREE_SPACE})
    header = io.BytesIO()
    promise = {"descr": "|u1", "fortran_order": False, "shape": (10**9, 10**6)}
    np.lib.format.write_array_header_1_0(header, promise)
    with zipfile.ZipFile(files.results["a"], "w") as archive:
        archive.writestr("pred.npy", header.getvalue())
    with pytest.raises(InputError, match="pred: expected 200 x 200 x 16 values"):
        read_frame(files, "a")


def test_damaged_files(tmp_path: Path) -> None:
    files = one_frame(tmp_path, OCC3D_TRUTH, {"pred": FREE_SPACE})
    path = files.results["a"]
    whole = path.read_bytes()
    middle = bytearray(whole)
    middle[200:260] = b"\xff" * 60
    for content in (b"", b"not an archive", whole[:-200], whole[: len(whole) // 2], bytes(middle)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"results/a.npz: not an npz file that can be read"):
            read_frame(files, "a")


def test_truth_without_masks_or_flow(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"labels.npz: has neither mask_camera and mask_lidar .* nor flow"):
        one_frame(tmp_path, {"semantics": FREE_SPACE}, {"pred": FREE_SPACE})


def test_velocities_that_do_not_fit(tmp_path: Path) -> None:
    labels, flow = OPENOCC_TRUTH["semantics"], OPENOCC_TRUTH["flow"].copy()
    flow[3, 4, 5, 1] = np.inf
    files = one_frame(tmp_path, OPENOCC_TRUTH, {"semantics": labels, "flow": flow})
    with pytest.raises(InputError, match=r"results/a.npz: flow: a velocity is not finite"):
        read_frame(files, "a")
    write_result(tmp_path / "results", "a", semantics=labels, flow=flow[..., 0])
    with pytest.raises(InputError, match=r"flow: expected 200 x 200 x 16 x 2 values"):
        read_frame(files, "a")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ego2global_translation": [0.0, 0.0]}, "frame 0: a pose is not three metres and a quaternion"),
        ({"lidar2ego_rotation": [0.0, 0.0, 0.0, 0.0]}, "frame 0: .*zero norm"),
        ({"ego2global_translation": [0.0, 0.0, float("nan")]}, "frame 0: a pose is not finite"),
        ({"timestamp": "noon"}, "frame 0: could not convert"),
        ({"ego2global_rotation": None}, "frame 0: "),
    ],
)
def test_infos_that_do_not_fit(
    occ3d: tuple[Path, Path], tmp_path: Path, change: dict[str, object], message: str
) -> None:
    poses = write_infos(tmp_path / "infos.pkl", {"a": 0.0, "b": 1.0})
    content = pickle.loads(poses.read_bytes())
    content["infos"][0] |= change
    poses.write_bytes(pickle.dumps(content))
    with pytest.raises(InputError, match=f"infos.pkl: {message}"):
        find_voxels(*occ3d, poses)


@pytest.mark.real
def test_infos_of_the_newer_format(real_data: Path) -> None:
    (file,) = (real_data / "nuscenes" / "keyframe").glob("*.pkl")
    (pose,) = read_poses(file).values()
    assert pose.T_ego_lidar[:3, 3] == pytest.approx(LIDAR_POSITION_M["n015"], abs=1e-5)
    assert np.linalg.det(pose.T_world_ego[:3, :3]) == pytest.approx(1.0, abs=1e-5)


def test_files_that_are_no_poses(occ3d: tuple[Path, Path], tmp_path: Path) -> None:
    odd = tmp_path / "odd.pkl"
    odd.write_bytes(pickle.dumps({"infos": "none"}))
    with pytest.raises(InputError, match=r"odd.pkl: has no list of frames under 'infos' or 'data_list'"):
        find_voxels(*occ3d, odd)
    odd.write_bytes(pickle.dumps({"infos": []}))
    with pytest.raises(InputError, match=r"odd.pkl: holds no frames"):
        find_voxels(*occ3d, odd)
    annotations = write_annotations(tmp_path / "annotations.json", {"a": 0.0}, "scene-0001", vehicle="n999")
    with pytest.raises(
        InputError, match=r"annotations.json: scene-0001: frame a: .* begins with none of n008"
    ):
        find_voxels(*occ3d, annotations)
    annotations.write_text("{}")
    with pytest.raises(InputError, match=r"annotations.json: not Occ3D's annotations: has no 'val_split'"):
        find_voxels(*occ3d, annotations)
