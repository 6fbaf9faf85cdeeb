#!/usr/bin/env bash
# Ray 2.56.0: an actor that has died goes back into ray.util.ActorPool as a free one. It fails at once, so it is
# free again before the others, and takes most of the work that is left.
#
# Seen: 40 short tasks on two actors, one of which ends while it works on the fourth: most of the 40 fail, though
# one actor is alive to the end.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ray==2.56.0
"$folder/venv/bin/python" - <<'PY'
import os
import time

import ray
from ray.util import ActorPool

ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)


@ray.remote(num_cpus=1)
class Renderer:
    def render(self, frame):
        if frame == 3:
            os._exit(1)  # as a process that the system ends
        time.sleep(0.05)
        return frame


pool = ActorPool([Renderer.remote() for _ in range(2)])
for frame in range(40):
    pool.submit(lambda actor, value: actor.render.remote(value), frame)
done, failed = [], 0
while pool.has_next():
    try:
        done.append(pool.get_next_unordered())
    except ray.exceptions.ActorDiedError:
        failed += 1
print(ray.__version__, f"{len(done)} done, {failed} failed")
assert len(done) + failed == 40
assert failed > 20
PY
