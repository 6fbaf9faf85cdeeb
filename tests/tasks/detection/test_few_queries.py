"""The decoder's layer for few queries, beside torch's own."""

import torch
from torch import nn

from foredrive.heads.few_queries import FewQueriesDecoderLayer, attend_few


def test_layer_and_gradients_are_those_of_torch() -> None:
    torch.manual_seed(0)
    theirs = nn.TransformerDecoderLayer(16, 4, 32, dropout=0.0, batch_first=True, norm_first=True)
    own = FewQueriesDecoderLayer(16, 4, 32, dropout=0.0)
    for parameter in theirs.parameters():
        nn.init.normal_(parameter, std=0.3)  # biases start at zero and would hide mistakes
    own.load_state_dict(theirs.state_dict())
    query, memory = torch.randn(2, 3, 16), torch.randn(2, 50, 16)
    found = []
    for layer in (own, theirs):
        inputs = [tensor.clone().requires_grad_() for tensor in (query, memory)]
        out = layer(*inputs)
        out.square().sum().backward()
        gradients = {name: parameter.grad for name, parameter in layer.named_parameters()}
        found.append((out, *(tensor.grad for tensor in inputs), gradients))
    torch.testing.assert_close(found[0], found[1], rtol=2e-5, atol=2e-5)


def test_dropout_thins_the_weights() -> None:
    """Averaged over many draws the output is that without dropout: each draw is scaled up."""
    torch.manual_seed(0)
    attention = nn.MultiheadAttention(8, 2, dropout=0.5, batch_first=True)
    nn.init.normal_(attention.in_proj_bias)
    query, memory = torch.randn(1, 1, 8), torch.randn(1, 6, 8)
    with torch.no_grad():
        drawn = attend_few(attention, query.expand(4000, -1, -1), memory.expand(4000, -1, -1))
        attention.eval()
        torch.testing.assert_close(drawn.mean(0), attend_few(attention, query, memory)[0], rtol=0, atol=0.05)
    assert float(drawn.std(0).max()) > 0.1
