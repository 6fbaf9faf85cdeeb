#!/usr/bin/env bash
# PyTorch 2.13.0 (CPU): a fused Adam reads its moments in the order of the parameter's memory, whatever their
# strides. Moments that were saved row by row, as safetensors saves them, and loaded for a parameter in
# channels-last order are taken for those of other weights. The step is wrong, without an error. The same
# optimizer without `fused=True` goes on as if it had not been interrupted.
#
# Seen: largest difference of a weight after the next step, at a learning rate of 0.1:
#   not fused 0.0, fused with moments in the parameter's order 0.0 (to 1e-6), fused with moments by rows 0.16
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check torch==2.13.0 numpy
"$folder/venv/bin/python" - <<'PY'
import copy

import torch


def weight_after_a_resumed_step(fused: bool, by_rows: bool) -> torch.Tensor:
    torch.manual_seed(0)
    weight = torch.nn.Parameter(torch.randn(8, 4, 3, 3).to(memory_format=torch.channels_last))
    gradients = torch.randn(2, 8, 4, 3, 3)
    first = torch.optim.Adam([weight], lr=0.1, fused=fused)
    weight.grad = gradients[0].to(memory_format=torch.channels_last)
    first.step()
    saved = copy.deepcopy(first.state_dict())
    if by_rows:
        moments = saved["state"][0]
        moments["exp_avg"] = moments["exp_avg"].contiguous()
        moments["exp_avg_sq"] = moments["exp_avg_sq"].contiguous()
    resumed = torch.optim.Adam([weight], lr=0.1, fused=fused)
    resumed.load_state_dict(saved)
    weight.grad = gradients[1].to(memory_format=torch.channels_last)
    resumed.step()
    return weight.detach()


expected = weight_after_a_resumed_step(fused=False, by_rows=False)
differences = {
    (fused, by_rows): float((weight_after_a_resumed_step(fused, by_rows) - expected).abs().max())
    for fused in (False, True)
    for by_rows in (False, True)
}
print(torch.__version__, differences)
assert differences[False, True] == 0
assert differences[True, False] < 1e-5
assert differences[True, True] > 0.05, "fused Adam heeds strides now"
PY
