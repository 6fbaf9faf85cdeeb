"""Images and clouds of bags: rectified ones, mosaics, depth, and rows with padding."""

import io
from pathlib import Path
from typing import Any

import made_bags
import numpy as np
import pytest
from made_bags import START_NS, Messages, Recording, converted, pose_at
from PIL import Image

from foredrive.data.cameras import pinhole_cameras, read_camera
from foredrive.data.formats.bag_images import depth_fault, is_rectified, read_image
from foredrive.data.formats.bag_messages import read_calibration, read_cloud
from foredrive.data.formats.bag_topics import topics_file
from foredrive.errors import InputError


def test_rectified_images_have_the_camera_matrix_of_p_and_the_axes_of_r(tmp_path: Path) -> None:
    c, s = np.cos(0.1), np.sin(0.1)
    R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # the rectified axes are turned to the right

    def change(made: Messages, recording: Recording) -> Recording:
        rows: Recording = []
        for topic, t_ns, message in recording:
            if topic.endswith("camera_info"):
                p = np.array([40.0, 0, 16.5, 0, 0, 40, 8.5, 0, 0, 0, 1, 0])
                message = made.info(t_ns, d=np.array([-0.3, 0.1, 0, 0, 0]), r=R.reshape(-1), p=p)
            rows.append((topic.replace("image_raw", "image_rect_color"), t_ns, message))
        return rows

    log, notices = converted(tmp_path, change)
    camera = read_camera(log, 0, pinhole_cameras(log)["front"], (16, 32), with_image=True)
    assert camera.K.tolist() == [[40.0, 0.0, 17.0], [0.0, 40.0, 9.0], [0.0, 0.0, 1.0]]
    assert not camera.dist.any()
    at_exposure = np.linalg.inv(pose_at(0.0)) @ pose_at(0.02)
    optical = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    expected = at_exposure[:3, :3] @ optical @ R.T
    np.testing.assert_allclose(camera.T_ego_cam[:3, :3].numpy(), expected, atol=1e-4)
    assert any("rectified images; P and R of /front/camera_info hold" in each for each in notices)


def test_rectified_images_without_p_are_refused_and_names_tell_them() -> None:
    info = Messages(2).info(START_NS, d=np.array([-0.3, 0.1, 0, 0, 0]))
    assert read_calibration(info).dist[0] == -0.3
    with pytest.raises(InputError, match="rectified images without P"):
        read_calibration(info, rectified=True)
    rectified = ["/left/image_rect", "/cam/image_rect_color/compressed", "/rectified/image"]
    assert [is_rectified(topic) for topic in (*rectified, "/direct/image_raw")] == [True] * 3 + [False]


def encoded(pixels: np.ndarray, text: str, header: bytes = b"", kind: str = "PNG") -> Any:
    """A compressed image of a format."""
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, kind)
    message = Messages(2).compressed(START_NS)
    message.format, message.data = text, np.frombuffer(header + out.getvalue(), np.uint8)
    return message


def test_a_compressed_mosaic_is_decoded_by_its_format() -> None:
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[::2, ::2] = 200  # red, in the first column of the first row
    for text in ("bayer_rggb8; png compressed bayer_rggb8", "bayer_rggb8; png compressed "):
        assert read_image(encoded(mosaic, text))[8, 8].tolist() == [200, 0, 0]
    assert read_image(encoded(mosaic, "bayer_bggr8; png compressed bayer_bggr8"))[8, 8].tolist() == [
        0,
        0,
        200,
    ]
    colours = np.zeros((16, 16, 3), np.uint8) + np.array([10, 20, 30], np.uint8)
    assert read_image(encoded(colours, "bayer_rggb8; png compressed bgr8"))[8, 8].tolist() == [10, 20, 30]
    assert read_image(encoded(mosaic, "mono8; png compressed mono8"))[8, 8].tolist() == [200, 200, 200]
    with pytest.raises(InputError, match=r"mosaics of the pattern 'bayer_xyz8' are not read"):
        read_image(encoded(mosaic, "bayer_xyz8; png compressed bayer_xyz8"))
    mosaic16 = mosaic.astype(np.uint16) * 200
    deep = encoded(mosaic16, "bayer_rggb16; png compressed bayer_rggb16")
    assert read_image(deep, (0.0, 40_000.0))[8, 8].tolist() == [255, 0, 0]


def test_depth_is_known_by_encoding_and_format() -> None:
    depth = np.full((16, 32), 1500, np.uint16)
    compressed = encoded(depth, "16UC1; compressedDepth png", header=bytes(12))
    with pytest.raises(InputError, match="are depth"):
        read_image(compressed)
    assert depth_fault("/x", compressed) is not None
    assert depth_fault("/camera/depth/image_raw", encoded(depth, "16UC1; png compressed ")) is not None
    assert depth_fault("/thermal/image_raw", encoded(depth, "16UC1; png compressed ")) is None
    raw = Messages(2).image(START_NS)
    raw.encoding, raw.step, raw.data = "32FC1", 128, np.zeros(16 * 128, np.uint8)
    assert depth_fault("/zed/points", raw) is not None


def test_a_depth_topic_is_left_out_of_the_proposal_and_says_why(tmp_path: Path) -> None:
    depth = np.full((16, 32), 1500, np.uint16)

    def change(made: Messages, recording: Recording) -> Recording:
        more = []
        for topic, t_ns, _ in recording:
            if topic == "/front/camera_info":
                image = encoded(depth, "16UC1; compressedDepth png", header=bytes(12))
                more += [
                    ("/depth/camera_info", t_ns, made.info(t_ns)),
                    ("/depth/compressedDepth", t_ns, image),
                ]
        return [*recording, *more]

    log, _ = converted(tmp_path, change)
    assert list(pinhole_cameras(log)) == ["front"]
    text = topics_file(tmp_path / "drive").read_text()
    assert "5 messages; left out: depth, not images of a camera" in text


def test_rows_of_clouds_and_images_begin_at_their_steps() -> None:
    made = Messages(2)
    cloud = made.cloud(START_NS)
    tight = cloud.data.reshape(2, 24)
    cloud.height, cloud.width, cloud.row_step = 2, 1, 36
    cloud.data = np.concatenate([tight, np.full((2, 12), 77, np.uint8)], axis=1).reshape(-1)
    expected = made_bags.POINTS[:, :3]
    np.testing.assert_allclose(read_cloud(cloud).xyz_m, expected, atol=1e-6)
    cloud.data = cloud.data[:-12]  # the last row may lack its padding
    np.testing.assert_allclose(read_cloud(cloud).xyz_m, expected, atol=1e-6)
    for wrong in (0, 48):  # drivers leave it 0, or write the size of all rows
        cloud.row_step, cloud.data = wrong, tight.reshape(-1)
        np.testing.assert_allclose(read_cloud(cloud).xyz_m, expected, atol=1e-6)
    image = made.image(START_NS)
    whole = read_image(image)
    image.data = image.data[:-4]
    assert (read_image(image) == whole).all()
    image.data = image.data[:-1]
    with pytest.raises(InputError, match="in rows of 100 bytes"):
        read_image(image)
