"""Pictures of voxel grids."""

import numpy as np
import torch

from foredrive.scene import VoxelSpec
from foredrive.view import palette
from foredrive.view.voxel_drawing import Viewpoint, draw_comparison, draw_volume_pca, draw_voxels

SPEC = VoxelSpec(lower_m=(-4.0, -3.0, -0.5), voxel_m=0.5, shape_zyx=(4, 12, 16))
SIZE_HW = (120, 160)


def cells(*zyx: tuple[int, int, int]) -> torch.Tensor:
    grid = torch.zeros(SPEC.shape_zyx, dtype=torch.bool)
    for index in zyx:
        grid[index] = True
    return grid


def bounds(image: np.ndarray) -> tuple[int, int, int, int]:
    """First and last row, first and last column that are not background."""
    rows, columns = np.nonzero((image != np.array(palette.rgb255(palette.GROUND))).any(-1))
    return rows.min(), rows.max(), columns.min(), columns.max()


def test_a_voxel_appears_where_its_corners_project() -> None:
    viewpoint = Viewpoint.behind(SPEC, SIZE_HW)
    for z, y, x in [(0, 3, 3), (3, 9, 13), (1, 6, 8)]:
        image = draw_voxels(cells((z, y, x)), SPEC, SIZE_HW, viewpoint)
        corner = np.array(SPEC.lower_m) + 0.5 * np.array([x, y, z])
        corners = corner + 0.5 * np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(8, 3)
        uv = viewpoint.project(corners, SIZE_HW)
        expected = (uv[:, 1].min(), uv[:, 1].max(), uv[:, 0].min(), uv[:, 0].max())
        np.testing.assert_allclose(np.array(bounds(image)) + 0.5, expected, atol=1.01)


def test_a_near_voxel_hides_a_far_one() -> None:
    viewpoint = Viewpoint(position_m=(-20.0, 0.25, 0.25), target_m=(0.0, 0.25, 0.25), focal=4.0)
    colours = np.zeros((*SPEC.shape_zyx, 3), dtype=np.uint8)
    colours[1, 6, 2], colours[1, 6, 12] = (200, 0, 0), (0, 200, 0)  # on the line of sight, 5 m apart
    image = draw_voxels(cells((1, 6, 2), (1, 6, 12)), SPEC, SIZE_HW, viewpoint, colours)
    red, green, _ = image[60, 80].astype(int)
    assert red > 50
    assert green == 0


def test_nothing_occupied_leaves_the_background() -> None:
    image = draw_voxels(cells(), SPEC, SIZE_HW)
    assert (image == np.array(palette.rgb255(palette.GROUND))).all()


def test_columns_are_compared_above_the_road_and_where_known() -> None:
    low, high = 1, 3  # voxel centres at z = 0.25 m and 1.25 m
    label = cells((high, 0, 0), (high, 2, 0), (low, 3, 0), (high, 4, 0))
    predicted = cells((high, 0, 0), (high, 1, 0), (low, 3, 0), (high, 5, 0))
    known = torch.ones(SPEC.shape_zyx, dtype=torch.bool)
    known[:, 4:6] = False
    picture = draw_comparison(predicted, label, known, SPEC, above_m=0.4)
    assert picture.shape == (16, 12, 3)

    def at(y: int) -> list[int]:
        return picture[15, 11 - y].tolist()  # x = 0 is the rearmost row: the lowest; y = 0 the rightmost

    expected = [
        palette.TRUE_POSITIVE,
        palette.FALSE_POSITIVE,
        palette.FALSE_NEGATIVE,
        palette.KNOWN_FREE,  # both speak of the road layer alone
        palette.GROUND,  # unknown: neither a miss
        palette.GROUND,  # nor a false alarm
    ]
    assert [at(y) for y in range(6)] == [list(palette.rgb255(colour)) for colour in expected]


def test_principal_components_are_found_in_order_and_oriented_as_seen_from_above() -> None:
    nz, ny, nx = SPEC.shape_zyx
    forward = torch.linspace(-3, 3, nx).expand(nz, ny, nx)
    left = torch.linspace(-1, 1, ny)[:, None].expand(nz, ny, nx)
    mix = torch.tensor([[0.8, 0.1], [0.6, -0.2], [0.0, 0.9]])  # three channels, rank two
    volume = (mix @ torch.stack([forward, left]).flatten(1)).unflatten(1, SPEC.shape_zyx)
    picture = draw_volume_pca(volume).astype(int)
    assert picture.shape == (nx, ny, 3)
    along_rows, along_columns = (np.abs(np.diff(picture, axis=axis)).mean((0, 1)) for axis in (0, 1))
    assert along_rows[0] > 10 * along_columns[0]  # red, the strongest component, is the forward direction
    assert along_columns[1] > 10 * along_rows[1]  # green is the sideways one
    assert picture[0, :, 0].mean() > picture[-1, :, 0].mean()  # it grows with x, and x points up


def test_constant_features_make_a_plain_picture() -> None:
    picture = draw_volume_pca(torch.ones(5, *SPEC.shape_zyx))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 1
