# %% [markdown]
# # Your own log in ten lines
#
# Images, calibration, poses and lidar points of any vehicle become a log that every verb reads. This
# notebook first makes such a recording, because it cannot know yours: a street with a striped wall on each
# side. Replace that cell by your files.
#
# ## A recording

# %%
import numpy as np

K = np.array([[120.0, 0, 120], [0, 120, 68], [0, 0, 1]])  # pixels; centres are at +0.5
T_ego_cam = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1.0]])
LIDAR = np.array([1.0, 0.0, 1.8])  # position in the ego frame


def range_along(origin, rays):
    """The distance to the ground (z = 0) or to the walls (y = 7 and y = -7) along each ray."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ground, left = -origin[2] / rays[:, 2], (7 - origin[1]) / rays[:, 1]
        to = np.stack([ground, left, (-7 - origin[1]) / rays[:, 1]])
    return np.where(to > 0, to, np.inf).min(axis=0)


def photo(T_world_cam):
    """A picture of the street: stripes of 2 m on the walls, lane markings on the ground."""
    v, u = np.mgrid[0:136, 0:240] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    rays, eye = rays.reshape(-1, 3) @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    hit = eye + rays * np.minimum(range_along(eye, rays), 200)[:, None]
    wall, stripe = np.abs(hit[:, 1]) > 6.9, hit[:, 0] // 2 % 2 == 0
    paint = (np.abs(np.abs(hit[:, 1]) - 1.75) < 0.1) & stripe
    grey = np.where(wall, np.where(stripe, 170, 110), np.where(paint, 240, 70))
    sky = (hit[:, 2] > 6)[:, None]
    return np.where(sky, (150, 190, 230), grey[:, None]).astype(np.uint8).reshape(136, 240, 3)


t_s = np.arange(20) * 0.1
T_world_ego = np.tile(np.eye(4), (20, 1, 1))
T_world_ego[:, 0, 3] = 8 * t_s  # 8 m/s along x
images = [photo(T @ T_ego_cam) for T in T_world_ego]

azimuth = np.radians(np.arange(-180, 180, 1.0))
elevation = np.radians(np.arange(-15, 3, 1.0))[:, None]
level = np.cos(elevation)
parts = (level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth)
rays = np.stack(parts, axis=-1).reshape(-1, 3)
distance = range_along(LIDAR, rays)
near = distance < 60
points = LIDAR + distance[near, None] * rays[near]  # of each frame: the street does not change

# %% [markdown]
# ## The ten lines

# %%
from foredrive.data import Box, CameraSpec, Points, write_log

front = CameraSpec("front", K, T_ego_cam, size_hw=(136, 240))
sweeps = [Points(points) for _ in t_s]
boxes = [[Box("car", 1, (12 - 4 * t, 3.5, 0.8), (4.5, 1.8, 1.6), 0.0)] for t in t_s]
sensed = {"images": {"front": images}, "sweeps": sweeps, "boxes": boxes}
log = write_log("data", "my_street", t_s, T_world_ego, cameras=[front], **sensed)
print(log.name)

# %% [markdown]
# ## Is it right?
#
# `foredrive check` says what a log holds, and what looks wrong in it. Here nothing is, except what we left
# out.

# %% language="bash"
# foredrive check data/logs/own_train/my_street

# %% [markdown]
# An error in the data is found before anything is trained on it. Here the camera's calibration is turned by
# about six degrees:

# %%
turn = np.eye(4)
turn[:2, :2] = [[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]]
wrong = CameraSpec("front", K, turn @ T_ego_cam, size_hw=(136, 240))
turned = write_log("data", "turned", t_s, T_world_ego, cameras=[wrong], **sensed)

# %% language="bash"
# foredrive check data/logs/own_train/turned

# %% [markdown]
# ## Look at it
#
# `foredrive view` shows the log in the browser; with `--save` it writes a picture of one time. Points on
# the image, and the box of the car, show at once whether poses and calibration fit.

# %% language="bash"
# foredrive view data/logs/own_train/my_street --t 1 --save street.png

# %%
from IPython.display import Image

Image("street.png")

# %% [markdown]
# ## Then
#
# The log can be [reconstructed](../reconstruction.md), [searched](../search.md) and
# [trained on](../how-to/train.md).
# What else `write_log` takes (exposure times, motion within a sweep, rolling shutter, distortion) is on the
# page about [data](../data.md#your-own-data).
