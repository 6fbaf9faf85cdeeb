#!/usr/bin/env bash
# PyTorch 2.13.0: the device "meta" is used to try shapes without memory, and refuses a tensor of the CPU beside
# one of its own in some operations only. A program whose layers or indices lie on the wrong device passes there
# and fails on a GPU.
#
# Seen: add, cat, where and layer_norm raise; matmul, linear, conv2d, gather, index_select, an index into a
# tensor of the CPU and embedding pass.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy
"$folder/venv/bin/python" - <<'PY'
import torch
import torch.nn.functional as F

meta, host = torch.ones(3, 4, device="meta"), torch.ones(3, 4)
rows = torch.zeros(2, dtype=torch.int64)
cases = {
    "add": lambda: meta + host,
    "matmul": lambda: meta @ host.T,
    "cat": lambda: torch.cat([meta, host]),
    "where": lambda: torch.where(meta > 0, meta, host),
    "linear": lambda: F.linear(meta, host),
    "conv2d": lambda: F.conv2d(meta[None, None], host[None, None]),
    "gather": lambda: meta.gather(0, rows[None]),
    "index_select": lambda: meta.index_select(0, rows),
    "index into the CPU": lambda: host[rows.to("meta")],
    "layer_norm": lambda: F.layer_norm(meta, (4,), host[0], host[0]),
    "embedding": lambda: F.embedding(rows.to("meta"), host),
}
passes = {}
for name, case in cases.items():
    try:
        case()
        passes[name] = True
    except (RuntimeError, NotImplementedError):
        passes[name] = False
print(torch.__version__, passes)
refused = {"add", "cat", "where", "layer_norm"}
assert {name for name, passed in passes.items() if not passed} == refused
PY
