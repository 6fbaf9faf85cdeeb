# %% [markdown]
# # Judge a plan under five protocols
#
# Five papers report "L2" and "collisions" of plans on nuScenes, and mean five different things. Here one
# plan is judged under all of them. It is that of the NeMo that comes with the package, in a town that it
# was not trained on.
#
# ## A drive and a model

# %% language="bash"
# foredrive record --town Town05 --seconds 12 --rate 2 --seed 3 --out data

# %%
from pathlib import Path

from foredrive.data import ClipDataset, collate, find_logs
from foredrive.runs import load_agent, open_run
from foredrive.runs.shipped import run_folder

run = open_run(run_folder(Path("embedded:nemo_town")))
agent = load_agent(run)
clips = ClipDataset(find_logs(Path("data/logs/town_test")), run.recipe.clips, cache_dir=None)
example = collate([clips[6]])
plan = agent.act(example.clip.observed())  # six waypoints over 3 s, in the ego frame at now
plan.xy[0, 0].round(decimals=2)

# %% [markdown]
# ## One plan, five scores
#
# Each protocol is a record of its choices.

# %%
from foredrive.tasks.planning.protocols import PROTOCOLS

for name, protocol in PROTOCOLS.items():
    cells = f"cells of {protocol.grid.cell_m} m" if protocol.grid else "exact polygons"
    print(
        f"{name:12} L2 {protocol.l2:5} collision {protocol.collision:5} heading {protocol.heading:5} {cells}"
    )

# %% [markdown]
# The scores of the same plan at 1, 2 and 3 s. The driven path and the boxes are the same in each row; only
# the way of counting differs.

# %%
from foredrive.tasks.planning.obstacles import future_obstacles
from foredrive.tasks.planning.protocols import STEP_S, STEPS
from foredrive.tasks.planning.scores import score_plan

driven, obstacles = example.clip.future, future_obstacles(example.clip, STEPS, STEP_S)
for protocol in PROTOCOLS.values():
    scores = score_plan(plan, driven, obstacles, protocol)
    l2, collision = scores.l2_m[0].tolist(), scores.collision[0].tolist()
    print(f"{protocol.title:12} L2 " + " ".join(f"{value:5.2f}" for value in l2), "m   collision", collision)

# %% [markdown]
# UniAD takes the distance at each time; the others average over all steps up to it. A plan that drifts off
# steadily has about half the L2 under them.
#
# ## A whole evaluation
#
# `foredrive evaluate` does this for all clips, and for the baselines that a plan has to be compared with.

# %% language="bash"
# foredrive evaluate embedded:nemo_town --logs data/logs/town_test --out runs/five

# %% [markdown]
# Twelve seconds of one drive say little about a model; they show what is counted.
# [Protocols](../protocols.md) lists the choices, and [claims](../claims.md) has the figures of whole
# studies.
