"""Camera rigs by name and from files."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from foredrive.errors import InputError
from foredrive.geometry.projection import project
from foredrive.geometry.se3 import inverse_se3, transform_points
from foredrive.sensors.rigs import (
    DRIVING,
    RIGS,
    TELE,
    Mount,
    RigPlan,
    camera_rig,
    find_rig,
    rig_of_cameras,
    rig_yaml,
    same_rig,
)

RIG = """
image_hw: [90, 160]
cameras:
  PCAM_F0: {xyz_m: [1.5, 0.2, 1.4], yaw_deg: 30, fov_deg: 90, pitch_deg: 10}
  PCAM_B0: {xyz_m: [-1, 0, 1.5], yaw_deg: 180, fov_deg: 60}
"""
angles = st.floats(-60.0, 60.0)


def test_a_camera_looks_where_the_file_says(tmp_path: Path) -> None:
    """The optical axis of the first camera: 30° to the left, 10° up. Its left edge is 45° off the axis."""
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    rig = camera_rig(plan=find_rig(str(path)))
    assert (rig.names, rig.size_hw) == (("PCAM_F0", "PCAM_B0"), (90, 160))
    yaw, pitch = torch.deg2rad(torch.tensor([30.0, 10.0]))
    ahead = torch.stack([yaw.cos() * pitch.cos(), yaw.sin() * pitch.cos(), pitch.sin()])
    left = torch.stack([-yaw.sin(), yaw.cos(), torch.tensor(0.0)])
    points = torch.tensor([1.5, 0.2, 1.4]) + 20.0 * torch.stack([ahead, ahead + 0.999 * left])
    in_camera = transform_points(inverse_se3(rig.T_ego_cam[:1]), points[None])
    uv, _, inside = project(in_camera, rig.K[:1], rig.dist[:1], rig.size_hw)
    torch.testing.assert_close(uv[0], torch.tensor([[80.0, 45.0], [0.08, 45.0]]), atol=1e-3, rtol=0)
    assert inside.all()


@given(yaw=st.floats(-179.0, 179.0), pitch=angles, roll=angles, fov=st.floats(5.0, 150.0))
def test_a_rig_is_read_back_from_its_matrices(yaw: float, pitch: float, roll: float, fov: float) -> None:
    level = Mount((0.0, 0.0, 0.0), 0.0, 90.0)
    plan = RigPlan((48, 64), {"A": Mount((0.5, -2.0, 1.0), yaw, fov, pitch, roll), "B": level})
    assert same_rig(rig_of_cameras(camera_rig(plan=plan)), plan)


@pytest.mark.parametrize("name", RIGS)
def test_known_rigs_survive_their_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(rig_yaml(RIGS[name]))
    assert find_rig(str(path)) == RIGS[name] == find_rig(name)


def test_rigs_differ_by_place_angle_names_and_size() -> None:
    plan = RigPlan((48, 64), {"A": Mount((0.5, -2.0, 1.0), 180.0, 60.0)})
    assert same_rig(plan, RigPlan((48, 64), {"A": Mount((0.5, -2.0, 1.0), -180.0, 60.0)}))
    for mount in (Mount((0.5, -2.0, 1.1), 180.0, 60.0), Mount((0.5, -2.0, 1.0), 179.0, 60.0)):
        assert not same_rig(plan, RigPlan((48, 64), {"A": mount}))
    assert not same_rig(plan, RigPlan((48, 64), {"B": plan.cameras["A"]}))
    assert not same_rig(plan, plan.of_size((36, 64)))


def test_the_narrow_camera_shows_a_lamp_at_40_m_and_one_beside_the_near_line() -> None:
    """A lamp of 0.3 m covers three pixels at 40 m. Lamps 14 m ahead over the next lane are in view."""
    rig = camera_rig(DRIVING.image_hw, plan=DRIVING)
    tele = rig.names.index(TELE)
    lamp_m = torch.tensor([[41.7, 0.15, 5.05], [41.7, -0.15, 5.05], [15.7, 3.0, 4.8], [15.7, -3.0, 2.7]])
    in_camera = transform_points(inverse_se3(rig.T_ego_cam[tele]), lamp_m)
    uv, _, inside = project(in_camera, rig.K[tele], rig.dist[tele], rig.size_hw)
    assert inside.all()
    assert uv[1, 0] - uv[0, 0] >= 3.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cameras: {A: {xyz_m: [0, 0, 1], yaw_deg: 0, fov_deg: 60}}", "image_hw: Field required"),
        ("image_hw: [9, 16]\ncameras: {}", "at least one camera"),
        ("image_hw: [0, 16]\ncameras: {A: {xyz_m: [0, 0, 1], yaw_deg: 0, fov_deg: 60}}", "must be positive"),
        ("image_hw: [9, 16]\ncameras: {A: {xyz_m: [0, 0, 1], yaw_deg: 0, fov_deg: 190}}", "fov_deg must be"),
        ("image_hw: [9, 16]\ncameras: {A: {xyz_m: [0, 0, .nan], yaw_deg: 0, fov_deg: 60}}", "finite"),
        ("image_hw: [9, 16]\ncameras: {A: {xyz_m: [0, 0], yaw_deg: 0, fov_deg: 60}}", "cameras.A.xyz_m"),
        ("image_hw: [9, 16]\ncameras: {A: {xyz_m: [0, 0, 1], yaw: 0, fov_deg: 60}}", "A.yaw: Unexpected"),
        ("", "the file: Input should be a dictionary$"),
        ("[", "not YAML"),
    ],
)
def test_a_wrong_file_is_one_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        find_rig(str(path))
    assert str(path) in str(caught.value)


def test_an_unknown_rig_names_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no rig 'sidewinder': surround, .*, navsim, or"):
        find_rig("sidewinder")
