# %% [markdown]
# # Train and look into a world model
#
# A world model predicts the scene around the vehicle, now and in the next second, from camera images. Here a
# small NeMo learns for about a minute. Then its parts are called one by one, and it is compared with the
# NeMo that comes with the package, which is the same kind of model after thirty minutes on more drives.
#
# ## A drive to learn from, and one to be judged on

# %% language="bash"
# foredrive record --town Town01 --seconds 40 --rate 2 --seed 1 --out data
# foredrive record --town Town05 --seconds 8 --rate 2 --seed 7 --out data

# %% [markdown]
# ## Train
#
# A recipe has every number of a run; as a file it can be changed and shared. Here both stages get few steps.
# The first stage learns occupancy and images from the logs alone, the second to plan as the expert drove.

# %%
from pathlib import Path

from foredrive.engine.config import save_recipe
from foredrive.runs.recipes.known import find_recipe

few = ["pretrain.schedule.steps=150", "pretrain.schedule.warmup_steps=15", "finetune.schedule.steps=30"]
save_recipe(find_recipe("nemo_tiny", few), Path("few_steps.yaml"))

# %% language="bash"
# foredrive train few_steps.yaml --logs data/logs/town_train --out runs/tiny

# %% [markdown]
# Each stage writes its losses, one line of JSON for each step.

# %%
import matplotlib.pyplot as plt
import numpy as np

from foredrive.engine.metrics_log import read_metrics

lines = read_metrics(Path("runs/tiny/pretrain/metrics.jsonl"))
for name in ("occ", "l1"):  # of occupancy, and of rendered images
    values = np.array([line[name] for line in lines])
    plt.plot(np.convolve(values / values[0], np.ones(10) / 10, "valid"), label=name)
plt.xlabel("step")
plt.ylabel("loss, relative to the first step")
plt.legend()
plt.show()

# %% [markdown]
# ## Observe, imagine, decode
#
# `observe` turns a clip into a belief: a volume of features around the vehicle. `imagine` moves it into the
# future. `decode` reads occupancy off it. The clip is cut at now first; a model refuses one that shows more.

# %%
from foredrive.data import ClipDataset, collate, find_logs
from foredrive.runs import load_agent, open_run

run = open_run(Path("runs/tiny"))
world = load_agent(run).world_model
clips = ClipDataset(find_logs(Path("data/logs/town_test")), run.recipe.clips, cache_dir=None)
example = collate([clips[len(clips) // 2]])
belief = world.observe(example.clip.observed())
futures = world.imagine(belief, steps=2)
print("volume", tuple(belief.volume.shape), "of which", len(futures), "futures were imagined")

# %% [markdown]
# ## Is it right?
#
# Occupancy is judged on voxels that a lidar beam has crossed or hit; what nobody has seen is not counted. The
# intersection over union above the ground says most, because nearly all of the ground is easy.

# %%
import torch

now = example.clip.now
spec, labels = run.recipe.clips.voxels, example.occupancy
height_m = spec.lower_m[2] + spec.voxel_m * (torch.arange(spec.shape_zyx[0]) + 0.5)


def iou_above_ground(logit, step):
    """The IoU of voxels more than 0.4 m above the ground, some key frames after now."""
    known = labels.known[0, now + step] & (height_m > 0.4)[:, None, None]
    truth = labels.values[0, now + step, 0] > 0.5
    hit, either = (logit[0] > 0) & truth & known, ((logit[0] > 0) | truth) & known
    return (hit.sum() / either.sum()).item()


with torch.no_grad():
    decoded = [world.decode(each) for each in (belief, *futures)]
for step, each in enumerate(decoded):
    print(f"in {0.5 * step:.1f} s: IoU {iou_above_ground(each.occupancy_logit, step):.3f}")

# %% [markdown]
# ## The model that comes along
#
# The same calls, with other weights.

# %%
from foredrive.runs.shipped import run_folder

shipped_run = open_run(run_folder(Path("embedded:nemo_town")))
shipped = load_agent(shipped_run).world_model
its_clips = ClipDataset(find_logs(Path("data/logs/town_test")), shipped_run.recipe.clips, cache_dir=None)
its_example = collate([its_clips[len(its_clips) // 2]])
with torch.no_grad():
    seen = shipped.decode(shipped.observe(its_example.clip.observed())).occupancy_logit[0] > 0

# %%
from foredrive.view.voxel_drawing import draw_voxels

its_labels = its_example.occupancy
truth = (its_labels.values[0, its_example.clip.now, 0] > 0.5) & its_labels.known[0, its_example.clip.now]
shown = {
    "after about a minute": (decoded[0].occupancy_logit[0] > 0, spec),
    "the one that comes along": (seen, its_labels.spec),
    "labels of the lidar": (truth, its_labels.spec),
}
figure, axes = plt.subplots(1, 3, figsize=(15, 3.4), layout="constrained")
for axis, (title, (occupied, grid)) in zip(axes, shown.items(), strict=True):
    axis.imshow(draw_voxels(occupied, grid, (360, 560)))
    axis.set_title(title)
    axis.set_axis_off()
plt.show()

# %% [markdown]
# ## A film of what it imagines
#
# `foredrive imagine` does this over a whole log, beside what was recorded.

# %% language="bash"
# foredrive imagine embedded:nemo_town data/logs/town_test --seconds 1 --moments 4 --out futures.webp

# %%
from IPython.display import Image

Image("futures.webp")

# %% [markdown]
# ## Then
#
# `foredrive evaluate runs/tiny --logs data/logs/town_test` writes every figure with its baselines;
# `foredrive view LOG --run runs/tiny` shows the volume in the browser ([look into a
# model](../how-to/view.md)). [NeMo](../nemo.md) says what the parts are, and what a longer training gives.
