# %% [markdown]
# # Reconstruct a log and put a car in the way
#
# A recorded drive becomes a scene of 3-D Gaussians: a static part, and one for each road user that moves. The
# scene renders cameras and lidar from places where nobody drove. So a planner can be tested there on what
# never happened: here, a car that stands in the lane.
#
# ## A drive
#
# Eight seconds of Town05. A log of your own vehicle works as well ([data](../data.md)).

# %% language="bash"
# foredrive record --town Town05 --seconds 8 --rate 5 --seed 7 --out data

# %% [markdown]
# ## Reconstruct it
#
# Every second frame is held out, and the scene is judged on those frames. Two hundred steps on small images
# are enough to see how it works.

# %% language="bash"
# foredrive reconstruct data --out reconstructed --image-size 96 160 --set representation.schedule.steps=200

# %% [markdown]
# Held-out frames: recorded, rendered, their difference, and the range.

# %%
from IPython.display import Image

Image("reconstructed/held_out.png")

# %% [markdown]
# The figure to compare with is that of the nearest recorded image in time: a reconstruction that is
# no better than it has learned nothing.

# %%
import json
from pathlib import Path

summary = json.loads(Path("reconstructed/summary.json").read_text())
print(f"rendered {summary['psnr_db']:.1f} dB, nearest image {summary['nearest.psnr_db']:.1f} dB")

# %% [markdown]
# ## Change it
#
# The ego vehicle's path two metres to the left, beside the drive as it was; below the cameras, the lidar.

# %% language="bash"
# foredrive render reconstructed --shift-left 2 --cameras pcam_f0 --rate-hz 2 --out shifted.webp

# %%
Image("shifted.webp")

# %% [markdown]
# ## Put a car in the way
#
# `--threat stationary` takes the best observed car of the scene and puts it where the ego vehicle will be in
# four seconds. Two agents meet it. `log` drives on as recorded. `lidar-corridor` follows the recorded path
# too, but stops if the rendered lidar sees something in it. The safety score is that of NeuroNCAP: 5 for a
# drive without a collision, less the faster the impact.

# %% language="bash"
# foredrive drive --in reconstructed --agent log --threat stationary --out as_recorded
# foredrive drive --in reconstructed --agent lidar-corridor --threat stationary --out with_lidar

# %%
(film,) = Path("with_lidar/videos").glob("*.webp")
Image(film)

# %% [markdown]
# ## Look around
#
# `foredrive view reconstructed` opens the scene in the browser: move the camera and the time, drag road users
# that moved, remove and add some. `reconstructed/static.ply` opens in other viewers of 3-D Gaussians.
#
# ## Then
#
# [Reconstruction](../reconstruction.md) says how well it works, and what for.
# [Safety tests](../safety-tests.md) has whole sets of such threats, planners and renderers of other
# programs, and NAVSIM's scores of single plans.
