# %% [markdown]
# # Find failures by asking
#
# Where does a model fail, and what do these moments have in common? Here the moments of four drives are
# scored by what a world model misses in them. Then they are searched by text, by this score, and by both.
# The hits are a list of clips to train on.
#
# ## Drives, by day and by night

# %% language="bash"
# foredrive record --town Town05 --seeds 2 --conditions clear night --seconds 8 --rate 2 --out data

# %% [markdown]
# ## What a model misses
#
# The NeMo that comes with the package predicts occupancy. A moment's score is the number of occupied voxels
# more than half a metre above the ground that it does not predict. A line of JSON for each moment goes to a
# file.

# %%
import json
from pathlib import Path

from foredrive.data import ClipDataset, collate, find_logs
from foredrive.runs import load_agent, open_run
from foredrive.runs.shipped import run_folder

run = open_run(run_folder(Path("embedded:nemo_town")))
model = load_agent(run).world_model
clips = ClipDataset(find_logs(Path("data/logs/town_test")), run.recipe.clips, cache_dir=None)
now, rise = run.recipe.clips.past_frames, 2  # frame of now; layers of voxels from 0.5 m above the ground on

with open("scores.jsonl", "w") as file:
    for n in range(len(clips)):
        example = collate([clips[n]])
        predicted = model.decode(model.observe(example.clip.observed())).occupancy_logit > 0
        labels = example.occupancy
        occupied = labels.known[:, now] & (labels.values[:, now, 0] > 0.5)
        missed = (occupied & ~predicted)[:, rise:].sum().item()
        file.write(json.dumps({"frame": example.key[0], "missed": missed}) + "\n")

print(Path("scores.jsonl").read_text()[:300])

# %% [markdown]
# ## An index of the drives, with the scores

# %% language="bash"
# foredrive search index data/logs/town_test --scores scores.jsonl --index index

# %% [markdown]
# ## Ask
#
# First by text alone:

# %% language="bash"
# foredrive search "a street at night" --index index --view all --top 4

# %% [markdown]
# Then by the score alone: the moments in which most is missed.

# %% language="bash"
# foredrive search --by score_missed --index index --view all --top 4

# %% [markdown]
# And by both. The sheet shows the hits; the list of clips, here under a condition on what the log knows,
# holds what `train`, `evaluate` and `search` take in place of logs.

# %% language="bash"
# foredrive search "cars close ahead" --by score_missed --mix 0.7 --index index --top 4 --out hits.png
# foredrive search --by score_missed --where "ego_speed > 1" --index index --top 4 --clips missed.json

# %%
from IPython.display import Image

Image("hits.png")

# %% [markdown]
# Four short drives say little; the same commands take a fleet's worth of logs ([search](../search.md)). For
# a detector, `foredrive score` writes such a file of scores itself ([where a detector
# fails](../search.md#where-a-detector-fails)).
