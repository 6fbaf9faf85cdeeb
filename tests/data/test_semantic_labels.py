"""Semantic voxels of a recorded scene: classes, what towns and taxonomies lack, and the two masks."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import synthetic_log as world
import torch

from foredrive.data import find_logs
from foredrive.data.cameras import pinhole_cameras
from foredrive.data.labels import make_labels
from foredrive.data.log_writer import LogWriter
from foredrive.data.logs import Log
from foredrive.data.modalities import FullOccupancy
from foredrive.data.truth.semantic_labels import ABSENT_IN_TOWNS, STATIC_CLASSES, read_semantics
from foredrive.scene import Category, VoxelSpec
from foredrive.scene.semantics import VOXEL_CLASSES, SemanticVoxels, Taxonomy
from foredrive.towns.place.materials import Surface

GRID = VoxelSpec((-10.0, -10.0, -1.0), 0.5, (8, 40, 40))


def at(x: float, y: float, z: float, spec: VoxelSpec = GRID) -> tuple[int, int, int]:
    """Index z, y, x of the voxel of a point."""
    return tuple(
        int(np.floor((p - low) / spec.voxel_m)) for p, low in zip((z, y, x), spec.lower_m[::-1], strict=True)
    )


def static(surface: Surface) -> int:
    return -1 - surface


def recorded(root: Path, voxels: list[tuple[tuple[int, int, int], int]]) -> Log:
    """The flat log of one frame with cameras, lidar and these voxels."""
    specs = world.cameras()
    index, kinds = np.array([index for index, _ in voxels]), np.array([kind for _, kind in voxels])
    occupancy = FullOccupancy(GRID, index, kinds, np.zeros((len(voxels), 3), np.float32))
    with LogWriter(root, "flat_train", "log", specs, None, None, None) as writer:
        writer.write(dataclasses.replace(world.frame(0, specs), occupancy=occupancy))
    return Log(find_logs(root)[0])


def read(log: Log, taxonomy: Taxonomy = "occ3d", spec: VoxelSpec = GRID) -> SemanticVoxels:
    return read_semantics(log, 0, spec, taxonomy, list(pinhole_cameras(log).values()))


def name(semantics: SemanticVoxels, index: tuple[int, int, int]) -> str:
    return VOXEL_CLASSES[semantics.taxonomy][int(semantics.index[index])]


def test_public_orders_of_the_classes() -> None:
    occ3d, openocc = VOXEL_CLASSES["occ3d"], VOXEL_CLASSES["openocc"]
    assert (len(occ3d), len(openocc)) == (18, 17)
    assert (occ3d.index("car"), occ3d.index("driveable_surface"), occ3d.index("free")) == (4, 11, 17)
    assert (openocc.index("car"), openocc.index("pedestrian"), openocc.index("free")) == (0, 7, 16)
    assert set(occ3d) - set(openocc) == {"others"}


@pytest.mark.parametrize("taxonomy", ["occ3d", "openocc"])
def test_voxels_have_the_class_of_their_matter(taxonomy: Taxonomy, tmp_path: Path) -> None:
    kinds = {
        (0, 0, 0): (static(Surface.ROAD), "driveable_surface"),
        (0, 0, 1): (static(Surface.SIDEWALK), "sidewalk"),
        (0, 0, 2): (static(Surface.TERRAIN), "terrain"),
        (0, 0, 3): (static(Surface.BUILDING), "manmade"),
        (0, 0, 4): (static(Surface.STRUCTURE), "manmade"),
        (0, 0, 5): (static(Surface.SIGNAL), "manmade"),
        (0, 0, 6): (static(Surface.VEGETATION), "vegetation"),
        (0, 0, 7): (Category.CAR, "car"),
        (0, 0, 8): (Category.MOTORCYCLE, "motorcycle"),
        (7, 39, 39): (Category.PEDESTRIAN, "pedestrian"),
    }
    semantics = read(recorded(tmp_path, [(index, kind) for index, (kind, _) in kinds.items()]), taxonomy)
    assert bool(semantics.known.all())
    assert {index: name(semantics, index) for index in kinds} == {k: v for k, (_, v) in kinds.items()}
    free = VOXEL_CLASSES[taxonomy].index("free")
    assert int((semantics.index != free).sum()) == len(kinds)


def test_a_class_that_a_taxonomy_lacks_is_not_known(tmp_path: Path) -> None:
    log = recorded(tmp_path, [((3, 3, 3), Category.ANIMAL), ((3, 3, 4), Category.CAR)])
    assert name(read(log), (3, 3, 3)) == "others"
    semantics = read(log, "openocc")
    assert (~semantics.known).nonzero().tolist() == [[3, 3, 3]]
    assert name(semantics, (3, 3, 4)) == "car"


def test_of_several_voxels_road_users_and_then_things_win(tmp_path: Path) -> None:
    voxels = [
        ((0, 0, 0), static(Surface.BUILDING)),
        ((0, 0, 1), Category.PEDESTRIAN),
        ((0, 2, 2), static(Surface.ROAD)),
        ((0, 2, 3), static(Surface.POLE)),
    ]
    coarse = read(recorded(tmp_path, voxels), spec=VoxelSpec(GRID.lower_m, 1.0, (4, 20, 20)))
    assert name(coarse, (0, 0, 0)) == "pedestrian"
    assert name(coarse, (0, 1, 1)) == "manmade"


def test_beyond_the_recording_nothing_is_known_or_seen(tmp_path: Path) -> None:
    wide = VoxelSpec((-12.0, -10.0, -1.0), 0.5, (8, 40, 48))
    semantics = read(recorded(tmp_path, [((0, 0, 0), Category.CAR)]), spec=wide)
    assert not semantics.known[..., :4].any()
    assert not semantics.known[..., 44:].any()
    assert bool(semantics.known[..., 4:44].all())
    for mask in (semantics.camera_mask, semantics.lidar_mask):
        assert not (mask & ~semantics.known).any()
        assert mask.any()


def test_a_wall_hides_what_stands_behind_it_from_the_camera(tmp_path: Path) -> None:
    """The cameras look ahead from (1.6, 0, 1.5) and to the left from (0.8, 0.5, 1.5), 90° wide."""
    heights = (0.1, 0.6, 1.1, 1.6, 2.1, 2.6)
    wall = [(at(5.1, y, z), static(Surface.BUILDING)) for y in np.arange(-2.9, 3.0, 0.5) for z in heights]
    across = np.arange(-9.9, 10.0, 0.5)
    ground = [(at(x, y, -0.2), static(Surface.ROAD)) for x in across for y in across]
    behind, beside = at(8.1, 0.1, 1.1), at(8.1, 6.1, 1.1)
    voxels = [*wall, *ground, (behind, Category.CAR), (beside, Category.CAR)]
    seen = read(recorded(tmp_path, voxels)).camera_mask
    assert bool(seen[at(5.1, 0.1, 1.1)])  # the wall itself
    assert bool(seen[at(3.1, 0.1, 1.1)])  # the air before it
    assert bool(seen[beside])
    assert not seen[behind]
    assert not seen[at(7.1, 0.1, 1.1)]  # the air behind it
    assert not seen[at(-5.1, -5.1, 1.1)]  # out of both images
    assert bool(seen[at(0.8, 8.1, 1.1)])  # to the left
    level = torch.tensor([bool(seen[at(x, 9.1, -0.2)]) for x in np.arange(-4.9, 5.0, 0.5)])
    assert level.all()  # level ground up to the border
    assert not seen[at(5.1, 0.1, -0.8)]  # under the ground


def test_the_lidar_mask_is_what_beams_have_crossed_or_hit(tmp_path: Path) -> None:
    log = recorded(tmp_path, [((0, 0, 0), Category.CAR)])
    semantics = read(log)
    assert torch.equal(semantics.lidar_mask, make_labels(log, 0, GRID).known)


def test_without_a_recording_nothing_is_known(flat_log: Path) -> None:
    semantics = read(Log(find_logs(flat_log)[0]))
    for part in (semantics.known, semantics.camera_mask, semantics.lidar_mask):
        assert not part.any()


def test_every_surface_of_towns_has_a_class() -> None:
    assert len(STATIC_CLASSES) == len(Surface)
    classes = {surface.name: STATIC_CLASSES[surface] for surface in Surface}
    assert classes == {
        "ROAD": "driveable_surface",
        "SIDEWALK": "sidewalk",
        "TERRAIN": "terrain",
        "BUILDING": "manmade",
        "VEGETATION": "vegetation",
        "POLE": "manmade",
        "SIGN": "manmade",
        "STRUCTURE": "manmade",
        "VEHICLE": "car",
        "PEDESTRIAN": "pedestrian",
        "HIDDEN": "terrain",
        "SIGNAL": "manmade",
    }
    assert not set(ABSENT_IN_TOWNS) & set(classes.values())
    assert set(ABSENT_IN_TOWNS) < set(VOXEL_CLASSES["occ3d"])
