"""What a reconstruction knows of rendered images, on scenes that are computed by hand."""

import dataclasses
import math

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from foredrive.geometry.se3 import matrix_from_yaw
from foredrive.methods.reconstruction.rendered import RenderedImage
from foredrive.methods.reconstruction.scene_graph import ANOTHER, SceneGraph
from foredrive.methods.reconstruction.tracks import ActorTracks, joined_tracks
from foredrive.methods.reconstruction.trust import (
    IMAGE_WEIGHTS,
    TINY_RAD,
    ObservedViews,
    expected_errors,
    fitted_offset,
    image_features,
    psnr_of,
)
from foredrive.methods.reconstruction.views import CameraView
from foredrive.methods.splatad import Gaussians
from foredrive.methods.splatad.content import GaussianContent
from foredrive.scene import Category

SIZE_HW = (16, 32)
WALL_M = 10.0
LOOKS_FORWARD = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Axes of a camera (x right, y down, z forward) that looks along x."""
K = torch.tensor([[16.0, 0.0, 16.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]])


def pose(x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0) -> Float[Tensor, "4 4"]:
    """Pose of a camera that looks along the yaw."""
    T = matrix_from_yaw(torch.tensor(math.radians(yaw_deg)), torch.tensor([x_m, y_m, 0.0]))
    T[:3, :3] = T[:3, :3] @ LOOKS_FORWARD
    return T


def view(x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0, t_s: float = 1.0) -> CameraView:
    return CameraView(
        K=K,
        dist=torch.zeros(5),
        T_scene_cam=pose(x_m, y_m, yaw_deg),
        twist_cam=torch.zeros(6),
        t_s=t_s,
        readout_s=0.0,
        size_hw=SIZE_HW,
        sensor=0,
    )


def image(depth_m: float, alpha: float = 1.0) -> RenderedImage:
    return RenderedImage(
        torch.full((3, *SIZE_HW), 0.5), torch.full(SIZE_HW, depth_m), torch.full(SIZE_HW, alpha)
    )


def tracks(x_m: tuple[float, float], track_id: int = 7) -> ActorTracks:
    """A wide box that drives along x: its places at 0 and at 1 s."""
    xyz = torch.tensor([[x_m[0], 0.0, 0.0], [x_m[1], 0.0, 0.0]])
    return ActorTracks(
        track_id=torch.tensor([track_id]),
        category=torch.tensor([int(Category.TRUCK)]),
        size_lwh=torch.tensor([[2.0, 60.0, 60.0]]),
        t_s=torch.tensor([0.0, 1.0]),
        T_scene_actor=matrix_from_yaw(torch.zeros(2), xyz)[None],
        present=torch.ones(1, 2, dtype=torch.bool),
    )


NOBODY = tracks((1e4, 1e4))


def observed(
    depths_m: tuple[float, ...] = (WALL_M,), x_m: tuple[float, ...] = (0.0,), actor_m: float = 1e4
) -> ObservedViews:
    """Training views from places on the x axis that see walls at some depths, exposed at 0 s."""
    count = len(depths_m)
    return ObservedViews(
        K=K.expand(count, 3, 3),
        dist=torch.zeros(count, 5),
        T_scene_cam=torch.stack([pose(x) for x in x_m]),
        depth_m=torch.tensor(depths_m)[:, None, None].expand(count, *SIZE_HW),
        alpha=torch.ones(count, *SIZE_HW),
        T_scene_actor=matrix_from_yaw(
            torch.zeros(count, 1), torch.tensor([actor_m, 0.0, 0.0]).expand(count, 1, 3)
        ),
        present=torch.ones(count, 1, dtype=torch.bool),
    )


def middle(values: Float[Tensor, "N"]) -> float:
    return float(values.view(SIZE_HW)[8, 16])


def features(
    views: ObservedViews,
    new: CameraView,
    shown: RenderedImage,
    actors: ActorTracks = NOBODY,
    looks: tuple[int, ...] | None = None,
) -> dict[str, Float[Tensor, "N"]]:
    content = GaussianContent(
        Gaussians(*(torch.zeros(0, size) for size in (3, 4, 3)), torch.zeros(0), torch.zeros(0, 3)),
        torch.zeros(0, dtype=torch.int64),
    )
    graph = SceneGraph(actors, content, looks=None if looks is None else torch.tensor(looks))
    return image_features(views, torch.tensor([7]), graph, new, shown)


def test_what_a_view_saw_is_seen_again_from_its_place() -> None:
    known = features(observed(), view(), image(WALL_M))
    assert set(known) == set(IMAGE_WEIGHTS)
    assert float(known["unseen"].sum()) == 0
    assert float(known["angle"].max()) < 1e-3
    assert float(known["nearer_than_seen"].max()) < 1e-3
    assert known["views"].tolist() == pytest.approx([math.log(2)] * 512)


def test_who_comes_nearer_or_aside_knows_less_of_the_same_wall() -> None:
    nearer = features(observed(), view(x_m=5.0), image(WALL_M - 5.0))
    assert middle(nearer["nearer_than_seen"]) == pytest.approx(math.log(2), abs=0.01)
    aside = features(observed(), view(y_m=3.0), image(WALL_M))
    # The point straight ahead lies 3 m to the left of the first camera's axis
    assert middle(aside["angle"]) == pytest.approx(math.atan(3.0 / WALL_M), abs=0.03)
    assert float(aside["near_views"].view(SIZE_HW)[8, 16]) == 0.0
    farther = features(observed(), view(x_m=-10.0), image(WALL_M + 10.0))
    assert middle(farther["farther_than_seen"]) == pytest.approx(-math.log(2), abs=0.01)


def test_behind_something_and_outside_of_the_image_nothing_was_seen() -> None:
    assert features(observed((4.0,)), view(), image(WALL_M))["unseen"].tolist() == [1.0] * 512
    assert features(observed(), view(yaw_deg=180.0), image(WALL_M))["unseen"].tolist() == [1.0] * 512
    # Of two views, the one that is not hidden counts
    both = features(observed((4.0, WALL_M - 2.0), (0.0, 2.0)), view(), image(WALL_M))
    assert middle(both["unseen"]) == 0.0


def test_sky_is_where_the_training_views_saw_sky() -> None:
    open_sky = dataclasses.replace(observed(), alpha=torch.zeros(1, *SIZE_HW))
    assert features(open_sky, view(x_m=6.0), image(3.0, alpha=0.0))["unseen"].sum() == 0
    walled = features(observed(), view(x_m=6.0), image(3.0, alpha=0.0))
    assert walled["unseen_sky"].tolist() == [1.0] * 512


def test_an_actor_is_looked_up_where_it_was() -> None:
    """It was 10 m ahead at 0 s and is 20 m ahead at 1 s: its rear was seen from half the distance."""
    driven = tracks((11.0, 21.0))
    known = features(observed((WALL_M,), actor_m=11.0), view(), image(2 * WALL_M), driven)
    assert middle(known["actor"]) == 1.0
    assert middle(known["unseen"]) == 0.0
    assert middle(known["farther_than_seen"]) == pytest.approx(-math.log(2), abs=0.01)
    # A wall at that depth was never seen, nor was an actor of another number
    still = features(observed((WALL_M,), actor_m=11.0), view(), image(2 * WALL_M))
    assert middle(still["unseen"]) == 1.0
    stranger = features(observed((WALL_M,), actor_m=11.0), view(), image(2 * WALL_M), tracks((11.0, 21.0), 8))
    assert (middle(stranger["actor"]), middle(stranger["unseen"])) == (1.0, 1.0)


def test_copies_were_seen_where_the_actor_was_that_they_look_like() -> None:
    """Two copies of the actor whose rear was 10 m ahead at 0 s: one is 20 m ahead, one behind the camera."""
    copies = tracks((21.0, 21.0), 8)
    behind = tracks((-99.0, -99.0), 9)
    both = joined_tracks(behind, copies)
    known = features(observed(actor_m=11.0), view(), image(2 * WALL_M), both, looks=(7, 7))
    assert (middle(known["actor"]), middle(known["unseen"])) == (1.0, 0.0)
    assert middle(known["farther_than_seen"]) == pytest.approx(-math.log(2), abs=0.01)
    of_another_log = features(observed(actor_m=11.0), view(), image(2 * WALL_M), copies, looks=(ANOTHER,))
    assert middle(of_another_log["unseen"]) == 1.0


def test_two_copies_in_one_image_are_looked_up_each_by_its_own_pose() -> None:
    """The actor's rear was straight ahead at 10 m; its copies stand 20 m ahead, 5 m to either side."""
    sides = []
    for y_m, track_id in ((5.0, 8), (-5.0, 9)):
        copy = tracks((21.0, 21.0), track_id)
        poses = matrix_from_yaw(torch.zeros(2), torch.tensor([[21.0, y_m, 0.0]] * 2))[None]
        size_lwh = torch.tensor([[2.0, 8.0, 60.0]])
        sides.append(dataclasses.replace(copy, T_scene_actor=poses, size_lwh=size_lwh))
    both = joined_tracks(*sides)
    known = features(observed(actor_m=11.0), view(), image(2 * WALL_M), both, looks=(7, 7))
    row, columns = 8, (12, 19)  # 5 m aside at 20 m: 4 px from the middle
    for column in columns:
        assert float(known["actor"].view(SIZE_HW)[row, column]) == 1.0
        assert float(known["unseen"].view(SIZE_HW)[row, column]) == 0.0
        # Each rear was seen head on, from half the distance
        assert float(known["farther_than_seen"].view(SIZE_HW)[row, column]) < -0.6


def test_psnr_is_that_of_the_mean_error() -> None:
    assert psnr_of(torch.tensor([[0.001, 0.003]])) == pytest.approx(-10 * math.log10(0.002))


def test_a_block_beside_seen_ones_is_half_of_an_unseen_area() -> None:
    """The training view looked at the left half of what is rendered; the right half is behind its wall."""
    depths = torch.full((1, *SIZE_HW), WALL_M)
    depths[..., 16:] = 4.0
    views = dataclasses.replace(observed(), depth_m=depths)
    known = features(views, view(), image(WALL_M))
    unseen = known["unseen"].view(SIZE_HW)
    assert unseen[:, :15].sum() == 0
    assert unseen[:, 17:].min() == 1
    area = known["unseen_area"].view(SIZE_HW)
    assert area[8, 24] == 1.0
    assert area[8, 16] == pytest.approx(2 / 3)


def blocks(unseen: list[float], angle_rad: list[float]) -> dict[str, Float[Tensor, "N"]]:
    """Blocks of which nothing else is known."""
    known = {name: torch.zeros(len(unseen)) for name in IMAGE_WEIGHTS}
    known |= {"one": torch.ones(len(unseen)), "unseen": torch.tensor(unseen)}
    return known | {"tiny_angle": torch.tensor(angle_rad).clamp_max(TINY_RAD)}


def test_the_level_of_a_log_counts_for_what_was_seen() -> None:
    weights = {"one": math.log(0.001), "unseen": math.log(20.0)}
    known = blocks([0.0, 0.0, 1.0], [0.0, 0.3, 0.0])
    plain, worse = (expected_errors(known, offset, weights) for offset in (0.0, math.log(4.0)))
    assert plain.tolist() == pytest.approx([0.001, 0.001, 0.02])
    assert worse.tolist() == pytest.approx([0.004, 0.002, 0.02])
    assert float(expected_errors(known, 100.0, weights).max()) == 1.0  # no error is larger


@pytest.mark.parametrize("psnr_db", [20.0, 27.0, 33.0])
def test_held_out_images_set_the_level(psnr_db: float) -> None:
    weights = {"one": math.log(0.002), "tiny_angle": 50.0}
    frames = [blocks([0.0, 0.0], [0.0, 0.005]), blocks([0.0, 0.0], [0.002, 0.001])]
    offset = fitted_offset(frames, psnr_db, weights)
    reached_db = [psnr_of(expected_errors(frame, offset, weights)) for frame in frames]
    assert sum(reached_db) / 2 == pytest.approx(psnr_db, abs=1e-3)
    assert (offset > 0) == (psnr_db < 26.0)
